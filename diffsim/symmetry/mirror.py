"""Left and right: how states, observations and actions look in a mirror at the plane y = 0.

A mirror keeps x and z of vectors and turns y round; of angular velocities and rotation axes, which are pseudovectors,
it keeps y and turns x and z round. Left and right joints, motors and muscles change places.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from diffsim.robot.elements import at_rest, muscles
from diffsim.robot.types import Array
from diffsim.tasks.locomotion import Locomotion

VECTOR = (1.0, -1.0, 1.0)  # of a velocity
PSEUDOVECTOR = (-1.0, 1.0, -1.0)  # of an angular velocity
QUATERNION = (1.0, *PSEUDOVECTOR)  # wxyz, of a rotation

Sides = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Reflection:
    """A permutation with signs, its own inverse: one gather and one product, differentiable."""

    index: Tensor  # (n,) int64, from where each number comes
    sign: Tensor  # (n,) 1 or -1, of each number after the permutation

    def __call__(self, x: Tensor) -> Tensor:
        """The mirror image (..., n) of x (..., n)."""
        return x.index_select(-1, self.index) * self.sign

    @staticmethod
    def of(numbers: Iterable[tuple[int, float]], device: torch.device, dtype: torch.dtype) -> Reflection:
        """Make the reflection of numbers that come each from a place and with a sign."""
        index, sign = zip(*numbers, strict=True)
        return Reflection(torch.tensor(index, device=device), torch.tensor(sign, device=device, dtype=dtype))

    @staticmethod
    def cat(parts: Sequence[Reflection]) -> Reflection:
        """Make the reflection of numbers that stand one after the other."""
        index, start = [], 0
        for part in parts:
            index.append(part.index + start)
            start += len(part.index)
        return Reflection(torch.cat(index), torch.cat([part.sign for part in parts]))


class Mirror(NamedTuple):
    """The mirror images of what a task and its robot are described by."""

    qpos: Reflection
    qvel: Reflection
    action: Reflection
    obs: Reflection

    @property
    def size(self) -> Reflection:
        """Reflect numbers that each action has and that have no direction, such as standard deviations."""
        return Reflection(self.action.index, torch.ones_like(self.action.sign))

    @property
    def value(self) -> Reflection:
        """Reflect one number that is the same in the image."""
        return Reflection.of([(0, 1.0)], self.obs.sign.device, self.obs.sign.dtype)


def mirror_of_locomotion(task: Locomotion) -> Mirror:
    """Make the mirror of an ant or a humanoid, whose observation is that of Locomotion.observe."""
    device, dtype = task.device, task.dtype
    qpos, qvel, action, joints, rates = reflections(task.load_robot().mj_model, task.sides, device, dtype)
    root = (1.0, *PSEUDOVECTOR, 1.0, *VECTOR, *PSEUDOVECTOR)  # height to angular velocity
    fixed = [Reflection.of(enumerate(signs), device, dtype) for signs in (root, (1.0, 1.0))]
    seen = (fixed[0], joints, rates, fixed[1])  # as in observe
    return Mirror(qpos, qvel, action, Reflection.cat((*seen, action) if task.observe_action else seen))


def reflections(
    model: mujoco.MjModel, sides: Sides, device: torch.device, dtype: torch.dtype
) -> tuple[Reflection, ...]:
    """Those of qpos (nq,), qvel (nv,) and action (nu,), by the names of joints and actuators; then those of the joints
    (nq - 7,) and their rates (nv - 6,) that follow a free root.

    Args:
        model: of which left and right are mirror images in the reference configuration. Checked are only the frames.
        sides: (right, left) beginnings or ends of names, which a mirror exchanges.

    Raises:
        ValueError: a joint or an actuator has no partner of the other side's name, or its axis is another one; or an
            actuator is on a fixed tendon or at a site.
    """
    qpos, qvel, action = (list[tuple[int, float]]() for _ in range(3))  # from where, sign
    frames = at_rest(model).xmat.reshape(-1, 3, 3)
    for joint, partner in enumerate(partners([model.joint(k).name for k in range(model.njnt)], sides)):
        positions, rates = _joint_signs(model, frames, joint, partner)
        qpos += enumerate(positions, int(model.jnt_qposadr[partner]))
        qvel += enumerate(rates, int(model.jnt_dofadr[partner]))
    for motor, partner in enumerate(partners([model.actuator(k).name for k in range(model.nu)], sides)):
        pulls = bool(muscles(model)[motor])
        if not pulls and model.actuator_trntype[motor] != mujoco.mjtTrn.mjTRN_JOINT:
            raise ValueError(f"actuator {model.actuator(motor).name!r} has no known mirror image: it is on no joint")
        action.append((partner, 1.0 if pulls else qvel[model.jnt_dofadr[model.actuator_trnid[motor, 0]]][1]))
    whole = [Reflection.of(numbers, device, dtype) for numbers in (qpos, qvel, action)]
    return *whole, *(Reflection(part.index[n:] - n, part.sign[n:]) for part, n in zip(whole, (7, 6), strict=False))


def _joint_signs(model: mujoco.MjModel, frames: Array, joint: int, partner: int) -> tuple[list[float], list[float]]:
    """Return the signs of the positions and of the rates of a joint; frames (nbody, 3, 3) are those of the bodies."""
    kind, ball = model.jnt_type[joint], model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return [*VECTOR, *QUATERNION], [*VECTOR, *PSEUDOVECTOR]
    own, other = (
        (np.eye(3) if ball else model.jnt_axis[[k]]) @ frames[model.jnt_bodyid[k]].T for k in (joint, partner)
    )
    mirrored = own * (VECTOR if kind == mujoco.mjtJoint.mjJNT_SLIDE else PSEUDOVECTOR)
    signs = np.round((mirrored * other).sum(1), 6).tolist()
    if any(abs(sign) != 1.0 for sign in signs):
        raise ValueError(f"the axis of joint {model.joint(partner).name!r} is not the mirror image of the other side's")
    return [1.0] * ball + signs, signs


def partners(names: Sequence[str], sides: Sides) -> list[int]:
    """Find the place of the other side's name of each; its own place if it is of no side."""
    other = {side: pair[1 - k] for pair in sides for k, side in enumerate(pair)}
    ends = "|".join(other)
    images = [re.sub(f"^({ends})|({ends})$", lambda side: other[side[0]], name, count=1) for name in names]
    for name, image in zip(names, images, strict=True):
        if names.count(image) != 1:
            raise ValueError(f"{name!r} has no mirror image: there is no {image!r}, or more than one")
    return [names.index(image) for image in images]
