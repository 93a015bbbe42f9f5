"""SAPO, Soft Analytic Policy Optimization (Xing et al. 2025, https://arxiv.org/abs/2412.12089).

SHAC with a maximum-entropy objective: the actor descends the gradient of a short rollout, taken through the simulator,
with the policy's entropy as a part of the reward. Two critics are fitted to the soft TD(lambda) returns of the rollout.

    python baselines/sapo.py --env humanoid --seed 1                                train; writes a folder of runs/
    python baselines/sapo.py --resume runs/humanoid__sapo__1__<time>/checkpoint.pt  continue an interrupted run exactly
    python baselines/sapo.py --evaluate runs/humanoid__sapo__1__<time>/checkpoint.pt  evaluate its deterministic policy
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv, Integration
from diffsim.learning.ensemble import Ensemble, EnsembleAdam
from diffsim.symmetry.networks import make_alike
from diffsim.tasks import TASKS
from diffsim.training import Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import ObsNormalizer, mlp
from diffsim.training.ranges import Count, Finite, Fraction, NonNegative, Positive, SomeWidths, UpTo10k, UpTo1000

# SHAC's networks, and the settings of the best results (docs/sapo.md).
# fmt: off
COLUMNS = ("actor_hidden", "critic_hidden", "activation", "actor_lr", "critic_lr", "target_alpha", "initial_log_std",
           "target_entropy", "population", "num_envs", "iterations", "critic_iterations")
PER_TASK = {
    "cartpole":     ((64, 64),      (64, 64),   "elu",  1e-2, 1e-3, 0.2,  -1.0, ( 0.0, -1.5),  1,   64,  500, 16),
    "hopper":       ((128, 64, 32), (64, 64),   "elu",  2e-3, 2e-4, 0.9,  -1.0, ( 0.0, -1.5),  8, 1024, 1100, 16),
    "half_cheetah": ((128, 64, 32), (64, 64),   "elu",  2e-3, 2e-3, 0.2,  -1.0, ( 0.0, -3.0),  1,  256, 2000, 16),
    "ant":          ((128, 64, 32), (64, 64),   "elu",  2e-3, 2e-3, 0.2,  -1.0, ( 0.0, -3.0), 16, 2048, 2500, 16),
    "humanoid":     ((256, 128),    (128, 128), "silu", 2e-3, 5e-4, 0.2,  -1.0, (-0.5, -0.5),  4, 1024, 1200,  8),
    "humanoid_mtu": ((512, 256),    (256, 256), "silu", 1e-3, 5e-4, 0.95, -0.5, (-0.5, -0.5),  2, 1024, 1400, 16),
}
# Integrations that replace the papers' with --accuracy default.
INTEGRATION = {name: TASKS[name].integration("fast") for name in ("hopper", "half_cheetah")}
INTEGRATION |= {"ant": Integration("soft", 8, implicit=True)}
INTEGRATION |= {name: Integration("soft", 16, implicit=True) for name in ("humanoid", "humanoid_mtu")}
CPU = {"num_envs": 64, "population": 1}  # at most, where environments cost time in proportion
ON_CPU: dict[str, dict[str, Any]] = {
    "ant": {"iterations": 1500},
    "humanoid": {"critic_iterations": 4},
    "humanoid_mtu": {"critic_iterations": 4, "iterations": 1000},
}
ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "silu": nn.SiLU}
# fmt: on
LOG_STD = (-5.0, 2.0)  # bounds of the log standard deviation
GAMMA, LAMBDA = 0.99, 0.95  # discount factor; lambda of the value estimation
MINIBATCHES = 4  # of a pass over the samples of a rollout, contiguous in time
MAX_GRAD_NORM, BETAS = 1.0, (0.7, 0.95)  # of the optimizers; Adam's decay rates of the gradient's moments
FINAL_LR = 1e-5  # the learning rates of actor and critics reach it, linearly, after the last iteration
TEMPERATURE_LR = 5e-3  # of the temperature's logarithm
SCORE_RATE = 0.03  # of a member's running mean reward, per iteration
SELECTION = 0.5  # share of the iterations after which the best policy continues in all environments


@dataclass
class Args(Flags):
    """The algorithm. With --no-entropy --no-state-std --critics 1 --activation elu it is SHAC."""

    differentiates: ClassVar[bool] = True

    num_envs: Count = 64
    """parallel environments N, over all processes of torchrun (per task)"""
    horizon: Count = 32
    """control steps H of a rollout (per task)"""
    entropy: bool = True
    """the policy's entropy is part of the reward"""
    target_entropy: tuple[Finite, Finite] = (-0.5, -0.5)
    """target entropy per action in the first and in the last iteration, in nats; linear between them (per task)"""
    actor_hidden: SomeWidths = (256, 128)
    """units of the actor's hidden layers (per task)"""
    activation: Literal["elu", "silu"] = "silu"
    """nonlinearity of actor and critics (per task)"""
    state_std: bool = True
    """the standard deviation of the policy's noise depends on the state"""
    initial_log_std: Finite = -1.0
    """initial log standard deviation of the policy's noise, before tanh (per task)"""
    actor_lr: Positive = 2e-3
    """initial learning rate of the actor (per task)"""
    critics: UpTo1000 = 2
    """value functions: targets take the smallest value, the actor's loss the mean"""
    critic_hidden: SomeWidths = (128, 128)
    """units of the critics' hidden layers (per task)"""
    critic_lr: Positive = 5e-4
    """initial learning rate of the critics (per task)"""
    critic_iterations: UpTo10k = 16
    """passes over the samples of a rollout to fit the critics (per task)"""
    target_alpha: Fraction = 0.2
    """target critics <- alpha target critics + (1 - alpha) critics, each iteration (per task)"""
    population: UpTo1000 = 1
    """policies that learn in parallel; after half of the iterations the best one goes on in all environments"""
    symmetric: bool = False
    """treat left and right alike: a mirrored state gets the mirrored action (per task; docs/sapo.md)"""
    adjoint_clip: NonNegative = 0.0
    """clip gradients with respect to a state to this many times the batch's median (per task; 0: do not clip)"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK.get(self.like, ()), strict=False))
        if self.device == "cpu":
            values |= {name: min(values.get(name, most), most) for name, most in CPU.items()}
            values |= ON_CPU.get(self.task, {})
        if self.contact == "mujoco":  # whose gradients agree over few steps: docs/transfer.md
            values["horizon"] = 8
            if self.device == "cpu":
                values["num_envs"] = 4 * values["num_envs"]
        if (self.accuracy, self.contact) == ("default", "soft") and self.task in INTEGRATION:
            how = INTEGRATION[self.task]
            values |= {"substeps": how.substeps, "implicit": how.implicit}
        return values


# Networks -------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """pi(a|s) of K members, tanh of a Gaussian. Observations are normalized by the statistics of all members."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim, seen = env.task.obs_dim, env.scene.nu, env.task.actor_dim
        K, width, activation = args.population, args.actor_hidden[-1], ACTIVATIONS[args.activation]
        self.normalizer = ObsNormalizer(obs_dim)
        bodies = [mlp(obs_dim, args.actor_hidden, None, activation, norm=True, columns=seen) for _ in range(K)]
        self.body = Ensemble(bodies)
        self.mean = Ensemble([nn.Sequential(nn.Linear(width, action_dim)) for _ in range(K)])
        spread = nn.Linear(width, action_dim)  # of the log standard deviation, which begins almost constant
        with torch.no_grad():
            spread.weight.mul_(0.1)
            spread.bias.fill_(args.initial_log_std)
        self.spread = Ensemble([nn.Sequential(spread) for _ in range(K)]) if args.state_std else None
        start = torch.full((K, 1, action_dim), args.initial_log_std)
        self.log_std = nn.Parameter(start, requires_grad=not args.state_std)

    def forward(self, obs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions of normalized observations (K, B, obs_dim), and minus their log density per action (K, B)."""
        features = self.body(obs)
        log_std = self.log_std if self.spread is None else self.spread(features).clamp(*LOG_STD)
        u = self.mean(features) + log_std.exp() * noise
        log_slope = 2 * (math.log(2) - u - F.softplus(-2 * u))  # of tanh
        surprise = 0.5 * noise.square() + 0.5 * math.log(2 * math.pi) + log_std + log_slope
        return torch.tanh(u), surprise.mean(-1)

    def deterministic(self, member: int) -> nn.Sequential:
        """Copy a member's policy without noise, of observations as they come."""
        return nn.Sequential(self.normalizer, *self.body[member], *self.mean[member], nn.Tanh())


# The algorithm --------------------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """What happened in one rollout, time first: (H, N, ...)."""

    obs: Tensor  # s_t, on which the policy acted
    next_obs: Tensor  # s_{t+1}, before any reset
    reward: Tensor
    entropy: Tensor  # minus the action's log density, per action
    terminated: Tensor
    done: Tensor  # terminated or truncated


class Members(NamedTuple):
    """K members share N environments, one after the other. Networks take tensors (K, B, ...) of B samples each."""

    number: int  # K
    num_envs: int  # N

    def split(self, x: Tensor) -> Tensor:
        """Give each member its environments: (N, ...) -> (K, N / K, ...)."""
        return x.unflatten(0, (self.number, -1))

    def join(self, x: Tensor) -> Tensor:
        """Put environments one after the other again: (K, N / K, ...) -> (N, ...)."""
        return x.flatten(0, 1)

    def repeat(self, x: Tensor) -> Tensor:
        """Give each environment its member's number: (K,) -> (N,)."""
        return x.repeat_interleave(self.num_envs // self.number)

    def samples(self, x: Tensor) -> Tensor:
        """Give each member its samples of a rollout: (H, N, ...) -> (K, B, ...), where B is H N / K."""
        return x.unflatten(1, (self.number, -1)).movedim(1, 0).flatten(1, 2)

    def rollout(self, x: Tensor) -> Tensor:
        """Put samples in the order of the rollout again: (..., K, B) -> (..., H, N)."""
        return x.unflatten(-1, (-1, self.num_envs // self.number)).movedim(-3, -2).flatten(-2)


class SAPO:
    """What an iteration changes, and the iteration.

    The members learn side by side, each in its share of the environments, until the best one goes on in all of them.
    """

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env, K = args, env, args.population
        self.members = Members(K, env.num_envs)
        if env.num_envs % K:
            fail(f"--num-envs {args.num_envs} cannot be split evenly among --population {K}, in each process")
        if MINIBATCHES > (samples := args.horizon * env.num_envs // K):
            fail(f"--horizon {args.horizon} gives each critic {samples} samples: at least {MINIBATCHES} are needed")
        self.actor = Actor(args, env).to(env.device)
        options = args.critic_hidden, 1, ACTIVATIONS[args.activation]
        critics = [mlp(env.task.obs_dim, *options, norm=True, orthogonal=True) for _ in range(args.critics * K)]
        self.critics = Ensemble(critics).to(env.device)
        if args.symmetric:
            actor, layers = self.actor, self.critics.layers
            size = actor.spread.layers if actor.spread else None
            make_alike(env.task.mirror, actor, (actor.body.layers, layers), actor.mean.layers, layers, size)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.temperature = nn.ParameterDict({"log": torch.zeros(K)}).to(env.device)  # the entropy's weight
        score = {"reward": torch.zeros(K), "tied": torch.zeros(())}  # running mean reward; whether all members are one
        self.score = nn.ParameterDict(score).requires_grad_(False).to(env.device)
        limits = MAX_GRAD_NORM, BETAS, self.score["tied"]
        self.actor_optimizer = EnsembleAdam(self.actor, 1, K, *limits)
        self.critic_optimizer = EnsembleAdam(self.critics, args.critics, K, *limits)
        self.temperature_optimizer = EnsembleAdam(self.temperature, 1, K, *limits)
        self.temperature_optimizer.lr.fill_(TEMPERATURE_LR)
        self.target_entropy = torch.zeros((), device=env.device)

    @property
    def optimizers(self) -> tuple[EnsembleAdam, ...]:
        return self.actor_optimizer, self.critic_optimizer, self.temperature_optimizer

    @property
    def best(self) -> int:
        """Number the member with the largest recent reward."""
        return int(self.score["reward"].argmax())

    @property
    def policy(self) -> nn.Sequential:
        return self.actor.deterministic(self.best)

    def prepare(self, iteration: int) -> None:
        """Set the iteration's learning rates and target entropy; before one of them the best member is selected."""
        args, done = self.args, (iteration - 1) / self.args.iterations
        self.actor_optimizer.lr.fill_(args.actor_lr + (FINAL_LR - args.actor_lr) * done)
        self.critic_optimizer.lr.fill_(args.critic_lr + (FINAL_LR - args.critic_lr) * done)
        begin, end = args.target_entropy
        self.target_entropy.fill_(begin + (end - begin) * done)
        if iteration == 1 + round(SELECTION * args.iterations):
            self.select(self.best)

    def select(self, member: int) -> None:
        """Let all members be this one from now on, which learns from the samples of all."""
        for optimizer in self.optimizers:
            optimizer.tie(member)
        for p in self.targets.parameters():
            members = p.view(self.args.critics, self.args.population, -1)
            members.copy_(members[:, member, None].clone().expand_as(members))
        self.score["tied"].fill_(1.0)

    def iterate(self) -> dict[str, Tensor]:
        """Act, step the actor, step the temperature, fit the critics; returns metrics.

        It changes tensors in place and never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        args, normalizer, members = self.args, self.actor.normalizer, self.members
        temperature = self.temperature["log"].detach().exp()

        # Act for H steps in N environments. The entropy of the actions is part of the soft reward.
        rollout = self.collect()
        reward = rollout.reward
        if args.entropy:
            reward = reward + members.repeat(temperature) * (1 + rollout.entropy) / 2

        # SHAC's Eq. 5 with the soft reward; the actor's step along its gradient through targets, rewards, simulator and
        # actor. K times the mean over all environments is the sum of the members' losses.
        next_values = self.next_values(rollout)
        loss = actor_loss(reward, next_values.mean(0), rollout.done, GAMMA)
        gradient = self.actor_optimizer.gradient(members.number * loss)
        norm = self.actor_optimizer.step(gradient)

        # The temperature rises where the entropy is below its target. No gradient of the rollout goes back from here.
        entropy, gained = (members.samples(x.detach()).mean(-1) for x in (rollout.entropy, rollout.reward))  # (K,)
        surplus = (self.temperature["log"].exp() * (entropy - self.target_entropy)).sum()
        self.temperature_optimizer.step(self.temperature_optimizer.gradient(surplus))
        self.score["reward"].lerp_(self.actor_optimizer.average(gained), SCORE_RATE)

        # Fit the critics to the soft TD(lambda) returns; the target critics follow.
        obs = rollout.obs.detach()
        value = td_lambda(reward.detach(), next_values.detach().amin(0), rollout.done, GAMMA, LAMBDA)
        critic_loss = self.fit_critics(members.samples(normalizer(obs)), members.samples(value))
        normalizer.update(obs)
        for slow, fast in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast.detach(), 1 - args.target_alpha)

        return {
            "losses/actor": loss.detach(),
            "losses/critic": critic_loss,
            "grad/norm": norm,
            "grad/skipped": torch.stack([optimizer.skipped for optimizer in self.optimizers]).sum(),
            "charts/reward": gained.mean(),
            "charts/entropy": entropy.mean(),
            "charts/temperature": self.temperature["log"].detach().exp().mean(),
            "charts/actor_lr": self.actor_optimizer.lr,
            "charts/critic_lr": self.critic_optimizer.lr,
        }

    def collect(self) -> Rollout:
        """Take H steps of all environments from where they stand, each with its member's policy."""
        env, normalizer, members = self.env, self.actor.normalizer, self.members
        steps, obs = [], env.detach()  # no gradient goes back to the steps before
        for noise in torch.randn(self.args.horizon, env.num_envs, env.scene.nu, device=env.device).unbind():
            action, entropy = map(members.join, self.actor(members.split(normalizer(obs)), members.split(noise)))
            next_obs, reward, terminated, truncated, info = env.step(action)
            steps.append((obs, info["final_obs"], reward, entropy, terminated, terminated | truncated))
            obs = next_obs
        return Rollout(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))

    def fit_critics(self, obs: Tensor, value: Tensor) -> Tensor:
        """Fit V to values (K, B) of normalized observations (K, B, obs_dim); returns the mean loss of the last pass."""
        optimizer = self.critic_optimizer
        batches = [*zip(obs.tensor_split(MINIBATCHES, -2), value.tensor_split(MINIBATCHES, -1), strict=True)]
        for _ in range(self.args.critic_iterations):
            losses = []
            for some_obs, some_value in batches:
                errors = (self.values(self.critics, some_obs) - some_value).square().mean(-1)
                optimizer.step(optimizer.gradient(errors.sum()))
                losses.append(errors.detach().mean())
        return torch.stack(losses).mean()

    def values(self, critics: Ensemble, obs: Tensor) -> Tensor:
        """Return each critic's V (C, K, B) of normalized observations (K, B, obs_dim)."""
        return critics(obs.repeat(self.args.critics, 1, 1)).squeeze(-1).unflatten(0, (self.args.critics, -1))

    def next_values(self, rollout: Rollout) -> Tensor:
        """Return each critic's V(s_{t+1}) (C, H, N): of the last state where time ran out, zero where it terminated."""
        values = self.values(self.targets, self.members.samples(self.actor.normalizer(rollout.next_obs)))
        return self.members.rollout(values).masked_fill(rollout.terminated, 0.0)


def actor_loss(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float) -> Tensor:
    """Compute SHAC's Eq. 5 of (H, N) steps: dones cut the rollouts, and the discount restarts after them."""
    ages, age = [], torch.zeros_like(reward[0])
    for ended in done:
        ages.append(age)
        age = (age + 1).masked_fill(ended, 0.0)
    discount = gamma ** torch.stack(ages)
    ends = done.clone()
    ends[-1] = True
    return -(discount * reward + discount * gamma * ends * next_value).mean()


def td_lambda(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """Compute TD(lambda) of (H, N) steps, backward in time; a done ends the return as the rollout's end does."""
    returns, following = torch.empty_like(reward), next_value[-1]
    for t in reversed(range(len(reward))):
        following = torch.where(done[t], next_value[t], torch.lerp(next_value[t], following, lam))
        following = returns[t] = reward[t] + gamma * following
    return returns


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon, adjoint_clip=args.adjoint_clip)
    sapo = run.restore(SAPO(args, env))
    iterate = run.capture(sapo.iterate, env)
    for iteration in run:
        sapo.prepare(iteration)
        run.log(iterate())
        if run.evaluation_due:
            run.evaluate(sapo.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
