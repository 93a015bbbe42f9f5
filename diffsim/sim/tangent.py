"""Tangent: differences of a robot's states, whose quaternions have four numbers and three degrees of freedom."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.robot.scene import Scene


class Tangent:
    """Tangent vectors (..., 2 nv) of states x = (qpos, qvel) (..., nq + nv).

    A vector v of the body's frame moves a quaternion q to q (1, v / 2): to first order the rotation vector in which
    MuJoCo differentiates (mj_differentiatePos, mjd_transitionFD). All other numbers are their own.

    Attributes:
        quaternions: first index of each in qpos, and of its rotation vector in the degrees of freedom.
    """

    def __init__(self, scene: Scene, device: torch.device, dtype: torch.dtype) -> None:
        m, nx, nd = scene.mj_model, scene.nq + scene.nv, 2 * scene.nv
        # mjtJoint: 0 is a free joint, whose quaternion follows three coordinates, 1 a ball joint
        offsets = [(j, 3 * (m.jnt_type[j] == 0)) for j in range(m.njnt) if m.jnt_type[j] <= 1]
        self.quaternions = [(int(m.jnt_qposadr[j] + k), int(m.jnt_dofadr[j] + k)) for j, k in offsets]
        rows = [i for i in range(nx) if not any(q <= i < q + 4 for q, _ in self.quaternions)]
        columns = [i for i in range(nd) if not any(d <= i < d + 3 for _, d in self.quaternions)]
        self._flat = torch.zeros(nx, nd, dtype=dtype, device=device)
        self._flat[rows, columns] = 1.0

    def basis(self, x: Tensor) -> Tensor:
        """Return the derivative (..., nx, nd) of x along each coordinate of a tangent vector."""
        basis = self._flat.expand(*x.shape[:-1], *self._flat.shape)
        if self.quaternions:
            basis = basis.clone()
        for q, d in self.quaternions:
            w, i, j, k = (0.5 * x[..., q : q + 4]).unbind(-1)
            columns = ((-i, w, k, -j), (-j, -k, w, i), (-k, j, -i, w))  # q times each unit vector
            basis[..., q : q + 4, d : d + 3] = torch.stack([torch.stack(column, -1) for column in columns], -1)
        return basis

    def left_inverse(self, x: Tensor) -> Tensor:
        """Return the left inverse (..., nd, nx) of the basis, for quaternions of unit length."""
        inverse = self.basis(x).mT
        for _, d in self.quaternions:
            inverse[..., d : d + 3, :] *= 4.0
        return inverse
