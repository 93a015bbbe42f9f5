"""Guided policy search as the paper compares it (Figure 2), and over terrains, with an example and guides on each.

    python benchmarks/gps_variants.py --case dagger --env hopper
    python benchmarks/gps_variants.py --env walker --terrain incline:10 --demonstration slope.npz

Takes the flags of gps.py, too. --resume and --evaluate take the checkpoints of this script. A demonstration of several
terrains says by `terrain` which trajectory is over which one.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
import torch.nn.functional as F
from tables import ROOT
from torch import Tensor

from diffsim import DiffEnv
from diffsim.planning import REAL, System
from diffsim.robot.profile import TerrainError
from diffsim.robot.scene import Scene
from diffsim.robot.types import Array
from diffsim.sim.elevation import Elevation
from diffsim.training import evaluate_checkpoint, fail, script
from diffsim.training.evaluation import Evaluation
from diffsim_robots.terrain import incline, rough

sys.path.append(str(ROOT))
import gps  # noqa: E402

Case = Literal[
    "guided", "one-start", "effective-samples", "nonguided", "restart", "single-example", "policy-gradient", "dagger"
]
LEAST = 5.0  # effective samples: half of what the policy draws
MAKERS: dict[str, Callable[..., Array]] = {
    "level": lambda: incline(0.0),
    "incline": incline,
    "rough": lambda degrees, segment=1.0, seed=0.0: rough(seed, segment, degrees),
}
USAGE = "level, incline:DEGREES[:START] or rough:DEGREES[:SEGMENT[:SEED]]"


@dataclass
class VariantArgs(gps.Args):
    """What differs from gps.py."""

    case: Case = "guided"
    """the search of gps.py, or a variant of the paper's algorithm"""
    terrain: tuple[str, ...] = ("level",)
    """train on each, with its own guides: level, incline:DEGREES or rough:DEGREES; the policy sees none"""

    def check(self) -> None:
        super().check()
        if (least := len(self.terrain)) > min(self.samples, self.guiding_samples):
            fail(f"--samples and --guiding-samples must be at least {least}, one for each --terrain")
        if self.adaptive and least > 1:
            fail("--adaptive takes one --terrain")
        named_terrains(*self.terrain)


# Terrains by their names ----------------------------------------------------------------------------------------------


def named_terrains(*names: str) -> Array:
    """(M, K, 2) profiles of M names, K of the longest; USAGE without numbers that have defaults, or with them.

    Raises:
        TerrainError: another name, a number too few or too many, or one that its function refuses.
    """
    profiles = []
    for name in names:
        kind, *numbers = name.split(":")
        try:
            profiles.append(MAKERS[kind](*map(float, numbers)))
        except (KeyError, TypeError, ValueError) as error:
            raise TerrainError(f"terrain {name!r} must be {USAGE}: {error}") from error
    most = max(map(len, profiles))
    for i, p in enumerate(profiles):  # the last segment goes on
        more = p[-1] + np.arange(1, most - len(p) + 1)[:, None] * (p[-1] - p[-2])
        profiles[i] = np.concatenate((p, more))
    return np.stack(profiles)


# Planning over them ---------------------------------------------------------------------------------------------------


class Ground(System):
    """A robot over a terrain (K, 2), or trajectory i of a rollout over number i % M of (M, K, 2).

    The root's height in a state is that over the ground below.
    """

    def __init__(self, env: DiffEnv, terrain: Array, threads: int | None = None) -> None:
        scene = env.scene.with_terrain(terrain)
        assert scene.terrain is not None
        self.profiles = scene.terrain
        self._elevations: dict[int, Elevation] = {}
        super().__init__(env, threads, scene)

    def copies(self, count: int) -> Scene:
        M = len(self.profiles)
        return self.scene if M == 1 else self.scene.with_terrain(self.profiles[np.arange(count) % M])

    def rollout(self, x: Tensor, steps: int, act: Callable[[int, Tensor], Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        ground = self.ground(len(x))
        start = self._moved(x, ground.lift)
        x, u, finite = super().rollout(start, steps, lambda t, x: act(t, self._moved(x, ground.lower)))
        return self._moved(x, ground.lower), u, finite

    def jacobians(self, x: Tensor, u: Tensor) -> Tensor:
        if len(self.profiles) > 1:
            raise ValueError("Jacobians need one terrain for all steps")
        ground, nq, nv = self.ground(1), self.nq, self.nv
        f_z, following = super().jacobians(self._moved(x, ground.lift), u), self.rollout(x, 1, lambda *_: u)[0][:, 1]
        before, after = (F.pad(ground.gradient(part[:, :nq])[..., :nv, :nv], (0, nv, 0, nv)) for part in (x, following))
        f_z[..., : self.nd] = f_z[..., : self.nd] + f_z[..., : self.nd] @ before
        return f_z - after @ f_z

    def ground(self, count: int) -> Elevation:
        """The ground below so many trajectories."""
        if count not in self._elevations:
            self._elevations[count] = Elevation(self.copies(count), self.device, REAL)
        return self._elevations[count]

    def _moved(self, x: Tensor, move: Callable[[Tensor], Tensor]) -> Tensor:
        """x (n, nx) or (n, T, nx), a row for each ground, with qpos lifted or lowered."""
        qpos = move(x[..., : self.nq].movedim(0, -2)).movedim(-2, 0)
        return torch.cat((qpos, x[..., self.nq :]), -1)


class Search(gps.Search):
    """Plans and guides on each of --terrain; the policy's trajectory i goes over number i % n."""

    args: VariantArgs

    def __init__(self, args: VariantArgs, env: DiffEnv) -> None:
        super().__init__(args, env)
        if args.terrain != ("level",):
            self.system = self.over(*args.terrain)

    def over(self, *names: str) -> Ground:
        return Ground(self.env, named_terrains(*names), self.args.threads or None)

    def examples(self) -> list[tuple[System, Tensor, Tensor]]:
        path, trajectories = self.args.demonstration, [(x, u) for _, x, u in super().examples()]
        assert path is not None
        with np.load(path) as example:
            known = example["terrain"].tolist() if "terrain" in example else ["level"] * len(trajectories)
        if missing := [name for name in self.args.terrain if name not in known]:
            fail(f"{path} has no trajectory over {missing[0]}, only over {', '.join(dict.fromkeys(known))}")
        grounds = {name: self.over(name) if len(self.args.terrain) > 1 else self.system for name in self.args.terrain}
        return [(grounds[name], *pair) for name, pair in zip(known, trajectories, strict=True) if name in grounds]

    def evaluate(self) -> Evaluation:
        found = super().evaluate()
        if isinstance(self.system, Ground):
            found.qpos = self.system.ground(len(found.returns)).lift(found.qpos)
        return found


# The variants ---------------------------------------------------------------------------------------------------------


class OneStart(Search):
    """Line 7 from theta* alone."""

    starts = 1


class EffectiveSamples(Search):
    """Tang and Abbeel 2010: in place of the regularizer a bound on the effective samples of each step (footnote 4)."""

    def objective(self, mixture: Tensor, reward: Tensor) -> Callable[[Tensor], Tensor]:
        def value(log_pi: Tensor) -> Tensor:
            effective = 1 / gps.log_weights(log_pi, mixture).softmax(0).square().sum(0)
            return gps.phi(log_pi, mixture, reward, 0.0) - (LEAST - effective).clamp(min=0).square().sum()

        return value


class NonGuided(Search):
    """S begins without the guides; they only pretrain the policy."""

    guided = False


class Restart(NonGuided):
    """The policy's samples start at any state of the guides, which are no guides otherwise."""

    def draw(self, theta: Tensor, source: int = -1, count: int = 0) -> gps.Samples:
        count = count or self.args.samples
        x = torch.cat([guide.x[:-1] for guide in self.guides])
        start = x[torch.randint(len(x), (count,), generator=self.rng).to(x.device)]
        self.control_steps += count * self.args.horizon
        return self.roll_out(theta, self.noise(count), start, source)


class SingleExample(NonGuided):
    """Pretrained on the example alone, without samples about it."""

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


CLASSES = Search, OneStart, EffectiveSamples, NonGuided, Restart, SingleExample, PolicyGradient, DAgger
CASES: dict[str, type[Search]] = dict(zip(get_args(Case), CLASSES, strict=True))

main = script(
    VariantArgs,
    lambda args: gps.train(args, CASES[args.case]),
    lambda args: evaluate_checkpoint(args, CASES[args.case]),
)

if __name__ == "__main__":
    main()
