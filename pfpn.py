"""PFPN, Particle Filtering Policy Network (Xu and Karamouzas 2021, https://doi.org/10.1145/3487983.3488301), by PPO.

A Gaussian policy has one peak. Here each action has particles: normal distributions that are the same in all states,
with weights from the network. The policy is their mixture. Particles without weight are moved to others that have some.
PPO trains this policy and those with which the paper compares it; pfpn_sac.py trains it off-policy.

    python pfpn.py --env ant --seed 1                        train; writes runs/ant__pfpn__1__<time>/
    python pfpn.py --env ant --policy gaussian               or gmm, discrete: the policies to compare
    python pfpn.py --resume <run>/checkpoint.pt              continue an interrupted run exactly
    python pfpn.py --evaluate <run>/checkpoint.pt            evaluate its deterministic policy
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.learning.likeliest import Likeliest
from diffsim.training import Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import ObsNormalizer, mlp, moments
from diffsim.training.optimizer import ClippedAdam
from diffsim.training.ranges import AtLeast2, Bounds, Count, Decay, Fraction, NonNegative, Positive, SomeWidths, UpTo10k

# The settings of ppo_baseline.py, so that only the policy differs. A task that is not in the table has the humanoid's.
# fmt: off
COLUMNS = ("hidden", "num_envs", "horizon", "minibatch_size", "epochs", "entropy_coef", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),         32, 240,  1920, 5, 0.0,    500),
    "hopper":       ((128, 64, 32),  1024,  32,  8192, 5, 0.01,  5000),
    "half_cheetah": ((128, 64, 32),  1024,  32,  8192, 5, 0.0,   5000),
    "ant":          ((128, 64, 32),  2048,  32, 16384, 5, 0.01,  5000),
    "humanoid":     ((256, 128, 64), 1024,  32,  8192, 5, 0.0,   5000),
    "humanoid_mtu": ((512, 512, 256), 1024, 32,  8192, 6, 0.0,  20000),
}
# fmt: on
CPU = {"num_envs": 256, "minibatch_size": 2048}  # at most: where samples cost more, smaller steps learn more of each
LOG_STD = (-5.0, 2.0)  # bounds of the log standard deviation of a component
# As in ppo_baseline.py, where they are explained:
MAX_GRAD_NORM, TARGET_KL, GAE_LAMBDA, CLIP, VALUE_COEF, BOUND_COEF = 1.0, 0.008, 0.95, 0.2, 2.0, 1e-4


@dataclass
class Args(Flags):
    """The policy, and PPO. Defaults are the humanoid's."""

    processes: ClassVar[bool] = False

    policy: Literal["pfpn", "gaussian", "gmm", "discrete"] = "pfpn"
    """particles; one Gaussian; a mixture whose locations and scales also depend on the state; fixed bins"""
    std: Literal["state", "own"] = "state"
    """standard deviation of the Gaussian policy: a function of the state, or one parameter per action"""
    particles: AtLeast2 = 35
    """particles (components, bins) of each action"""
    initial_log_std: float | None = None
    """log standard deviation of the first actions (default: a Gaussian's is 0, components cover [-1, 1], about -0.5)"""
    resampling: Literal["weighted", "uniform", "none"] = "weighted"
    """dead particles become copies of living ones: in proportion to mean weights, uniformly, or not at all"""
    resampling_interval: Count = 20
    """iterations between resamplings"""
    resampling_noise: NonNegative = 0.1
    """a particle lands within this many standard deviations of the one that it copies"""
    dead: Decay = 0.05
    """a particle is dead if its weight since the last resampling is below this share of 1 / particles"""
    dead_by: Literal["mean", "max"] = "mean"
    """weight that decides: the mean over the recorded steps, or the largest (Eq. 8)"""

    num_envs: Count = 1024
    """parallel environments N (per task; on a CPU at most 256)"""
    horizon: Count = 32
    """control steps of a rollout (per task)"""
    hidden: SomeWidths = (256, 128, 64)
    """units of the hidden layers, which policy and value share (per task)"""
    lr: Positive = 3e-4
    """initial learning rate, which then follows the KL divergence of the updates"""
    lr_bounds: Bounds = (1e-6, 1e-2)
    """smallest and largest learning rate; two equal numbers fix it"""
    gamma: Fraction = 0.99
    """discount factor"""
    epochs: UpTo10k = 5
    """passes over the samples of a rollout (per task)"""
    minibatch_size: Count = 8192
    """samples of an update (per task; on a CPU at most 2048)"""
    entropy_coef: NonNegative = 0.0
    """weight of the entropy bonus, which keeps the policy's noise from vanishing (per task)"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK.get(self.like, PER_TASK["humanoid"]), strict=True))
        if self.device == "cpu":
            values |= {name: min(values[name], most) for name, most in CPU.items()}
        return values | {"eval_every": 500, "save_every": 500}

    def check(self) -> None:
        super().check()
        if not LOG_STD[0] <= (self.initial_log_std or 0.0) <= LOG_STD[1]:
            fail(f"--initial-log-std must be from {LOG_STD[0]:g} to {LOG_STD[1]:g}, not {self.initial_log_std}")


# Policies -------------------------------------------------------------------------------------------------------------


class Mixture:
    """pi(a|s) = prod_k sum_i w_ki N(a_k; mu_ki, xi_ki^2) (Eq. 3), of m actions k with n components i each.

    A log_std of minus infinity makes the components points.
    """

    def __init__(self, logits: Tensor, loc: Tensor, log_std: Tensor) -> None:
        self.logits, self.log_weight = logits, F.log_softmax(logits, -1)  # (..., m, n)
        self.loc, self.log_std = loc, log_std  # (..., m, n) or (m, n)

    def sample(self) -> Tensor:
        """Draw actions (..., m), Eq. 4 and 5: a component by its weight, and a normal number around its location."""
        noise, std = torch.randn_like(self.logits[..., 0]), self.log_std.exp()
        if self.logits.shape[-1] == 1:  # a Gaussian
            return self.loc.squeeze(-1) + std.squeeze(-1) * noise
        total = self.logits.softmax(-1).cumsum(-1)
        level = (1 - torch.rand_like(noise).unsqueeze(-1)) * total[..., -1:]
        index = (total < level).sum(-1, keepdim=True)
        loc, scale = (x.expand_as(self.logits).gather(-1, index).squeeze(-1) for x in (self.loc, std))
        return loc + scale * noise

    def log_density(self, action: Tensor) -> Tensor:
        """Compute the log density of each action by itself (..., m)."""
        rate = (-self.log_std).exp() * math.sqrt(0.5)
        z = torch.addcmul(-self.loc * rate, action.unsqueeze(-1), rate)
        return logsumexp(self.log_weight - self.log_std - z.square()) - 0.5 * math.log(2 * math.pi)

    def log_prob(self, action: Tensor) -> Tensor:
        """Compute log pi(a|s) (...) of actions (..., m)."""
        return self.log_density(action).sum(-1)

    def entropy(self) -> Tensor:
        """Sum the weights' entropy (appendix B) over the actions (...), or a single component's differential one."""
        if self.logits.shape[-1] == 1:
            return (self.log_std + (1 + math.log(2 * math.pi)) / 2).sum((-1, -2))
        return -(self.log_weight.exp() * self.log_weight).sum((-1, -2))


class Bins(Mixture):
    """The mixture of points, DISCRETE in the paper. What it draws is a location; others count as the nearest one."""

    def log_density(self, action: Tensor) -> Tensor:
        nearest = (action.unsqueeze(-1) - self.loc).abs().argmin(-1, keepdim=True)
        return self.log_weight.gather(-1, nearest).squeeze(-1)


def logsumexp(x: Tensor) -> Tensor:
    """Sum over the last dimension. torch's takes several times as long on a CPU where an exponential underflows."""
    largest = x.detach().argmax(-1, keepdim=True)
    return (x.gather(-1, largest) - F.log_softmax(x, -1).gather(-1, largest)).squeeze(-1)


# A head takes features of a network (..., inputs) to the mixture of each of m actions. Its `layers` take them to the
# locations of the largest weights.


class ParticleHead(nn.Module):
    """PFPN: the weights depend on the state, locations and scales are the same in all states (Figure 2)."""

    mixture: type[Mixture] = Mixture
    moving: bool = True  # locations and scales are trained

    def __init__(self, args: Args, inputs: int, actions: int) -> None:
        super().__init__()
        self.shape = actions, args.particles
        loc, log_std = spread(*self.shape, args.initial_log_std)
        self.linear, self.likeliest = almost_constant(inputs, torch.zeros_like(loc)), Likeliest(*self.shape)
        self.layers = [self.linear, self.likeliest]
        self.loc.requires_grad_(self.moving).data.copy_(loc)
        self.log_std = nn.Parameter(log_std if self.moving else log_std.fill_(-math.inf), self.moving)

    @property
    def loc(self) -> nn.Parameter:
        return self.likeliest.get_parameter("loc")

    def forward(self, features: Tensor) -> Mixture:
        return self.mixture(self.linear(features).unflatten(-1, self.shape), self.loc, self.log_std)


class DiscreteHead(ParticleHead):
    """DISCRETE: the components are points, which stay where they are."""

    mixture, moving = Bins, False


class MixtureHead(nn.Module):
    """GMM: weights, locations and scales depend on the state."""

    def __init__(self, args: Args, inputs: int, actions: int) -> None:
        super().__init__()
        self.shape = actions, args.particles
        loc, log_std = spread(*self.shape, args.initial_log_std)
        self.linear = almost_constant(inputs, torch.stack((torch.zeros_like(loc), loc)))
        self.scale = almost_constant(inputs, log_std)
        self.layers = [self.linear, Likeliest(*self.shape, shared=False)]

    def forward(self, features: Tensor) -> Mixture:
        logits, loc = self.linear(features).unflatten(-1, (2, *self.shape)).unbind(-3)
        return Mixture(logits, loc, self.scale(features).unflatten(-1, self.shape).clamp(*LOG_STD))


class GaussianHead(nn.Module):
    """A Gaussian: its location depends on the state, with --std state its scale, too."""

    def __init__(self, args: Args, inputs: int, actions: int) -> None:
        super().__init__()
        self.shape, first = (actions, 1), torch.full((actions, 1), args.initial_log_std or 0.0)
        self.linear = nn.Linear(inputs, actions)
        self.layers = [self.linear]
        self.scale = almost_constant(inputs, first) if args.std == "state" else None
        if self.scale is None:
            self.log_std = nn.Parameter(first)

    def forward(self, features: Tensor) -> Mixture:
        loc = self.linear(features).unsqueeze(-1)
        log_std = self.log_std if self.scale is None else self.scale(features).unsqueeze(-1).clamp(*LOG_STD)
        return Mixture(torch.zeros_like(loc), loc, log_std)


Head = ParticleHead | MixtureHead | GaussianHead
HEADS: dict[str, type[Head]]
HEADS = {"pfpn": ParticleHead, "gaussian": GaussianHead, "gmm": MixtureHead, "discrete": DiscreteHead}


def spread(actions: int, n: int, log_std: float | None = None) -> tuple[Tensor, Tensor]:
    """Return locations that cover each action evenly, and log standard deviations that cover their gaps (m, n).

    They cover [-1, 1], or as much as gives their mixture with equal weights a log standard deviation.
    """
    loc = torch.linspace(-1, 1, n, dtype=torch.float64)
    gap = loc.diff()
    widest = torch.maximum(F.pad(gap, (1, 0)), F.pad(gap, (0, 1)))
    if log_std is not None:
        scale = math.exp(log_std) / (loc.square() + widest.square()).mean().sqrt()
        loc, widest = loc * scale, widest * scale
    return loc.float().repeat(actions, 1), widest.log().float().repeat(actions, 1)


def almost_constant(inputs: int, output: Tensor) -> nn.Linear:
    """Make a layer that begins with small weights around an output."""
    layer = nn.Linear(inputs, output.numel())
    nn.init.trunc_normal_(layer.weight, std=0.01, a=-0.02, b=0.02)
    layer.bias.data.copy_(output.flatten())
    return layer


class Actor(nn.Module):
    """pi(a|s) and V(s), in units of its normalizer, on shared features of normalized observations."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim, seen = env.task.obs_dim, env.scene.nu, env.task.actor_dim
        self.normalizer = ObsNormalizer(obs_dim)
        self.body = mlp(obs_dim, args.hidden, None, nn.ELU, columns=seen)
        self.head = HEADS[args.policy](args, args.hidden[-1], action_dim)
        self.value = nn.Linear(args.hidden[-1], 1)

    def forward(self, obs: Tensor) -> tuple[Mixture, Tensor]:
        features = self.body(obs)
        return self.head(features), self.value(features).squeeze(-1)

    def deterministic(self) -> nn.Sequential:
        """Return the locations of the largest weights, of observations as they come, with the same weights."""
        return nn.Sequential(self.normalizer, *self.body, *self.head.layers)


# Resampling -----------------------------------------------------------------------------------------------------------


class Resampling(nn.Module):
    """Keeps the particles' weights, and moves those without weight to others (section 3.3). Works in place."""

    def __init__(self, args: Args, head: Head) -> None:
        super().__init__()
        self.args, self.active = args, type(head) is ParticleHead  # others have nothing to move
        self.seen: Tensor = nn.Buffer(torch.zeros(2, *head.shape))  # since the last one: sum and largest of weights
        self.age: Tensor = nn.Buffer(torch.zeros((), dtype=torch.int64))  # iterations
        self.moved: Tensor = nn.Buffer(torch.zeros(()))  # particles, ever

    def record(self, acting: Mixture) -> None:
        """Take the weights (..., m, n) with which the policy acts."""
        if self.active:
            weight = acting.logits.detach().softmax(-1).flatten(0, -3)
            self.seen[0] += weight.sum(0)
            torch.maximum(self.seen[1], weight.amax(0), out=self.seen[1])

    @torch.no_grad()
    def end_iteration(self, head: Head, optimizer: ClippedAdam) -> dict[str, Tensor]:
        """Resample if it is time; that is decided on the device, so a captured iteration does the same."""
        if type(head) is not ParticleHead:
            return {}
        head.log_std.clamp_(*LOG_STD)
        self.age += 1
        due = self.age % self.args.resampling_interval == 0
        weight = self.seen[0] / self.seen[0].sum(-1, keepdim=True)  # where nothing was recorded not a number
        least, largest = self.args.dead / head.shape[1], torch.maximum(weight, self.seen[1])
        below = {"mean": weight < least, "max": largest < least}  # Eq. 8 has the second
        dead = below[self.args.dead_by]
        if self.args.resampling != "none":
            chance = weight if self.args.resampling == "weighted" else torch.ones_like(weight)
            self.move(head, optimizer, dead & due, chance.masked_fill(dead, 0.0))
        self.seen *= ~due
        return {
            **{f"particles/dead_{by}": each.to(weight.dtype).mean() for by, each in below.items()},
            "particles/moved": self.moved,
            "particles/active": (-torch.xlogy(weight, weight).sum(-1)).exp().mean(),
            "particles/std": (weight * head.log_std.exp()).sum(-1).mean(),
        }

    def move(self, head: ParticleHead, optimizer: ClippedAdam, dead: Tensor, chance: Tensor) -> None:
        """Make the dead particles copies of others, drawn by the chances (m, n) (Eq. 9), the policy the same (Eq. 10).

        |D| copies share the weight of their target: log(|D| + 1) less in each logit. Adam's moments of them are zeroed.
        """
        m, n = head.shape
        draws = torch.empty(m, n, n, device=dead.device).exponential_()
        target = torch.where(dead, (chance.unsqueeze(1) / draws).argmax(-1), torch.arange(n, device=dead.device))
        copies = torch.zeros_like(chance).scatter_add(1, target, dead.to(chance.dtype))
        head.linear.bias.data.view(m, n).sub_(torch.log1p(copies))
        for parameter in (head.linear.weight, head.linear.bias, head.loc, head.log_std):
            rows = parameter.data.view(m, n, -1)
            rows.copy_(rows.gather(1, target.unsqueeze(-1).expand_as(rows)))
            for moment in optimizer.moments(parameter):
                moment.view(m, n, -1).masked_fill_(dead.unsqueeze(-1), 0.0)
        uniform = 2 * torch.rand_like(head.loc) - 1
        head.loc.add_(dead * self.args.resampling_noise * uniform * head.log_std.exp())
        self.moved += dead.sum()


# The algorithm --------------------------------------------------------------------------------------------------------


class Batch(NamedTuple):
    """What the update needs of a rollout's samples, or of some of them: (B, ...)."""

    obs: Tensor  # normalized
    action: Tensor
    log_prob: Tensor  # of the policy that acted
    advantage: Tensor  # normalized
    target: Tensor  # of the value, normalized


class PPO:
    """What an iteration changes, and the iteration."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        self.actor = Actor(args, env).to(env.device)
        self.policy = self.actor.deterministic()
        self.resampling = Resampling(args, self.actor.head).to(env.device)
        self.return_normalizer = ObsNormalizer().to(env.device)
        self.optimizer = ClippedAdam(self.actor, MAX_GRAD_NORM, lr=args.lr)
        self.minibatches = math.ceil(args.horizon * env.num_envs / args.minibatch_size)

    def iterate(self) -> dict[str, Tensor]:
        """Act for a rollout, descend the clipped loss in epochs of minibatches, then resample; returns metrics.

        It changes tensors in place and never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        samples, found = self.sample()
        rows = []
        for _ in range(self.args.epochs):
            order = torch.randperm(len(samples.obs), device=self.env.device)
            for tensors in zip(*(tensor[order].chunk(self.minibatches) for tensor in samples), strict=True):
                rows.append(self.update(Batch(*tensors)))
        found |= {name: torch.stack([row[name] for row in rows]).mean() for name in rows[0]}
        found |= {"grad/skipped": self.optimizer.skipped, "charts/learning_rate": self.optimizer.lr}
        return found | self.resampling.end_iteration(self.actor.head, self.optimizer)

    @torch.no_grad()
    def sample(self) -> tuple[Batch, dict[str, Tensor]]:
        """Act for a rollout; returns its samples with their advantages and value targets, and metrics."""
        args, normalizer, steps, obs = self.args, self.actor.normalizer, [], self.env.detach()
        for _ in range(args.horizon):
            mixture, value = self.actor(normalizer(obs))
            self.resampling.record(mixture)
            action = mixture.sample()
            next_obs, reward, terminated, truncated, info = self.env.step(action)
            ends = terminated, terminated | truncated
            steps.append((obs, info["final_obs"], action, mixture.log_prob(action), value, reward, *ends))
            obs = next_obs
        rollout = (torch.stack(tensors) for tensors in zip(*steps, strict=True))  # (H, N, ...)
        obs, next_obs, action, log_prob, value, reward, terminated, done = rollout
        mixture, next_value = self.actor(normalizer(next_obs))
        next_value = self.return_normalizer.inverse(next_value).masked_fill(terminated, 0.0)
        target = td_lambda(reward, next_value, done, args.gamma, GAE_LAMBDA)
        advantage = target - self.return_normalizer.inverse(value)
        explained = 1 - advantage.var() / target.var()
        self.return_normalizer.update(target)
        var, mean = moments(advantage.flatten())
        advantage = (advantage - mean) / (var.sqrt() + 1e-8)
        samples = normalizer(obs), action, log_prob, advantage, self.return_normalizer(target)
        normalizer.update(obs)
        found = {"losses/entropy": mixture.entropy().mean(), "losses/explained_variance": explained}
        return Batch(*(tensor.flatten(0, 1) for tensor in samples)), found

    def update(self, batch: Batch) -> dict[str, Tensor]:
        """Take one step on a minibatch, with a learning rate that keeps the policy near the one that acted."""
        mixture, value = self.actor(batch.obs)
        log_ratio = mixture.log_prob(batch.action) - batch.log_prob
        kl = (log_ratio.detach().expm1() - log_ratio.detach()).mean()  # estimated; not below zero
        up, down = (x.to(kl.dtype) for x in (kl < TARGET_KL / 2, kl > 2 * TARGET_KL))
        self.optimizer.lr.mul_(1.5 ** (up - down)).clamp_(*self.args.lr_bounds)
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
        policy_loss = -torch.minimum(ratio * batch.advantage, clipped * batch.advantage).mean()
        value_loss = (value - batch.target).square().mean()
        bound_loss = (mixture.loc.abs() - 1.1).clamp(min=0).square().mean(-1).sum(-1).mean()
        loss = policy_loss + VALUE_COEF * value_loss + BOUND_COEF * bound_loss
        if self.args.entropy_coef:
            loss = loss - self.args.entropy_coef * mixture.entropy().mean()
        gradient = self.optimizer.gradient(loss)
        return {
            "losses/policy_loss": policy_loss.detach(),
            "losses/value_loss": value_loss.detach(),
            "losses/approx_kl": kl,
            "losses/clipfrac": ((ratio.detach() - 1).abs() > CLIP).to(kl.dtype).mean(),
            "grad/norm": self.optimizer.step(gradient),
        }


def td_lambda(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """Compute TD(lambda) of (H, N) steps, to a done or the rollout's end: value plus generalized advantage.

    next_value is V(s_{t+1}), before any reset: zero where the episode terminated, but not where its time ran out.
    """
    returns = torch.empty_like(reward)
    following = next_value[-1]
    for t in reversed(range(len(reward))):
        following = torch.where(done[t], next_value[t], torch.lerp(next_value[t], following, lam))
        following = returns[t] = reward[t] + gamma * following
    return returns


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon)
    ppo = run.restore(PPO(args, env))
    iterate = run.capture(ppo.iterate, env)
    for _ in run:
        run.log(iterate())
        if run.evaluation_due:
            run.evaluate(ppo.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
