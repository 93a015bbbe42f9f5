"""SAPO, Soft Analytic Policy Optimization (Xing et al. 2025, https://arxiv.org/abs/2412.12089).

SHAC with a maximum-entropy objective: the actor descends the gradient of a short rollout, taken through the simulator,
with the policy's entropy as a part of the reward. Two critics are fitted to the soft TD(lambda) returns of the rollout.

    python sapo.py --env humanoid --seed 1                                  train; writes a folder of runs/
    python sapo.py --resume runs/humanoid__sapo__1__<time>/checkpoint.pt    continue an interrupted run exactly
    python sapo.py --evaluate runs/humanoid__sapo__1__<time>/checkpoint.pt  evaluate its deterministic policy
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv, Integration
from diffsim.extra.learning.ensemble import Ensemble, EnsembleAdam
from diffsim.extra.mirror import Mirror
from diffsim.tasks import TASKS
from diffsim.training import Run, distributed, fail, script
from diffsim.training.flags import WindowFlags
from diffsim.training.layers import ObsNormalizer, folded, make_even, mlp, seeing
from diffsim.training.ranges import Decay, Few, Finite, Fraction, Positive, Repeats, SomeWidths

# SHAC's networks, and the settings of the best results (docs/sapo.md).
# fmt: off
COLUMNS = ("actor_hidden", "critic_hidden", "activation", "actor_lr", "critic_lr", "target_alpha", "initial_log_std",
           "initial_target_entropy", "target_entropy", "population", "num_envs", "iterations", "critic_iterations")
PER_TASK = {
    "cartpole":     ((64, 64),      (64, 64),   "elu",  1e-2, 1e-3, 0.2,  -1.0,  0.0, -1.5,  1,   64,  500, 16),
    "hopper":       ((128, 64, 32), (64, 64),   "elu",  2e-3, 2e-4, 0.9,  -1.0,  0.0, -1.5,  8, 1024, 1100, 16),
    "half_cheetah": ((128, 64, 32), (64, 64),   "elu",  2e-3, 2e-3, 0.2,  -1.0,  0.0, -3.0,  1,  256, 2000, 16),
    "ant":          ((128, 64, 32), (64, 64),   "elu",  2e-3, 2e-3, 0.2,  -1.0,  0.0, -3.0, 16, 2048, 2500, 16),
    "humanoid":     ((256, 128),    (128, 128), "silu", 2e-3, 5e-4, 0.2,  -1.0, -0.5, -0.5,  4, 1024, 1200,  8),
    "humanoid_mtu": ((512, 256),    (256, 256), "silu", 1e-3, 5e-4, 0.95, -0.5, -0.5, -0.5,  2, 1024, 1400, 16),
    "g1":           ((256, 128),    (256, 128), "silu", 2e-3, 1e-3, 0.9,  -2.0, -1.0, -1.0,  1, 1024, 1200,  4),
    "g1_track":     ((256, 128),    (512, 256), "silu", 2e-3, 1e-3, 0.9,  -2.0, -1.0, -2.0,  1, 1024,  700,  8),
}
PER_TASK["humanoid_imitation"] = PER_TASK["humanoid"]
# Integrations that replace the papers' with --accuracy default.
INTEGRATION = {name: TASKS[name].integration("fast") for name in ("hopper", "half_cheetah")}
INTEGRATION |= {"ant": Integration("soft", 8, implicit=True)}
INTEGRATION |= {name: Integration("soft", 16, implicit=True) for name in ("humanoid", "humanoid_mtu")}
# Robots that fall before they learn to walk
BALANCING: dict[str, dict[str, Any]] = {"g1": {"horizon": 16, "adjoint_clip": 5.0}, "g1_track": {"horizon": 16}}
CPU = {"num_envs": 64, "population": 1}  # at most, where environments cost time in proportion
ON_CPU: dict[str, dict[str, Any]] = {
    "ant": {"iterations": 1500},
    "humanoid": {"critic_iterations": 4},
    "humanoid_mtu": {"critic_iterations": 4, "iterations": 1000},
    "g1": {"iterations": 700},
    "g1_track": {"critic_hidden": (256, 128), "critic_iterations": 4, "iterations": 1300},
}
ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "silu": nn.SiLU}
LOG_STD = (-5.0, 2.0)  # bounds of the log standard deviation
SCORE_RATE = 0.03  # of a member's running mean reward, per iteration
# fmt: on


@dataclass
class Args(WindowFlags):
    """The algorithm. With --no-entropy --no-state-std --critics 1 --activation elu it is SHAC."""

    entropy: bool = True
    """the policy's entropy is part of the reward"""
    state_std: bool = True
    """the standard deviation of the policy's noise depends on the state"""
    critics: Few = 2
    """value functions: targets take the smallest value, the actor's loss the mean"""
    activation: Literal["elu", "silu"] = "silu"
    """nonlinearity of actor and critics (per task)"""
    population: Few = 1
    """policies that learn in parallel, each in its share of the environments (per task)"""
    selection: Fraction = 0.5
    """share of the iterations after which the best policy continues in all environments"""
    initial_target_entropy: Finite = -0.5
    """target entropy per action in the first iteration, in nats (per task)"""
    target_entropy: Finite = -0.5
    """target entropy per action in the last iteration; linear between them (per task)"""
    initial_temperature: Positive = 1.0
    """initial weight of the entropy in the reward"""
    temperature_lr: Positive = 5e-3
    """learning rate of the temperature's logarithm"""
    actor_hidden: SomeWidths = (256, 128)
    """units of the actor's hidden layers (per task)"""
    critic_hidden: SomeWidths = (128, 128)
    """units of the critics' hidden layers (per task)"""
    actor_lr: Positive = 2e-3
    """initial learning rate of the actor (per task)"""
    critic_lr: Positive = 5e-4
    """initial learning rate of the critics (per task)"""
    final_lr: Positive = 1e-5
    """learning rate that both reach, linearly, after the last iteration"""
    betas: tuple[Decay, Decay] = (0.7, 0.95)
    """Adam's decay rates of the gradient's first and second moment"""
    max_grad_norm: Positive = 1.0
    """gradients of actors and critics are clipped to this norm"""
    gamma: Fraction = 0.99
    """discount factor"""
    td_lambda: Fraction = 0.95
    """lambda of the value estimation"""
    target_alpha: Fraction = 0.2
    """target critics <- alpha target critics + (1 - alpha) critics, each iteration (per task)"""
    critic_iterations: Repeats = 16
    """passes over the samples of a rollout to fit the critics (per task)"""
    initial_log_std: Finite = -1.0
    """initial log standard deviation of the policy's noise, before tanh (per task)"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK.get(self.env, ()), strict=False))
        if self.device == "cpu":
            values |= {name: min(values.get(name, most), most) for name, most in CPU.items()}
            values |= ON_CPU.get(self.env, {})
        if self.contact == "mujoco":  # whose gradients agree over few steps: docs/transfer.md
            values["horizon"] = 8
            if self.device == "cpu":
                values["num_envs"] = 4 * values["num_envs"]
        if (self.accuracy, self.contact) == ("default", "soft") and self.env in INTEGRATION:
            how = INTEGRATION[self.env]
            values |= {"substeps": how.substeps, "implicit": how.implicit}
        return super().task_defaults() | values | BALANCING.get(self.env, {})

    @property
    def samples(self) -> int:
        return super().samples // self.population

    def check(self) -> None:
        super().check()
        if (self.num_envs // distributed.size()) % self.population:
            fail(f"--num-envs {self.num_envs} cannot be split evenly among --population {self.population}")


# Networks -------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """pi(a|s) of K members, tanh of a Gaussian. Observations are normalized by the statistics of all members.

    A mirror makes the policy symmetric.
    """

    def __init__(self, args: Args, env: DiffEnv, mirror: Mirror | None) -> None:
        super().__init__()
        obs_dim, action_dim, seen = env.task.obs_dim, env.scene.nu, env.task.actor_dim
        K, width = args.population, args.actor_hidden[-1]
        self.normalizer = ObsNormalizer(obs_dim, mirror)
        bodies = [mlp(seen or obs_dim, args.actor_hidden, None, ACTIVATIONS[args.activation], True) for _ in range(K)]
        self.body = Ensemble([seeing(seen, body, mirror) for body in bodies])
        means = [nn.Sequential(nn.Linear(width, action_dim)) for _ in range(K)]
        self.mean = Ensemble([folded(mean, mirror and mirror.action) for mean in means])
        spread = nn.Linear(width, action_dim)  # of the log standard deviation, which begins almost constant
        with torch.no_grad():
            spread.weight.mul_(0.1)
            spread.bias.fill_(args.initial_log_std)
        spreads = [folded(nn.Sequential(spread), mirror and mirror.size) for _ in range(K)]
        self.spread = Ensemble(spreads) if args.state_std else None
        start = torch.full((K, 1, action_dim), args.initial_log_std)
        self.log_std = nn.Parameter(start, requires_grad=not args.state_std)
        make_even(self, "log_std", mirror)

    def forward(self, obs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Of normalized observations (K, B, obs_dim): the actions, and minus their log density per action (K, B)."""
        features = self.body(obs)
        log_std = self.log_std if self.spread is None else self.spread(features).clamp(*LOG_STD)
        u = self.mean(features) + log_std.exp() * noise
        log_slope = 2 * (math.log(2) - u - F.softplus(-2 * u))  # of tanh
        surprise = 0.5 * noise.square() + 0.5 * math.log(2 * math.pi) + log_std + log_slope
        return torch.tanh(u), surprise.mean(-1)

    def deterministic(self, member: int) -> nn.Sequential:
        """A member's policy without noise, of observations as they come; a copy."""
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


class SAPO:
    """All that the next iteration depends on, and its two halves.

    K members learn side by side, each in its share of the environments, until the best one goes on in all of them. The
    N environments are those of the members one after the other; networks take tensors (K, B, ...) of B samples each.
    The halves change tensors in place and never wait for the device, so that on a GPU each becomes one CUDA graph.
    """

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env, K, obs_dim = args, env, args.population, env.task.obs_dim
        mirror = env.task.mirror if args.symmetric else None
        self.actor = Actor(args, env, mirror).to(env.device)
        options = args.critic_hidden, 1, ACTIVATIONS[args.activation]
        networks = [mlp(obs_dim, *options, norm=True, orthogonal=True) for _ in range(args.critics * K)]
        critics = [folded(seeing(None, network, mirror), mirror and mirror.value) for network in networks]
        self.critics = Ensemble(critics).to(env.device)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        log = torch.full((K,), math.log(args.initial_temperature))
        self.temperature = nn.ParameterDict({"log": log}).to(env.device)  # the entropy's weight
        score = {"reward": torch.zeros(K), "tied": torch.zeros(())}  # running mean reward; whether all members are one
        self.score = nn.ParameterDict(score).requires_grad_(False).to(env.device)
        limits = args.max_grad_norm, args.betas, self.score["tied"]
        self.actor_optimizer = EnsembleAdam(self.actor, 1, K, *limits)
        self.critic_optimizer = EnsembleAdam(self.critics, args.critics, K, *limits)
        self.temperature_optimizer = EnsembleAdam(self.temperature, 1, K, *limits)
        self.temperature_optimizer.lr.fill_(args.temperature_lr)
        self.target_entropy = torch.zeros((), device=env.device)
        samples = args.horizon * env.num_envs // K  # of a rollout, for each member's critics
        self.obs = torch.zeros(K, samples, obs_dim, device=env.device)
        self.value = torch.zeros(K, samples, device=env.device)

    @property
    def optimizers(self) -> tuple[EnsembleAdam, ...]:
        return self.actor_optimizer, self.critic_optimizer, self.temperature_optimizer

    @property
    def best(self) -> int:
        """The member with the largest recent reward."""
        return int(self.score["reward"].argmax())

    @property
    def policy(self) -> nn.Sequential:
        return self.actor.deterministic(self.best)

    def prepare(self, iteration: int) -> None:
        """The iteration's learning rates and target entropy; before one of them the best member is selected."""
        args, done = self.args, (iteration - 1) / self.args.iterations
        self.actor_optimizer.lr.fill_(args.actor_lr + (args.final_lr - args.actor_lr) * done)
        self.critic_optimizer.lr.fill_(args.critic_lr + (args.final_lr - args.critic_lr) * done)
        begin, end = args.initial_target_entropy, args.target_entropy
        self.target_entropy.fill_(begin + (end - begin) * done)
        if iteration == 1 + round(args.selection * args.iterations):
            self.select(self.best)

    def select(self, member: int) -> None:
        """From now on all members are this one, and learn from the samples of all."""
        for optimizer in self.optimizers:
            optimizer.tie(member)
        for p in self.targets.parameters():
            members = p.view(self.args.critics, self.args.population, -1)
            members.copy_(members[:, member, None].clone().expand_as(members))
        self.score["tied"].fill_(1.0)

    # The two halves of an iteration -----------------------------------------------------------------------------------

    def update_actor(self) -> dict[str, Tensor]:
        """Act for a rollout, descend its soft loss, and keep its samples for the critics."""
        args, K = self.args, self.args.population
        rollout = self.collect()
        next_values, reward = self.next_values(rollout), rollout.reward
        if args.entropy:  # the soft reward
            weight = self.temperature["log"].detach().exp().repeat_interleave(self.env.num_envs // K)
            reward = reward + weight * (1 + rollout.entropy) / 2
        loss = actor_loss(reward, next_values.mean(0), rollout.done, args.gamma)
        norm = self.actor_optimizer.step(K * loss)  # each member's mean over its own environments
        rollout = Rollout(*(tensor.detach() for tensor in rollout))
        self.keep(rollout, reward.detach(), next_values.detach())
        entropy, gained = (self.split(tensor).mean(-1) for tensor in (rollout.entropy, rollout.reward))  # (K,)
        self.temperature_optimizer.step((self.temperature["log"].exp() * (entropy - self.target_entropy)).sum())
        self.score["reward"].lerp_(distributed.average(gained), SCORE_RATE)
        return {
            "losses/actor": loss.detach(),
            "grad/norm": norm,
            "charts/reward": gained.mean(),
            "charts/entropy": entropy.mean(),
            "charts/temperature": self.temperature["log"].detach().exp().mean(),
            "charts/actor_lr": self.actor_optimizer.lr,
        }

    def update_critic(self) -> dict[str, Tensor]:
        """Fit the critics to the rollout's soft TD(lambda) returns, and let the target critics follow."""
        args = self.args
        parts = args.critic_minibatches
        batches = self.obs.tensor_split(parts, -2), self.value.tensor_split(parts, -1)
        for _ in range(args.critic_iterations):
            losses = []
            for obs, value in zip(*batches, strict=True):
                errors = (self.values(self.critics, obs) - value).square().mean(-1)
                self.critic_optimizer.step(errors.sum())
                losses.append(errors.detach().mean())
        for slow, fast in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast.detach(), 1 - args.target_alpha)
        skipped = torch.stack([optimizer.skipped for optimizer in self.optimizers]).sum()
        found = {"losses/critic": torch.stack(losses).mean(), "grad/skipped": skipped}  # the loss of the last pass
        return found | {"charts/critic_lr": self.critic_optimizer.lr}

    # Their parts ------------------------------------------------------------------------------------------------------

    def collect(self) -> Rollout:
        """H steps of all environments from where they stand, each with its member's policy."""
        env, normalizer, members = self.env, self.actor.normalizer, (self.args.population, -1)
        steps, obs = [], env.detach()
        for noise in torch.randn(self.args.horizon, env.num_envs, env.scene.nu, device=env.device).unbind():
            own = self.actor(normalizer(obs).unflatten(0, members), noise.unflatten(0, members))
            action, entropy = (tensor.flatten(0, 1) for tensor in own)
            next_obs, reward, terminated, truncated, info = env.step(action)
            steps.append((obs, info["final_obs"], reward, entropy, terminated, terminated | truncated))
            obs = next_obs
        return Rollout(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))

    def split(self, tensor: Tensor) -> Tensor:
        """The samples of a rollout (H, N, ...) by members (K, B, ...)."""
        return tensor.unflatten(1, (self.args.population, -1)).movedim(1, 0).flatten(1, 2)

    def values(self, critics: Ensemble, obs: Tensor) -> Tensor:
        """Each critic's V (C, K, B) of normalized observations (K, B, obs_dim)."""
        return critics(obs.repeat(self.args.critics, 1, 1)).squeeze(-1).unflatten(0, (self.args.critics, -1))

    def next_values(self, rollout: Rollout) -> Tensor:
        """Each critic's V(s_{t+1}) (C, H, N): of an episode's last state where its time ran out, zero if terminated."""
        values = self.values(self.targets, self.split(self.actor.normalizer(rollout.next_obs)))
        values = values.unflatten(-1, (self.args.horizon, -1)).movedim(1, 2).flatten(2)
        return torch.where(rollout.terminated, torch.zeros_like(values), values)

    def keep(self, rollout: Rollout, reward: Tensor, next_values: Tensor) -> None:
        """Store the critics' samples: observations of a rollout, and their TD(lambda) returns."""
        args, normalizer = self.args, self.actor.normalizer
        value = td_lambda(reward, next_values.amin(0), rollout.done, args.gamma, args.td_lambda)
        self.value.copy_(self.split(value))
        self.obs.copy_(self.split(normalizer(rollout.obs)))
        normalizer.update(rollout.obs)


def actor_loss(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float) -> Tensor:
    """SHAC's Eq. 5 of (H, N) steps: rollouts are cut at their dones, and the discount restarts after them."""
    t = torch.arange(len(reward), device=reward.device).unsqueeze(1)
    starts, ends = done.roll(1, 0), done.clone()
    starts[0] = ends[-1] = True
    age = t - torch.where(starts, t, torch.zeros_like(t)).cummax(0).values  # steps since the start or the last done
    discount = gamma ** age.to(reward.dtype)
    return -(discount * reward + discount * gamma * ends * next_value).mean()


def td_lambda(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """TD(lambda) of (H, N) steps, backward in time; a done ends the return as the rollout's end does."""
    returns = torch.empty_like(reward)
    following = next_value[-1]
    for t in reversed(range(len(reward))):
        following = torch.where(done[t], next_value[t], torch.lerp(next_value[t], following, lam))
        following = returns[t] = reward[t] + gamma * following
    return returns


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon, adjoint_clip=args.adjoint_clip)
    sapo = run.restore(SAPO(args, env))
    update_actor, update_critic = run.capture(sapo.update_actor, env), run.capture(sapo.update_critic)
    for iteration in run:
        sapo.prepare(iteration)
        run.log(update_actor() | update_critic())
        if run.evaluation_due:
            run.evaluate(sapo.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
