"""How a robot moves over the ground, as a table with a row for each body that touches it.

Duty factor and phase: Alexander (1984), The gaits of bipedal and quadrupedal animals, Int. J. Robotics Research 3(2).
"""

from collections.abc import Iterable
from itertools import islice, pairwise
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from diffsim.robot.scene import Array, Index, Scene

EPISODES = 8  # at most as many are measured
SETTLING = 1.0  # s at the start of an episode that are left out
TOUCHING = 0.03  # a body that touches the ground in a smaller share of the frames is no foot
BOUNCE = 0.05  # s; a foot that leaves the ground for no longer has not made a step


class Foot(NamedTuple):
    """A body that touches the ground. Without steps, its phase and clearance are 0."""

    duty: float  # share of the frames in which it touches the ground
    steps: float  # touch-downs per second
    phase: float  # circular mean of its touch-downs within the strides of the first foot, in [0, 1]
    clearance: float  # m between the ground and its lowest point, the most in a stride; median over strides
    slip: float  # m/s along the ground, mean over its points that touch it
    depth: float  # m of its lowest point in the ground, median over the frames of contact


def contact_bodies(scene: Scene) -> Index:
    """(ncontact,) MuJoCo's number of the body of each contact sphere."""
    return scene.mj_model.dof_bodyid[scene.contact_link + (5 if scene.floating else -1)]  # a link's last dof


def trace(scene: Scene, qpos: Array) -> tuple[Array, Array]:
    """Depth (F, nc) below and slide (F - 1, nc) along the ground of contact spheres' lowest points, m; qpos (F, nq)."""
    model, data, bodies = scene.mj_model, mujoco.MjData(scene.mj_model), contact_bodies(scene)
    # A link's frame has the axes of its body and sits at the anchor of its joint.
    centre = model.jnt_pos[model.body_jntadr[bodies] + model.body_jntnum[bodies] - 1] + scene.contact_position
    place, turn = np.empty((len(qpos), len(bodies), 3)), np.empty((len(qpos), len(bodies), 3, 3))
    for k, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        place[k], turn[k] = data.xpos[bodies], data.xmat[bodies].reshape(-1, 3, 3)
    lowest = centre - scene.contact_radius[:, None] * turn[:, :, 2]  # in the body's frame
    point = place + np.einsum("fcij,fcj->fci", turn, lowest)
    moved = place[1:] + np.einsum("fcij,fcj->fci", turn[1:], lowest[:-1]) - point[:-1]
    return scene.ground_height - point[..., 2], np.linalg.norm(moved[..., :2], axis=-1)


def measure(scene: Scene, control_dt: float, episodes: Iterable[NDArray[Any]]) -> dict[str, Foot]:
    """The feet in episodes qpos (F, nq), by name; none without contact with a plane or if all episodes are short."""
    settled = [qpos[round(SETTLING / control_dt) :] for qpos in islice(episodes, EPISODES)]
    traces = [trace(scene, qpos) for qpos in settled if len(qpos) > 1]
    if "contact" not in scene.features or scene.terrain is not None or not traces:
        return {}
    feet, first = dict[str, Foot](), list[list[int]]()
    for body in np.unique(bodies := contact_bodies(scene)):
        depths, slides = ([kind[:, bodies == body] for kind in kinds] for kinds in zip(*traces, strict=True))
        deepest = [depth.max(1) for depth in depths]
        contact = (joined := np.concatenate(deepest)) > 0
        if contact.mean() < TOUCHING:
            continue
        landings = [touch_downs(depth, control_dt) for depth in deepest]
        first = first or landings
        both = zip(first, landings, strict=True)
        turns = [np.interp(k, a, range(len(a))) for a, b in both for k in b if a and a[0] <= k < a[-1]]
        peaks = [-depth[a:b].min() for depth, ends in zip(deepest, landings, strict=True) for a, b in pairwise(ends)]
        slid = np.concatenate([s[(d[1:] > 0) & (d[:-1] > 0)] for d, s in zip(depths, slides, strict=True)])
        feet[scene.mj_model.body(body).name] = Foot(
            duty=float(contact.mean()),
            steps=sum(map(len, landings)) / (len(contact) * control_dt),
            phase=round(float(np.angle(np.exp(2j * np.pi * np.array(turns)).sum()) / (2 * np.pi)), 6) % 1,
            clearance=float(np.median(peaks or 0.0)),
            slip=float(slid.sum() / (max(len(slid), 1) * control_dt)),
            depth=float(np.median(joined[contact])),
        )
    return feet


def touch_downs(depth: Array, dt: float) -> list[int]:
    """Frames in which a foot lands after more than BOUNCE seconds in the air; depth (F,), dt in s."""
    down = np.flatnonzero(depth > 0)
    return down[np.diff(down, prepend=-1) - 1 > BOUNCE / dt + 1e-6].tolist()


def table(feet: dict[str, Foot]) -> str:
    header = f"{'gait':20}  duty  steps/s  phase  clearance (m)  slip (m/s)  depth (m)"
    row = "{:20}  {:4.2f}  {:7.2f}  {:5.2f}  {:13.3f}  {:10.2f}  {:9.3f}"
    return "\n".join([header, *(row.format(name, *foot) for name, foot in feet.items())])
