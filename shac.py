"""SHAC, Short-Horizon Actor-Critic (Xu et al. 2022, https://arxiv.org/abs/2204.07137).

The actor descends the gradient of a short rollout, taken through the simulator, with a value function at the rollout's
end (Eq. 5). The value function is fitted to the TD(lambda) returns of the same rollout (Eq. 6 and 7).

    python shac.py --env ant --seed 1                                   train; writes runs/ant__shac__1__<time>/
    python shac.py --resume runs/ant__shac__1__<time>/checkpoint.pt     continue an interrupted run exactly
    python shac.py --evaluate runs/ant__shac__1__<time>/checkpoint.pt   evaluate its deterministic policy
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.symmetry.networks import make_alike
from diffsim.training import ClippedAdam, ObsNormalizer, Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import Chain, mlp
from diffsim.training.ranges import Count, Fraction, LogStd, Natural, NonNegative, Positive, UpTo10k, Widths

# Tables 1 and 4; hopper and half_cheetah: the authors' released settings.
# fmt: off
COLUMNS = ("actor_hidden", "critic_hidden", "actor_lr", "critic_lr", "target_alpha", "num_envs", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),      (64, 64),   1e-2, 1e-3, 0.2,    64,  500),
    "hopper":       ((128, 64, 32), (64, 64),   2e-3, 2e-4, 0.2,   256, 2000),
    "half_cheetah": ((128, 64, 32), (64, 64),   2e-3, 2e-3, 0.2,    64, 2000),
    "ant":          ((128, 64, 32), (64, 64),   2e-3, 2e-3, 0.2,    64, 2000),
    "humanoid":     ((256, 128),    (128, 128), 2e-3, 5e-4, 0.995,  64, 2000),
    "humanoid_mtu": ((512, 256),    (256, 256), 2e-3, 5e-4, 0.995,  64, 2000),
}
# fmt: on
MAX_GRAD_NORM, BETAS = 1.0, (0.7, 0.95)  # of both optimizers; Adam's decay rates of the gradient's moments
FINAL_LR = 1e-5  # both learning rates reach it, linearly, after the last iteration
ELU = partial(nn.ELU, inplace=True)


@dataclass
class Args(Flags):
    """The algorithm. Defaults: one setting for all tasks, Table 5 with the networks of A.4.3."""

    differentiates: ClassVar[bool] = True

    num_envs: Count = 64
    """parallel environments N, over all processes of torchrun (per task)"""
    horizon: Count = 32
    """control steps h of a rollout (per task)"""
    gamma: Fraction = 0.99
    """discount factor"""
    actor_hidden: Widths = (256, 128)
    """units of the actor's hidden layers (per task)"""
    initial_log_std: LogStd = -1.0
    """initial log standard deviation of the noise, before tanh (per task); =-inf: a policy without noise (A.4.4)"""
    actor_lr: Positive = 2e-3
    """initial learning rate of the actor (per task)"""
    td_lambda: Fraction = 0.95
    """lambda of the value estimation (Eq. 7)"""
    critic_hidden: Widths = (128, 128)
    """units of the critic's hidden layers (per task)"""
    critic_lr: Positive = 5e-4
    """initial learning rate of the critic (per task)"""
    critic_iterations: Natural = 16
    """passes over the samples of a rollout to fit the critic; 0: no value function (section 4.3)"""
    critic_minibatches: UpTo10k = 4
    """minibatches of a pass, contiguous in time"""
    target_alpha: Fraction = 0.995
    """target critic <- alpha target critic + (1 - alpha) critic, each iteration (per task)"""
    general_hyperparameters: bool = False
    """one setting for all of the paper's tasks (Table 5) instead of the per-task ones"""
    symmetric: bool = False
    """treat left and right alike: a mirrored state gets the mirrored action (per task; docs/sapo.md)"""
    adjoint_clip: NonNegative = 0.0
    """clip gradients with respect to a state to this many times the batch's median (per task; 0: do not clip)"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK.get(self.like, ()), strict=False))
        if self.general_hyperparameters:
            values = {name: value for name, value in values.items() if name == "iterations"}
        if self.contact == "mujoco":  # whose gradients agree over few steps: docs/transfer.md
            values |= {"horizon": 8, "num_envs": 4 * values.get("num_envs", self.num_envs)}
        return values

    def check(self) -> None:
        super().check()
        if self.critic_minibatches > (samples := self.num_envs * self.horizon):
            fail(f"--critic-minibatches {self.critic_minibatches} are more than the {samples} samples of a rollout")


# Networks -------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """pi(a|s): tanh of a Gaussian whose standard deviation does not depend on the state, or of its mean only."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim, noiseless = env.task.obs_dim, env.scene.nu, args.initial_log_std == -math.inf
        self.normalizer = ObsNormalizer(obs_dim)
        options: dict[str, Any] = dict(orthogonal=noiseless, columns=env.task.actor_dim, gain=env.task.initial_gain)
        self.mean = mlp(obs_dim, args.actor_hidden, action_dim, ELU, norm=True, **options)
        self.log_std = nn.Parameter(torch.full((action_dim,), args.initial_log_std), requires_grad=not noiseless)

    def sample_noise(self, *shape: int) -> Tensor:
        """Draw reparameterised noise (*shape, action_dim) of a rollout, differentiable in log_std (A.1)."""
        std = self.log_std.exp()
        return std * torch.randn(*shape, std.numel(), dtype=std.dtype, device=std.device)

    def forward(self, obs: Tensor, noise: Tensor) -> Tensor:
        return torch.tanh(self.mean(self.normalizer(obs)) + noise)

    def deterministic(self) -> nn.Sequential:
        """Return the policy without noise, with the same weights."""
        return Chain(self.normalizer, *self.mean, nn.Tanh())


# The algorithm --------------------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """What happened in one rollout, time first: (H, N, ...)."""

    obs: Tensor  # s_t, on which the policy acted
    next_obs: Tensor  # s_{t+1}, before any reset
    reward: Tensor
    terminated: Tensor
    done: Tensor  # terminated or truncated


class SHAC:
    """Algorithm 1: what an iteration changes, and the iteration."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        self.actor = Actor(args, env).to(env.device)
        self.critic = mlp(env.task.obs_dim, args.critic_hidden, 1, ELU, norm=True, orthogonal=True).to(env.device)
        if args.symmetric:
            make_alike(env.task.mirror, self.actor, (self.actor.mean, self.critic), self.actor.mean, self.critic)
        self.policy = self.actor.deterministic()
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.actor_optimizer = ClippedAdam(self.actor, MAX_GRAD_NORM, BETAS)
        self.critic_optimizer = ClippedAdam(self.critic, MAX_GRAD_NORM, BETAS)

    def iterate(self) -> dict[str, Tensor]:
        """Take one iteration of Algorithm 1; returns metrics.

        It changes tensors in place and never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        args, normalizer = self.args, self.actor.normalizer

        # Act for h steps in N environments, where they stand. torch records the steps, the simulator's included.
        rollout = collect(self.env, self.actor, self.actor.sample_noise(args.horizon, self.env.num_envs))

        # Eq. 5: the loss; its gradient, back through target critic, rewards, simulator and actor; and Adam's step.
        next_value = self.next_values(rollout)
        loss = actor_loss(rollout.reward, next_value, rollout.done, args.gamma)
        gradient = self.actor_optimizer.gradient(loss)
        norm = self.actor_optimizer.step(gradient)

        # Eq. 7: the TD(lambda) returns, and Eq. 6: the critic fitted to them. No gradient goes back from here.
        obs, reward = rollout.obs.detach(), rollout.reward.detach()
        value = td_lambda(reward, next_value.detach(), rollout.done, args.gamma, args.td_lambda)
        critic_loss = self.fit_critic(normalizer(obs).flatten(0, 1), value.view(-1, 1))
        normalizer.update(obs)

        # The target critic follows.
        for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
            slow.lerp_(fast.detach(), 1 - args.target_alpha)

        return {
            "losses/actor": loss.detach(),
            "losses/critic": critic_loss,
            "grad/norm": norm,
            "grad/skipped": self.actor_optimizer.skipped + self.critic_optimizer.skipped,
            "charts/actor_lr": self.actor_optimizer.lr,
            "charts/critic_lr": self.critic_optimizer.lr,
        }

    def next_values(self, rollout: Rollout) -> Tensor:
        """Return V(s_{t+1}) (H, N): of the last state where an episode's time ran out, zero where it terminated."""
        if self.args.critic_iterations == 0:
            return torch.zeros_like(rollout.reward)
        values = self.target(self.actor.normalizer(rollout.next_obs)).squeeze(-1)
        return values.masked_fill(rollout.terminated, 0.0)

    def fit_critic(self, obs: Tensor, value: Tensor) -> Tensor:
        """Fit V to values (B, 1) of normalized observations (B, obs_dim); returns the mean loss of the last pass."""
        optimizer, parts = self.critic_optimizer, self.args.critic_minibatches
        losses = [torch.zeros_like(optimizer.skipped)]
        for _ in range(self.args.critic_iterations):
            losses = []
            for some_obs, some_value in zip(obs.tensor_split(parts), value.tensor_split(parts), strict=True):
                loss = F.mse_loss(self.critic(some_obs), some_value)
                optimizer.step(optimizer.gradient(loss))
                losses.append(loss.detach())
        return torch.stack(losses).mean()


def collect(env: DiffEnv, actor: Actor, noise: Tensor) -> Rollout:
    """Take H steps of all environments from where they stand, with the policy's noise (H, N, action_dim)."""
    steps, obs = [], env.detach()  # no gradient goes back to the steps before
    for step_noise in noise.unbind():
        next_obs, reward, terminated, truncated, info = env.step(actor(obs, step_noise))
        steps.append((obs, info["final_obs"], reward, terminated, terminated | truncated))
        obs = next_obs
    return Rollout(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))


def actor_loss(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float) -> Tensor:
    """Compute Eq. 5 of (H, N) steps: dones cut an environment's rollout, and the discount restarts after them."""
    ages, age = [], torch.zeros_like(reward[0])
    for ended in done:
        ages.append(age)
        age = (age + 1).masked_fill(ended, 0.0)
    discount = gamma ** torch.stack(ages)
    ends = done.clone()
    ends[-1] = True
    return -(discount * reward + discount * gamma * ends * next_value).mean()


def td_lambda(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """Compute Eq. 7 of (H, N) steps, backward in time; a done ends the return as the rollout's end does."""
    returns, following = torch.empty_like(reward), next_value[-1]
    for t in reversed(range(len(reward))):
        following = torch.where(done[t], next_value[t], torch.lerp(next_value[t], following, lam))
        following = returns[t] = reward[t] + gamma * following
    return returns


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon, adjoint_clip=args.adjoint_clip)
    shac = run.restore(SHAC(args, env))
    iterate = run.capture(shac.iterate, env)
    for iteration in run:
        done = (iteration - 1) / args.iterations
        shac.actor_optimizer.lr.fill_(args.actor_lr + (FINAL_LR - args.actor_lr) * done)
        shac.critic_optimizer.lr.fill_(args.critic_lr + (FINAL_LR - args.critic_lr) * done)
        run.log(iterate())
        if run.evaluation_due:
            run.evaluate(shac.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
