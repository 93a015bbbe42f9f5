"""Losses of BPTT and SHAC along one weight of a policy, and norms of gradients: Figures 2 and 11 to 13 of the paper.

    python benchmarks/landscape.py runs/ant__shac__1__<time>        a run of shac.py
    python benchmarks/landscape.py runs/shac/at_50.pt runs/shac/at_200.pt --norms    gradients of several checkpoints

BPTT's loss is minus the mean reward of an episode of --horizon steps up to its end (a fallen robot gains no more),
SHAC's is Eq. 5 over a window of its length from states that the policy visits. Start states and noise are the same for
every value of the weight, on which SHAC's loss depends most. Writes landscape_<task>.csv and its picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from common import TASKS, CheckpointFlags, Line, Panel, checkpoint_of, plot, run
from tables import Row
from torch import Tensor

import diffsim
import shac
from diffsim.training import Count, checkpoint

WARMUP = 100  # control steps of the policy before SHAC's window begins
Loss = Literal["bptt", "shac"]


@dataclass
class Args(CheckpointFlags):
    horizon: Count = 1000  # control steps of BPTT's window
    trajectories: Count = 128  # environments
    points: Count = 101  # values of the weight, from 1 less to 1 more
    norms: bool = False  # only the norms of both gradients with respect to all weights


class Look:
    """A learner's policy, and both of its losses."""

    def __init__(self, args: Args, learner: shac.SHAC) -> None:
        self.learner, self.actor, task = learner, learner.actor, learner.args.env
        flags = task, args.trajectories, args.device, learner.args.seed
        horizons: dict[Loss, int] = {"bptt": args.horizon, "shac": learner.args.horizon}
        # A reset is the same for every value of the weight
        self.envs = {name: diffsim.make(*flags, steps, stochastic_init=False) for name, steps in horizons.items()}
        env = diffsim.make(*flags)
        torch.manual_seed(learner.args.seed)
        self.starts = {"bptt": (env.qpos, env.qvel)}
        with torch.no_grad():
            shac.collect(env, self.actor, torch.stack([self.actor.sample_noise(env.num_envs) for _ in range(WARMUP)]))
        self.starts["shac"] = env.qpos, env.qvel

    def loss(self, name: Loss) -> Tensor:
        """BPTT's: minus the rewards of the episodes up to their ends, per step of the horizon; SHAC's: Eq. 5."""
        env, learner = self.envs[name], self.learner
        env.reset()
        env.detach()
        env.set_state(*self.starts[name])
        torch.manual_seed(0)
        rollout = shac.collect(env, self.actor, self.actor.sample_noise(env.horizon, env.num_envs))
        if name == "shac":
            return shac.actor_loss(rollout.reward, learner.next_values(rollout), rollout.done, learner.args.gamma)
        ended = rollout.done.cumsum(0).roll(1, 0)
        ended[0] = 0
        return -rollout.reward.masked_fill(ended > 0, 0.0).mean()

    def norms(self) -> Row:
        weights = [weight for weight in self.actor.parameters() if weight.requires_grad]
        found = {}
        for name in ("shac", "bptt"):
            slopes = torch.autograd.grad(self.loss(name), weights)
            found[name] = f"{math.sqrt(sum(float(slope.double().square().sum()) for slope in slopes)):.6g}"
        return found

    def along_a_weight(self, points: int) -> list[Row]:
        """Both losses, and the slope of SHAC's, along the weight on which that depends most."""
        weights, rows = [weight for weight in self.actor.parameters() if weight.ndim == 2], list[Row]()
        sizes = [slope.abs() for slope in torch.autograd.grad(self.loss("shac"), weights)]
        steepest = max(range(len(sizes)), key=lambda k: sizes[k].max().item())
        index, weight = sizes[steepest].argmax(), weights[steepest].data.view(-1)
        value = weight[index].item()
        for step in torch.linspace(-1, 1, points):
            weight[index] = value + step
            loss = self.loss("shac")
            (slope,) = torch.autograd.grad(loss, weights[steepest])
            with torch.no_grad():
                numbers = step, self.loss("bptt"), loss, slope.view(-1)[index]
            columns = ("step", "bptt", "shac", "shac_gradient")
            rows.append({name: f"{x.item():.7g}" for name, x in zip(columns, numbers, strict=True)})
        weight[index] = value
        return rows


def measure(args: Args, path: Path) -> None:
    state = checkpoint.load(checkpoint_of(path), "shac")
    settings = replace(shac.Args(**state["args"]), device=args.device)
    learner = shac.SHAC(settings, diffsim.make(settings.env, 1, args.device))
    checkpoint.restore(learner, state)
    if args.norms:
        args.keep(
            "landscape_norms",
            {"task": settings.env, "iteration": state["iteration"]} | Look(args, learner).norms(),
            ("task", "iteration"),
        )
        return
    args.replace(f"landscape_{settings.env}", Look(args, learner).along_a_weight(args.points), ("step",))


def draw(args: Args, task: str) -> None:
    """The picture of a task; prints how well SHAC's gradient agrees with its loss."""
    rows = args.read(f"landscape_{task}")
    line = {column: np.array([float(row[column]) for row in rows]) for column in rows[0]}
    x, text, difference = line["step"], "change of one weight", np.gradient(line["shac"], line["step"])
    correlation = np.corrcoef(difference[1:-1], line["shac_gradient"][1:-1])[0, 1]
    print(f"{task}, SHAC's analytic against finite-difference gradient along one weight: correlation {correlation:.3f}")
    slopes = Line(x, difference, "-", "finite difference"), Line(x, line["shac_gradient"], "--", "analytic")
    panels = [Panel([Line(x, line[loss], "k-", width=1)], f"{loss.upper()}: loss", text) for loss in ("bptt", "shac")]
    plot(args.picture(f"landscape_{task}"), [[*panels, Panel(slopes, "SHAC: gradient", text)]], (4, 3.2))


def main(args: Args) -> None:
    for path in args.measured:
        measure(args, path)
    for task in TASKS:
        if args.csv(f"landscape_{task}").is_file():
            draw(args, task)


if __name__ == "__main__":
    run(main, Args, __doc__)
