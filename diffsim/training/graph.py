"""Capture a function into a CUDA graph; on the CPU there is nothing to capture."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar
from weakref import WeakSet

import torch

from diffsim.env import DiffEnv

Result = TypeVar("Result")

# Calls that run eagerly before the capture: they compile kernels, allocate optimiser state and pick algorithms.
WARMUP = 2
_captured: WeakSet[torch.cuda.CUDAGraph] = WeakSet()


def capture(
    function: Callable[[], Result], device: torch.device | str, env: DiffEnv | None = None
) -> Callable[[], Result]:
    """Make repeated calls of a function of no arguments cheap: on a GPU they replay one CUDA graph.

    The first calls run eagerly and count as calls like any other; the next one captures. The function must keep its
    state in tensors that it changes in place, must not wait for the device, and may step `env` from the start of a
    rollout to its end: the environment's state and random start states are carried from call to call. What it returns
    lives in the same memory every time, so copy what is to outlast the next call.

    If its tensors are on the CPU, the function comes back as it is.
    """
    if torch.device(device).type != "cuda":
        return function
    stream = torch.cuda.Stream(device)
    graph = torch.cuda.CUDAGraph()
    _captured.add(graph)
    if env is not None:
        graph.register_generator_state(env.generator)
    calls, result = 0, None

    def call() -> Any:
        nonlocal calls, result
        calls += 1
        if calls <= WARMUP:
            stream.wait_stream(torch.cuda.current_stream(device))
            with torch.cuda.stream(stream):
                result = function()
            torch.cuda.current_stream(device).wait_stream(stream)
            return result
        if calls == WARMUP + 1:
            torch.cuda.synchronize(device)
            start = env.pin_rollout() if env is not None else None
            with torch.cuda.graph(graph, stream=stream):
                result = function()
                if env is not None and start is not None:
                    env.write_back(start)
        graph.replay()
        return result

    return call


def release() -> None:
    """Drop what was captured; the captured functions must not be called again."""
    for graph in list(_captured):
        graph.reset()
