"""Adam on clipped gradients, without waiting for the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from diffsim.training import distributed
from diffsim.training.errors import fail

PLAIN: dict[str, Any] = dict(weight_decay=0.0, eps=1e-8, amsgrad=False, maximize=False)  # torch.optim.Adam's defaults


class ClippedAdam:
    """Adam on gradients clipped to a norm, which are averaged over the ranks; bad ones are counted and skipped.

    The module's parameters become views of one vector, so a step is a dozen operations for any network; none of them
    waits for the device, so a step can be captured into a CUDA graph. The update is torch's own fused kernel. It is
    called here because torch.optim.Adam costs three times its time on a CPU, and imports a compiler when it is made.

    Args:
        module: whose parameters that require a gradient are optimised.
        max_norm: to which gradients are clipped.
        betas: Adam's decay rates of the gradient's first and second moment.
        lr: initial learning rate.
        skip_norm: a gradient whose norm is not below this, or not a number, is skipped.

    Attributes:
        vector: the parameters, and `exp_avg` and `exp_avg_sq` of its shape their moments.
        step_count: () how many steps were taken, a tensor like `lr`.
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
        self.vector = self.flatten(self.parameters).detach()
        self._adopt(self.vector)
        self.exp_avg, self.exp_avg_sq = torch.zeros_like(self.vector), torch.zeros_like(self.vector)
        self.lr = torch.full((), lr, device=self.vector.device)
        self.step_count, self.skipped = torch.zeros_like(self.lr), torch.zeros_like(self.lr)
        self.betas, self.max_norm, self.skip_norm = betas, max_norm, skip_norm
        self._adam: dict[str, Any] = dict(lr=self.lr, beta1=betas[0], beta2=betas[1], **PLAIN)

    def flatten(self, tensors: Sequence[Tensor]) -> Tensor:
        """Join all numbers in one tensor."""
        return torch.cat([tensor.flatten() for tensor in tensors])

    def _adopt(self, vector: Tensor) -> None:
        """Make the parameters views of it."""
        nn.utils.vector_to_parameters(vector, self.parameters)

    def gradient(self, loss: Tensor) -> Tensor:
        """Compute the gradient of a loss in the parameters, flat like `vector`: the mean over the ranks.

        Raises ValueError if the loss has no gradient at all, as of a task that leaves torch's graph.
        """
        if not loss.requires_grad:
            fail("the loss has no gradient: observe and reward must be torch operations, without detach and no_grad")
        return self.average(self.flatten(torch.autograd.grad(loss, self.parameters)))

    def average(self, tensor: Tensor) -> Tensor:
        """Average what each rank measured on its samples over the ranks, in place."""
        return distributed.average(tensor)

    def step(self, gradient: Tensor) -> Tensor:
        """Take one descent step; returns the gradient's norm () before clipping."""
        norm = torch.linalg.vector_norm(gradient)
        good = norm < self.skip_norm
        bad = (~good).to(norm.dtype)
        self.step_count += good
        self._update(gradient, grad_scale=(norm / self.max_norm).clamp(min=1.0), found_inf=bad)
        self.skipped += bad
        return norm

    def _update(self, gradient: Tensor, **scaled: Any) -> None:
        """Apply Adam along the gradient, over `grad_scale` if given; where `found_inf` is 1, nothing changes."""
        parts = 32 if gradient.is_cuda else 1  # the kernel has a block of threads for 65,536 numbers of a tensor
        numbers = self.vector, gradient, self.exp_avg, self.exp_avg_sq
        state: Any = *(x.tensor_split(parts) for x in numbers), [], [self.step_count] * parts
        torch._fused_adam_(*state, **self._adam | scaled)

    def moments(self, parameter: Tensor) -> list[Tensor]:
        """Views of a parameter's moments (numel,), first and second."""
        start = parameter.storage_offset()
        return [moment[start : start + parameter.numel()] for moment in (self.exp_avg, self.exp_avg_sq)]

    def _state(self) -> dict[str, Tensor]:
        return {"step": self.step_count, "exp_avg": self.exp_avg, "exp_avg_sq": self.exp_avg_sq}

    def state_dict(self) -> dict[str, Any]:
        """The moments, the learning rate and the count; not what the constructor is given."""
        return {"adam": {0: self._state()}, "lr": self.lr, "skipped": self.skipped}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Raises a ValueError where moments are missing or of another shape."""
        own, saved = self._state(), state["adam"][0]
        if {name: value.shape for name, value in saved.items()} != {name: value.shape for name, value in own.items()}:
            raise ValueError("the state of an optimizer")
        for name, value in own.items():
            value.copy_(saved[name])
        self.lr.copy_(state["lr"])
        self.skipped.copy_(state["skipped"])
