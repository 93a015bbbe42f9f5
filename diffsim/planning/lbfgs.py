"""L-BFGS: maximise a deterministic function of one vector."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor


def maximise(objective: Callable[[Tensor], Tensor], theta: Tensor, iterations: int) -> tuple[Tensor, float]:
    """L-BFGS with strong Wolfe conditions, from theta (n,), of an objective ().

    Returns:
        The best theta of a finite value that it saw, and its value; if there was none, the first and minus infinity.
    """
    leaf = theta.clone().requires_grad_()
    best, best_value = theta.clone(), -math.inf
    lbfgs = torch.optim.LBFGS(
        [leaf],
        max_iter=iterations,
        max_eval=iterations * 5 // 4 + 1,
        tolerance_grad=1e-9,
        tolerance_change=1e-12,
        history_size=50,
        line_search_fn="strong_wolfe",
    )

    def closure() -> float:
        nonlocal best_value
        value = objective(leaf)
        (leaf.grad,) = torch.autograd.grad(-value, leaf)
        if not (math.isfinite(value.item()) and bool(torch.isfinite(leaf.grad).all())):
            leaf.grad.zero_()
            return 1e12
        if value.item() > best_value:
            best_value = value.item()
            best.copy_(leaf.detach())
        return -value.item()

    lbfgs.step(closure)
    return best, best_value
