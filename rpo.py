"""RPO, Reparameterization Proximal Policy Optimization (after Zhong et al. 2025, https://arxiv.org/abs/2508.06214).

SHAC's gradient, used more than once. One rollout and one backward pass through the simulator give the gradient with
respect to each action. The actor descends it for several epochs, bounded as in PPO, without the simulator.

    python rpo.py --env ant --seed 1                                   train; writes runs/ant__rpo__1__<time>/
    python rpo.py --resume runs/ant__rpo__1__<time>/checkpoint.pt      continue an interrupted run exactly
    python rpo.py --evaluate runs/ant__rpo__1__<time>/checkpoint.pt    evaluate its deterministic policy
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils import parametrize

from diffsim import DiffEnv
from diffsim.sim.integration import Integration
from diffsim.symmetry.networks import make_alike
from diffsim.training import ClippedAdam, ObsNormalizer, Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import Chain, mlp
from diffsim.training.ranges import Count, Finite, Fraction, NonNegative, Positive, UpTo10k, UpTo1000, Widths

# SHAC's networks; the rest was chosen by trials (docs/rpo.md). Environments are those of a CPU, where they cost time.
# fmt: off
COLUMNS = ("actor_hidden", "critic_hidden", "critic_lr", "target_alpha", "num_envs", "iterations",
           "critic_iterations", "epochs", "trust")
PER_TASK = {
    "cartpole":     ((64, 64),      (64, 64),   1e-3, 0.2,  64,  300, 8, 4, 0.5),
    "hopper":       ((128, 64, 32), (64, 64),   2e-3, 0.2, 256,  400, 4, 8, 1.0),
    "half_cheetah": ((128, 64, 32), (64, 64),   2e-3, 0.2,  64,  600, 8, 4, 0.5),
    "ant":          ((128, 64, 32), (64, 64),   2e-3, 0.2,  64, 1200, 16, 2, 0.3),
    "humanoid":     ((256, 128),    (128, 128), 5e-4, 0.9,  64,  800, 4, 4, 0.5),
    "humanoid_mtu": ((512, 256),    (256, 256), 5e-4, 0.9,  64,  400, 4, 4, 0.5),
}
PER_TASK |= {"walker": PER_TASK["hopper"], "swimmer": PER_TASK["half_cheetah"]}
SOME, MANY = {"num_envs": 256}, {"num_envs": 1024}
ON_GPU: dict[str, dict[str, Any]] = dict.fromkeys(("half_cheetah", "ant"), SOME)
ON_GPU["cartpole"] = SOME | {"critic_iterations": 16, "critic_lr": 2e-3}
ON_GPU |= dict.fromkeys(("hopper", "humanoid", "humanoid_mtu"), MANY | {"critic_iterations": 8})
INTEGRATION = {"ant": Integration("soft", 8, implicit=True)}  # SAPO's cheaper steps
INTEGRATION |= dict.fromkeys(("humanoid", "humanoid_mtu"), Integration("soft", 16, implicit=True))
# On MuJoCo's contact (docs/transfer.md): its gradients agree over few steps, with four times the environments; or
# contacts begin softly, and PPO's loss steadies the gradient of a longer rollout.
MUJOCO = {"epochs": 2, "trust": 0.2}
SOFTLY = {"onset": (0.02, 0.002), "adjoint_clip": 8.0, "mix": 0.3}
ONSET = dict.fromkeys(("half_cheetah", "humanoid", "humanoid_mtu"), SOFTLY)
# fmt: on
GAMMA, LAMBDA = 0.99, 0.95  # discount factor; lambda of the value estimation
CRITIC_MINIBATCHES = 4  # of a pass over the samples of a rollout, contiguous in time
MAX_GRAD_NORM, BETAS = 1.0, (0.7, 0.95)  # of both optimizers; Adam's decay rates of the gradient's moments
WINDOW = 0.2, 2.0  # of the probabilities' ratio (RPO's Eq. 11)
CLIP = 0.2  # of this ratio in PPO's loss
FINAL_LR = 1e-5  # both learning rates reach it, linearly, after the last iteration
ELU = partial(nn.ELU, inplace=True)


@dataclass
class Args(Flags):
    """The algorithm. With --epochs 1 --minibatches 1 an iteration is SHAC's."""

    differentiates: ClassVar[bool] = True

    num_envs: Count = 64
    """parallel environments N, over all processes of torchrun (per task)"""
    horizon: Count = 32
    """control steps H of a rollout (per task)"""
    actor_hidden: Widths = (256, 128)
    """units of the actor's hidden layers (per task)"""
    initial_log_std: Finite = -1.0
    """initial log standard deviation of the noise, before tanh (per task)"""
    actor_lr: Positive = 2e-3
    """initial learning rate of the actor (per task)"""
    epochs: UpTo1000 = 4
    """passes of the actor over a rollout's samples and their gradients (per task)"""
    minibatches: UpTo1000 = 4
    """minibatches of such a pass, each a step of the actor on a share of the environments"""
    bound: Literal["distance", "ratio", "none"] = "distance"
    """what ends the reuse of a sample: how far its action has moved, or (the paper) how much likelier it has become"""
    trust: Positive = 0.3
    """the bound of distance, in standard deviations of an action (per task)"""
    kl_coef: NonNegative = 0.0
    """weight of the KL divergence from the policy that acted, in the loss"""
    entropy_coef: NonNegative = 0.0
    """weight of the policy's entropy, in the loss"""
    mix: NonNegative = 0.0
    """weight of PPO's clipped loss of the same samples, beside gradients scaled to its size (per task; 0: neither)"""
    critic_hidden: Widths = (128, 128)
    """units of the critic's hidden layers (per task)"""
    critic_lr: Positive = 5e-4
    """initial learning rate of the critic (per task)"""
    critic_iterations: UpTo10k = 8
    """passes over the samples of a rollout to fit the critic (per task)"""
    target_alpha: Fraction = 0.9
    """target critic <- alpha target critic + (1 - alpha) critic, each iteration (per task)"""
    symmetric: bool = False
    """treat left and right alike: a mirrored state gets the mirrored action (per task; docs/sapo.md)"""
    adjoint_clip: NonNegative = 0.0
    """clip gradients with respect to a state to this many times the batch's median (per task; 0: do not clip)"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK.get(self.like, ()), strict=False))
        if self.device != "cpu":
            values |= ON_GPU.get(self.like, {})
        if (self.accuracy, self.contact) == ("default", "soft") and self.task in INTEGRATION:
            _, values["substeps"], values["implicit"], *_ = INTEGRATION[self.task]
        if self.contact == "mujoco":
            few = {"horizon": 8, "num_envs": 4 * values.get("num_envs", self.num_envs)}
            values |= MUJOCO | ONSET.get(self.task, few)
        return values


# Networks -------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """pi(a|s): tanh of a Gaussian whose standard deviation does not depend on the state."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        task, action_dim = env.task, env.scene.nu
        self.normalizer = ObsNormalizer(task.obs_dim)
        options: dict[str, Any] = dict(columns=task.actor_dim, gain=task.initial_gain)
        self.mean = mlp(task.obs_dim, args.actor_hidden, action_dim, ELU, norm=True, **options)
        self.log_std = nn.Parameter(torch.full((action_dim,), args.initial_log_std))

    @property
    def deviation(self) -> Tensor:
        """Return the numbers of log_std themselves, also where it is computed from them (--symmetric)."""
        own = "parametrizations.log_std.original" if parametrize.is_parametrized(self, "log_std") else "log_std"
        return self.get_parameter(own)

    def forward(self, obs: Tensor, noise: Tensor) -> Tensor:
        return torch.tanh(self.mean(self.normalizer(obs)) + noise)

    def deterministic(self) -> nn.Sequential:
        """Return the policy without noise, with the same weights."""
        return Chain(self.normalizer, *self.mean, nn.Tanh())


# The algorithm -------------------------------------------------------------------------------------------------------


class Rollout(NamedTuple):
    """What happened in one rollout, time first: (H, N, ...)."""

    obs: Tensor  # s_t, on which the policy acted
    next_obs: Tensor  # s_{t+1}, before any reset
    reward: Tensor
    terminated: Tensor
    done: Tensor  # terminated or truncated


class Batch(NamedTuple):
    """What the actor's update needs of a rollout, or of some of its environments: (H, B, ...)."""

    obs: Tensor  # normalized
    mean: Tensor  # of the policy that acted
    eps: Tensor  # standard normal noise: it took u = mean + std eps, before tanh
    gradient: Tensor  # dJ/du of the rollout's loss J
    advantage: Tensor  # (H, B, 1), of mean 0 and deviation 1; without --mix not used


class RPO:
    """What an iteration changes, and the iteration."""

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
        """Act for a rollout, take its gradient once, descend it several times, fit the critic; returns metrics.

        It changes tensors in place and never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        args, normalizer = self.args, self.actor.normalizer

        # Act for H steps in N environments, where they stand. The noise is a leaf of torch's graph.
        std = self.actor.log_std.detach().exp()
        eps = torch.randn(args.horizon, self.env.num_envs, len(std), device=std.device)
        noise = (std * eps).requires_grad_()
        rollout = collect(self.env, self.actor, noise)

        # SHAC's loss. Its gradient with respect to the noise is that with respect to the actions u = mean + noise.
        next_value = self.target(normalizer(rollout.next_obs)).squeeze(-1).masked_fill(rollout.terminated, 0.0)
        loss = actor_loss(rollout.reward, next_value, rollout.done, GAMMA)
        if not loss.requires_grad:
            fail("the loss has no gradient: observe and reward must be torch operations, without detach and no_grad")
        (gradient,) = torch.autograd.grad(loss, noise)

        # Several epochs on these numbers. Nothing of the simulator is needed any more.
        obs = normalizer(rollout.obs.detach())
        value = td_lambda(rollout.reward.detach(), next_value.detach(), rollout.done, GAMMA, LAMBDA)
        advantage = value.unsqueeze(-1)
        if args.mix:  # gradients per deviation of an action and sample, of size 1 as the advantages are
            advantage = advantage - self.critic(obs).detach()
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            size = (gradient * std).square().sum(-1).mean().sqrt() * advantage.numel()
            gradient = gradient / (size + 1e-12)
        metrics = self.fit_actor(Batch(obs, self.actor.mean(obs).detach(), eps, gradient, advantage), std)

        # The critic is fitted to the TD(lambda) returns, and the target critic follows.
        critic_loss = self.fit_critic(obs.flatten(0, 1), value.view(-1, 1))
        normalizer.update(rollout.obs)
        for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
            slow.lerp_(fast.detach(), 1 - args.target_alpha)

        return {
            "losses/actor": loss.detach(),
            "losses/critic": critic_loss,
            **metrics,
            "grad/skipped": self.actor_optimizer.skipped + self.critic_optimizer.skipped,
            "charts/std": self.actor.log_std.detach().exp().mean(),
            "charts/actor_lr": self.actor_optimizer.lr,
        }

    def fit_actor(self, samples: Batch, old_std: Tensor) -> dict[str, Tensor]:
        """Descend the surrogate in epochs of minibatches; returns metrics, each the mean of all steps.

        The deviation keeps its first step only, as in SHAC. Each further one would shrink the noise again along the
        same samples, and with it the bound: learning would end early. The paper's ratio keeps all of them.
        """
        args, optimizer, metrics, once = self.args, self.actor_optimizer, list[Tensor](), list[Tensor]()
        count = min(args.minibatches, self.env.num_envs)
        parts = [Batch(*part) for part in zip(*(x.tensor_split(count, dim=1) for x in samples), strict=True)]
        for b in parts * args.epochs:
            mean, std = self.actor.mean(b.obs), self.actor.log_std.exp()
            change, beyond = surrogate(args.bound, args.trust, b, mean, std, old_std)
            kl = kl_divergence(b.mean, old_std, mean, std)
            loss = count * change + args.kl_coef * kl - args.entropy_coef * std.log().sum()
            if args.mix:
                loss = loss + args.mix * ppo_loss(b, mean, std, old_std)
            gradient = optimizer.gradient(loss)
            metrics.append(torch.stack((kl.detach(), beyond, optimizer.step(gradient))))
            once = once or [self.actor.deviation.detach().clone()]
        if args.bound != "ratio":
            self.actor.deviation.detach().copy_(once[0])
        return dict(
            zip(("losses/approx_kl", "losses/clipfrac", "grad/norm"), torch.stack(metrics).mean(0), strict=True)
        )

    def fit_critic(self, obs: Tensor, value: Tensor) -> Tensor:
        """Fit V to values (B, 1) of normalized observations (B, obs_dim); returns the mean loss of the last pass."""
        optimizer, losses = self.critic_optimizer, list[Tensor]()
        batches = [*zip(obs.tensor_split(CRITIC_MINIBATCHES), value.tensor_split(CRITIC_MINIBATCHES), strict=True)]
        for _ in range(self.args.critic_iterations):
            losses = []
            for some_obs, some_value in batches:
                loss = F.mse_loss(self.critic(some_obs), some_value)
                optimizer.step(optimizer.gradient(loss))
                losses.append(loss.detach())
        return torch.stack(losses).mean()


def surrogate(bound: str, trust: float, b: Batch, mean: Tensor, std: Tensor, old_std: Tensor) -> tuple[Tensor, Tensor]:
    """Sum over samples what moving their actions changes in J, to first order; and the share beyond the bound.

    distance: an action u follows the policy, mean + std eps, and gains nothing by more than `trust` deviations; none:
    without that bound.
    ratio (RPO, Eq. 10 and 11): u stays, the policy passes through it with other noise, and its gradient counts
    pi(u|s) / pi_old(u|s) times, or not at all where this ratio has left its window.
    """
    u = b.mean + old_std * b.eps
    if bound == "ratio":
        eps = ((u - mean) / std).detach()
        ratio = probability_ratio(b, mean, std, old_std).detach()
        beyond = (ratio < WINDOW[0]) | (ratio > WINDOW[1])
        return (ratio.masked_fill(beyond, 0.0) * b.gradient * (mean + std * eps)).sum(), beyond.to(ratio.dtype).mean()
    move, most = mean + std * b.eps - u, trust * old_std
    change, beyond = b.gradient * move, move.detach().abs() > most
    if bound == "distance":
        change = torch.maximum(change, b.gradient * move.clamp(-most, most))
    return change.sum(), beyond.to(move.dtype).mean()


def probability_ratio(b: Batch, mean: Tensor, std: Tensor, old_std: Tensor) -> Tensor:
    """Compute pi(u|s) / pi_old(u|s) of the actions that were taken, (H, B, 1)."""
    eps = (b.mean + old_std * b.eps - mean) / std
    return ((b.eps.square() - eps.square()) / 2 + (old_std / std).log()).sum(-1, keepdim=True).exp()


def ppo_loss(b: Batch, mean: Tensor, std: Tensor, old_std: Tensor) -> Tensor:
    """Compute PPO's clipped surrogate (Schulman et al. 2017, Eq. 7), mean over samples."""
    ratio = probability_ratio(b, mean, std, old_std)
    return -torch.minimum(ratio * b.advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * b.advantage).mean()


def kl_divergence(old_mean: Tensor, old_std: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Compute KL(pi_old || pi) of diagonal Gaussians, mean over states."""
    ratio = (old_std.square() + (old_mean - mean).square()) / std.square()
    return ((std / old_std).log() + (ratio - 1) / 2).sum(-1).mean()


def collect(env: DiffEnv, actor: Actor, noise: Tensor) -> Rollout:
    """Take H steps of all environments from where they stand, with the policy's noise (H, N, action_dim)."""
    steps, obs = [], env.detach()  # no gradient goes back to the steps before
    for step_noise in noise.unbind():
        next_obs, reward, terminated, truncated, info = env.step(actor(obs, step_noise))
        steps.append((obs, info["final_obs"], reward, terminated, terminated | truncated))
        obs = next_obs
    return Rollout(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))


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
    rpo = run.restore(RPO(args, env))
    iterate = run.capture(rpo.iterate, env)
    for iteration in run:
        done = (iteration - 1) / args.iterations
        rpo.actor_optimizer.lr.fill_(args.actor_lr + (FINAL_LR - args.actor_lr) * done)
        rpo.critic_optimizer.lr.fill_(args.critic_lr + (FINAL_LR - args.critic_lr) * done)
        run.log(iterate())
        if run.evaluation_due:
            run.evaluate(rpo.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
