"""Adam on clipped gradients, without waiting for the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from diffsim.training import distributed


class ScaledAdam(torch.optim.Adam):
    """Fused Adam with GradScaler's hooks: it divides by grad_scale and, where found_inf is 1, changes nothing."""

    grad_scale: Tensor | None = None
    found_inf: Tensor | None = None


class ClippedAdam:
    """Adam on the gradient, averaged over the ranks and clipped to a norm; bad gradients are counted and skipped.

    The module's parameters become views of one vector, so a step is a dozen operations for any network; none of them
    waits for the device, so a step can be captured into a CUDA graph.

    Args:
        module: whose parameters that require a gradient are optimised.
        max_norm: to which gradients are clipped.
        betas: Adam's decay rates of the gradient's first and second moment.
        skip_norm: a gradient whose norm is not below this, or not a number, is skipped.

    Attributes:
        lr: () the learning rate, a tensor: a captured graph reads its present value.
        skipped: () how many gradients were skipped.
    """

    def __init__(
        self,
        module: nn.Module,
        max_norm: float,
        betas: tuple[float, float] = (0.9, 0.999),
        lr: float = 0.0,
        skip_norm: float = 1e6,
    ) -> None:
        self.parameters = [p for p in module.parameters() if p.requires_grad]
        self.vector = self._flatten(self.parameters).detach()
        self._adopt(self.vector)
        self.lr = torch.full((), lr, device=self.vector.device)
        self.adam = ScaledAdam([self.vector], self.lr, betas, fused=True, capturable=self.vector.is_cuda)
        self.max_norm, self.skip_norm = max_norm, skip_norm
        self.skipped = torch.zeros_like(self.lr)

    def _flatten(self, tensors: Sequence[Tensor]) -> Tensor:
        """All numbers in one tensor."""
        return torch.cat([tensor.flatten() for tensor in tensors])

    def _adopt(self, vector: Tensor) -> None:
        """Make the parameters views of it."""
        nn.utils.vector_to_parameters(vector, self.parameters)

    def step(self, loss: Tensor) -> Tensor:
        """One descent step; returns the gradient's norm () before clipping."""
        gradients = torch.autograd.grad(loss, self.parameters)
        self.vector.grad = distributed.average(self._flatten(gradients))
        norm = torch.linalg.vector_norm(self.vector.grad)
        bad = (~(norm < self.skip_norm)).to(norm.dtype)
        self.adam.grad_scale = (norm / self.max_norm).clamp(min=1.0)
        self.adam.found_inf = bad
        self.adam.step()
        self.skipped += bad
        return norm

    def moments(self, parameter: Tensor) -> list[Tensor]:
        """Views of a parameter's moments (numel,), first and second; none before the first step."""
        start, state = parameter.storage_offset(), self.adam.state[self.vector]
        names = (name for name in ("exp_avg", "exp_avg_sq") if name in state)
        return [state[name][start : start + parameter.numel()] for name in names]

    def state_dict(self) -> dict[str, Any]:
        """The moments, the learning rate and the count; not what the constructor is given."""
        return {"adam": self.adam.state_dict()["state"], "lr": self.lr, "skipped": self.skipped}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Raises a ValueError where moments are missing or of another shape."""
        shapes = {name: value.shape for name, value in state["adam"].get(0, {}).items()}
        shape = self.vector.shape
        if shapes and shapes != {"step": torch.Size(()), "exp_avg": shape, "exp_avg_sq": shape}:
            raise ValueError("the state of an optimizer")
        if not bool(state["skipped"].isfinite()):
            raise ValueError("the count of skipped updates")
        self.adam.load_state_dict(self.adam.state_dict() | {"state": state["adam"]})
        self.adam.param_groups[0]["lr"] = self.lr  # not a copy of it
        self.lr.copy_(state["lr"])
        self.skipped.copy_(state["skipped"])
