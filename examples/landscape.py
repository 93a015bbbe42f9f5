"""See why SHAC's rollouts are short: the loss along one weight of a policy, over 1,000 steps and over SHAC's 32.

    python shac.py --env ant --seed 1 --iterations 500 --run-dir runs/ant
    python examples/landscape.py runs/ant

Figure 2 of the paper. Over 1,000 steps the loss is minus the reward per step up to a fall, over SHAC's 32 it is Eq. 5,
with the critic's value. Start states and noise are equal for all values of the weight, the one on which SHAC's loss
depends most. Writes landscape.csv, which marks local minima, and its picture.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

sys.path += [str(Path(__file__).resolve().parents[1] / folder) for folder in ("", "benchmarks")]
from common import CheckpointFlags, Line, Panel, checkpoint_of, plot, run  # noqa: E402
from tables import Row, grouped, numbers  # noqa: E402

import diffsim  # noqa: E402
import shac  # noqa: E402
from diffsim.training import checkpoint  # noqa: E402

STEPS, WARMUP = 1000, 100  # control steps of the long loss, and of the policy before SHAC's rollout begins
X, COLUMNS = "change of a weight", ("task", "change", "long", "rollout", "long minimum", "rollout minimum")


@dataclass
class Args(CheckpointFlags):
    trajectories: int = 64  # environments
    points: int = 61  # values of the weight, from 1 less to 1 more


def measure(args: Args, path: Path) -> list[Row]:
    """Both losses at each value of the weight."""
    state = checkpoint.load(checkpoint_of(path), "shac")
    own = shac.Args(**state["args"] | {"device": args.device})
    env = diffsim.make(own.env, args.trajectories, args.device, own.seed, own.horizon, stochastic_init=False)
    learner = shac.SHAC(own, env)
    checkpoint.restore(learner, state)

    def collect(start: tuple[Tensor, Tensor], steps: int) -> shac.Rollout:
        torch.manual_seed(own.seed)
        env.reset()
        env.set_state(*start)
        return shac.collect(env, learner.actor, learner.actor.sample_noise(steps, env.num_envs))

    def short_loss() -> Tensor:
        rollout = collect(later, own.horizon)
        return shac.actor_loss(rollout.reward, learner.next_values(rollout), rollout.done, own.gamma)

    with torch.no_grad():
        collect(first := (env.qpos.clone(), env.qvel.clone()), WARMUP)
        later = env.qpos.clone(), env.qvel.clone()
    weights = [weight for weight in learner.actor.parameters() if weight.ndim == 2]
    pairs = zip(weights, torch.autograd.grad(short_loss(), weights), strict=True)
    matrix, slope = max(pairs, key=lambda pair: pair[1].abs().max().item())
    weight, place = matrix.data.view(-1), slope.abs().argmax()
    value, changes, found = weight[place].item(), torch.linspace(-1, 1, args.points).tolist(), []
    with torch.no_grad():
        for change in changes:
            weight[place] = value + change
            rollout = collect(first, STEPS)
            alive = rollout.done.cumsum(0) - rollout.done.long() == 0
            found.append((-(rollout.reward * alive).mean().item(), short_loss().item()))
    long, short = map(list, zip(*found, strict=True))
    columns = changes, map("{:.6g}".format, long), map("{:.6g}".format, short), lowest(long), lowest(short)
    return [dict(zip(COLUMNS, (own.task, *row), strict=True)) for row in zip(*columns, strict=True)]


def lowest(y: list[float]) -> list[int]:  # 1 where y has a local minimum
    return [0, *(int(b < min(a, c)) for a, b, c in zip(y, y[1:], y[2:], strict=False)), 0]


def main(args: Args) -> None:
    for path in args.measured:
        args.replace("landscape", measure(args, path), ("task",))
    grid = list[list[Panel]]()
    for (task,), rows in grouped(args.read("landscape"), "task").items():
        long, short = ([Line(numbers(rows, "change"), numbers(rows, y), "k-")] for y in ("long", "rollout"))
        grid.append([Panel(long, f"{task}: 1,000 steps", X, "loss"), Panel(short, f"{task}: SHAC's rollout", X)])
    plot(args.picture("landscape"), grid, (4, 2.6))


if __name__ == "__main__":
    run(main, Args, __doc__)
