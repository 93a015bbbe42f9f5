"""Feet: the kinematics of a robot's legs, in torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from diffsim.robot.types import Array

INSTANT = 1e-3  # s, over which a velocity is measured: exact to it squared, and to float32's rounding over it


class Feet(NamedTuple):
    """L legs, each a chain of J hinges from a floating root to the contact point of its foot."""

    joint: Tensor  # (L * J,) int64 column of each joint
    place: Tensor  # (L, J, 3, 1) m, of each link in the one before
    turn: Tensor  # (3, L, J, 3, 3): a link is turned by turn[0] + cos turn[1] + sin turn[2] of its joint's angle
    point: Tensor  # (L, 3, 1) m, the contact point in the last link

    @staticmethod
    def of(model: mujoco.MjModel, legs: Sequence[str], device: torch.device | str, dtype: torch.dtype) -> Feet:
        """Read the legs, given by the name of a joint of each.

        The contact point is the mean of the lowest points of the foot's spheres in the first keyframe.
        """
        mujoco.mj_resetDataKeyframe(model, data := mujoco.MjData(model), 0)
        mujoco.mj_kinematics(model, data)
        touches = (model.geom_contype > 0) & (model.geom_bodyid > 0)
        chains = dict[int, list[int]]()  # by the joint's body: bodies from the root's child to the foot
        for foot in np.unique(model.geom_bodyid[touches]):
            chain = [int(foot)]
            while model.body_parentid[chain[0]] > 1:
                chain.insert(0, int(model.body_parentid[chain[0]]))
            chains |= dict.fromkeys(chain, chain)
        bodies = np.array([chains[int(model.jnt_bodyid[model.joint(leg).id])] for leg in legs])
        lowest = data.geom_xpos - np.array([0, 0, 1]) * model.geom_size[:, :1]
        points = [
            data.xmat[foot].reshape(3, 3).T @ (lowest[touches & (model.geom_bodyid == foot)].mean(0) - data.xpos[foot])
            for foot in bodies[:, -1]
        ]

        def tensor(values: object) -> Tensor:
            return torch.tensor(np.array(values), device=device, dtype=dtype)

        turns = tensor([[_turns(model, body) for body in chain] for chain in bodies])
        joints = torch.tensor(model.body_jntadr[bodies].flatten() - 1, dtype=torch.int64, device=device)
        places = tensor(model.body_pos[bodies]).unsqueeze(-1)
        return Feet(joints, places, turns.movedim(2, 0).contiguous(), tensor(points).unsqueeze(-1))

    def places(self, joints: Tensor) -> Tensor:
        """Return the contact points (..., L, 3) [m] from the root, in its frame, at joints (..., n) [rad]."""
        angle = joints.index_select(-1, self.joint).unflatten(-1, (*self.place.shape[:2], 1, 1))
        turns = torch.addcmul(torch.addcmul(self.turn[0], angle.cos(), self.turn[1]), angle.sin(), self.turn[2])
        point = self.point
        for turn, place in reversed([*zip(turns.unbind(-3), self.place.unbind(-3), strict=True)]):
            point = place + turn @ point
        return point.squeeze(-1)

    def motion(self, joints: Tensor, rates: Tensor) -> tuple[Tensor, Tensor]:
        """Return `places`, and their velocities (..., L, 3) [m/s] in the root's frame; rates (..., n) [rad/s]."""
        there, here, then = self.places(torch.stack([joints + k * INSTANT * rates for k in (-1, 0, 1)])).unbind()
        return here, (then - there) / (2 * INSTANT)


def _turns(model: mujoco.MjModel, body: int) -> Array:
    """Return the parts (3, 3, 3) of a body with one hinge, see Feet.turn."""
    mujoco.mju_quat2Mat(frame := np.empty(9), model.body_quat[body])
    axis = model.jnt_axis[model.body_jntadr[body]]
    along, across = np.outer(axis, axis), np.cross(axis, np.eye(3)).T
    return np.stack([frame.reshape(3, 3) @ part for part in (along, np.eye(3) - along, across)])
