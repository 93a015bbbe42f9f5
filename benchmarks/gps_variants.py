"""The variants with which the paper of guided policy search compares it: gps.py with some of its lines changed.

    python benchmarks/gps_variants.py --case dagger --env hopper --demonstration benchmarks/plans/hopper_500.npz

Takes the flags of gps.py. --resume and --evaluate take the checkpoints of this script.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tables import ROOT
from torch import Tensor

from diffsim.planning.lbfgs import maximise
from diffsim.training import command, evaluate_checkpoint, parse

sys.path.append(str(ROOT))
import gps  # noqa: E402

LEAST = 5.0  # effective samples: half of what the policy draws


class NonGuided(gps.Search):
    """S begins without the guides; they only pretrain the policy."""

    guided = False


class Restart(NonGuided):
    """Without guides in S; the policy's samples start at any state of the guiding samples' path."""

    def starts(self, count: int, source: int) -> Tensor:
        if source < 0:
            return super().starts(count, source)
        x = torch.cat([guide.x[:-1] for guide in self.guides])
        return x[torch.randint(len(x), (count,), generator=self.rng).to(x.device)]

    def optimise(self, S: gps.Samples) -> tuple[Tensor, dict[str, float]]:
        self.student, metrics = super().optimise(S)
        return self.student, metrics

    def iterate(self, iteration: int) -> dict[str, float]:
        """Measures the proposal from the guides' start, as the others do."""
        return super().iterate(iteration) | self.metrics(self.draw(self.student))


class SingleExample(NonGuided):
    """Pretrained on the plans alone, without samples about them."""

    def pretrain(self, guiding: gps.Samples) -> Tensor:
        obs = self.system.observe(torch.stack([guide.x[:-1] for guide in self.guides]))
        return super().pretrain(guiding._replace(obs=obs, u=torch.stack([guide.u for guide in self.guides])))


class PolicyGradient(NonGuided):
    """GPOMDP (Baxter et al. 2001): reward to go minus its mean over the samples, at each time."""

    def iterate(self, iteration: int) -> dict[str, float]:
        policy = self.network
        new = self.draw(policy.theta)
        to_go = new.reward.flip(1).cumsum(1).flip(1)
        theta = policy.theta.clone().requires_grad_()
        log_pi = policy.log_prob(theta, new.obs, new.u)
        (gradient,) = torch.autograd.grad(((to_go - to_go.mean(0)) * log_pi).sum(), theta)
        policy.theta = policy.theta + 0.1 * gradient / gradient.norm().clamp(min=1e-12)
        return self.metrics(new)


class DAgger(NonGuided):
    """Ross et al. 2011: the controller's actions at the states that the policy visits join the data."""

    def pretrain(self, guiding: gps.Samples) -> Tensor:
        self.lessons = guiding.obs, guiding.u
        return super().pretrain(guiding)

    def iterate(self, iteration: int) -> dict[str, float]:
        new = self.draw(self.network.theta)
        (obs, u), labels = self.lessons, self.guides[0].mean(self.system, slice(0, new.u.shape[1]), new.x[:, :-1])
        obs, u = self.lessons = torch.cat((obs, new.obs)), torch.cat((u, labels))
        self.network.theta = self.network.fit(self.network.theta, obs, u, self.args.lbfgs_iterations)
        return self.metrics(new)


class OneStart(gps.Search):
    """Line 7 from theta* alone, not from theta* fitted to the best sample, too."""

    def optimise(self, S: gps.Samples) -> tuple[Tensor, dict[str, float]]:
        policy, objective = self.network, self.objective(S.log_mixture, S.reward / self.scale)
        iterations = self.args.lbfgs_iterations
        theta, value = maximise(lambda theta: gps.sparse(objective, policy, theta, S), policy.theta, iterations)
        return theta, {"gps/phi": value}


class Effective(gps.Search):
    """Tang and Abbeel 2010: in place of the regulariser a bound on the effective samples of each step."""

    def objective(self, mixture: Tensor, reward: Tensor) -> Callable[[Tensor], Tensor]:
        def value(log_pi: Tensor) -> Tensor:
            effective = 1 / gps.log_weights(log_pi, mixture).softmax(0).square().sum(0)
            missing = (LEAST - effective).clamp(min=0)
            return gps.phi(log_pi, mixture, reward, 0.0) - missing.square().sum()

        return value


Name = Literal[
    "unregularized", "effective", "one-start", "nonguided", "restart", "single-example", "policy-gradient", "dagger"
]
CASES: dict[Name, type[gps.Search]] = {"unregularized": gps.Search, "nonguided": NonGuided, "restart": Restart}
CASES |= {"effective": Effective, "single-example": SingleExample, "policy-gradient": PolicyGradient, "dagger": DAgger}
CASES["one-start"] = OneStart


@dataclass
class VariantArgs(gps.Args):
    """Which variant."""

    case: Name = "nonguided"
    """the variant of Figure 2, of its footnote on effective samples, or of Section 5's two starts"""

    def task_defaults(self) -> dict[str, Any]:
        bounds = {"regularizer_bounds": (0.0, 0.0)} if self.case == "unregularized" else {}
        return super().task_defaults() | {"variant": "full", "perturb": 0.0} | bounds


@command
def main(argv: Sequence[str] | None = None) -> None:
    args = parse(VariantArgs, argv)
    search = CASES[args.case]
    evaluate_checkpoint(args, search, search.evaluate) if args.evaluate else gps.train(args, search)


if __name__ == "__main__":
    main()
