"""PPO, Proximal Policy Optimization (Schulman et al. 2017, https://arxiv.org/abs/1707.06347), the model-free baseline.

It acts in the same environments as the other learners, without their gradients: thousands of environments, large
minibatches, and a learning rate that follows the policy's KL divergence, as the SHAC paper ran its baseline (A.2.1).

    python ppo_baseline.py --env ant --seed 1                train; writes runs/ant__ppo_baseline__1__<time>/
    python ppo_baseline.py --resume <run>/checkpoint.pt      continue an interrupted run exactly
    python ppo_baseline.py --evaluate <run>/checkpoint.pt    evaluate its deterministic policy
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.symmetry.networks import make_alike
from diffsim.training import Run, script
from diffsim.training.flags import Flags
from diffsim.training.layers import ObsNormalizer, mlp, moments
from diffsim.training.optimizer import ClippedAdam
from diffsim.training.ranges import Bounds, Count, Finite, Fraction, Natural, NonNegative, Positive, UpTo10k, Widths

# Table 2 of the SHAC paper; networks, iterations, hopper and half_cheetah: its authors' released settings. They have no
# entropy bonus, with which hopper and ant learn more (docs/ppo.md).
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
MAX_GRAD_NORM = 1.0
TARGET_KL = 0.008  # the learning rate falls if a minibatch's KL divergence is above twice this, rises below half of it
GAE_LAMBDA = 0.95  # of the advantage estimation
CLIP = 0.2  # the probability ratio counts only within 1 - CLIP and 1 + CLIP
VALUE_COEF = 2.0  # weight of the value's squared error, in units of its standard deviation
BOUND, BOUND_COEF = 1.1, 1e-4  # weight of the squared excess of the policy's mean, as actions are clipped at 1


@dataclass
class Args(Flags):
    """The algorithm. Defaults are those of a task that is not in the table."""

    iterations: Count = 5000
    """learning iterations (per task)"""
    eval_every: Natural = 500
    """evaluate the policy without noise every this many iterations (0: only at the end)"""
    num_envs: Count = 1024
    """parallel environments N, over all processes of torchrun (per task; on a CPU at most 256)"""
    horizon: Count = 32
    """control steps H of a rollout (per task)"""
    gamma: Fraction = 0.99
    """discount factor"""
    hidden: Widths = (256, 128, 64)
    """units of the hidden layers, which policy and value share (per task)"""
    initial_log_std: Finite = 0.0
    """initial log standard deviation of the policy's noise (per task)"""
    epochs: UpTo10k = 5
    """passes over the samples of a rollout (per task)"""
    minibatch_size: Count = 8192
    """samples of an update (per task; on a CPU at most 2048)"""
    entropy_coef: NonNegative = 0.0
    """weight of the entropy bonus, which keeps the policy's noise from vanishing (per task)"""
    lr: Positive = 3e-4
    """initial learning rate, which then follows the KL divergence of the updates"""
    lr_bounds: Bounds = (1e-6, 1e-2)
    """smallest and largest learning rate; two equal numbers fix it"""
    symmetric: bool = False
    """treat left and right alike: a mirrored state gets the mirrored action (per task; docs/sapo.md)"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK.get(self.like, ()), strict=False))
        if self.device == "cpu":
            values |= {name: min(values.get(name, getattr(self, name)), most) for name, most in CPU.items()}
        return values


# Networks -------------------------------------------------------------------------------------------------------------


class ActorCritic(nn.Module):
    """The mean of the Gaussian pi(a|s), whose standard deviation does not depend on s, and V(s), on common features."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim, seen = env.task.obs_dim, env.scene.nu, env.task.actor_dim
        self.normalizer = ObsNormalizer(obs_dim)
        elu = partial(nn.ELU, inplace=True)
        self.features = mlp(obs_dim, args.hidden, None, elu, columns=seen)
        self.own = None if seen is None else mlp(obs_dim, args.hidden, None, elu)  # features of V, which sees more
        self.mean, self.value = (nn.Sequential(nn.Linear(args.hidden[-1], n)) for n in (action_dim, 1))
        self.log_std = nn.Parameter(torch.full((action_dim,), args.initial_log_std))

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean (..., action_dim) and the normalized value (...) of normalized observations."""
        features = self.features(obs)
        return self.mean(features), self.value(features if self.own is None else self.own(obs)).squeeze(-1)

    def deterministic(self) -> nn.Sequential:
        """Return the mean of raw observations, with the same weights."""
        return nn.Sequential(self.normalizer, *self.features, *self.mean)


# The algorithm --------------------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """What happened in one rollout, time first: (H, N, ...)."""

    obs: Tensor  # s_t, on which the policy acted
    next_obs: Tensor  # s_{t+1}, before any reset
    mean: Tensor  # of the policy
    action: Tensor  # before it is clipped to [-1, 1]
    value: Tensor  # V(s_t), normalized
    reward: Tensor
    terminated: Tensor
    done: Tensor  # terminated or truncated


class Batch(NamedTuple):
    """What the update needs of a rollout's samples, or of some of them: (B, ...)."""

    obs: Tensor  # normalized
    mean: Tensor  # of the policy that acted
    action: Tensor
    advantage: Tensor  # normalized
    target: Tensor  # of the value, normalized


class PPO:
    """What an iteration changes, and the iteration."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        self.actor_critic = ActorCritic(args, env).to(env.device)
        if args.symmetric:
            both = self.actor_critic
            make_alike(env.task.mirror, both, (both.features, both.own), both.mean, both.value)
        self.policy = self.actor_critic.deterministic()
        self.return_normalizer = ObsNormalizer().to(env.device)
        self.optimizer = ClippedAdam(self.actor_critic, MAX_GRAD_NORM, lr=args.lr)
        self.minibatches = math.ceil(args.horizon * args.num_envs / args.minibatch_size)

    def iterate(self) -> dict[str, Tensor]:
        """Act for a rollout, and descend the clipped loss on its samples; returns metrics.

        It changes tensors in place and never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        samples, explained = self.act()
        return {
            "losses/explained_variance": explained,
            "charts/std": self.actor_critic.log_std.detach().exp().mean(),
            **self.learn(samples),
            "grad/skipped": self.optimizer.skipped,
            "charts/learning_rate": self.optimizer.lr,
        }

    @torch.no_grad()
    def act(self) -> tuple[Batch, Tensor]:
        """Act for a rollout; returns its samples, and the share of the returns' variance that their values explain."""
        args, policy, normalizer = self.args, self.actor_critic, self.actor_critic.normalizer
        noise = torch.randn(args.horizon, self.env.num_envs, policy.log_std.numel(), device=self.env.device)
        rollout = collect(self.env, policy, noise)
        value = self.return_normalizer.inverse(rollout.value)
        next_value = self.return_normalizer.inverse(policy(normalizer(rollout.next_obs))[1])
        next_value = next_value.masked_fill(rollout.terminated, 0.0)
        advantage = gae(rollout.reward, value, next_value, rollout.done, args.gamma, GAE_LAMBDA)
        returns = value + advantage
        self.return_normalizer.update(returns)
        target, explained = self.return_normalizer(returns), 1 - advantage.var() / returns.var()
        var, mean = moments(advantage.flatten())
        advantage = (advantage - mean) / (var.sqrt() + 1e-8)
        samples = normalizer(rollout.obs), rollout.mean, rollout.action, advantage, target
        normalizer.update(rollout.obs)
        return Batch(*(tensor.flatten(0, 1) for tensor in samples)), explained

    def learn(self, samples: Batch) -> dict[str, Tensor]:
        """Descend the clipped loss (Eq. 7) in epochs of minibatches; the rate keeps the policy near the old one."""
        args, policy, optimizer, metrics = self.args, self.actor_critic, self.optimizer, []
        old_log_std = policy.log_std.detach().clone()
        for _ in range(args.epochs):
            order = torch.randperm(len(samples.obs), device=self.env.device)
            for tensors in zip(*(tensor[order].chunk(self.minibatches) for tensor in samples), strict=True):
                b = Batch(*tensors)
                mean, value = policy(b.obs)
                kl = kl_divergence(b.mean, old_log_std, mean.detach(), policy.log_std.detach())
                adapt(optimizer.lr, optimizer.average(kl), TARGET_KL, args.lr_bounds)
                ratio = log_ratio(b, mean, policy.log_std, old_log_std).exp()
                policy_loss = clipped_loss(ratio, b.advantage, CLIP)
                value_loss = (value - b.target).square().mean()
                bound_loss = (mean.abs() - BOUND).clamp(min=0).square().sum(-1).mean()
                bonus = entropy(policy.log_std)
                loss = policy_loss + VALUE_COEF * value_loss + BOUND_COEF * bound_loss - args.entropy_coef * bonus
                gradient = optimizer.gradient(loss)
                norm = optimizer.step(gradient)
                clipped = ((ratio - 1).abs() > CLIP).to(kl.dtype).mean()
                metrics.append(torch.stack((policy_loss, value_loss, bonus, kl, clipped, norm)).detach())
        names = "losses/policy_loss losses/value_loss losses/entropy losses/approx_kl losses/clipfrac grad/norm".split()
        return dict(zip(names, torch.stack(metrics).mean(0), strict=True))


@torch.no_grad()
def collect(env: DiffEnv, policy: ActorCritic, noise: Tensor) -> Rollout:
    """Take H steps of all environments from where they stand, with standard normal noise (H, N, action_dim)."""
    steps = []
    obs, std = env.detach(), policy.log_std.exp()
    for step_noise in noise.unbind():
        mean, value = policy(policy.normalizer(obs))
        action = mean + std * step_noise
        next_obs, reward, terminated, truncated, info = env.step(action)
        ends = terminated, terminated | truncated
        steps.append((obs, info["final_obs"], mean, action, value, reward, *ends))
        obs = next_obs
    return Rollout(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))


def gae(reward: Tensor, value: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """Compute advantages of (H, N) steps (Schulman et al. 2016, Eq. 16), cut at dones and at the rollout's end.

    next_value is V(s_{t+1}), before any reset: zero where the episode terminated, but not where its time ran out.
    """
    advantages, following = torch.empty_like(reward), torch.zeros_like(reward[0])
    delta, decay = reward + gamma * next_value - value, gamma * lam * (~done).to(reward.dtype)
    for t in reversed(range(len(reward))):
        following = advantages[t] = torch.addcmul(delta[t], decay[t], following)
    return advantages


def log_ratio(batch: Batch, mean: Tensor, log_std: Tensor, old_log_std: Tensor) -> Tensor:
    """Compute log pi(a|s) / pi_old(a|s) (B,)."""
    new = ((batch.action - mean) / log_std.exp()).square() / 2 + log_std
    old = ((batch.action - batch.mean) / old_log_std.exp()).square() / 2 + old_log_std
    return (old - new).sum(-1)


def kl_divergence(old_mean: Tensor, old_log_std: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Compute KL(pi_old || pi) of diagonal Gaussians, mean over states."""
    ratio = ((2 * old_log_std).exp() + (old_mean - mean).square()) / (2 * log_std).exp()
    return (log_std - old_log_std + (ratio - 1) / 2).sum(-1).mean()


def clipped_loss(ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """Compute minus the clipped surrogate objective (Eq. 7), of pi(a|s) / pi_old(a|s) (B,)."""
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


def entropy(log_std: Tensor) -> Tensor:
    """Compute the entropy of a diagonal Gaussian, in nats."""
    return (log_std + (1 + math.log(2 * math.pi)) / 2).sum(-1)


@torch.no_grad()
def adapt(lr: Tensor, kl: Tensor, target: float, bounds: tuple[float, float]) -> None:
    """Divide lr by 1.5 where kl is beyond twice the target, and multiply it by 1.5 where kl is below half of it."""
    lr.mul_(1.5 ** ((kl < target / 2).to(lr.dtype) - (kl > 2 * target).to(lr.dtype))).clamp_(*bounds)


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
