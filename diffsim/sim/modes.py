"""Leave modes of torch that the simulator and environments do not run in."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
Result = TypeVar("Result")


def in_plain_mode(function: Callable[P, Result]) -> Callable[P, Result]:
    """Wrap a function so that it runs without torch.autocast, which would round to bfloat16, and inference_mode.

    Tensors made in inference_mode could not be trained from later. Those made instead have no gradient either.
    """

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        if torch.is_inference_mode_enabled():
            with torch.inference_mode(False), torch.no_grad():
                return call(*args, **kwargs)
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                with torch.autocast(device, enabled=False):
                    return call(*args, **kwargs)
        return function(*args, **kwargs)

    return call
