"""Forward kinematics in torch: where a robot's bodies are, batched and differentiable in qpos."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from torch import Tensor

FREE, HINGE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_HINGE)


def difference(a: Tensor, b: Tensor) -> Tensor:
    """The rotation vector (..., 3) [rad], in the frame of a, that turns a into b, unit quaternions wxyz (..., 4).

    It is the shorter way round, at most pi, and differentiable where a and b are equal.
    """
    (aw, au), (bw, bu) = a.split((1, 3), dim=-1), b.split((1, 3), dim=-1)
    w = aw * bw + (au * bu).sum(-1, keepdim=True)
    u = aw * bu - bw * au - torch.linalg.cross(au, bu)
    sine = (u.square().sum(-1, keepdim=True) + torch.finfo(u.dtype).eps ** 2).sqrt()
    return 2.0 * torch.atan2(sine, w.abs()) / sine * torch.where(w < 0, -u, u)


def matrix(quat: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions wxyz (..., 4)."""
    w, x, y, z = quat.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


class Kinematics:
    """Forward kinematics of a free root and, on each other body, hinges at its origin; else raises ValueError."""

    def __init__(self, model: mujoco.MjModel, device: torch.device | str, dtype: torch.dtype) -> None:
        free, others = model.jnt_type[0], model.jnt_type[1:]
        if free != FREE or any(others != HINGE) or np.any(model.jnt_pos) or not model.body_jntnum[1:].all():
            raise ValueError("forward kinematics needs a free root and hinges at the origins of the other bodies")

        def tensor(values: object) -> Tensor:
            return torch.tensor(np.array(values), device=device, dtype=dtype)

        # A hinge's rotation after its body's own (Rodrigues): A + sin B + (1 - cos) C
        eye, axes = torch.eye(3, device=device, dtype=dtype), tensor(model.jnt_axis[1:])
        cross = torch.linalg.cross(axes.unsqueeze(-2).expand(-1, 3, -1), eye.expand(len(axes), -1, -1)).mT.contiguous()
        own = matrix(tensor(model.body_quat))
        self.parents, self._count = model.body_parentid.tolist(), model.nbody
        first = [adr - 1 for adr in model.body_jntadr.tolist()]  # among the hinges
        self._hinges = [range(adr, adr + n) for adr, n in zip(first, model.body_jntnum.tolist(), strict=True)]
        at = torch.eye(3, device=device, dtype=dtype).repeat(len(axes), 1, 1)
        at[first[2:]] = own[2:]
        self._turns = at, at @ cross, at @ cross @ cross
        self._rest = tensor(model.qpos0[7:])
        self._offsets = tensor(model.body_pos)
        share = model.body_mass[1:, None] / model.body_mass[1:].sum()
        self._share, self._centres = tensor(share), tensor(model.body_ipos[1:])

    def __call__(self, qpos: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (..., B, 3) [m, world] and rotations (..., B, 3, 3) of the B bodies of qpos (..., nq)."""
        angle = (qpos[..., 7:] - self._rest)[..., None, None]
        still, sine, cosine = self._turns
        turns = (still + angle.sin() * sine + (1 - angle.cos()) * cosine).unbind(-3)
        positions, rotations = [qpos[..., :3]], [matrix(qpos[..., 3:7])]
        for body in range(2, self._count):
            parent = self.parents[body] - 1
            positions.append(positions[parent] + rotations[parent] @ self._offsets[body])
            rotation = rotations[parent]
            for hinge in self._hinges[body]:
                rotation = rotation @ turns[hinge]
            rotations.append(rotation)
        return torch.stack(positions, dim=-2), torch.stack(rotations, dim=-3)

    def centre(self, positions: Tensor, rotations: Tensor) -> Tensor:
        """The centre of mass (..., 3) of bodies at positions (..., B, 3) with rotations (..., B, 3, 3)."""
        centres = positions + (rotations @ self._centres.unsqueeze(-1)).squeeze(-1)
        return (self._share * centres).sum(-2)
