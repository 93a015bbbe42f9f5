"""What a person would say of a motion: which feet touch the ground when, how fast it is, what it costs.

Duty factor and relative phase are those of Alexander (1984, The gaits of bipedal and quadrupedal animals, Int. J.
Robotics Research 3(2)): a foot's duty factor is the share of the time in which it is on the ground, its relative phase
the time of its touch-down after that of the first foot, as a share of the stride.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.constants import servos
from diffsim.robot.scene import Array, Index, Scene

Flags = NDArray[np.bool_]
Frames = NDArray[np.intp]
Rows = NDArray[np.floating[Any]]
Episodes = Iterable[tuple[Rows, Rows]]

EPISODES = 8  # how many are looked at
SETTLING = 1.0  # s at the start of an episode that are left out
TOUCHING = 0.03  # a body that touches the ground in a smaller share of the frames is no foot
BOUNCE = 0.05  # s; a foot that leaves the ground for no longer has not made a step
# Where the words of `Gait.verdict` change
ONE_LEGGED = 0.9  # share of the touch-downs
EVEN = 0.4  # each foot's share of the touch-downs of two legs in turn, at least
STEADY = 0.8  # steadiness of a phase
IN_TURN, TOGETHER = 0.15, 0.1  # how far phases may be from 0.5 of legs in turn, from 0 of legs that land together
NUMBERS = {2: "two", 3: "three", 4: "four", 6: "six", 8: "eight"}


@dataclass(frozen=True)
class Foot:
    """The bodies of one leg that touch the ground, toes and heel together. Phases are None without touch-downs."""

    name: str  # the MJCF's, of the lowest body that touches; of several toes that of the body on which they hang
    duty: float  # duty factor, share of the frames in which it touches the ground
    phase: float | None  # in [0, 1), circular mean of its touch-downs within the strides of the first foot
    steadiness: float | None  # mean resultant length of the phase: 1 if it is the same in each stride, 0 if anywhere
    share: float  # of all touch-downs of all feet
    frequency: float  # touch-downs per second, the strides of this foot

    def __str__(self) -> str:
        return self.name.replace("_", " ")


@dataclass(frozen=True)
class Gait:
    """A motion over the ground, all of it after the first second of each episode."""

    feet: tuple[Foot, ...]  # in the order of the MJCF; the first is the one that phases refer to
    trunk: float  # share of the frames in which the trunk, the body without a parent, touches the ground
    speed: float | None  # mean forward speed, m/s; None of a task that knows no way forward
    # Sum over motors and muscles of |force times mean rate over a control step|, which pays for positive and negative
    # work alike, over m g v. None if the robot does not move forward or weighs nothing.
    cost_of_transport: float | None
    peak_joint_speed: float  # rad/s, of the fastest hinge or ball joint, a mean over one control step
    max_penetration: float  # m, how far a contact sphere of the scene reaches below the ground at most
    stance_penetration: float  # m, median over the feet's frames on the ground of their deepest sphere

    @property
    def verdict(self) -> str:
        """One phrase in words: "runs on two legs in turn, right foot and left foot (phase 0.49), 2.1 strides/s"."""
        if not self.feet:
            text = "touches the ground with no foot"
        elif strides := max(foot.frequency for foot in self.feet):
            text = f"{self._steps()}, {strides:.1f} strides/s"
        else:
            text = f"keeps {self._each('{}', ' and ')} on the ground"
        return text + (f", its trunk on the ground {self.trunk:.0%} of the time" if self.trunk >= TOUCHING else "")

    def _steps(self) -> str:
        main, number = max(self.feet, key=lambda foot: foot.share), len(self.feet)
        if main.share >= ONE_LEGGED:
            return f"hops on its {main}" + (f" ({main.share:.0%} of touch-downs)" if number > 1 else "")
        legs = f"{NUMBERS.get(number, number)} legs"
        pace = "runs" if np.mean([foot.duty for foot in self.feet]) < 0.5 else "walks"
        phases = [foot.phase for foot in self.feet[1:] if foot.phase is not None and (foot.steadiness or 0) >= STEADY]
        if len(phases) < number - 1:
            return f"{pace} irregularly on {legs} ({self._each('{0} {0.share:.0%}')} of touch-downs)"
        if all(min(phase, 1 - phase) <= TOGETHER for phase in phases):
            return f"hops on {legs} together"
        if number > 2:
            return f"{pace} on {legs} (phases: {self._each('{0} {0.phase:.2f}')})"
        if abs(phases[0] - 0.5) <= IN_TURN and main.share <= 1 - EVEN:
            return f"{pace} on two legs in turn, {self._each('{}', ' and ')} (phase {phases[0]:.2f})"
        return f"{pace} unevenly on two legs, {self.feet[1]} {phases[0]:.2f} of a stride after {self.feet[0]}"

    def _each(self, form: str, joint: str = ", ") -> str:
        return joint.join(form.format(foot) for foot in self.feet)

    def __str__(self) -> str:
        duty = f"duty factor {self._each('{0} {0.duty:.2f}')}; " if self.feet else ""
        cost = "" if self.cost_of_transport is None else f"cost of transport {self.cost_of_transport:.2f}, "
        depth = f"penetration {1e3 * self.stance_penetration:.0f} mm (at most {1e3 * self.max_penetration:.0f} mm)"
        return f"{self.verdict}; {duty}{cost}peak joint speed {self.peak_joint_speed:.1f} rad/s, {depth}"


def describe(scene: Scene, control_dt: float, episodes: Episodes, forward: int | None = 0) -> Gait | None:
    """The gait of the first EPISODES episodes, each qpos (F, nq) and action (F, nu) of control steps of control_dt [s].

    Column `forward` of qpos is the way. None without contact with a plane, or if no episode lasts over a second.
    """
    start = round(SETTLING / control_dt)
    settled = [(q[start:].astype(float), u[start:].astype(float)) for q, u in islice(episodes, EPISODES)]
    settled = [(qpos, action) for qpos, action in settled if len(qpos) > 1]
    if "contact" not in scene.features or scene.terrain is not None or not settled:
        return None
    traces, distance, work = [trace(scene, qpos) for qpos, _ in settled], 0.0, 0.0
    for (qpos, action), found in zip(settled, traces, strict=True):
        force = scene.gear * action[:-1].clip(-1.0, 1.0) + scene.motor_bias
        distance += 0.0 if forward is None else float(qpos[-1, forward] - qpos[0, forward])
        work += float(np.abs(force * np.diff(found.path, axis=0)).sum())  # J
    depth = np.concatenate([found.depth for found in traces])
    limbs = _limbs(scene, depth > 0)
    stance = [np.array([found.depth[:, limb].max(1) for limb in limbs.values()]) for found in traces]
    standing = np.concatenate([feet[feet > 0] for feet in stance])
    trunk = _parents(scene.mj_model)[contact_bodies(scene)] == 0
    weight = float(scene.mass.sum() * np.linalg.norm(scene.gravity))
    priced = distance > 0 and weight > 0 and not servos(scene.mj_model).any()
    return Gait(
        feet=_feet([*limbs], [feet > 0 for feet in stance], control_dt),
        trunk=float((depth[:, trunk] > 0).any(1).mean()),
        speed=None if forward is None else distance / (control_dt * sum(len(qpos) - 1 for qpos, _ in settled)),
        cost_of_transport=work / (weight * distance) if priced else None,
        peak_joint_speed=max(found.turned.max(initial=0.0) for found in traces) / control_dt,
        max_penetration=max(float(depth.max()), 0.0),
        stance_penetration=float(np.median(standing)) if len(standing) else 0.0,
    )


class Trace(NamedTuple):
    """What MuJoCo's kinematics says of F states."""

    depth: Array  # (F, ncontact) how far each contact sphere of the scene reaches below the ground, m; negative above
    path: Array  # (F, nu) joint angle [rad], slide [m] or length of the path [m] that each motor or muscle moves
    turned: Array  # (F - 1, joints) rad by which the hinge and ball joints that do not carry the trunk turned


def trace(scene: Scene, qpos: Array) -> Trace:
    """The trace of qpos (F, nq)."""
    model, data, bodies = scene.mj_model, mujoco.MjData(scene.mj_model), contact_bodies(scene)
    # A link's frame has the axes of its body and sits at the anchor of its joint.
    centre = model.jnt_pos[model.body_jntadr[bodies] + model.body_jntnum[bodies] - 1] + scene.contact_position
    moved = np.zeros((len(qpos), scene.nv))  # from the state before, in the units of qvel times s
    height, path = np.zeros((len(qpos), scene.ncontact)), np.zeros((len(qpos), scene.nu))
    for k, q in enumerate(qpos):
        data.qpos[:] = q
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_transmission):
            stage(model, data)
        height[k] = data.xpos[bodies, 2] + (data.xmat[bodies, 6:] * centre).sum(1)
        path[k] = data.actuator_length
        mujoco.mj_differentiatePos(model, moved[k], 1.0, qpos[max(k - 1, 0)], q)
    gear = model.actuator_gear[np.arange(model.nu), np.abs(model.actuator_gear).argmax(1)]
    turns = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL))
    turns &= _parents(model)[model.jnt_bodyid] != 0
    turned = np.sqrt(np.square(moved[1:]) @ (model.dof_jntid[:, None] == np.flatnonzero(turns)))
    depth = scene.ground_height + scene.contact_radius - height
    return Trace(depth, path / np.where(gear == 0, 1.0, gear), turned)


def contact_bodies(scene: Scene) -> Index:
    """(ncontact,) MuJoCo's number of the body of each contact sphere."""
    return scene.mj_model.dof_bodyid[scene.contact_link + (5 if scene.floating else -1)]  # a link's last dof


def _parents(model: mujoco.MjModel) -> Index:
    """(nbody,) of each body; 0 of a trunk, and of what does not move."""
    return model.body_weldid[model.body_parentid]


def _limbs(scene: Scene, touching: Flags) -> dict[str, Flags]:
    """For each foot, by its name: which of the contact spheres (ncontact,) are its. touching (F, ncontact).

    Two bodies belong to one foot if one hangs on the other, or if both hang on the same body that is not the trunk.
    """
    bodies, parent = contact_bodies(scene), _parents(scene.mj_model).tolist()
    above = list[tuple[int, ...]]()  # of each body those from the trunk, which is left out, to itself
    for body in range(len(parent)):
        above.append((*above[parent[body]], body) if parent[body] else ())
    down = [b for b in np.unique(bodies).tolist() if above[b] and touching[:, bodies == b].any(1).mean() >= TOUCHING]
    limbs, names = dict[int, list[int]](), dict[str, Flags]()
    for body in down:
        top = next(other for other in above[body] if other in down)
        if above[parent[top]] and sum(parent[other] == parent[top] for other in down) > 1:
            top = parent[top]  # toes of a foot that itself does not touch
        limbs.setdefault(top, []).append(body)
    for limb in limbs.values():
        tips = [set(above[body]) for body in limb if not any(body in above[other][:-1] for other in limb)]
        lowest = max(set.intersection(*tips))  # numbers grow from the trunk down
        names[scene.mj_model.body(lowest).name or f"body {lowest}"] = np.isin(bodies, limb)
    return names


def _feet(names: Sequence[str], contacts: Sequence[Flags], dt: float) -> tuple[Foot, ...]:
    """The feet that touched the ground in contacts (feet, F) of each episode; dt s between frames."""
    landings = [[touch_downs(foot, dt) for foot in contact] for contact in contacts]
    counts = [sum(map(len, foot)) for foot in zip(*landings, strict=True)]
    frames, feet = sum(contact.shape[-1] for contact in contacts), []
    for k, (name, count) in enumerate(zip(names, counts, strict=True)):
        duty = float(sum(contact[k].sum() for contact in contacts) / frames)
        turns = np.exp(2j * np.pi * np.concatenate([_phases(episode[0], episode[k]) for episode in landings]))
        mean = turns.mean() if len(turns) else None
        phase = None if mean is None else float(round(np.angle(mean) / (2 * np.pi), 9) % 1.0)
        steadiness = None if mean is None else float(abs(mean))
        feet.append(Foot(name, duty, phase, steadiness, count / max(sum(counts), 1), count / (frames * dt)))
    return tuple(feet)


def touch_downs(contact: Flags, dt: float) -> Frames:
    """Frames in which a foot lands after more than BOUNCE seconds in the air; contact (F,), dt in s."""
    down = np.flatnonzero(contact)
    return down[np.diff(down, prepend=-1) - 1 > BOUNCE / dt + 1e-6]


def _phases(first: Frames, landings: Frames) -> Array:
    """In [0, 1), of the landings within the strides between two landings of the first foot."""
    stride = np.searchsorted(first, landings, side="right") - 1
    inside = (stride >= 0) & (stride < len(first) - 1)
    return (landings[inside] - first[stride[inside]]) / np.diff(first)[stride[inside]]
