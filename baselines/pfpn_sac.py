"""PFPN, Particle Filtering Policy Network (Xu and Karamouzas 2021, https://doi.org/10.1145/3487983.3488301), by SAC.

The policy is a mixture of particles: normal distributions that are the same in all states, with weights from the
network. Soft Actor-Critic trains it off-policy, as in section 4.4 of the paper: the critics' gradient goes through the
sampled actions. pfpn.py trains it by PPO.

    python baselines/pfpn_sac.py --env ant --seed 1              train; writes runs/ant__pfpn_sac__1__<time>/
    python baselines/pfpn_sac.py --env ant --policy gaussian     the policy to compare
    python baselines/pfpn_sac.py --resume <run>/checkpoint.pt    continue an interrupted run exactly
    python baselines/pfpn_sac.py --evaluate <run>/checkpoint.pt  evaluate its deterministic policy
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.learning.ensemble import Ensemble
from diffsim.learning.likeliest import Likeliest
from diffsim.learning.replay import ReplayBuffer, Transition
from diffsim.training import Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import ObsNormalizer, mlp
from diffsim.training.optimizer import ClippedAdam
from diffsim.training.ranges import AtLeast2, Batch, Count, Decay, Fraction, NonNegative, Positive, SomeWidths, UpTo10k

# The settings of sac_baseline.py, so that only the policy differs. A task that is not in the table has the humanoid's.
# fmt: off
COLUMNS = ("hidden", "num_envs", "minibatch_size", "temperature_lr", "lr", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),              32, 1024, 5e-3, 5e-4,  4_000),
    "hopper":       ((256, 128, 64),        64, 2048, 5e-3, 5e-4, 20_000),
    "half_cheetah": ((256, 128, 64),        64, 2048, 5e-3, 5e-4, 20_000),
    "ant":          ((256, 128, 64),       128, 4096, 5e-3, 5e-4, 20_000),
    "humanoid":     ((512, 256),            64, 2048, 2e-4, 3e-4, 20_000),
    "humanoid_mtu": ((512, 512, 512, 256), 256, 4096, 2e-4, 3e-4, 40_000),
}
# fmt: on
LOG_STD = (-5.0, 2.0)  # bounds of the log standard deviation of a component
MAX_GRAD_NORM = 100.0  # sac_baseline.py's
TAU = 0.005  # target critics <- (1 - tau) target critics + tau critics, after each update


@dataclass
class Args(Flags):
    """The policy, and SAC. Defaults are the humanoid's."""

    processes: ClassVar[bool] = False

    policy: Literal["pfpn", "gaussian"] = "pfpn"
    """particles, or one Gaussian"""
    particles: AtLeast2 = 35
    """particles of each action"""
    estimator: Literal["implicit", "straight-through"] = "implicit"
    """gradient of a sampled action in the particles' weights: the one without bias, or the paper's"""
    resampling_interval: Count = 20
    """iterations between resamplings"""
    resampling_noise: NonNegative = 0.1
    """a particle lands within this many standard deviations of the one that it copies"""
    dead: Decay = 0.05
    """a particle is dead if its mean weight since the last resampling is below this share of 1 / particles"""

    num_envs: Count = 64
    """parallel environments N (per task)"""
    horizon: Count = 32
    """control steps of a rollout"""
    hidden: SomeWidths = (512, 256)
    """units of the policy's hidden layers (per task)"""
    critic_hidden: SomeWidths = (512, 256)
    """units of the critics' hidden layers (per task)"""
    lr: Positive = 3e-4
    """learning rate of policy and critics (per task)"""
    temperature_lr: Positive = 2e-4
    """learning rate of the temperature's logarithm (per task)"""
    gamma: Fraction = 0.99
    """discount factor"""
    epochs: UpTo10k = 1
    """updates per control step"""
    minibatch_size: Batch = 2048
    """samples of an update (per task)"""
    buffer_size: Count = 1_000_000
    """transitions in the replay buffer, over all environments"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK.get(self.like, PER_TASK["humanoid"]), strict=True))
        rare = {"eval_every": 500, "save_every": 500}  # a checkpoint holds the replay buffer
        return values | rare | {"critic_hidden": values["hidden"]}

    def check(self) -> None:
        super().check()
        if self.buffer_size < (steps := self.horizon * self.num_envs):
            fail(f"--buffer-size {self.buffer_size} is smaller than a rollout of {steps} steps")


# Policies -------------------------------------------------------------------------------------------------------------


class Mixture:
    """Each of m actions is tanh u, where u has the density sum_i w_i N(u; mu_i, xi_i^2) of n components (Eq. 3, 27)."""

    def __init__(self, logits: Tensor, loc: Tensor, log_std: Tensor) -> None:
        self.logits, self.log_weight = logits, F.log_softmax(logits, -1)  # (..., m, n)
        self.loc, self.log_std = loc, log_std  # (..., m, n) or (m, n)

    def sample(self) -> Tensor:
        """Draw u (..., m), Eq. 4 and 5: a component by its weight, and a normal number around its location."""
        noise = torch.randn_like(self.logits[..., 0])
        if self.logits.shape[-1] == 1:  # a Gaussian
            return self.loc.squeeze(-1) + self.log_std.exp().squeeze(-1) * noise
        return self.pick(self.choose(), noise)

    def choose(self) -> Tensor:
        """Draw a component (..., m, 1) by its weight."""
        total = self.logits.detach().softmax(-1).cumsum(-1)
        level = (1 - torch.rand_like(total[..., :1])) * total[..., -1:]
        return (total < level).sum(-1, keepdim=True)

    def pick(self, index: Tensor, noise: Tensor) -> Tensor:
        """Return u (..., m) of the components (..., m, 1), with the gradient of their locations and scales."""
        pair = self.loc, self.log_std.exp()
        loc, scale = (x.expand_as(self.logits).gather(-1, index).squeeze(-1) for x in pair)
        return loc + scale * noise

    def log_density(self, u: Tensor) -> Tensor:
        """Compute the log density of each u by itself (..., m)."""
        rate = (-self.log_std).exp() * math.sqrt(0.5)
        z = torch.addcmul(-self.loc * rate, u.unsqueeze(-1), rate)
        return logsumexp(self.log_weight - self.log_std - z.square()) - 0.5 * math.log(2 * math.pi)

    def log_prob(self, u: Tensor) -> Tensor:
        """Compute log pi(a|s) (...) of the actions of u (..., m): Eq. 28, with the slope outside of the logarithm."""
        return (self.log_density(u) - log_slope(u)).sum(-1)


def log_slope(u: Tensor) -> Tensor:
    """Compute log da/du."""
    return 2 * (math.log(2) - u - F.softplus(-2 * u))


def logsumexp(x: Tensor) -> Tensor:
    """Sum over the last dimension. torch's takes several times as long on a CPU where an exponential underflows."""
    largest = x.detach().argmax(-1, keepdim=True)
    return (x.gather(-1, largest) - F.log_softmax(x, -1).gather(-1, largest)).squeeze(-1)


# A head takes features of a network (..., inputs) to the mixture of each of m actions. Its `layers` take them to u of
# the largest weights.


class ParticleHead(nn.Module):
    """PFPN: the weights depend on the state, locations and scales are the same in all states (Figure 2)."""

    def __init__(self, args: Args, inputs: int, actions: int) -> None:
        super().__init__()
        self.shape = actions, args.particles
        loc, log_std = spread(*self.shape)
        self.linear, self.likeliest = nn.Linear(inputs, loc.numel()), Likeliest(*self.shape)
        self.layers = [self.linear, self.likeliest]
        nn.init.trunc_normal_(self.linear.weight, std=0.01, a=-0.02, b=0.02)  # almost constant
        nn.init.zeros_(self.linear.bias)
        self.loc.data.copy_(loc)
        self.log_std = nn.Parameter(log_std)

    @property
    def loc(self) -> nn.Parameter:
        """Return the particles' locations (m, n)."""
        return self.likeliest.get_parameter("loc")

    def forward(self, features: Tensor) -> Mixture:
        return Mixture(self.linear(features).unflatten(-1, self.shape), self.loc, self.log_std)


class GaussianHead(nn.Module):
    """A Gaussian, whose location and scale depend on the state."""

    def __init__(self, args: Args, inputs: int, actions: int) -> None:
        super().__init__()
        self.shape = actions, 1
        self.linear, self.scale = nn.Linear(inputs, actions), nn.Linear(inputs, actions)
        self.layers = [self.linear]

    def forward(self, features: Tensor) -> Mixture:
        loc, log_std = self.linear(features).unsqueeze(-1), self.scale(features).unsqueeze(-1).clamp(*LOG_STD)
        return Mixture(torch.zeros_like(log_std), loc, log_std)


Head = ParticleHead | GaussianHead
HEADS: dict[str, type[Head]] = {"pfpn": ParticleHead, "gaussian": GaussianHead}


def spread(actions: int, n: int) -> tuple[Tensor, Tensor]:
    """Return locations of u that cover actions evenly, and log standard deviations that cover their gaps (m, n)."""
    loc = torch.atanh(-1 + (2 * torch.arange(n, dtype=torch.float64) + 1) / n)
    gap = loc.diff()
    widest = torch.maximum(F.pad(gap, (1, 0)), F.pad(gap, (0, 1)))
    return loc.float().repeat(actions, 1), widest.log().float().repeat(actions, 1)


class Actor(nn.Module):
    """pi(a|s), of normalized observations."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim, seen = env.task.obs_dim, env.scene.nu, env.task.actor_dim
        self.normalizer = ObsNormalizer(obs_dim)
        self.body = mlp(obs_dim, args.hidden, None, nn.ReLU, columns=seen)
        self.head = HEADS[args.policy](args, args.hidden[-1], action_dim)

    def forward(self, obs: Tensor) -> Mixture:
        mixture: Mixture = self.head(self.body(obs))
        return mixture

    def deterministic(self) -> nn.Sequential:
        """Return the actions of the largest weights, of observations as they come, with the same weights."""
        return nn.Sequential(self.normalizer, *self.body, *self.head.layers, nn.Tanh())


class Draw(NamedTuple):
    """What SAC descends with: samples, whose gradients together are that of their mean."""

    u: Tensor  # (B, m)
    log_prob: Tensor  # (B,) of it
    other: Tensor | None = None  # (B, m), of which only the gradient counts


def reparameterised(mixture: Mixture) -> Draw:
    """Draw a sample of a Gaussian."""
    u = mixture.sample()
    return Draw(u, mixture.log_prob(u))


def straight_through(mixture: Mixture) -> Draw:
    """Draw a sample whose gradient in the weights is Eq. 25's: as if the action were linear in the relaxed choice x."""
    noise = torch.randn_like(mixture.logits[..., 0])
    scores = mixture.logits - torch.empty_like(mixture.logits).exponential_().log()  # Gumbel noise
    u = mixture.pick(scores.argmax(-1, keepdim=True), noise)
    each = (mixture.loc + mixture.log_std.exp() * noise.unsqueeze(-1)).detach()  # what each would have drawn
    x = scores.softmax(-1)  # Concrete distribution of temperature 1
    gap = torch.tanh(each) - torch.tanh(u.detach()).unsqueeze(-1)
    gap = gap / log_slope(u.detach()).exp().clamp(min=1e-3).unsqueeze(-1)  # of u, for the same gap of actions
    u = u + (gap * (x - x.detach())).sum(-1)
    return Draw(u, mixture.log_prob(u))


def implicit(mixture: Mixture) -> Draw:
    """Draw samples whose gradient has no bias.

    The value's is implicit (Figurnov et al. 2018, https://arxiv.org/abs/1805.08498). Few samples fall between narrow
    particles, where that is large. Therefore a second sample has one of the m actions from all of (-1, 1). The
    entropy's is the chosen component's in locations and scales, and the score function's in the weights, less what the
    temperature steers log pi of an action to, which is 1.
    """
    noise, chosen = torch.randn_like(mixture.logits[..., 0]), mixture.choose()
    u = mixture.pick(chosen, noise)
    log_pi = mixture.log_density(u) - log_slope(u)
    score = (log_pi.detach() - 1) * mixture.log_weight.gather(-1, chosen).squeeze(-1)
    drawn, m = u.detach(), u.shape[-1]
    one = F.one_hot(torch.randint(m, u.shape[:-1], device=u.device), m)
    other = torch.where(one > 0, torch.logit(torch.rand_like(u), eps=1e-7) / 2, drawn)
    log_pi = log_pi + score - score.detach()
    return Draw(drawn + shift(mixture, drawn), log_pi.sum(-1), other + one * shift(mixture, other))


def shift(mixture: Mixture, u: Tensor) -> Tensor:
    """Return 0 (B, m), with the gradient that u has if its cumulative probability F(u) stays: du = -dF / p(u).

    Both samples of `implicit` divide by the sum of the densities with which they come (Veach's balance heuristic),
    p(u) and that of a constant density 1/2 of actions, for one of m. So the gradient of tanh u is at most 2m times dF.
    """
    z = (u.unsqueeze(-1) - mixture.loc) * (-mixture.log_std).exp()
    cumulative = (mixture.log_weight.exp() * torch.special.ndtr(z)).sum(-1)
    density = mixture.log_density(u).detach().exp() + log_slope(u).exp() / (2 * u.shape[-1])
    return (cumulative.detach() - cumulative) / density


# Resampling -----------------------------------------------------------------------------------------------------------


class Resampling(nn.Module):
    """Keeps the particles' weights, and moves those without weight to others (section 3.3). Works in place."""

    def __init__(self, args: Args, head: Head) -> None:
        super().__init__()
        self.args, self.active = args, type(head) is ParticleHead  # a Gaussian has nothing to move
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
        dead = weight < least
        self.move(head, optimizer, dead & due, weight.masked_fill(dead, 0.0))
        self.seen *= ~due
        return {
            "particles/dead_mean": dead.to(weight.dtype).mean(),
            "particles/dead_max": (largest < least).to(weight.dtype).mean(),  # as in Eq. 8
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


class SAC:
    """What an iteration changes, and the iteration."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        estimator = straight_through if args.estimator == "straight-through" else implicit
        self.draw = reparameterised if args.policy == "gaussian" else estimator
        obs_dim, action_dim = env.task.obs_dim, env.scene.nu
        self.actor = Actor(args, env).to(env.device)
        self.policy = self.actor.deterministic()
        self.resampling = Resampling(args, self.actor.head).to(env.device)
        critics = [mlp(obs_dim + action_dim, args.critic_hidden, 1, nn.ReLU) for _ in range(2)]
        self.critics = Ensemble(critics).to(env.device)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.temperature = nn.ParameterDict({"log": torch.zeros(())}).to(env.device)  # the entropy's weight
        self.optimizer = ClippedAdam(self.actor, MAX_GRAD_NORM, lr=args.lr)
        self.critic_optimizer = ClippedAdam(self.critics, MAX_GRAD_NORM, lr=args.lr)
        self.temperature_optimizer = ClippedAdam(self.temperature, MAX_GRAD_NORM, lr=args.temperature_lr)
        self.buffer = ReplayBuffer(args.buffer_size, obs_dim, action_dim).to(env.device)

    def iterate(self) -> dict[str, Tensor]:
        """Act for a rollout, make as many updates as control steps, times the epochs, then resample; returns metrics.

        It changes tensors in place and never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        normalizer, rows = self.actor.normalizer, []
        self.act()
        for _ in range(self.args.horizon * self.args.epochs):
            batch = self.buffer.sample(self.args.minibatch_size)
            obs, next_obs = normalizer(batch.obs), normalizer(batch.next_obs)
            rows.append(self.update_critics(batch, obs, next_obs) | self.update_actor(obs))
        optimizers = self.optimizer, self.critic_optimizer, self.temperature_optimizer
        return {
            **{name: torch.stack([row[name] for row in rows]).mean() for name in rows[0]},
            "grad/skipped": torch.stack([optimizer.skipped for optimizer in optimizers]).sum(),
            "charts/temperature": self.temperature["log"].detach().exp(),
            "charts/learning_rate": self.optimizer.lr,
            **self.resampling.end_iteration(self.actor.head, self.optimizer),
        }

    @torch.no_grad()
    def act(self) -> None:
        """Act for a rollout, into the buffer."""
        steps, obs, normalizer = [], self.env.detach(), self.actor.normalizer
        for _ in range(self.args.horizon):
            mixture = self.actor(normalizer(obs))
            self.resampling.record(mixture)
            action = torch.tanh(mixture.sample())
            next_obs, reward, terminated, _, info = self.env.step(action)
            steps.append((obs, action, reward, info["final_obs"], terminated.to(reward.dtype)))
            obs = next_obs
        rollout = Transition(*(torch.cat(tensors) for tensors in zip(*steps, strict=True)))
        self.buffer.add(rollout)
        normalizer.update(rollout.obs)

    def update_critics(self, batch: Transition, obs: Tensor, next_obs: Tensor) -> dict[str, Tensor]:
        """Descend the soft Bellman residual, and let the target critics follow."""
        with torch.no_grad():
            mixture = self.actor(next_obs)
            u = mixture.sample()
            soft = self.targets.value(next_obs, torch.tanh(u)).amin(0)
            soft = soft - self.temperature["log"].exp() * mixture.log_prob(u)
            target = batch.reward + self.args.gamma * (1 - batch.terminated) * soft
        value = self.critics.value(obs, batch.action)
        loss = (value - target).square().mean(1).sum()
        self.critic_optimizer.step(self.critic_optimizer.gradient(loss))
        for slow, fast in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast.detach(), TAU)
        return {"losses/critic": loss.detach() / 2, "charts/value": value.detach().mean()}

    def update_actor(self, obs: Tensor) -> dict[str, Tensor]:
        """Ascend value and entropy; steer the temperature to an entropy of minus one nat per action."""
        u, log_pi, other = self.draw(self.actor(obs))
        value = self.critics.value(obs, torch.tanh(u)).amin(0)
        loss = (self.temperature["log"].detach().exp() * log_pi - value).mean()
        if other is not None:
            value = self.critics.value(obs, torch.tanh(other)).amin(0)
            loss = loss - (value - value.detach()).mean()
        norm = self.optimizer.step(self.optimizer.gradient(loss))
        surplus = u.shape[-1] - log_pi.detach().mean()  # of entropy over the target
        weighted = self.temperature["log"].exp() * surplus
        self.temperature_optimizer.step(self.temperature_optimizer.gradient(weighted))
        return {"losses/actor": loss.detach(), "charts/entropy": -log_pi.detach().mean(), "grad/norm": norm}


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon)
    sac = run.restore(SAC(args, env))
    iterate = run.capture(sac.iterate, env)
    for _ in run:
        run.log(iterate())
        if run.evaluation_due:
            run.evaluate(sac.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
