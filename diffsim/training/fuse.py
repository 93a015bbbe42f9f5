"""Fuse torch's operations around the simulator, of --compile."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

from torch import nn

from diffsim.env import DiffEnv
from diffsim.training.errors import fail

Result = TypeVar("Result")
_fused = "_fused_by_diffsim"  # marks what is compiled: a learner may capture several functions


def fused(function: Callable[[], Result], learner: object, env: DiffEnv | None) -> Callable[[], Result]:
    """Return a function whose calls run the environment's step and the learner's networks by torch.compile.

    The first calls compile; UsageError where torch cannot.
    """
    for part in (env, *vars(learner).values()):
        if isinstance(part, DiffEnv | nn.Module) and not getattr(part, _fused, False):
            setattr(part, _fused, True)
            if isinstance(part, nn.Module):
                part.compile(dynamic=False)
            else:
                part.compile()

    @functools.wraps(function)
    def call() -> Result:
        try:
            return function()
        except Exception as error:
            if type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
                fail(f"--compile: torch.compile failed, train without it: {str(error).strip().splitlines()[0]}")
            raise

    return call
