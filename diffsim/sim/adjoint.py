"""Where gradients of single environments are heavy-tailed, one bad step outweighs a whole batch.

Then the adjoint, the loss's gradient with respect to a state, is clipped in each environment on its way back in time,
as recurrent networks clip it at each step (Graves 2013, https://arxiv.org/abs/1308.0850, section 2.1; Pascanu et al.
2013, https://arxiv.org/abs/1211.5063, has the reasons), but to what is usual in the batch. By default nothing is
clipped; docs/transfer.md shows what clipping does.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def row_scales(adjoint: Tensor, factor: float) -> Tensor:
    """Scales (N, 1) in (0, 1] that bring the rows of adjoint (N, D) down to at most factor times their median norm.

    The median is the lower one of the rows that are finite and not zero: contained environments have zeros. Rows that
    are not finite keep their numbers, for the simulator to contain and count. The device is not waited for.
    """
    norm = torch.linalg.vector_norm(adjoint, dim=1, keepdim=True, dtype=torch.float64)  # squares of float32 fit in it
    usual = norm.isfinite() & (norm > 0)
    middle = ((usual.sum(0, keepdim=True) - 1) // 2).clamp(min=0)
    bound = factor * norm.where(usual, torch.inf).sort(0).values.gather(0, middle)
    return torch.where(norm.isfinite() & (norm > bound), bound / norm, 1.0).to(adjoint.dtype)


class ClipAdjoint(torch.autograd.Function):
    """qpos (N, nq) and qvel (N, nv) as they are; their gradient, as one row for each environment, is clipped."""

    @staticmethod
    def forward(ctx: Any, factor: float, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        ctx.factor = factor
        return qpos.view_as(qpos), qvel.view_as(qvel)

    @staticmethod
    def backward(ctx: Any, g_qpos: Tensor, g_qvel: Tensor) -> tuple[None, Tensor, Tensor]:
        scales = row_scales(torch.cat((g_qpos, g_qvel), dim=1), ctx.factor)
        return None, g_qpos * scales, g_qvel * scales
