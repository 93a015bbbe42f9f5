"""See what a policy learns where two actions are equally good: Figure 11 of the PFPN paper.

    python examples/bandit.py

An episode is one action, rewarded by its distance to the nearest of two peaks. PPO trains all policies by one setting.
Writes bandit.csv, the shares of actions near the peaks, and a picture of the first seed's actions.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

sys.path += [str(Path(__file__).resolve().parents[1] / folder) for folder in ("", "benchmarks")]
from common import CommonFlags, Line, Panel, plot, run  # noqa: E402

import pfpn  # noqa: E402
from diffsim.training import parse  # noqa: E402

PEAKS, NEAR = (-0.25, 0.75), 0.15
POLICIES = ("pfpn", "gmm", "gaussian")
SETTING = "--env ant --device cpu --horizon 1 --hidden 1 --minibatch-size 256 --epochs 4 --std own --entropy-coef 0 "
SETTING += "--lr 3e-3 --lr-bounds 3e-3 3e-3"
ITERATIONS = (0, 40, 150)  # of 256 actions each, after which the policy's actions are drawn
BINS = torch.linspace(-1, 1, 81)


@dataclass
class Args(CommonFlags):
    seeds: tuple[int, ...] = tuple(range(1, 21))  # of each policy; the first one's actions are drawn


class Bandit:
    """256 environments whose episodes are one action."""

    num_envs, device = 256, torch.device("cpu")
    scene, task = SimpleNamespace(nu=1), SimpleNamespace(obs_dim=1, actor_dim=None)

    def detach(self) -> Tensor:
        return torch.zeros(256, 1)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Tensor]]:
        obs, yes = torch.zeros(256, 1), torch.ones(256, dtype=torch.bool)
        distance = torch.stack([(action - peak).abs() for peak in PEAKS]).amin(0).squeeze(1)
        return obs, 1 / (distance + 0.1), yes, ~yes, {"final_obs": obs}


def learn(policy: str, seed: int) -> list[Tensor]:
    """20,000 actions of the policy after each of ITERATIONS."""
    torch.manual_seed(seed)
    bandit: Any = Bandit()
    flags = [*SETTING.split(), "--policy", policy, *(("--initial-log-std", "-1") if policy == "gaussian" else ())]
    learner, drawn = pfpn.PPO(parse(pfpn.Args, flags), bandit), list[Tensor]()
    for iteration in range(ITERATIONS[-1] + 1):
        if iteration in ITERATIONS:
            drawn.append(learner.actor(torch.zeros(20_000, 1))[0].sample().detach().squeeze(1).clamp(-1, 1))
        learner.iterate()
    return drawn


def main(args: Args) -> None:
    panels = list[Panel]()
    for policy, seed in [(policy, seed) for policy in POLICIES for seed in args.seeds if not args.draw_only]:
        drawn = learn(policy, seed)
        near = [((drawn[-1] - peak).abs() < NEAR).double().mean().item() for peak in PEAKS]
        shares = {f"near {peak}": share for peak, share in zip(PEAKS, near, strict=True)}
        both = {"both": int(min(near) > 0.1)}
        args.keep("bandit", {"policy": policy, "seed": seed} | shares | both, ("policy", "seed"))
        if seed == args.seeds[0]:
            heights = [torch.histogram(x, BINS, density=True).hist.tolist() for x in drawn]
            middle, names = ((BINS[1:] + BINS[:-1]) / 2).tolist(), [f"after {256 * n:,} actions" for n in ITERATIONS]
            lines = [Line(middle, y, f"C{k}", names[k]) for k, y in enumerate(heights)]
            panels.append(Panel(lines, policy, "action (the best: -0.25 and 0.75)", "density"))
    plot(args.picture("bandit"), [panels])


if __name__ == "__main__":
    run(main, Args, __doc__)
