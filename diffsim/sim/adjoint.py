"""Clip each environment's state gradient on the way back in time.

If gradients of single environments are heavy-tailed, one bad step outweighs a whole batch. So the adjoint, the loss's
gradient with respect to a state, can be clipped at each step, as in recurrent networks (Graves 2013,
https://arxiv.org/abs/1308.0850, section 2.1; Pascanu et al. 2013, https://arxiv.org/abs/1211.5063), but to a multiple
of the batch's median. By default nothing is clipped; docs/transfer.md shows the effect.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def row_scales(adjoint: Tensor, factor: float) -> Tensor:
    """Return scales (N, 1) in (0, 1] that limit the rows of adjoint (N, D) to factor times their median norm.

    The median is the lower one of the rows that are finite and not zero: failed environments have zeros. Rows that are
    not finite keep their numbers, for the simulator to contain and count. Nothing waits for the device.
    """
    norm = torch.linalg.vector_norm(adjoint, dim=1, keepdim=True, dtype=torch.float64)  # squares of float32 fit in it
    usual = norm.isfinite() & (norm > 0)
    middle = ((usual.sum(0, keepdim=True) - 1) // 2).clamp(min=0)
    bound = factor * norm.where(usual, torch.inf).sort(0).values.gather(0, middle)
    return torch.where(norm.isfinite() & (norm > bound), bound / norm, 1.0).to(adjoint.dtype)


class ClipAdjoint(torch.autograd.Function):
    """Passes qpos (N, nq) and qvel (N, nv) on, and clips their gradient, one row for each environment."""

    @staticmethod
    def forward(ctx: Any, factor: float, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        ctx.factor = factor
        return qpos.view_as(qpos), qvel.view_as(qvel)

    @staticmethod
    def backward(ctx: Any, g_qpos: Tensor, g_qvel: Tensor) -> tuple[None, Tensor, Tensor]:
        scales = row_scales(torch.cat((g_qpos, g_qvel), dim=1), ctx.factor)
        return None, g_qpos * scales, g_qvel * scales
