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

from diffsim.robot.scene import Array, Index, Scene

Flags = NDArray[np.bool_]
Frames = NDArray[np.intp]
Rows = NDArray[np.floating[Any]]

EPISODES = 8  # how many are looked at
SETTLING = 1.0  # s at the start of an episode that are left out
TOUCHING = 0.03  # a body that touches the ground in a smaller share of the frames is no foot
BOUNCE = 0.05  # s; a foot that leaves the ground for no longer has not made a step

# Where the words of `Gait.verdict` change
ONE_LEGGED = 0.9  # share of the touch-downs
EVEN = 0.4  # each foot's share of the touch-downs of two legs in turn, at least
STEADY = 0.8  # steadiness of a phase
IN_TURN = 0.15  # how far the phase of two legs in turn may be from 0.5
TOGETHER = 0.1  # and that of legs that land together from 0
NUMBERS = {2: "two", 3: "three", 4: "four", 6: "six", 8: "eight"}


@dataclass(frozen=True)
class Foot:
    """One foot: the bodies of one leg that touch the ground, toes and heel together.

    Two bodies belong to one foot if one hangs on the other, or if both hang on the same body that is not the trunk.

    Attributes:
        name: the MJCF's, of the lowest body that touches; of several toes that of the body on which they hang.
        duty: duty factor, share of the frames in which it touches the ground.
        phase: in [0, 1), circular mean of its touch-downs within the strides of the first foot; None if there are none.
        steadiness: of the phase, 1 if it is the same in each stride and 0 if touch-downs are anywhere (the mean
            resultant length of circular statistics); None if there is no phase.
        share: of all touch-downs of all feet.
        frequency: touch-downs per second, the strides of this foot.
    """

    name: str
    duty: float
    phase: float | None
    steadiness: float | None
    share: float
    frequency: float

    @property
    def words(self) -> str:
        return self.name.replace("_", " ")


@dataclass(frozen=True)
class Gait:
    """A motion over the ground, all of it after the first second of each episode.

    Attributes:
        feet: in the order of the MJCF; the first is the one that phases refer to.
        trunk: share of the frames in which the trunk, the body without a parent, touches the ground.
        speed: mean forward speed, m/s.
        cost_of_transport: sum over motors and muscles of |force times rate| over m g v, which pays for positive and
            negative work alike. The rates are means over a control step, of a joint's angle or of a muscle's path. None
            if the robot does not move forward, weighs nothing, or has Hill-type muscles.
        peak_joint_speed: rad/s, the fastest hinge or ball joint; a mean over one control step.
        max_penetration: m, how far a contact sphere of the scene reaches below the ground at most.
        stance_penetration: m, median over the feet's frames on the ground of their deepest sphere.
    """

    feet: tuple[Foot, ...]
    trunk: float
    speed: float
    cost_of_transport: float | None
    peak_joint_speed: float
    max_penetration: float
    stance_penetration: float

    @property
    def verdict(self) -> str:
        """One phrase in words: "runs on two legs in turn, right foot and left foot (phase 0.49), 2.1 strides/s"."""
        if not self.feet:
            text = "touches the ground with no foot"
        elif strides := max(foot.frequency for foot in self.feet):
            text = f"{self._steps()}, {strides:.1f} strides/s"
        else:
            text = f"keeps {' and '.join(foot.words for foot in self.feet)} on the ground"
        return text + (f", its trunk on the ground {self.trunk:.0%} of the time" if self.trunk >= TOUCHING else "")

    def _steps(self) -> str:
        first, *others = self.feet
        main = max(self.feet, key=lambda foot: foot.share)
        if main.share >= ONE_LEGGED:
            return f"hops on its {main.words}" + (f" ({main.share:.0%} of touch-downs)" if others else "")
        number = NUMBERS.get(len(self.feet), str(len(self.feet)))
        pace = "runs" if np.mean([foot.duty for foot in self.feet]) < 0.5 else "walks"
        phases = [foot.phase for foot in others if foot.phase is not None and (foot.steadiness or 0) >= STEADY]
        if len(phases) < len(others):
            shares = ", ".join(f"{foot.words} {foot.share:.0%}" for foot in self.feet)
            return f"{pace} irregularly on {number} legs ({shares} of touch-downs)"
        if all(min(phase, 1 - phase) <= TOGETHER for phase in phases):
            return f"hops on {number} legs together"
        if len(phases) > 1:
            order = ", ".join(f"{foot.words} {foot.phase:.2f}" for foot in self.feet)
            return f"{pace} on {number} legs (phases: {order})"
        (phase,), (second,) = phases, others
        if abs(phase - 0.5) <= IN_TURN and main.share <= 1 - EVEN:
            return f"{pace} on two legs in turn, {first.words} and {second.words} (phase {phase:.2f})"
        return f"{pace} unevenly on two legs, {second.words} {phase:.2f} of a stride after {first.words}"

    def __str__(self) -> str:
        duties = ", ".join(f"{foot.words} {foot.duty:.2f}" for foot in self.feet)
        cost = "" if self.cost_of_transport is None else f"cost of transport {self.cost_of_transport:.2f}, "
        depth = f"penetration {1e3 * self.stance_penetration:.0f} mm (at most {1e3 * self.max_penetration:.0f} mm)"
        duty = f"duty factor {duties}; " if duties else ""
        return f"{self.verdict}; {duty}{cost}peak joint speed {self.peak_joint_speed:.1f} rad/s, {depth}"


def describe(scene: Scene, control_dt: float, episodes: Iterable[tuple[Rows, Rows]]) -> Gait | None:
    """The gait of the first EPISODES episodes; None without contact with a plane, or if none lasts over a second.

    Args:
        scene, control_dt: the robot, and s of a control step.
        episodes: qpos (F, nq) and action (F, nu) of the control steps of each.
    """
    start = round(SETTLING / control_dt)
    settled = [
        (qpos[start:].astype(np.float64), action[start:].astype(np.float64))
        for qpos, action in islice(episodes, EPISODES)
        if len(qpos) > start + 1
    ]
    if "contact" not in scene.features or scene.terrain is not None or not settled:
        return None
    motions = [trace(scene, qpos) for qpos, _ in settled]
    depth = np.concatenate([motion.depth for motion in motions])
    limbs = _limbs(scene, depth > 0)
    stance = [np.array([motion.depth[:, limb].max(1) for limb in limbs.values()]) for motion in motions]
    standing = np.concatenate([feet[feet > 0] for feet in stance])
    distance = float(sum(qpos[-1, 0] - qpos[0, 0] for qpos, _ in settled))
    work = 0.0  # J, |force times displacement|
    for (_, action), motion in zip(settled, motions, strict=True):
        force = scene.gear * action[:-1].clip(-1.0, 1.0) + scene.motor_bias
        work += float(np.abs(force * np.diff(motion.path, axis=0)).sum())
    weight = float(scene.mass.sum() * np.linalg.norm(scene.gravity))
    priced = distance > 0 and weight > 0 and "hill" not in scene.features
    trunk = _parents(scene.mj_model)[contact_bodies(scene)] == 0
    return Gait(
        feet=feet_of(list(limbs), [feet > 0 for feet in stance], control_dt),
        trunk=float((depth[:, trunk] > 0).any(1).mean()),
        speed=distance / (control_dt * sum(len(qpos) - 1 for qpos, _ in settled)),
        cost_of_transport=work / (weight * distance) if priced else None,
        peak_joint_speed=max(motion.turned.max(initial=0.0) for motion in motions) / control_dt,
        max_penetration=max(float(depth.max()), 0.0),
        stance_penetration=float(np.median(standing)) if len(standing) else 0.0,
    )


class Trace(NamedTuple):
    """What MuJoCo's kinematics says of F states.

    Attributes:
        depth: (F, ncontact) how far each contact sphere of the scene reaches below the ground, m; negative above it.
        path: (F, nu) joint angle [rad], slide [m] or length of the path [m] that each motor or muscle moves.
        turned: (F - 1, joints) rad by which the hinge and ball joints that do not carry the trunk turned.
    """

    depth: Array
    path: Array
    turned: Array


def trace(scene: Scene, qpos: Array) -> Trace:
    """The trace of qpos (F, nq)."""
    model, bodies = scene.mj_model, contact_bodies(scene)
    data = mujoco.MjData(model)
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
        if k:
            mujoco.mj_differentiatePos(model, moved[k], 1.0, qpos[k - 1], q)
    gear = np.take_along_axis(model.actuator_gear, np.abs(model.actuator_gear).argmax(1)[:, None], 1)[:, 0]
    depth = scene.ground_height + scene.contact_radius - height
    kind = mujoco.mjtJoint
    turns = np.isin(model.jnt_type, (kind.mjJNT_HINGE, kind.mjJNT_BALL)) & (_parents(model)[model.jnt_bodyid] != 0)
    turned = np.sqrt(np.square(moved[1:]) @ (model.dof_jntid[:, None] == np.flatnonzero(turns)))
    return Trace(depth, path / np.where(gear == 0, 1.0, gear), turned)


def contact_bodies(scene: Scene) -> Index:
    """(ncontact,) MuJoCo's number of the body of each contact sphere."""
    last_dof = scene.contact_link + (5 if scene.floating else -1)
    return scene.mj_model.dof_bodyid[last_dof]


def _parents(model: mujoco.MjModel) -> Index:
    """(nbody,) of each body; 0 of a trunk, and of what does not move."""
    return model.body_weldid[model.body_parentid]


def _limbs(scene: Scene, touching: Flags) -> dict[str, Flags]:
    """For each foot, by its name: which of the contact spheres (ncontact,) are its. touching (F, ncontact)."""
    bodies, parent = contact_bodies(scene), _parents(scene.mj_model).tolist()

    def path(body: int) -> tuple[int, ...]:
        """The bodies from the trunk, which is left out, to this one."""
        return (*path(parent[body]), body) if parent[body] else ()

    down = [b for b in np.unique(bodies).tolist() if touching[:, bodies == b].any(1).mean() >= TOUCHING and path(b)]
    limbs = dict[int, list[int]]()
    for body in down:
        top = next(above for above in path(body) if above in down)  # what hangs on a body that touches belongs to it
        if path(parent[top]) and sum(parent[other] == parent[top] for other in down) > 1:
            top = parent[top]  # toes of a foot that itself does not touch
        limbs.setdefault(top, []).append(body)
    names = dict[str, Flags]()
    for limb in limbs.values():
        tips = [path(body) for body in limb if not any(body in path(other)[:-1] for other in limb)]
        lowest = [level[0] for level in zip(*tips, strict=False) if len(set(level)) == 1][-1]  # that all tips share
        names[scene.mj_model.body(lowest).name or f"body {lowest}"] = np.isin(bodies, limb)
    return names


def feet_of(names: Sequence[str], contacts: Sequence[Flags], dt: float) -> tuple[Foot, ...]:
    """The feet of some episodes.

    Args:
        names: of the feet.
        contacts: of each episode (feet, F), in which frames a foot touches the ground.
        dt: s between two frames.
    """
    landings = [[touch_downs(foot, dt) for foot in contact] for contact in contacts]
    counts = np.array([[len(foot) for foot in episode] for episode in landings]).sum(0)
    frames, feet = sum(contact.shape[-1] for contact in contacts), []
    for k, name in enumerate(names):
        duty = sum(contact[k].sum() for contact in contacts) / frames
        phase, steadiness = _mean_phase([(episode[0], episode[k]) for episode in landings])
        share, frequency = counts[k] / max(counts.sum(), 1), counts[k] / (frames * dt)
        feet.append(Foot(name, float(duty), phase, steadiness, float(share), float(frequency)))
    return tuple(feet)


def touch_downs(contact: Flags, dt: float) -> Frames:
    """Frames in which a foot lands after more than BOUNCE seconds in the air; contact (F,), dt in s."""
    down = np.flatnonzero(contact)
    return down[np.diff(down, prepend=-1) - 1 > BOUNCE / dt + 1e-6]


def _mean_phase(pairs: Sequence[tuple[Frames, Frames]]) -> tuple[float, float] | tuple[None, None]:
    """Circular mean in [0, 1) and its resultant length, of landings within the strides between first landings."""
    phases = [np.zeros(0)]
    for first, landings in pairs:
        stride = np.searchsorted(first, landings, side="right") - 1
        inside = (stride >= 0) & (stride < len(first) - 1)
        stride, landings = stride[inside], landings[inside]
        phases.append((landings - first[stride]) / np.diff(first)[stride])
    turns = np.concatenate(phases)
    if not len(turns):
        return None, None
    mean = np.exp(2j * np.pi * turns).mean()
    return float(round(np.angle(mean) / (2 * np.pi), 9) % 1.0), float(abs(mean))
