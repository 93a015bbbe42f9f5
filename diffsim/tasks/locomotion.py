"""Locomotion: a robot with a free root runs along x, as ant and the humanoids do. Appendix A.3.4 to A.3.6."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from diffsim.tasks.base import Task

FORWARD_VELOCITY = 5  # column of the observation: v_x


def rotate(quat: Tensor, vector: Tensor) -> Tensor:
    """Rotate vector (..., 3) by the unit quaternion wxyz (..., 4): v + 2 w (u x v) + 2 u x (u x v), broadcasting."""
    w, u = quat.split((1, 3), dim=-1)
    t = 2.0 * torch.linalg.cross(u, vector)
    return torch.addcmul(vector, w, t) + torch.linalg.cross(u, t)


class Locomotion(Task):
    """qpos = (position, quaternion wxyz, joints), qvel = (world linear, body angular velocity, joint rates)."""

    start_height: ClassVar[float]  # m
    start_joints: ClassVar[tuple[float, ...]]  # rad; of a ball joint a quaternion wxyz
    joint_rates: ClassVar[int | None] = None  # as many as start_joints, unless some are ball joints
    joint_spread: ClassVar[float] = 0.4  # rad
    observe_action: ClassVar[bool] = True
    target: ClassVar[float]  # m; the robot is to face the point (target, 0)
    sides: ClassVar[tuple[tuple[str, str], ...]]  # (right, left) beginnings or ends of names, see mirror
    mirrored_by: ClassVar[str | None] = "diffsim.symmetry.mirror:mirror_of_locomotion"

    def __init__(self, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32) -> None:
        joints = len(self.start_joints)
        rates = joints if self.joint_rates is None else self.joint_rates
        # What is drawn: position, angle and axis of a turn, joints; angular and linear velocity, joint rates.
        self.start = (0.0, 0.0, self.start_height, 0.0, 0.0, 0.0, 0.0, *self.start_joints) + (0.0,) * (6 + rates)
        joint_spread = (self.joint_spread,) * joints
        self.spread = (0.2,) * 3 + (math.pi / 12,) + (1.0,) * 3 + joint_spread + (0.5,) * (6 + rates)
        super().__init__(device, dtype)
        self._drawn = (3, 1, 3, joints, 3, 3, rates)
        self._target = torch.tensor((self.target, 0.0), device=device, dtype=dtype)
        self._axes = torch.tensor(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), device=device, dtype=dtype)
        # R_v + 0.1 R_up + R_heading, the common part of Eqs. 19, 20 and 23, is linear in the observation.
        self._progress = torch.zeros(self.obs_dim, device=device, dtype=dtype)
        up = 11 + joints + rates
        self._progress[FORWARD_VELOCITY], self._progress[up], self._progress[up + 1] = 1.0, 0.1, 1.0

    def reset(self, rand: Tensor) -> tuple[Tensor, Tensor]:
        """Draw start states from rand, see Task. The root is rotated by up to 7.5 degrees about a random axis."""
        drawn = torch.addcmul(self._start, rand - 0.5, self._spread)
        position, angle, axis, joints, angular, linear, rates = drawn.split(self._drawn, dim=-1)
        w, u = torch.cos(0.5 * angle), torch.sin(0.5 * angle) * F.normalize(axis, dim=-1)
        # The benchmark draws the velocity of the body's point at the world origin; so do we, to start as it does.
        velocity = linear + torch.linalg.cross(angular, position)
        angular = rotate(torch.cat((w, -u), dim=-1), angular)  # world to body frame
        return torch.cat((position, w, u, joints), dim=-1), torch.cat((velocity, angular, rates), dim=-1)

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        """Return the observation of Tables 9 to 11, vectors in the world frame.

        height, quaternion xyzw, linear and angular velocity, joints, 0.1 joint rates, projection of the body's z axis
        on up and of its x axis on the direction to the target, action (if observed).
        """
        position, quat, joints = qpos.split((3, 4, qpos.shape[-1] - 7), dim=-1)
        velocity, angular, rates = qvel.split((3, 3, qvel.shape[-1] - 6), dim=-1)
        body = torch.cat((angular.unsqueeze(-2), self._axes.expand(*angular.shape[:-1], 2, 3)), dim=-2)
        angular, x_axis, z_axis = rotate(quat.unsqueeze(-2), body).unbind(dim=-2)
        up = z_axis[..., 2:]
        place, height = position.split((2, 1), dim=-1)
        way = self._target - place
        distance = (way.square().sum(-1, keepdim=True) + 1e-12).sqrt()
        heading = (x_axis[..., :2] * way).sum(-1, keepdim=True) / distance
        w, xyz = quat.split((1, 3), dim=-1)
        seen = (height, xyz, w, velocity, angular, joints, 0.1 * rates, up, heading)
        return torch.cat((*seen, action) if self.observe_action else seen, dim=-1)

    def progress(self, obs: Tensor) -> Tensor:
        """Return R_v + 0.1 R_up + R_heading (...) of Eqs. 19, 20 and 23."""
        return (obs * self._progress).sum(-1)
