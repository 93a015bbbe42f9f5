"""The time of SHAC's critic beside that of a complete iteration, whose rest is the actor's: simulation and gradient.

    python benchmarks/stages.py --env ant --iterations 40 --device cuda

Takes the flags of shac.py. Besides each iteration, it fits another critic to random values of as many samples, in a
CUDA graph of its own; progress.csv has the seconds of both, `time_iterate` and `time_fit_critic`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import torch
from tables import ROOT
from torch import Tensor

from diffsim.training import Run, script

sys.path.append(str(ROOT))
import shac  # noqa: E402


@dataclass
class Args(shac.Args):
    """No flags of its own."""


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon, adjoint_clip=args.adjoint_clip)
    learner, other = run.restore(shac.SHAC(args, env)), shac.SHAC(args, env)
    obs = torch.randn(args.horizon * env.num_envs, env.task.obs_dim, device=env.device)
    value = torch.randn(len(obs), 1, device=env.device)

    def fit_critic() -> dict[str, Tensor]:
        return {"losses/other": other.fit_critic(obs, value)}

    iterate, fit = run.capture(learner.iterate, env), run.capture(fit_critic)
    for _ in run:
        run.log(iterate() | fit())
        if run.evaluation_due:
            run.evaluate(learner.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
