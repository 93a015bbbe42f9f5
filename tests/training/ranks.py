"""One of several ranks, which trains scripts in turn; test_distributed.py has torchrun start them.

In SHAC's case each rank takes its share of the noise and the start states that one process alone would draw.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from weakref import WeakKeyDictionary

import sapo
import torch
from torch import Tensor

import bptt
import ppo_baseline
import rpo
import shac
from diffsim.env import DiffEnv
from diffsim.training import Learner, Run, checkpoint, distributed

streams = WeakKeyDictionary[object, torch.Generator]()
runs: list[tuple[Run, Learner]] = []


def stream(owner: object) -> torch.Generator:
    return streams.setdefault(owner, torch.Generator().manual_seed(5))


def share(draw: Callable[[int], Tensor], num_envs: int) -> Tensor:
    rank, size = distributed.rank(), distributed.size()
    return draw(num_envs * size)[:, rank * num_envs : (rank + 1) * num_envs]


def sample_noise(actor: shac.Actor, horizon: int, num_envs: int) -> Tensor:
    std = actor.log_std.exp()
    return std * share(lambda n: torch.randn(horizon, n, len(std), generator=stream(actor)), num_envs)


def uniform(env: DiffEnv, steps: int, num_envs: int, width: int) -> Tensor:
    return share(lambda n: torch.rand(steps, n, width, generator=stream(env)), num_envs)


def restore(run: Run, learner: Learner, restore: Callable[[Run, Learner], Learner] = Run.restore) -> Learner:
    runs.append((run, learner))
    return restore(run, learner)


def main(directory: str, *setting: str) -> None:
    Run.restore = restore
    finalize, distributed.finalize = distributed.finalize, lambda: None  # the ranks stay connected until the last one
    for script in (bptt, ppo_baseline, rpo, sapo, shac):
        if script is shac:
            shac.Actor.sample_noise, DiffEnv._uniform, distributed.finalize = sample_noise, uniform, finalize
        rank, path = distributed.rank(), Path(directory) / script.__name__
        script.main([*setting, "--run-dir", str(path)])
        run, learner = runs[-1]
        modules = {name: part.state_dict() for name, part in checkpoint.parts(learner).items()}
        state = dict(modules=modules) | {k: v for k, v in run.recorder.state_dict().items() if k != "seconds"}
        torch.save(state, path.with_suffix(f".{rank}.pt"))


if __name__ == "__main__":
    main(*sys.argv[1:])
