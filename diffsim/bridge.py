"""One control step as a node of torch's graph."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

if TYPE_CHECKING:
    from diffsim.simulator import Simulator


class ControlStep(torch.autograd.Function):
    """qpos, qvel, ctrl -> qpos and qvel side by side.

    The simulator's checkpoint slot holds what backward needs; no tensor is saved.
    """

    @staticmethod
    def forward(
        ctx: Any, sim: Simulator, slot: int, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor
    ) -> torch.Tensor:
        result = sim._forward(slot, qpos, qvel, ctrl)
        ctx.sim, ctx.slot, ctx.version = sim, slot, sim._version[slot]
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_end: torch.Tensor) -> tuple[Any, ...]:
        return (None, None, *ctx.sim._backward(ctx.slot, ctx.version, g_end))
