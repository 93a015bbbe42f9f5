"""BPTT, backpropagation through time and through the simulator, the first-order baseline of the SHAC paper.

The policy descends the gradient of a rollout's return. There is no critic, so nothing stands for the rewards after the
rollout. Rollouts as long as an episode (--horizon 1000) make it the plain method of section 3.2.

    python bptt.py --env ant --seed 1                                   train; writes runs/ant__bptt__1__<time>/
    python bptt.py --resume runs/ant__bptt__1__<time>/checkpoint.pt     continue an interrupted run exactly
    python bptt.py --evaluate runs/ant__bptt__1__<time>/checkpoint.pt   evaluate its deterministic policy
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.training import ClippedAdam, ObsNormalizer, Run, script
from diffsim.training.flags import Flags
from diffsim.training.layers import mlp
from diffsim.training.ranges import Count, Fraction, LogStd, Positive, Widths

# Rollout lengths: section 4.2 of the SHAC paper; everything else: its authors' released settings.
# fmt: off
COLUMNS = ("hidden", "horizon", "num_envs", "lr", "normalize_obs", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),       64, 64, 1e-2, False,  500),
    "hopper":       ((128, 64, 32), 128, 32, 1e-3, True,  2000),
    "half_cheetah": ((128, 64, 32), 128, 32, 2e-3, True,  2000),
    "ant":          ((128, 64, 32), 128, 32, 4e-3, True,  2000),
    "humanoid":     ((256, 128),    128, 32, 2e-3, True,  2000),
    "humanoid_mtu": ((512, 256),    128, 16, 2e-3, True,  2000),
}
# fmt: on
BETAS = 0.7, 0.95  # Adam's decay rates of the gradient's first and second moment
MAX_GRAD_NORM = 1.0
FINAL_LR = 1e-5  # the learning rate reaches it, linearly, after the last iteration


@dataclass
class Args(Flags):
    """The algorithm. Defaults are those of a task that is not in the table."""

    differentiates: ClassVar[bool] = True

    num_envs: Count = 32
    """parallel environments N, over all processes of torchrun (per task)"""
    horizon: Count = 128
    """control steps H of a rollout (per task)"""
    gamma: Fraction = 0.99
    """discount factor"""
    hidden: Widths = (256, 128)
    """units of the policy's hidden layers (per task)"""
    normalize_obs: bool = True
    """normalize observations by their running mean and variance (per task)"""
    initial_log_std: LogStd = -1.0
    """initial log standard deviation of the policy's noise, before tanh; =-inf: a policy without noise"""
    lr: Positive = 2e-3
    """initial learning rate (per task)"""

    def task_defaults(self) -> dict[str, Any]:
        return dict(zip(COLUMNS, PER_TASK.get(self.like, ()), strict=False))


# Network --------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """pi(a|s): tanh of a Gaussian whose standard deviation does not depend on the state, or of its mean only."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim, noiseless = env.task.obs_dim, env.scene.nu, args.initial_log_std == -math.inf
        self.normalizer = ObsNormalizer(obs_dim)
        options: dict[str, Any] = dict(norm=True, orthogonal=noiseless, columns=env.task.actor_dim)
        self.mean = mlp(obs_dim, args.hidden, action_dim, partial(nn.ELU, inplace=True), **options)
        self.log_std = nn.Parameter(torch.full((action_dim,), args.initial_log_std), requires_grad=not noiseless)

    def sample_noise(self, *shape: int) -> Tensor:
        """Draw reparameterised noise (*shape, action_dim) of a rollout, differentiable in log_std (A.1)."""
        std = self.log_std.exp()
        return std * torch.randn(*shape, std.numel(), dtype=std.dtype, device=std.device)

    def forward(self, obs: Tensor, noise: Tensor) -> Tensor:
        return torch.tanh(self.mean(self.normalizer(obs)) + noise)

    def deterministic(self) -> nn.Sequential:
        """Return the policy without noise, with the same weights."""
        return nn.Sequential(self.normalizer, *self.mean, nn.Tanh())


# The algorithm --------------------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """What happened in one rollout, time first: (H, N, ...)."""

    obs: Tensor  # s_t, on which the policy acted
    reward: Tensor
    done: Tensor  # terminated or truncated


class BPTT:
    """What an iteration changes, and the iteration."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        self.actor = Actor(args, env).to(env.device)
        self.policy = self.actor.deterministic()
        # However large a gradient is, it is clipped and followed: the comparison shows exploding gradients.
        self.optimizer = ClippedAdam(self.actor, MAX_GRAD_NORM, BETAS, skip_norm=math.inf)

    def iterate(self) -> dict[str, Tensor]:
        """Act for a rollout, and step along the gradient of its loss through the simulator; returns metrics.

        It changes tensors in place and never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        args = self.args
        rollout = collect(self.env, self.actor, self.actor.sample_noise(args.horizon, self.env.num_envs))
        loss = bptt_loss(rollout.reward, rollout.done, args.gamma)
        gradient = self.optimizer.gradient(loss)
        norm = self.optimizer.step(gradient)
        if args.normalize_obs:
            self.actor.normalizer.update(rollout.obs.detach())
        found = {"losses/actor": loss.detach(), "grad/norm": norm, "grad/skipped": self.optimizer.skipped}
        return found | {"charts/learning_rate": self.optimizer.lr}


def collect(env: DiffEnv, actor: Actor, noise: Tensor) -> Rollout:
    """Take H steps of all environments from where they stand, with the policy's noise (H, N, action_dim)."""
    steps = []
    obs = env.detach()  # no gradient goes back to the steps before
    for step_noise in noise.unbind():
        next_obs, reward, terminated, truncated, _ = env.step(actor(obs, step_noise))
        steps.append((obs, reward, terminated | truncated))
        obs = next_obs
    return Rollout(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))


def bptt_loss(reward: Tensor, done: Tensor, gamma: float) -> Tensor:
    """Compute Eq. 8 without its value, of (H, N) steps: the discount restarts after each done."""
    ages, age = [], torch.zeros_like(reward[0])
    for ended in done:
        ages.append(age)
        age = (age + 1).masked_fill(ended, 0.0)
    return -(gamma ** torch.stack(ages) * reward).mean()


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon)
    bptt = run.restore(BPTT(args, env))
    iterate = run.capture(bptt.iterate, env)
    for iteration in run:
        bptt.optimizer.lr.fill_(args.lr + (FINAL_LR - args.lr) * (iteration - 1) / args.iterations)
        run.log(iterate())
        if run.evaluation_due:
            run.evaluate(bptt.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
