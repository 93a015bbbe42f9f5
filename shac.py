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
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.extra.mirror import Mirror
from diffsim.training import ClippedAdam, ObsNormalizer, Run, distributed, fail, script
from diffsim.training.flags import WindowFlags
from diffsim.training.layers import Chain, folded, make_even, mlp, seeing
from diffsim.training.ranges import Decay, Finite, Fraction, Positive, Repeats, Widths

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
    "go1":          ((256, 128),    (256, 128), 2e-3, 1e-3, 0.9,    64,  600),
    "go2":          ((256, 128),    (256, 128), 2e-3, 1e-3, 0.9,    64,  600),
    "g1":           ((256, 128),    (256, 128), 2e-3, 1e-3, 0.9,    64, 1500),
    "g1_track":     ((256, 128),    (512, 256), 2e-3, 1e-3, 0.9,   256, 1500),
    "humanoid_imitation": ((256, 128), (128, 128), 2e-3, 5e-4, 0.995, 64, 2000),
}
# fmt: on
# Robots with servos begin near their standing pose: little noise, actions near zero.
STANDING = {"initial_log_std": -2.0, "initial_gain": 0.01, "adjoint_clip": 5.0}
BEGINNING = {"go1": STANDING, "go2": STANDING} | dict.fromkeys(("g1", "g1_track"), STANDING | {"horizon": 16})
ELU = partial(nn.ELU, inplace=True)
ON_GPU = dict.fromkeys(("go1", "go2"), {"num_envs": 1024, "iterations": 1000})  # where environments cost little


@dataclass
class Args(WindowFlags):
    """The algorithm. Defaults: one setting for all tasks, Table 5 with the networks of A.4.3."""

    general_hyperparameters: bool = False
    """one setting for all tasks (Table 5) instead of the per-task ones"""
    deterministic_policy: bool = False
    """train a policy without noise (A.4.4)"""
    critic: bool = True
    """add a learned value at the end of the rollout; --no-critic is the ablation of section 4.3"""
    actor_hidden: Widths = (256, 128)
    """units of the actor's hidden layers (per task)"""
    critic_hidden: Widths = (128, 128)
    """units of the critic's hidden layers (per task)"""
    actor_lr: Positive = 2e-3
    """initial learning rate of the actor (per task)"""
    critic_lr: Positive = 5e-4
    """initial learning rate of the critic (per task)"""
    final_lr: Positive = 1e-5
    """learning rate that both reach, linearly, after the last iteration"""
    betas: tuple[Decay, Decay] = (0.7, 0.95)
    """Adam's decay rates of the gradient's first and second moment"""
    max_grad_norm: Positive = 1.0
    """gradients of actor and critic are clipped to this norm"""
    gamma: Fraction = 0.99
    """discount factor"""
    td_lambda: Fraction = 0.95
    """lambda of the value estimation (Eq. 7)"""
    target_alpha: Fraction = 0.995
    """target critic <- alpha target critic + (1 - alpha) critic, each iteration (per task)"""
    critic_iterations: Repeats = 16
    """passes over the samples of a rollout to fit the critic"""
    inverse_variance: bool = False
    """weight each step's gradient and that of the policy's density by their variances (arXiv 2604.18161)"""
    initial_log_std: Finite = -1.0
    """initial log standard deviation of the policy's noise, before tanh (per task)"""
    initial_gain: Positive = 1.0
    """initial factor of the actor's last layer; with a small one, actions begin near zero (per task)"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK[self.env], strict=True)) if self.env in PER_TASK else {}
        if self.general_hyperparameters:
            values = {name: value for name, value in values.items() if name == "iterations"}
        if self.contact == "mujoco":  # whose gradients agree over few steps: docs/transfer.md
            values |= {"horizon": 8, "num_envs": 4 * values.get("num_envs", self.num_envs)}
        if self.device != "cpu":
            values |= ON_GPU.get(self.env, {})
        return super().task_defaults() | values | BEGINNING.get(self.env, {})

    def check(self) -> None:
        super().check()
        if self.inverse_variance and self.deterministic_policy:
            fail("--inverse-variance weights the density of a policy: one with --deterministic-policy has none")
        if self.inverse_variance and self.num_envs < 2 * distributed.size():
            fail("--inverse-variance takes variances over environments: --num-envs must be at least 2 per process")


# Networks -------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """pi(a|s): tanh of a Gaussian whose standard deviation does not depend on the state, or of its mean only.

    A mirror makes the policy symmetric.
    """

    def __init__(self, args: Args, env: DiffEnv, mirror: Mirror | None) -> None:
        super().__init__()
        obs_dim, action_dim, seen = env.task.obs_dim, env.scene.nu, env.task.actor_dim
        self.normalizer = ObsNormalizer(obs_dim, mirror)
        orthogonal = args.deterministic_policy
        network = mlp(seen or obs_dim, args.actor_hidden, action_dim, ELU, norm=True, orthogonal=orthogonal)
        if args.initial_gain != 1.0:
            last = network[-1]
            assert isinstance(last, nn.Linear)
            with torch.no_grad():
                last.weight.mul_(args.initial_gain)
                last.bias.zero_()
        self.mean = folded(seeing(seen, network, mirror), mirror and mirror.action)
        log_std = torch.full((action_dim,), -math.inf if args.deterministic_policy else args.initial_log_std)
        self.log_std = nn.Parameter(log_std, requires_grad=not args.deterministic_policy)
        make_even(self, "log_std", mirror)

    def sample_noise(self, *shape: int) -> Tensor:
        """(*shape, action_dim) reparameterised noise of a rollout, differentiable in log_std (A.1)."""
        std = self.log_std.exp()
        return std * torch.randn(*shape, std.numel(), dtype=std.dtype, device=std.device)

    def forward(self, obs: Tensor, noise: Tensor) -> Tensor:
        return torch.tanh(self.mean(self.normalizer(obs)) + noise)

    def deterministic(self) -> nn.Sequential:
        """The policy without noise, with the same weights."""
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
    """Algorithm 1: all that the next iteration depends on, and its two halves.

    They change tensors in place and never wait for the device, so that on a GPU each becomes one CUDA graph.
    """

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        obs_dim = env.task.obs_dim
        mirror = env.task.mirror if args.symmetric else None
        self.actor = Actor(args, env, mirror).to(env.device)
        self.policy = self.actor.deterministic()
        critic = seeing(None, mlp(obs_dim, args.critic_hidden, 1, ELU, norm=True, orthogonal=True), mirror)
        self.critic = folded(critic, mirror and mirror.value).to(env.device)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.actor_optimizer = ClippedAdam(self.actor, args.max_grad_norm, args.betas)
        self.critic_optimizer = ClippedAdam(self.critic, args.max_grad_norm, args.betas)
        self.obs = torch.zeros(args.horizon * env.num_envs, obs_dim, device=env.device)  # the critic's samples
        self.value = torch.zeros(args.horizon * env.num_envs, 1, device=env.device)

    def set_learning_rates(self, iteration: int) -> None:
        args, done = self.args, (iteration - 1) / self.args.iterations
        self.actor_optimizer.lr.fill_(args.actor_lr + (args.final_lr - args.actor_lr) * done)
        self.critic_optimizer.lr.fill_(args.critic_lr + (args.final_lr - args.critic_lr) * done)

    def update_actor(self) -> dict[str, Tensor]:
        """Act for a rollout, descend its loss (Eq. 5), and keep its samples for the critic."""
        args, normalizer = self.args, self.actor.normalizer
        noise = self.actor.sample_noise(args.horizon, self.env.num_envs)
        if args.inverse_variance:
            noise = noise.detach().requires_grad_()
        rollout = collect(self.env, self.actor, noise)
        next_value = self.next_values(rollout)
        loss = actor_loss(rollout.reward, next_value, rollout.done, args.gamma)
        rollout = Rollout(*(tensor.detach() for tensor in rollout))
        value = td_lambda(rollout.reward, next_value.detach(), rollout.done, args.gamma, args.td_lambda)
        norm = self.actor_optimizer.step(self.weighted(loss, noise, rollout, value) if args.inverse_variance else loss)
        self.value.copy_(value.view(-1, 1))
        self.obs.copy_(normalizer(rollout.obs).flatten(0, 1))
        normalizer.update(rollout.obs)
        return {"losses/actor": loss.detach(), "grad/norm": norm, "charts/actor_lr": self.actor_optimizer.lr}

    def weighted(self, loss: Tensor, noise: Tensor, rollout: Rollout, value: Tensor) -> Tensor:
        """A loss whose gradient is, in each step, that of the loss and that of the policy's density, weighted.

        Where gradients through the simulator scatter more, over the environments, the others count more.
        """
        (through,) = torch.autograd.grad(loss, noise)
        obs, std = self.actor.normalizer(rollout.obs), self.actor.log_std.exp()
        advantage = (
            discounts(rollout.done, self.args.gamma, value.dtype)[0] * (value - self.target(obs).squeeze(-1)).detach()
        )
        advantage = (advantage - advantage.mean(1, keepdim=True)) / advantage.numel()
        density = -advantage.unsqueeze(-1) * noise / std.detach().square()
        off, other = (g.var(1, keepdim=True).sum(-1, keepdim=True) for g in (through, density))
        gradient = torch.lerp(density, through, other / (other + off))
        return (gradient.detach() * (self.actor.mean(obs) + noise.detach() * std / std.detach())).sum()

    def update_critic(self) -> dict[str, Tensor]:
        """Fit the critic to the rollout's TD(lambda) returns (Eq. 6), and let the target critic follow."""
        args = self.args
        losses = [torch.zeros_like(self.critic_optimizer.skipped)]
        parts = (part.tensor_split(args.critic_minibatches) for part in (self.obs, self.value))
        batches = list(zip(*parts, strict=True))
        for _ in range(args.critic_iterations if args.critic else 0):
            losses = []
            for obs, value in batches:
                loss = F.mse_loss(self.critic(obs), value)
                self.critic_optimizer.step(loss)
                losses.append(loss.detach())
        for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
            slow.lerp_(fast.detach(), 1 - args.target_alpha)
        skipped = self.actor_optimizer.skipped + self.critic_optimizer.skipped
        found = {"losses/critic": torch.stack(losses).mean(), "grad/skipped": skipped}  # the loss of the last pass
        return found | {"charts/critic_lr": self.critic_optimizer.lr}

    def next_values(self, rollout: Rollout) -> Tensor:
        """V(s_{t+1}) (H, N): of an episode's last state where it ran out of time, zero where it terminated."""
        if not self.args.critic:
            return torch.zeros_like(rollout.reward)
        values = self.target(self.actor.normalizer(rollout.next_obs)).squeeze(-1)
        return torch.where(rollout.terminated, torch.zeros_like(values), values)


def collect(env: DiffEnv, actor: Actor, noise: Tensor) -> Rollout:
    """H steps of all environments from where they stand, with the policy's noise (H, N, action_dim)."""
    steps = []
    obs = env.detach()
    for step_noise in noise.unbind():
        next_obs, reward, terminated, truncated, info = env.step(actor(obs, step_noise))
        steps.append((obs, info["final_obs"], reward, terminated, terminated | truncated))
        obs = next_obs
    return Rollout(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))


def actor_loss(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float) -> Tensor:
    """Eq. 5 of (H, N) steps: each environment's rollout is cut at its dones, and the discount restarts after them."""
    discount, ends = discounts(done, gamma, reward.dtype)
    return -(discount * reward + discount * gamma * ends * next_value).mean()


def discounts(done: Tensor, gamma: float, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Of (H, N) steps gamma to the power of those since the start or the last done, and which ones end a rollout."""
    t = torch.arange(len(done), device=done.device).unsqueeze(1)
    starts, ends = done.roll(1, 0), done.clone()
    starts[0] = ends[-1] = True
    age = t - torch.where(starts, t, torch.zeros_like(t)).cummax(0).values
    return gamma ** age.to(dtype), ends


def td_lambda(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """Eq. 7 of (H, N) steps, as its recursion backward in time; a done ends the return as the rollout's end does."""
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
    shac = run.restore(SHAC(args, env))
    update_actor, update_critic = run.capture(shac.update_actor, env), run.capture(shac.update_critic)
    for iteration in run:
        shac.set_learning_rates(iteration)
        run.log(update_actor() | update_critic())
        if run.evaluation_due:
            run.evaluate(shac.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
