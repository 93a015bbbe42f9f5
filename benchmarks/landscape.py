"""Losses of BPTT and SHAC along one weight of a policy, and their gradients: Figures 2, 11 and 13 of the SHAC paper.

    python benchmarks/landscape.py --env humanoid ant           train, keep six policies on the way, measure, draw
    python benchmarks/landscape.py --env ant --time-limit 500   stop training in time; the same command goes on

BPTT's loss is minus the mean reward of an episode of --horizon steps up to its end (a fallen robot gains no more),
SHAC's is Eq. 5 over a window of 32 steps from states that the policy visits. Start states and noise are the same for
every value of the weight. Writes landscape_*.csv and landscape_*.png.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from cells import Case, Runner, ScriptFlags
from common import TASKS, Line, Panel, TaskName, Tasks, plot, run
from tables import ROOT, Row, markdown
from torch import Tensor

import diffsim
import shac
from diffsim import DiffEnv
from diffsim.training import Count, checkpoint

WARMUP = 100  # control steps of the policy before SHAC's window begins
Loss = Literal["bptt", "shac"]
LOSSES: tuple[Loss, Loss] = ("bptt", "shac")


@dataclass
class Args(ScriptFlags):
    env: Tasks = ("humanoid", "ant")  # tasks
    seed: int = 1  # seed of training and start states
    # iterations of SHAC at which gradients are measured; losses: at the last
    iterations: tuple[Count, ...] = (50, 200, 500, 1000, 1500, 2000)
    horizon: Count = 1000  # control steps of BPTT's window
    trajectories: Count = 128  # environments
    points: Count = 101  # values of the weight, from 1 less to 1 more
    runs: Path = ROOT / "runs" / "landscape"  # directory of the trainings


class Look:
    """A learner's policy, and both of its losses."""

    def __init__(self, args: Args, task: TaskName, learner: shac.SHAC) -> None:
        self.learner, self.actor = learner, learner.actor
        self.envs: dict[Loss, DiffEnv] = {}
        for loss, horizon in zip(LOSSES, (args.horizon, learner.args.horizon), strict=True):
            flags = task, args.trajectories, args.device, args.seed, horizon
            self.envs[loss] = diffsim.make(*flags, stochastic_init=False)  # a reset is the same for every policy
        env = diffsim.make(task, args.trajectories, args.device, args.seed)
        torch.manual_seed(args.seed)
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

    def gradient(self, name: Loss) -> list[Tensor]:
        return list(torch.autograd.grad(self.loss(name), list(self.actor.parameters())))


def sizes(iteration: int, look: Look) -> Row:
    """Norms of both gradients, and quantiles of their entries' sizes."""
    row: dict[str, object] = {"iteration": iteration}
    for loss in LOSSES:
        gradient = torch.cat([tensor.flatten() for tensor in look.gradient(loss)]).cpu()
        finite = gradient[gradient.isfinite()].double()
        row[f"{loss}_norm"] = f"{finite.norm():.4g}"
        for q in (0.5, 0.9, 0.99, 1.0):
            row[f"{loss}_q{q:g}"] = f"{np.quantile(finite.abs(), q) if len(finite) else 0:.4g}"
        row[f"{loss}_nonfinite"] = len(gradient) - len(finite)
    return row


def along_a_weight(look: Look, points: int) -> list[Row]:
    """Both losses, and the slope of SHAC's, along the weight on which that depends most."""
    weights, rows = list(look.actor.parameters()), list[Row]()
    found = [tensor.abs().max() if tensor.ndim == 2 else -1.0 for tensor in look.gradient("shac")]
    k = max(range(len(found)), key=lambda k: float(found[k]))
    index = look.gradient("shac")[k].abs().argmax()
    weight = weights[k].data.view(-1)
    value = weight[index].item()
    for step in torch.linspace(-1, 1, points):
        weight[index] = value + step
        loss = look.loss("shac")
        (slope,) = torch.autograd.grad(loss, weights[k])
        with torch.no_grad():
            numbers = step, look.loss("bptt"), loss, slope.view(-1)[index]
        columns = ("step", "bptt", "shac", "shac_gradient")
        rows.append({name: f"{x.item():.7g}" for name, x in zip(columns, numbers, strict=True)})
    weight[index] = value
    return rows


def measure(args: Args, runner: Runner, task: TaskName) -> None:
    """Train once, stop at each of the given iterations to keep the checkpoint, and write the csv files."""
    folder = args.runs / f"{task}__{args.seed}"
    case = Case(folder, task, args.seed, "shac", ("--iterations", str(args.iterations[-1]), "--eval-every", "0"))
    looks = list[Look]()
    for k in args.iterations:
        path = folder / f"iteration_{k}.pt"
        if not path.is_file():
            if not runner.train(case, until=k):
                return
            shutil.copy(folder / "checkpoint.pt", path)
        state = checkpoint.load(path, "shac")
        settings = replace(shac.Args(**state["args"]), device=args.device)
        learner = shac.SHAC(settings, diffsim.make(task, 1, args.device))
        checkpoint.restore(learner, state)
        looks.append(Look(args, task, learner))
    args.replace(f"landscape_{task}_gradients", list(map(sizes, args.iterations, looks)), ("iteration",))
    args.replace(f"landscape_{task}_weight", along_a_weight(looks[-1], args.points), ("step",))


def draw(args: Args, task: TaskName) -> None:
    """The pictures of a task; prints the norms of both gradients, and how well SHAC's agrees with its loss."""
    rows, path = args.read(f"landscape_{task}_gradients"), args.read(f"landscape_{task}_weight")
    line = {column: np.array([float(row[column]) for row in path]) for column in path[0]}
    x, text, difference = line["step"], "change of one weight", np.gradient(line["shac"], line["step"])
    correlation = np.corrcoef(difference[1:-1], line["shac_gradient"][1:-1])[0, 1]
    print(f"{task}, SHAC's analytic against finite-difference gradient along one weight: correlation {correlation:.3f}")
    print(markdown(rows, ("iteration", *(f"{loss}_norm" for loss in LOSSES))))
    slopes = Line(x, difference, "-", "finite difference"), Line(x, line["shac_gradient"], "--", "analytic")
    panels = [Panel([Line(x, line[loss], "k-", width=1)], f"{loss.upper()}: loss", text) for loss in LOSSES]
    plot(args.picture(f"landscape_{task}_weight"), [[*panels, Panel(slopes, "SHAC: gradient", text)]], (4, 3.2))

    iterations = [float(row["iteration"]) for row in rows]
    curves, styles = list[Line](), (("q0.5", ":", "median"), ("q0.99", "--", "0.99 quantile"), ("q1", "-", "largest"))
    for (loss, colour), (quantile, style, name) in product(zip(LOSSES, ("C2", "C0"), strict=True), styles):
        values = [float(row[f"{loss}_{quantile}"]) for row in rows]
        curves.append(Line(iterations, values, colour + style, f"{loss}, {name}"))
    panel = Panel(curves, "", "iteration of SHAC", "size of the gradient's entries", log="y")
    plot(args.picture(f"landscape_{task}_gradients"), [[panel]], (6, 4))


def main(args: Args) -> None:
    runner = Runner(args)
    for task in () if args.draw_only else args.env:
        measure(args, runner, task)
    for task in TASKS:
        if args.csv(f"landscape_{task}_weight").is_file():
            draw(args, task)


if __name__ == "__main__":
    run(main, Args, __doc__)
