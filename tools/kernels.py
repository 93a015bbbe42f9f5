"""Where the GPU's time of one SHAC iteration goes: the kernels of its CUDA graph, by torch.profiler.

python tools/kernels.py hopper                     the iteration's table
python tools/kernels.py ant --num-envs 1024        what follows the task goes to shac.py
"""

from __future__ import annotations

import itertools
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp

import torch
from torch.profiler import ProfilerActivity, profile

import diffsim
from diffsim.training import graph

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import shac  # noqa: E402

ITERATION, LAST, ROWS = 12, 14, 30  # the one that is profiled, how many there are, kernels per table
Iterate = Callable[[], dict[str, torch.Tensor]]
capture = graph.capture


def profiled(function: Iterate, device: torch.device, env: diffsim.DiffEnv | None) -> Iterate:
    """graph.capture, whose twelfth call prints a table of its kernels."""
    replay, calls = capture(function, device, env), itertools.count(1)

    def call() -> dict[str, torch.Tensor]:
        if next(calls) != ITERATION:
            return replay()
        with profile(activities=[ProfilerActivity.CUDA]) as record:
            result = replay()
            torch.cuda.synchronize()
        kernels = defaultdict[str, list[float]](list)
        for event in record.events() or ():
            if event.device_type == torch.autograd.DeviceType.CUDA:
                kernels[event.name].append(event.device_time)
        busy, count = sum(map(sum, kernels.values())), sum(map(len, kernels.values()))
        print(f"{function.__name__}: {count} kernels, {busy / 1e3:.2f} ms")
        for name, times in sorted(kernels.items(), key=lambda item: -sum(item[1]))[:ROWS]:
            print(f"{len(times):6d} x {sum(times) / len(times):8.2f} us = {sum(times) / 1e3:8.3f} ms  {name[:100]}")
        return result

    return call


if __name__ == "__main__":
    graph.capture = profiled  # type: ignore[assignment]
    shac.Run.stop_after = LAST
    stop = ["--eval-every", "0", "--quiet", "--run-dir", mkdtemp()]
    shac.main(["--env", *(sys.argv[1:] or ["hopper"]), "--device", "cuda", *stop])
