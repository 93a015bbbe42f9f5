"""PFPN, Particle Filtering Policy Network (Xu and Karamouzas 2021, https://doi.org/10.1145/3487983.3488301).

A Gaussian policy has one peak. Here each action has particles: normal distributions, the same in all states, whose
weights the network gives. The policy is their mixture. Particles without weight are moved to those that have it. PPO,
SHAC and SAC train this policy, and the policies with which the paper compares it.

    python pfpn.py --env ant --seed 1                        by PPO; writes runs/ant__pfpn__1__<time>/
    python pfpn.py --env ant --algorithm shac                by the simulator's gradient; --algorithm sac: off-policy
    python pfpn.py --resume <run>/checkpoint.pt              continue an interrupted run; --evaluate: evaluate it
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.training import ClippedAdam, Ensemble, Run, distributed, evaluate, fail, script
from diffsim.training.flags import ParallelFlags
from diffsim.training.layers import Likeliest, ObsNormalizer, moments
from diffsim.training.ranges import Count, Fraction, Natural, NonNegative, Positive, Repeats, SomeWidths
from diffsim.training.replay import ReplayBuffer, Transition

# The settings of ppo_baseline.py, shac.py and sac_baseline.py, so that only the policy differs.
# fmt: off
COLUMNS: dict[str, tuple[str, ...]] = {
    "ppo":  ("hidden", "num_envs", "horizon", "minibatch_size", "epochs", "entropy_coef", "iterations"),
    "shac": ("hidden", "critic_hidden", "lr", "critic_lr", "target_rate", "num_envs", "minibatch_size", "epochs",
             "iterations"),
    "sac":  ("hidden", "critic_hidden", "num_envs", "minibatch_size", "temperature_lr", "lr", "critic_lr", "epochs",
             "iterations"),
}
PER_TASK: dict[tuple[str, str], tuple[Any, ...]] = {  # a task that is not in the table has the humanoid's
    ("ppo", "cartpole"):      ((64, 64),         32, 240,  1920, 5, 0.0,    500),
    ("ppo", "hopper"):        ((128, 64, 32),  1024,  32,  8192, 5, 0.01,  5000),
    ("ppo", "half_cheetah"):  ((128, 64, 32),  1024,  32,  8192, 5, 0.0,   5000),
    ("ppo", "ant"):           ((128, 64, 32),  2048,  32, 16384, 5, 0.01,  5000),
    ("ppo", "humanoid"):      ((256, 128, 64), 1024,  32,  8192, 5, 0.0,   5000),
    ("ppo", "humanoid_mtu"):  ((512, 512, 256), 1024, 32,  8192, 6, 0.0,  20000),
    ("shac", "cartpole"):     ((64, 64),      (64, 64),   1e-2, 1e-3, 0.8,    64,  512, 16,  500),
    ("shac", "hopper"):       ((128, 64, 32), (64, 64),   2e-3, 2e-4, 0.8,   256, 2048, 16, 2000),
    ("shac", "half_cheetah"): ((128, 64, 32), (64, 64),   2e-3, 2e-3, 0.8,    64,  512, 16, 2000),
    ("shac", "ant"):          ((128, 64, 32), (64, 64),   2e-3, 2e-3, 0.8,    64,  512, 16, 2000),
    ("shac", "humanoid"):     ((256, 128),    (128, 128), 2e-3, 5e-4, 0.005,  64,  512, 16, 2000),
    ("shac", "humanoid_mtu"): ((512, 256),    (256, 256), 2e-3, 5e-4, 0.005,  64,  512, 16, 2000),
    ("sac", "cartpole"):      ((64, 64),             (64, 64),              32, 1024, 5e-3, 5e-4, 5e-4, 1,  4_000),
    ("sac", "hopper"):        ((256, 128, 64),       (256, 128, 64),        64, 2048, 5e-3, 5e-4, 5e-4, 1, 20_000),
    ("sac", "half_cheetah"):  ((256, 128, 64),       (256, 128, 64),        64, 2048, 5e-3, 5e-4, 5e-4, 1, 20_000),
    ("sac", "ant"):           ((256, 128, 64),       (256, 128, 64),       128, 4096, 5e-3, 5e-4, 5e-4, 1, 20_000),
    ("sac", "humanoid"):      ((512, 256),           (512, 256),            64, 2048, 2e-4, 3e-4, 3e-4, 1, 20_000),
    ("sac", "humanoid_mtu"):  ((512, 512, 512, 256), (512, 512, 512, 256), 256, 4096, 2e-4, 3e-4, 3e-4, 1, 40_000),
}
PPO_ON_CPU = {"num_envs": 256, "minibatch_size": 2048}  # at most: where samples cost more, smaller steps learn more
# fmt: on
LOG_STD = (-5.0, 2.0)  # bounds of the log standard deviation of a component
Estimator = Literal["implicit", "straight-through", "mixed"]


@dataclass
class Args(ParallelFlags):
    """The policy and the algorithms. Defaults: of PPO on the humanoid."""

    MAY_CHANGE = (*ParallelFlags.MAY_CHANGE, "horizon", "lr", "critic_lr", "temperature_lr", "entropy_coef")

    algorithm: Literal["ppo", "shac", "sac"] = "ppo"
    """what trains the policy: rewards alone, the simulator's gradient, or a replay buffer"""
    policy: Literal["pfpn", "gaussian", "gmm", "discrete"] = "pfpn"
    """particles; one Gaussian; a mixture whose locations and scales depend on the state too; fixed bins"""
    std: Literal["state", "own"] = "state"
    """of the Gaussian: its standard deviation depends on the state, or is a parameter of each action"""
    particles: Count = 35
    """particles (components, bins) of each action"""
    resampling: Literal["weighted", "uniform", "none"] = "weighted"
    """where dead particles go: to living ones in proportion to their mean weight, to any of them, or nowhere"""
    resampling_interval: Count = 20
    """iterations between resamplings"""
    resampling_noise: NonNegative = 0.1
    """a particle lands within this many standard deviations of the one that it copies"""
    dead: Fraction = 0.05
    """a particle is dead if its weight since the last resampling is below this share of 1 / particles"""
    dead_by: Literal["mean", "max"] = "mean"
    """which weight: its mean over the recorded steps, or its largest (Eq. 8)"""
    estimator: Estimator = "straight-through"
    """gradient of a sampled action, with shac and sac: only straight-through is biased (docs/pfpn.md)"""
    density_floor: NonNegative = 0.01
    """the implicit gradient divides by the action's density, at least by this; 0: no bias, no bound either"""
    log_particles: tuple[Natural, ...] = ()
    """actions, counted from 0, whose particles' locations and mean weights are logged"""

    iterations: Count = 5000
    """learning iterations, a window of all environments and its updates each (per task)"""
    num_envs: Count = 1024
    """parallel environments N, over all processes of torchrun (per task; PPO on a CPU: at most 256)"""
    horizon: Count = 32
    """control steps of a window (1/60 s each) (per task)"""
    hidden: SomeWidths = (256, 128, 64)
    """units of the hidden layers of the policy, which PPO's value shares (per task)"""
    critic_hidden: SomeWidths = (128, 128)
    """units of the hidden layers of SHAC's and SAC's critics (per task)"""
    lr: Positive = 3e-4
    """learning rate of the policy; of PPO the initial one, of SHAC too (per task)"""
    lr_bounds: tuple[Positive, Positive] = (1e-6, 1e-2)
    """PPO: lowest and highest learning rate; twice the same number fixes it"""
    critic_lr: Positive = 5e-4
    """learning rate of SHAC's and SAC's critics, of SHAC the initial one (per task)"""
    gamma: Fraction = 0.99
    """discount factor"""
    trace_decay: Fraction = 0.95
    """lambda of PPO's advantages and of SHAC's values"""
    epochs: Repeats = 5
    """passes over a window's samples: of PPO, of SHAC's critic; SAC: updates per control step (per task)"""
    minibatch_size: Count = 8192
    """samples of an update (per task; PPO on a CPU: at most 2048)"""
    entropy_coef: NonNegative = 0.0
    """PPO, SHAC: weight of the entropy, of a mixture's weights or of a Gaussian (per task)"""
    target_rate: Fraction = 0.005
    """SHAC, SAC: target critic <- (1 - rate) target critic + rate critic (per task)"""
    buffer_size: Count = 1_000_000
    """SAC: transitions in the replay buffer"""
    temperature_lr: Positive = 5e-3
    """SAC: learning rate of the logarithm of the entropy's weight (per task)"""
    eval_every: Natural = 500
    """evaluate the deterministic policy every this many iterations (0: only at the end)"""
    save_every: Natural = 500
    """save the checkpoint every this many iterations, SAC's with the replay buffer (0: only at the end)"""

    def task_defaults(self) -> dict[str, Any]:
        row = PER_TASK.get((self.algorithm, self.env), PER_TASK[self.algorithm, "humanoid"])
        values = dict(zip(COLUMNS[self.algorithm], row, strict=True))
        if self.algorithm == "ppo" and self.device == "cpu":
            values |= {name: min(values[name], most) for name, most in PPO_ON_CPU.items()}
        return values

    def check(self) -> None:
        super().check()
        sac, discrete, window = self.algorithm == "sac", self.policy == "discrete", self.horizon * self.num_envs
        few = self.policy != "gaussian" and not 2 <= self.particles <= 1000
        pathless = discrete and self.algorithm == "shac" and self.estimator == "implicit"
        for wrong, message in (
            (few, f"--particles must be from 2 to 1,000 with --policy {self.policy}, not {self.particles}"),
            (self.lr_bounds[0] > self.lr_bounds[1], f"--lr-bounds {self.lr_bounds}: the lowest exceeds the highest"),
            (self.dead == 1, "--dead 1: with equal weights all particles would be dead"),
            (discrete and sac, "--policy discrete has no density, whose entropy --algorithm sac needs"),
            (pathless, "--policy discrete has no implicit gradient: choose --estimator straight-through or mixed"),
            (sac and self.estimator == "mixed", "--estimator mixed needs the rewards of a window: not --algorithm sac"),
            (sac and distributed.size() > 1, "--algorithm sac is one process: ranks do not share a replay buffer"),
            (sac and self.buffer_size < window, f"--buffer-size {self.buffer_size} holds no window of {window} steps"),
        ):
            if wrong:
                fail(message)


# Policies -------------------------------------------------------------------------------------------------------------


class Mixture:
    """pi(a|s) = prod_k sum_i w_ki N(u_k; mu_ki, xi_ki^2) (Eq. 3), of m actions k with n components i each.

    The action a is u, or tanh u if squashed (Eq. 27). A log_std of minus infinity makes the components points.
    """

    def __init__(self, logits: Tensor, loc: Tensor, log_std: Tensor, squashed: bool) -> None:
        self.logits, self.log_weight = logits, F.log_softmax(logits, -1)  # (..., m, n)
        self.loc, self.log_std, self.squashed = loc, log_std, squashed  # (..., m, n) or (m, n)

    def action(self, u: Tensor) -> Tensor:
        return torch.tanh(u) if self.squashed else u

    def log_slope(self, u: Tensor) -> Tensor:
        """log da/du."""
        return 2 * (math.log(2) - u - F.softplus(-2 * u)) if self.squashed else torch.zeros_like(u)

    def log_density(self, u: Tensor) -> Tensor:
        """Of each u_k by itself (..., m)."""
        rate = (-self.log_std).exp() * math.sqrt(0.5)
        z = torch.addcmul(-self.loc * rate, u.unsqueeze(-1), rate)
        return logsumexp(self.log_weight - self.log_std - z.square()) - 0.5 * math.log(2 * math.pi)

    def log_prob(self, u: Tensor) -> Tensor:
        """log pi(a|s) of the action of u (..., m): (...). Eq. 28, with the slope outside of the logarithm."""
        return (self.log_density(u) - self.log_slope(u)).sum(-1)

    def entropy(self) -> Tensor:
        """Of the weights (appendix B), summed over the actions (...); of a single component its differential one."""
        if self.logits.shape[-1] == 1:
            return (self.log_std + (1 + math.log(2 * math.pi)) / 2).sum((-1, -2))
        return -(self.log_weight.exp() * self.log_weight).sum((-1, -2))


def logsumexp(x: Tensor) -> Tensor:
    """Over the last dimension. torch's own takes several times as long on a CPU where an exponential underflows."""
    largest = x.detach().argmax(-1, keepdim=True)
    return (x.gather(-1, largest) - F.log_softmax(x, -1).gather(-1, largest)).squeeze(-1)


class Bins(Mixture):
    """The mixture of points, DISCRETE in the paper. What it draws is a location; others count as the nearest one."""

    def log_density(self, u: Tensor) -> Tensor:
        nearest = (u.unsqueeze(-1) - self.loc).abs().argmin(-1, keepdim=True)
        return self.log_weight.gather(-1, nearest).squeeze(-1)


class Head(nn.Module):
    """Features of a network (..., inputs) -> the mixture of each of m actions. What of it depends on the state:

    pfpn      the weights (Figure 2)
    discrete  the weights; the components are points, which stay where they are
    gmm       weights, locations and scales
    gaussian  the location of its only component, with --std state its scale too
    """

    def __init__(self, args: Args, inputs: int, actions: int) -> None:
        super().__init__()
        self.policy, n = args.policy, 1 if args.policy == "gaussian" else args.particles
        self.shape, self.squashed = (actions, n), args.algorithm != "ppo" and args.policy != "discrete"
        self.scale: nn.Linear | None = None
        loc, log_std = spread(*self.shape, self.squashed)
        if self.policy == "gaussian":
            self.linear, first = nn.Linear(inputs, actions), log_std.fill_(-1.0 if args.algorithm == "shac" else 0.0)
            if args.std == "own":
                self.log_std = nn.Parameter(first)
            else:
                self.scale = nn.Linear(inputs, actions) if args.algorithm == "sac" else almost_constant(inputs, first)
        elif self.policy == "gmm":
            self.linear = almost_constant(inputs, torch.stack((torch.zeros_like(loc), loc)))
            self.scale = almost_constant(inputs, log_std)
            self.likeliest = Likeliest(*self.shape, shared=False)
        else:
            moving = self.policy == "pfpn"
            self.linear, self.likeliest = almost_constant(inputs, torch.zeros_like(loc)), Likeliest(*self.shape)
            self.loc.requires_grad_(moving).data.copy_(loc)
            self.log_std = nn.Parameter(log_std if moving else log_std.fill_(-math.inf), requires_grad=moving)

    @property
    def loc(self) -> nn.Parameter:
        """(m, n) with pfpn and discrete."""
        return self.likeliest.get_parameter("loc")

    def forward(self, features: Tensor) -> Mixture:
        out = self.linear(features)
        if self.policy == "gaussian":
            logits, loc = torch.zeros_like(out).unsqueeze(-1), out.unsqueeze(-1)
        elif self.policy == "gmm":
            logits, loc = out.unflatten(-1, (2, *self.shape)).unbind(-3)
        else:
            logits, loc = out.unflatten(-1, self.shape), self.loc
        scale = self.scale(features).unflatten(-1, self.shape).clamp(*LOG_STD) if self.scale else self.log_std
        return (Bins if self.policy == "discrete" else Mixture)(logits, loc, scale, self.squashed)


def spread(actions: int, n: int, squashed: bool) -> tuple[Tensor, Tensor]:
    """Locations that cover each action evenly, and log standard deviations that cover the gaps between them (m, n)."""
    if squashed:
        loc = torch.atanh(-1 + (2 * torch.arange(n, dtype=torch.float64) + 1) / n)
    else:
        loc = torch.linspace(-1, 1, n, dtype=torch.float64)
    gap = loc.diff()
    widest = torch.maximum(F.pad(gap, (1, 0)), F.pad(gap, (0, 1)))
    return loc.float().repeat(actions, 1), widest.log().float().repeat(actions, 1)


def almost_constant(inputs: int, output: Tensor) -> nn.Linear:
    """A layer that begins with small weights around an output."""
    layer = nn.Linear(inputs, output.numel())
    nn.init.trunc_normal_(layer.weight, std=0.01, a=-0.02, b=0.02)
    layer.bias.data.copy_(output.flatten())
    return layer


def mlp(inputs: int, hidden: Sequence[int], activation: type[nn.Module] = nn.ELU, norm: bool = False) -> nn.Sequential:
    """Linear, activation and, if asked for, LayerNorm per hidden layer."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), activation(), *([nn.LayerNorm(width)] if norm else [])]
        inputs = width
    return nn.Sequential(*layers)


class Actor(nn.Module):
    """pi(a|s), of normalized observations; with PPO also V(s), in units of its normalizer, of the same features."""

    def __init__(self, args: Args, obs_dim: int, action_dim: int) -> None:
        super().__init__()
        self.normalizer = ObsNormalizer(obs_dim)
        activation = nn.ReLU if args.algorithm == "sac" else nn.ELU
        self.body = mlp(obs_dim, args.hidden, activation, norm=args.algorithm == "shac")
        self.head = Head(args, args.hidden[-1], action_dim)
        self.value = nn.Linear(args.hidden[-1], 1) if args.algorithm == "ppo" else None

    def forward(self, obs: Tensor) -> Mixture:
        mixture: Mixture = self.head(self.body(obs))
        return mixture

    def both(self, obs: Tensor) -> tuple[Mixture, Tensor]:
        assert self.value is not None
        features = self.body(obs)
        return self.head(features), self.value(features).squeeze(-1)

    def deterministic(self) -> nn.Sequential:
        """The locations of the largest weights, of observations as they come, with the same weights."""
        likeliest = [] if self.head.policy == "gaussian" else [self.head.likeliest]
        squash = [nn.Tanh()] if self.head.squashed else []
        return nn.Sequential(self.normalizer, *self.body, self.head.linear, *likeliest, *squash)


# Estimators: how the gradient of a sampled action reaches the policy --------------------------------------------------


def sample(mixture: Mixture, estimator: Estimator = "mixed", floor: float = 0.0) -> tuple[Tensor, Tensor]:
    """u (..., m), Eq. 4 and 5, and the log probability of the chosen components (...).

    Locations and scales have the gradient of the chosen component, the weights the estimator's; with "mixed" the caller
    adds the score function, for which it needs the log probability.
    """
    noise, std = torch.randn_like(mixture.logits[..., 0]), mixture.log_std.exp()
    if mixture.logits.shape[-1] == 1:  # a Gaussian
        return mixture.loc.squeeze(-1) + std.squeeze(-1) * noise, torch.zeros_like(noise[..., 0])
    if estimator == "straight-through":
        scores = mixture.logits - torch.empty_like(mixture.logits).exponential_().log()  # Gumbel noise
        index = scores.argmax(-1, keepdim=True)
    else:  # the same choice, with less noise to draw
        total = mixture.logits.detach().softmax(-1).cumsum(-1)
        level = (1 - torch.rand_like(noise).unsqueeze(-1)) * total[..., -1:]
        index = (total < level).sum(-1, keepdim=True)
    loc, scale = (x.expand_as(mixture.logits).gather(-1, index).squeeze(-1) for x in (mixture.loc, std))
    u = loc + scale * noise
    if estimator == "straight-through":
        each = mixture.loc + std * noise.unsqueeze(-1)  # what each component would have drawn
        u = u + straight_through(mixture, u.detach(), each.detach(), scores)
    if estimator == "implicit":
        u = implicit(mixture, u.detach(), floor)
    return u, mixture.log_weight.gather(-1, index).squeeze(-1).sum(-1)


def straight_through(mixture: Mixture, u: Tensor, each: Tensor, scores: Tensor) -> Tensor:
    """Zero, whose gradient in the weights is Eq. 25's: as if the action were linear in the relaxed choice x."""
    x = scores.softmax(-1)  # Concrete distribution of temperature 1
    gap = mixture.action(each) - mixture.action(u).unsqueeze(-1)
    gap = gap / mixture.log_slope(u).exp().clamp(min=1e-3).unsqueeze(-1)  # of u, for the same gap of actions
    return (gap * (x - x.detach())).sum(-1)


def implicit(mixture: Mixture, u: Tensor, floor: float) -> Tensor:
    """u with its implicit gradient: its cumulative probability F(u) stays, so du = -dF / p(u) (Figurnov 2018)."""
    z = (u.unsqueeze(-1) - mixture.loc) * (-mixture.log_std).exp()
    cumulative = (mixture.logits.softmax(-1) * torch.special.ndtr(z)).sum(-1)
    least = floor * mixture.log_slope(u).exp()  # the floor is of the action's density
    density = torch.maximum(mixture.log_density(u).detach().exp(), least)
    return u - (cumulative - cumulative.detach()) / density


# Resampling -----------------------------------------------------------------------------------------------------------


class Resampling(nn.Module):
    """Keeps the particles' weights, and moves those without weight to others (section 3.3). Works in place."""

    seen: Tensor
    age: Tensor
    moved: Tensor

    def __init__(self, args: Args, head: Head) -> None:
        super().__init__()
        self.args, self.active = args, args.policy == "pfpn"  # the other policies have nothing to move
        self.register_buffer("seen", torch.zeros(2, *head.shape))  # since the last one: sum and largest of weights
        self.register_buffer("age", torch.zeros((), dtype=torch.int64))  # iterations
        self.register_buffer("moved", torch.zeros(()))  # particles, ever
        if self.active and (wrong := [k for k in args.log_particles if k >= head.shape[0]]):
            fail(f"--log-particles {wrong[0]}: the actions of {args.env!r} are 0 to {head.shape[0] - 1}")

    def record(self, acting: Mixture) -> None:
        """Take the weights (..., m, n) with which the policy acts."""
        if self.active:
            weight = acting.logits.detach().softmax(-1).flatten(0, -3)
            self.seen[0] += weight.sum(0)
            torch.maximum(self.seen[1], weight.amax(0), out=self.seen[1])

    @torch.no_grad()
    def end_iteration(self, head: Head, optimizer: ClippedAdam) -> dict[str, Tensor]:
        """Resample if it is time; that is decided on the device, so a captured iteration does the same."""
        if not self.active:
            return {}
        head.log_std.clamp_(*LOG_STD)
        self.age += 1
        due = self.age % self.args.resampling_interval == 0
        every = distributed.stack(self.seen)
        self.seen.copy_(torch.stack((every[:, 0].mean(0), every[:, 1].amax(0))))  # ranks decide and resume alike
        weight = self.seen[0] / self.seen[0].sum(-1, keepdim=True)  # where nothing was recorded not a number
        least, largest = self.args.dead / head.shape[1], torch.maximum(weight, self.seen[1])
        below = {"mean": weight < least, "max": largest < least}  # Eq. 8 has the second
        dead = below[self.args.dead_by]
        if self.args.resampling != "none":
            chance = weight if self.args.resampling == "weighted" else torch.ones_like(weight)
            self.move(head, optimizer, dead & due, chance.masked_fill(dead, 0.0))
        found = {
            **{f"particles/dead_{by}": each.to(weight.dtype).mean() for by, each in below.items()},
            "particles/moved": self.moved,
            "particles/active": (-torch.xlogy(weight, weight).sum(-1)).exp().mean(),
            "particles/std": (weight * head.log_std.exp()).sum(-1).mean(),
        }
        for name, values in (("loc", head.loc.tanh() if head.squashed else head.loc.clone()), ("weight", weight)):
            for k in self.args.log_particles:
                found |= {f"particles/{name}_{k}_{i}": value for i, value in enumerate(values[k].unbind())}
        self.seen *= ~due
        return found

    def move(self, head: Head, optimizer: ClippedAdam, dead: Tensor, chance: Tensor) -> None:
        """Make the dead particles copies of others, drawn by the chances (m, n) (Eq. 9), the policy the same (Eq. 10).

        |D| copies share the weight of their target: log(|D| + 1) less in each logit. Adam's moments of them are zeroed.
        """
        m, n = head.shape
        draws = distributed.stack(torch.empty(m, n, n, device=dead.device).exponential_())[0]
        target = torch.where(dead, (chance.unsqueeze(1) / draws).argmax(-1), torch.arange(n, device=dead.device))
        copies = torch.zeros_like(chance).scatter_add(1, target, dead.to(chance.dtype))
        head.linear.bias.data.view(m, n).sub_(torch.log1p(copies))
        for parameter in (head.linear.weight, head.linear.bias, head.loc, head.log_std):
            rows = parameter.data.view(m, n, -1)
            rows.copy_(rows.gather(1, target.unsqueeze(-1).expand_as(rows)))
            for moment in optimizer.moments(parameter):
                moment.view(m, n, -1).masked_fill_(dead.unsqueeze(-1), 0.0)
        uniform = distributed.stack(2 * torch.rand_like(head.loc) - 1)[0]
        head.loc.add_(dead * self.args.resampling_noise * uniform * head.log_std.exp())
        self.moved += dead.sum()


# Learners -------------------------------------------------------------------------------------------------------------


class Window(NamedTuple):
    """What came of H steps of all environments, time first: (H, N, ...)."""

    obs: Tensor  # s_t, on which the policy acted
    next_obs: Tensor  # s_{t+1}, before any reset
    reward: Tensor
    terminated: Tensor
    done: Tensor  # terminated or truncated


class Learner:
    """What the algorithms share. Each adds the two halves of an iteration, interact and learn, as CUDA graphs allow."""

    max_grad_norm, betas = 1.0, (0.9, 0.999)
    samples: list[Tensor]  # (H N, ...) of a window

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        self.actor = Actor(args, env.task.obs_dim, env.scene.nu).to(env.device)
        self.policy = self.actor.deterministic()
        self.resampling = Resampling(args, self.actor.head).to(env.device)
        self.optimizer = ClippedAdam(self.actor, self.max_grad_norm, self.betas, args.lr)

    def add_critic(self, critic: nn.Module) -> None:
        self.critic = critic.to(self.env.device)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.critic_optimizer = ClippedAdam(self.critic, self.max_grad_norm, self.betas, self.args.critic_lr)

    def schedule(self, iteration: int) -> None:
        """Set the learning rates of an iteration."""

    def act(self, obs: Tensor) -> tuple[Tensor, ...]:
        """The action of one step, and what else of it the algorithm needs."""
        raise NotImplementedError

    def collect(self) -> tuple[Window, list[Tensor]]:
        """A window of all environments from where they stand, and what else `act` returned (H, N, ...)."""
        steps, obs = [], self.env.detach()
        for _ in range(self.args.horizon):
            action, *beside = self.act(obs)
            next_obs, reward, terminated, truncated, info = self.env.step(action)
            steps.append((obs, info["final_obs"], reward, terminated, terminated | truncated, *beside))
            obs = next_obs
        columns = [torch.stack(tensors) for tensors in zip(*steps, strict=True)]
        return Window(*columns[:5]), columns[5:]

    def keep(self, *tensors: Tensor) -> None:
        for samples, tensor in zip(self.samples, tensors, strict=True):
            samples.copy_(tensor.flatten(0, 1))

    def minibatches(self, order: Tensor | slice) -> Iterator[tuple[Tensor, ...]]:
        parts = math.ceil(len(self.samples[0]) / self.args.minibatch_size * distributed.size())
        return zip(*(samples[order].chunk(parts) for samples in self.samples), strict=True)

    def follow(self) -> None:
        """target <- (1 - rate) target + rate critic."""
        for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
            slow.lerp_(fast.detach(), self.args.target_rate)

    def end_iteration(self, rows: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
        """Resample; returns the means of the updates' metrics with what every algorithm logs."""
        found = {name: torch.stack([row[name] for row in rows]).mean() for name in rows[0]}
        skipped = [value.skipped for value in vars(self).values() if isinstance(value, ClippedAdam)]
        found["grad/skipped"] = torch.stack(skipped).sum()
        return found | self.resampling.end_iteration(self.actor.head, self.optimizer)


def td_lambda(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """SHAC's Eq. 7 (H, N), to a done or the window's end. next_value is V(s_{t+1}) before a reset, 0 if terminated."""
    returns = torch.empty_like(reward)
    following = next_value[-1]
    for t in reversed(range(len(reward))):
        following = torch.where(done[t], next_value[t], torch.lerp(next_value[t], following, lam))
        following = returns[t] = reward[t] + gamma * following
    return returns


class PPO(Learner):
    """Proximal Policy Optimization, with the constants of ppo_baseline.py."""

    target_kl, clip_coef, value_coef, bound_coef = 0.008, 0.2, 2.0, 1e-4

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__(args, env)
        self.return_normalizer = ObsNormalizer().to(env.device)
        sizes = (env.task.obs_dim,), (env.scene.nu,), (), (), ()  # see update
        self.samples = [torch.zeros(args.horizon * env.num_envs, *size, device=env.device) for size in sizes]

    def act(self, obs: Tensor) -> tuple[Tensor, ...]:
        mixture, value = self.actor.both(self.actor.normalizer(obs))
        self.resampling.record(mixture)
        u, _ = sample(mixture)
        return u, u, mixture.log_prob(u), value

    @torch.no_grad()
    def interact(self) -> dict[str, Tensor]:
        """Act for a window, and keep its samples with their advantages and value targets."""
        args, normalizer = self.args, self.actor.normalizer
        window, (u, log_prob, value) = self.collect()
        mixture, next_value = self.actor.both(normalizer(window.next_obs))
        next_value = self.return_normalizer.inverse(next_value).masked_fill(window.terminated, 0.0)
        target = td_lambda(window.reward, next_value, window.done, args.gamma, args.trace_decay)
        advantage = target - self.return_normalizer.inverse(value)
        self.return_normalizer.update(target)
        var, mean = moments(advantage.flatten())
        advantage = (advantage - mean) / (var.sqrt() + 1e-8)
        self.keep(normalizer(window.obs), u, log_prob, advantage, self.return_normalizer(target))
        normalizer.update(window.obs)
        return {"charts/entropy": mixture.entropy().mean()}

    def learn(self) -> dict[str, Tensor]:
        """Descend the clipped loss in epochs of minibatches."""
        rows = []
        for _ in range(self.args.epochs):
            order = torch.randperm(len(self.samples[0]), device=self.env.device)
            rows += [self.update(*batch) for batch in self.minibatches(order)]
        return self.end_iteration(rows) | {"charts/learning_rate": self.optimizer.lr}

    def update(self, obs: Tensor, u: Tensor, log_prob: Tensor, advantage: Tensor, target: Tensor) -> dict[str, Tensor]:
        """One step on a minibatch of normalized s_t, u, its log probability, the advantage and the value's target."""
        mixture, value = self.actor.both(obs)
        log_ratio = mixture.log_prob(u) - log_prob
        kl = distributed.average((log_ratio.detach().expm1() - log_ratio.detach()).mean())  # estimated; not below zero
        up, down = (x.to(kl.dtype) for x in (kl < self.target_kl / 2, kl > 2 * self.target_kl))
        self.optimizer.lr.mul_(1.5 ** (up - down)).clamp_(*self.args.lr_bounds)
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - self.clip_coef, 1 + self.clip_coef)
        policy_loss = -torch.minimum(ratio * advantage, clipped * advantage).mean()
        value_loss = (value - target).square().mean()
        bound_loss = (mixture.loc.abs() - 1.1).clamp(min=0).square().mean(-1).sum(-1).mean()
        loss = policy_loss + self.value_coef * value_loss + self.bound_coef * bound_loss
        if self.args.entropy_coef:
            loss = loss - self.args.entropy_coef * mixture.entropy().mean()
        found = {"losses/policy": policy_loss.detach(), "losses/value": value_loss.detach(), "losses/kl": kl}
        return found | {"grad/norm": self.optimizer.step(loss)}


class SHAC(Learner):
    """Short-Horizon Actor-Critic, with the constants of shac.py. The gradient goes on through the sampled actions."""

    betas, final_lr = (0.7, 0.95), 1e-5

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__(args, env)
        critic = mlp(env.task.obs_dim, args.critic_hidden, norm=True).append(nn.Linear(args.critic_hidden[-1], 1))
        for layer in critic:
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, math.sqrt(2))
                nn.init.zeros_(layer.bias)
        self.add_critic(critic)
        sizes = (env.task.obs_dim,), ()  # normalized s_t; the value's target
        self.samples = [torch.zeros(args.horizon * env.num_envs, *size, device=env.device) for size in sizes]

    def schedule(self, iteration: int) -> None:
        """Linear decay of the learning rates."""
        done = (iteration - 1) / self.args.iterations
        for optimizer, lr in ((self.optimizer, self.args.lr), (self.critic_optimizer, self.args.critic_lr)):
            optimizer.lr.fill_(lr + (self.final_lr - lr) * done)

    def act(self, obs: Tensor) -> tuple[Tensor, ...]:
        mixture = self.actor(self.actor.normalizer(obs))
        self.resampling.record(mixture)
        u, chosen = sample(mixture, self.args.estimator, self.args.density_floor)
        return mixture.action(u), chosen, mixture.entropy().expand_as(chosen)

    def interact(self) -> dict[str, Tensor]:
        """Descend the loss of a window of all environments; keep the critic's samples of it."""
        args, normalizer = self.args, self.actor.normalizer
        window, (chosen, entropy) = self.collect()
        loss = self.loss(window, chosen, entropy)
        norm = self.optimizer.step(loss)
        window = Window(*(tensor.detach() for tensor in window))
        value = td_lambda(window.reward, self.next_values(window), window.done, args.gamma, args.trace_decay)
        self.keep(normalizer(window.obs), value)
        normalizer.update(window.obs)
        return {"losses/actor": loss.detach(), "charts/entropy": entropy.detach().mean(), "grad/norm": norm}

    def loss(self, window: Window, chosen: Tensor, entropy: Tensor) -> Tensor:
        """Eq. 5, cut at the dones, with the chosen components' log probabilities and the policy's entropies (H, N)."""
        args, reward, done, next_value = self.args, window.reward, window.done, self.next_values(window)
        t = torch.arange(len(done), device=done.device).unsqueeze(1)
        starts, ends = done.roll(1, 0), done.clone()
        starts[0] = ends[-1] = True
        age = t - torch.where(starts, t, torch.zeros_like(t)).cummax(0).values  # steps since the start or the last done
        discount = args.gamma ** age.to(reward.dtype)
        loss = -(discount * reward + discount * args.gamma * ends * next_value).mean()
        if args.estimator == "mixed":  # the score function of the chosen particles
            with torch.no_grad():
                value = self.target(self.actor.normalizer(window.obs)).squeeze(-1)
                advantage = td_lambda(reward, next_value, done, args.gamma, 1.0) - value
            loss = loss - (discount * advantage * chosen).mean()
        return loss - args.entropy_coef * entropy.mean()

    def next_values(self, window: Window) -> Tensor:
        """V(s_{t+1}) (H, N): of an episode's last state where it ran out of time, zero where it terminated."""
        values: Tensor = self.target(self.actor.normalizer(window.next_obs)).squeeze(-1)
        return values.masked_fill(window.terminated, 0.0)

    def learn(self) -> dict[str, Tensor]:
        """Fit the critic to the window's TD(lambda) returns, and let the target critic follow."""
        for _ in range(self.args.epochs):
            rows = []  # of the last pass
            for obs, value in self.minibatches(slice(None)):
                loss = F.mse_loss(self.critic(obs).squeeze(-1), value)
                self.critic_optimizer.step(loss)
                rows.append({"losses/critic": loss.detach()})
        self.follow()
        return self.end_iteration(rows)


class SAC(Learner):
    """Soft Actor-Critic: see sac_baseline.py. The critics' gradient goes on through the sampled actions."""

    max_grad_norm = 100.0

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__(args, env)
        obs_dim, action_dim, hidden = env.task.obs_dim, env.scene.nu, args.critic_hidden
        critics = [mlp(obs_dim + action_dim, hidden, nn.ReLU).append(nn.Linear(hidden[-1], 1)) for _ in range(2)]
        self.add_critic(Ensemble(critics))
        self.temperature = nn.ParameterDict({"log": torch.zeros(())}).to(env.device)
        self.temperature_optimizer = ClippedAdam(self.temperature, self.max_grad_norm, lr=args.temperature_lr)
        self.buffer = ReplayBuffer(args.buffer_size, obs_dim, action_dim).to(env.device)

    def act(self, obs: Tensor) -> tuple[Tensor, ...]:
        mixture = self.actor(self.actor.normalizer(obs))
        self.resampling.record(mixture)
        action = mixture.action(sample(mixture)[0])
        return action, action

    @torch.no_grad()
    def interact(self) -> dict[str, Tensor]:
        """Act for a window, into the buffer."""
        window, (action,) = self.collect()
        made = window.obs, action, window.reward, window.next_obs, window.terminated.to(window.reward.dtype)
        self.buffer.add(Transition(*(tensor.flatten(0, 1) for tensor in made)))
        self.actor.normalizer.update(window.obs)
        return {}

    def learn(self) -> dict[str, Tensor]:
        """As many updates as there were control steps, times the epochs."""
        normalizer, rows = self.actor.normalizer, []
        for _ in range(self.args.horizon * self.args.epochs):
            batch = self.buffer.sample(self.args.minibatch_size)
            obs, next_obs = normalizer(batch.obs), normalizer(batch.next_obs)
            rows.append(self.update_critics(batch, obs, next_obs) | self.update_actor(obs))
        return self.end_iteration(rows) | {"charts/temperature": self.temperature["log"].detach().exp()}

    def update_critics(self, batch: Transition, obs: Tensor, next_obs: Tensor) -> dict[str, Tensor]:
        """Descend the soft Bellman residual, and let the target critics follow."""
        with torch.no_grad():
            mixture = self.actor(next_obs)
            u, _ = sample(mixture)
            soft = values(self.target, next_obs, mixture.action(u)).amin(0)
            soft = soft - self.temperature["log"].exp() * mixture.log_prob(u)
            target = batch.reward + self.args.gamma * (1 - batch.terminated) * soft
        value = values(self.critic, obs, batch.action)
        loss = (value - target).square().mean(1).sum()
        self.critic_optimizer.step(loss)
        self.follow()
        return {"losses/critic": loss.detach() / 2, "charts/value": value.detach().mean()}

    def update_actor(self, obs: Tensor) -> dict[str, Tensor]:
        """Ascend value and entropy; steer the temperature to an entropy of minus one nat per action."""
        mixture = self.actor(obs)
        u, _ = sample(mixture, self.args.estimator, self.args.density_floor)
        density = mixture.log_prob(u)
        value = values(self.critic, obs, mixture.action(u)).amin(0)
        loss = (self.temperature["log"].detach().exp() * density - value).mean()
        norm = self.optimizer.step(loss)
        surplus = u.shape[-1] - density.detach().mean()  # of entropy over the target
        self.temperature_optimizer.step(self.temperature["log"].exp() * surplus)
        return {"losses/actor": loss.detach(), "charts/entropy": -density.detach().mean(), "grad/norm": norm}


def values(critics: nn.Module, obs: Tensor, action: Tensor) -> Tensor:
    """Each critic's Q(s, a) (2, B)."""
    inputs = torch.cat((obs, action), -1)
    found: Tensor = critics(inputs.expand(2, *inputs.shape)).squeeze(-1)
    return found


# The run --------------------------------------------------------------------------------------------------------------

ALGORITHMS: dict[str, type[PPO | SHAC | SAC]] = {"ppo": PPO, "shac": SHAC, "sac": SAC}


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon)
    learner = run.restore(ALGORITHMS[args.algorithm](args, env))
    interact, learn = run.capture(learner.interact, env), run.capture(learner.learn)
    for iteration in run:
        learner.schedule(iteration)
        run.log(interact() | learn())
        if run.evaluation_due:
            run.log_evaluation(evaluate(run.eval_env, learner.policy))


main = script(Args, train)

if __name__ == "__main__":
    main()
