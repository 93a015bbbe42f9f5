"""Left and right: how states, observations and actions look in a mirror at the plane y = 0.

A mirror keeps x and z of vectors and turns y round; of angular velocities and rotation axes, which are pseudovectors,
it keeps y and turns x and z round. Left and right joints, motors and muscles change places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

VECTOR = (1.0, -1.0, 1.0)  # of a velocity
PSEUDOVECTOR = (-1.0, 1.0, -1.0)  # of an angular velocity
QUATERNION = (1.0, *PSEUDOVECTOR)  # wxyz, of a rotation

Sides = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Reflection:
    """A permutation with signs, its own inverse: one gather and one product, differentiable.

    Attributes:
        index: (n,) int64, from where each number comes.
        sign: (n,) 1 or -1, of each number after the permutation.
    """

    index: Tensor
    sign: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """The mirror image (..., n) of x (..., n)."""
        return x.index_select(-1, self.index) * self.sign

    @staticmethod
    def cat(parts: Sequence[Reflection]) -> Reflection:
        """Of numbers that stand one after the other."""
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


def signs(values: Sequence[float], device: torch.device, dtype: torch.dtype) -> Reflection:
    """Of numbers that keep their places."""
    return Reflection(torch.arange(len(values), device=device), torch.tensor(values, device=device, dtype=dtype))


def reflections(
    model: mujoco.MjModel, sides: Sides, device: torch.device, dtype: torch.dtype
) -> tuple[Reflection, Reflection, Reflection]:
    """Those of qpos (nq,), qvel (nv,) and action (nu,), by the names of joints and actuators.

    Args:
        model: of which left and right are mirror images in the reference configuration. This is not checked.
        sides: (right, left) beginnings or ends of names, which a mirror exchanges.
        device, dtype: of the tensors.

    Raises:
        ValueError: a joint or an actuator has no partner of the other side's name, or its axis is another one.
    """
    qpos, qvel, action = (np.zeros((2, n)) for n in (model.nq, model.nv, model.nu))  # rows: index, sign
    joints = [model.joint(k).name for k in range(model.njnt)]
    actuators = [model.actuator(k).name for k in range(model.nu)]
    turns = np.ones(model.njnt)  # sign of a hinge's angle or of a slide's length
    for joint, name in enumerate(joints):
        partner = joints.index(_image(name, joints, sides))
        positions, rates = _joint_signs(model, joint, partner)
        turns[joint] = rates[0]
        for table, address, values in ((qpos, model.jnt_qposadr, positions), (qvel, model.jnt_dofadr, rates)):
            place = slice(address[partner], address[partner] + len(values))
            table[:, place] = np.arange(address[joint], address[joint] + len(values)), values
    for k, name in enumerate(actuators):
        pulls = model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_TENDON
        sign = 1.0 if pulls else turns[model.actuator_trnid[k, 0]]
        action[:, actuators.index(_image(name, actuators, sides))] = k, sign
    tensors = ((torch.tensor(index).long(), torch.tensor(sign)) for index, sign in (qpos, qvel, action))
    first, second, third = (Reflection(index.to(device), sign.to(device, dtype)) for index, sign in tensors)
    return first, second, third


def _joint_signs(model: mujoco.MjModel, joint: int, partner: int) -> tuple[Sequence[float], Sequence[float]]:
    """Of the positions and of the rates of a joint."""
    kind = model.jnt_type[joint]
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return (*VECTOR, *QUATERNION), (*VECTOR, *PSEUDOVECTOR)
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        return QUATERNION, PSEUDOVECTOR
    mirrored = model.jnt_axis[joint] * (VECTOR if kind == mujoco.mjtJoint.mjJNT_SLIDE else PSEUDOVECTOR)
    sign = float(np.round(mirrored @ model.jnt_axis[partner], 6))
    if abs(sign) != 1.0:
        raise ValueError(f"the axis of joint {model.joint(partner).name!r} is no mirror image of the other side's")
    return (sign,), (sign,)


def _image(name: str, names: Sequence[str], sides: Sides) -> str:
    """The name on the other side, or the same one if it is of no side."""
    image = name
    for pair in sides:
        for side, other in (pair, pair[::-1]):
            if image == name and name.startswith(side):
                image = other + name.removeprefix(side)
            elif image == name and name.endswith(side):
                image = name.removesuffix(side) + other
    if image not in names:
        raise ValueError(f"{name!r} has no mirror image: there is no {image!r}")
    return image
