"""What a person would say of a motion: which feet touch the ground when, how fast it is, what it costs.

Duty factor and relative phase are those of Alexander (1984, The gaits of bipedal and quadrupedal animals, Int. J.
Robotics Research 3(2)): a foot's duty factor is the share of the time in which it is on the ground, its relative phase
the time of its touch-down after that of the first foot, as a share of the stride.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.scene import Array, Index, Scene
from diffsim.training.evaluation import Evaluation

Flags = NDArray[np.bool_]
Frames = NDArray[np.intp]

EPISODES = 8  # that are looked at
SETTLING = 1.0  # s at the start of an episode that are left out
TOUCHING = 0.03  # share of the frames from which on a body counts as one that touches the ground
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

    Two bodies are of one foot if one hangs on the other, or both on the same body, unless that is the trunk.

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
        fallen = f", its trunk on the ground {self.trunk:.0%} of the time" if self.trunk >= TOUCHING else ""
        if not self.feet:
            return f"touches the ground with no foot{fallen}"
        if not any(foot.frequency for foot in self.feet):
            return f"keeps {' and '.join(foot.words for foot in self.feet)} on the ground{fallen}"
        return f"{self._steps()}, {max(foot.frequency for foot in self.feet):.1f} strides/s{fallen}"

    def _steps(self) -> str:
        first, *others = self.feet
        main = max(self.feet, key=lambda foot: foot.share)
        if not others:
            return f"hops on its {main.words}"
        if main.share >= ONE_LEGGED:
            return f"hops on its {main.words} ({main.share:.0%} of touch-downs)"
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
        if abs(phases[0] - 0.5) <= IN_TURN and main.share <= 1 - EVEN:
            return f"{pace} on two legs in turn, {first.words} and {others[0].words} (phase {phases[0]:.2f})"
        return f"{pace} unevenly on two legs, {others[0].words} {phases[0]:.2f} of a stride after {first.words}"

    def __str__(self) -> str:
        duty = ", ".join(f"{foot.words} {foot.duty:.2f}" for foot in self.feet)
        cost = "" if self.cost_of_transport is None else f"cost of transport {self.cost_of_transport:.2f}, "
        depth = f"penetration {1e3 * self.stance_penetration:.0f} mm (at most {1e3 * self.max_penetration:.0f} mm)"
        duties = f"duty factor {duty}; " if duty else ""
        return f"{self.verdict}; {duties}{cost}peak joint speed {self.peak_joint_speed:.1f} rad/s, {depth}"


def describe(evaluation: Evaluation) -> Gait | None:
    """The gait of an evaluation's first episodes; None without contact with a plane, or if none lasts over a second."""
    scene, dt, first = evaluation.scene, evaluation.control_dt, round(SETTLING / evaluation.control_dt)
    lengths = evaluation.lengths[:EPISODES].tolist()
    episodes = [k for k, length in enumerate(lengths) if length > first + 1]
    if "contact" not in scene.features or scene.terrain is not None or not episodes:
        return None
    model, bodies = scene.mj_model, contact_bodies(scene)
    qpos = [evaluation.qpos[first : lengths[k], k].double().cpu().numpy() for k in episodes]
    action = [evaluation.action[first : lengths[k], k].double().cpu().numpy() for k in episodes]
    motions = [trace(scene, q) for q in qpos]
    depth = np.concatenate([motion.depth for motion in motions])

    distance = float(sum(q[-1, 0] - q[0, 0] for q in qpos))
    work = sum(_work(scene, a, motion.path) for a, motion in zip(action, motions, strict=True))
    weight = float(scene.mass.sum() * np.linalg.norm(scene.gravity))
    priced = distance > 0 and weight > 0 and "hill" not in scene.features
    limbs = _limbs(model, bodies, depth > 0)
    feet = [_deepest(motion.depth, list(limbs.values())) for motion in motions]
    stance = np.concatenate(feet)
    trunk = np.isin(bodies, np.flatnonzero(_parents(model) == 0))
    return Gait(
        feet=feet_of(list(limbs), [foot > 0 for foot in feet], dt),
        trunk=float((depth[:, trunk] > 0).any(1).mean()),
        speed=distance / (dt * sum(len(q) - 1 for q in qpos)),
        cost_of_transport=work / (weight * distance) if priced else None,
        peak_joint_speed=max(_joint_turns(model, motion.moved).max(initial=0.0) for motion in motions) / dt,
        max_penetration=max(float(depth.max()), 0.0),
        stance_penetration=float(np.median(stance[stance > 0])) if (stance > 0).any() else 0.0,
    )


# From positions to contacts -------------------------------------------------------------------------------------------


class Trace(NamedTuple):
    """What MuJoCo's kinematics says of F states.

    Attributes:
        depth: (F, ncontact) how far each contact sphere of the scene reaches below the ground, m; negative above it.
        path: (F, nu) joint angle [rad], slide [m] or length of the path [m] that each motor or muscle moves.
        moved: (F - 1, nv) from each state to the next, in the units of qvel times s.
    """

    depth: Array
    path: Array
    moved: Array


def trace(scene: Scene, qpos: Array) -> Trace:
    """The trace of qpos (F, nq)."""
    model, bodies = scene.mj_model, contact_bodies(scene)
    data = mujoco.MjData(model)
    # A link's frame has the axes of its body and sits at the anchor of its joint.
    centre = model.jnt_pos[model.dof_jntid[_contact_dofs(scene)]] + scene.contact_position
    moved = np.zeros((max(len(qpos) - 1, 0), scene.nv))
    height, path = np.zeros((len(qpos), scene.ncontact)), np.zeros((len(qpos), scene.nu))
    for k, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mj_transmission(model, data)
        height[k] = data.xpos[bodies, 2] + (data.xmat[bodies, 6:] * centre).sum(1)
        path[k] = data.actuator_length
        if k:
            mujoco.mj_differentiatePos(model, moved[k - 1], 1.0, qpos[k - 1], q)
    gear = np.take_along_axis(model.actuator_gear, np.abs(model.actuator_gear).argmax(1)[:, None], 1)[:, 0]
    return Trace(scene.ground_height + scene.contact_radius - height, path / np.where(gear == 0, 1.0, gear), moved)


def _contact_dofs(scene: Scene) -> Index:
    """(ncontact,) the last degree of freedom that moves each contact sphere."""
    return scene.contact_link + (5 if scene.floating else -1)


def contact_bodies(scene: Scene) -> Index:
    """(ncontact,) MuJoCo's number of the body of each contact sphere."""
    return scene.mj_model.jnt_bodyid[scene.mj_model.dof_jntid[_contact_dofs(scene)]]


def _parents(model: mujoco.MjModel) -> Index:
    """(nbody,) of each body; 0 of a trunk, and of what does not move."""
    return model.body_weldid[model.body_parentid]


def _limbs(model: mujoco.MjModel, bodies: Index, touching: Flags) -> dict[str, Flags]:
    """Of each foot, by its name: which of the contact spheres (ncontact,) are its. touching (F, ncontact)."""
    parent = _parents(model).tolist()

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
        (*_, common) = (set(level) for level in zip(*tips, strict=False) if len(set(level)) == 1)
        names[_name(model, common.pop())] = np.isin(bodies, limb)  # of a foot with two toes the foot's
    return names


def _name(model: mujoco.MjModel, body: int) -> str:
    return model.body(body).name or f"body {body}"


def _deepest(depth: Array, limbs: Sequence[Flags]) -> Array:
    """(F, feet) depth of each foot's deepest sphere."""
    return np.array([depth[:, limb].max(1) for limb in limbs]).reshape(len(limbs), len(depth)).T


# From contacts to steps -----------------------------------------------------------------------------------------------


def feet_of(names: Sequence[str], contacts: Sequence[Flags], dt: float) -> tuple[Foot, ...]:
    """The feet of some episodes.

    Args:
        names: of the feet.
        contacts: of each episode (F, feet), in which frames a foot touches the ground.
        dt: s between two frames.
    """
    landings = [[touch_downs(foot, dt) for foot in contact.T] for contact in contacts]
    counts = np.array([[len(foot) for foot in episode] for episode in landings]).sum(0)
    frames = sum(len(contact) for contact in contacts)
    duty = sum(contact.sum(0) for contact in contacts) / frames
    feet = []
    for k, name in enumerate(names):
        mean = _mean_phase((episode[0], episode[k]) for episode in landings)
        phase, steadiness = (None, None) if mean is None else mean
        share = float(counts[k] / max(counts.sum(), 1))
        feet.append(Foot(name, float(duty[k]), phase, steadiness, share, float(counts[k] / (frames * dt))))
    return tuple(feet)


def touch_downs(contact: Flags, dt: float) -> Frames:
    """Frames in which a foot lands after more than BOUNCE seconds in the air; contact (F,), dt in s."""
    down = np.flatnonzero(contact)
    return down[np.diff(down, prepend=-1) - 1 > BOUNCE / dt + 1e-6]


def _mean_phase(pairs: Iterable[tuple[Frames, Frames]]) -> tuple[float, float] | None:
    """Circular mean in [0, 1) and its resultant length, of landings within the strides between first landings."""
    phases = []
    for first, landings in pairs:
        if len(first) < 2:
            continue
        inside = landings[(landings >= first[0]) & (landings < first[-1])]
        stride = np.searchsorted(first, inside, side="right") - 1
        phases.append((inside - first[stride]) / np.diff(first)[stride])
    all_phases = np.concatenate(phases) if phases else np.zeros(0)
    if not len(all_phases):
        return None
    mean = np.exp(2j * np.pi * all_phases).mean()
    return float(round(np.angle(mean) / (2 * np.pi), 9) % 1.0), float(abs(mean))


# From positions to speed and work -------------------------------------------------------------------------------------


def _work(scene: Scene, action: Array, path: Array) -> float:
    """J, sum of |force times displacement| over motors, muscles and steps, of action (F, nu) and path (F, nu)."""
    force = scene.gear * action[:-1].clip(-1.0, 1.0) + scene.motor_bias
    return float(np.abs(force * np.diff(path, axis=0)).sum())


def _joint_turns(model: mujoco.MjModel, moved: Array) -> Array:
    """(F - 1, joints) rad by which the hinge and ball joints that hang on the trunk turned; moved as in Trace."""
    kind = mujoco.mjtJoint
    turning = np.isin(model.jnt_type, (kind.mjJNT_HINGE, kind.mjJNT_BALL)) & (_parents(model)[model.jnt_bodyid] != 0)
    of_joint = model.dof_jntid[:, None] == np.flatnonzero(turning)
    return np.sqrt(np.square(moved) @ of_joint)
