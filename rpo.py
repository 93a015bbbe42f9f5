"""RPO, Reparameterization Proximal Policy Optimization (after Zhong et al. 2025, https://arxiv.org/abs/2508.06214).

A rollout and its backward pass through the simulator are dear, a step of the policy is cheap. So one backward pass
keeps g = dJ/du, the gradient of SHAC's loss J in each action u of the rollout, before tanh. The policy then takes many
Adam steps along the same g, without the simulator, and a bound keeps each action near the rollout's. With one epoch and
one minibatch an iteration is SHAC's. docs/rpo.md says what is the paper's.

    python rpo.py --env ant --seed 1                                   train; writes runs/ant__rpo__1__<time>/
    python rpo.py --resume runs/ant__rpo__1__<time>/checkpoint.pt      continue an interrupted run exactly
    python rpo.py --evaluate runs/ant__rpo__1__<time>/checkpoint.pt    evaluate its deterministic policy
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.extra.symmetry import mirror_inputs, mirror_outputs, mirror_parameter, mirror_statistics
from diffsim.training import ClippedAdam, ObsNormalizer, Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import Chain, mlp
from diffsim.training.ranges import Count, Finite, Fraction, Natural, NonNegative, Positive, UpTo10k, Widths

# Networks are SHAC's; the rest was chosen by trials (docs/rpo.md).
# fmt: off
COLUMNS = ("actor_hidden", "critic_hidden", "critic_lr", "target_alpha", "num_envs", "epochs", "trust",
           "critic_iterations", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),      (64, 64),   1e-3, 0.2,    64, 4, 0.5,  8,  300),
    "hopper":       ((128, 64, 32), (64, 64),   2e-3, 0.2,   256, 8, 1.0,  4,  400),
    "half_cheetah": ((128, 64, 32), (64, 64),   2e-3, 0.2,    64, 4, 0.5,  8,  600),
    "ant":          ((128, 64, 32), (64, 64),   2e-3, 0.2,    64, 2, 0.3,  4, 1200),
    "humanoid":     ((256, 128),    (128, 128), 5e-4, 0.9,    64, 4, 0.5,  4,  800),
    "humanoid_mtu": ((512, 256),    (256, 256), 5e-4, 0.9,    64, 4, 0.5,  4,  800),
    "humanoid_imitation": ((256, 128), (128, 128), 5e-4, 0.9, 64, 4, 0.5,  4,  800),
    "go1":          ((256, 128),    (256, 128), 1e-3, 0.9,    64, 4, 0.5,  4,  400),
    "go2":          ((256, 128),    (256, 128), 1e-3, 0.9,    64, 4, 0.5,  4,  400),
    "g1":           ((256, 128),    (256, 128), 1e-3, 0.9,    64, 4, 0.5,  4,  600),
    "g1_track":     ((256, 128),    (512, 256), 1e-3, 0.9,   256, 4, 0.5,  8,  400),
}
ON_GPU = {  # where environments cost little
    "hopper": {"num_envs": 1024, "critic_iterations": 8},
    "half_cheetah": {"num_envs": 256},
    "humanoid": {"num_envs": 1024, "critic_iterations": 8},
    "humanoid_mtu": {"num_envs": 1024, "critic_iterations": 8, "iterations": 400},
    "humanoid_imitation": {"num_envs": 1024, "critic_iterations": 8},
} | {name: {"num_envs": 1024} for name in ("go1", "go2", "g1", "g1_track")}
# Robots with servos begin near their standing pose: little noise, actions near zero.
STANDING = {"horizon": 16, "initial_log_std": -2.0, "adjoint_clip": 5.0}
BEGINNING = dict.fromkeys(("go1", "go2", "g1", "g1_track"), STANDING)
GAIN = dict.fromkeys(BEGINNING, 0.01)  # factor of the weights of the actor's last layer at first, otherwise 1
# Cheaper than SHAC's, as SAPO's; policies keep their return at four times the substeps (docs/numerics.md).
INTEGRATION = {"ant": {"substeps": 8, "implicit": True}}
INTEGRATION |= dict.fromkeys(("humanoid", "humanoid_mtu"), {"substeps": 16, "implicit": True})
# fmt: on
MAX_GRAD_NORM, BETAS = 1.0, (0.7, 0.95)  # of both optimizers; Adam's decay rates of the gradient's moments
FINAL_LR = 1e-5  # both learning rates reach it, linearly, after the last iteration
CRITIC_MINIBATCHES = 4  # of a pass, contiguous in time
ELU = partial(nn.ELU, inplace=True)


@dataclass
class Args(Flags):
    """The algorithm. Defaults are those of a task that is not in the table."""

    num_envs: Count = 64
    """parallel environments N, over all processes of torchrun (per task)"""
    horizon: Count = 32
    """control steps h of a rollout (per task)"""
    gamma: Fraction = 0.99
    """discount factor"""
    epochs: Count = 4
    """passes of the actor over a rollout's samples (per task)"""
    minibatches: UpTo10k = 4
    """parts of a pass, each with its own environments"""
    bound: Literal["distance", "ratio"] = "distance"
    """what a sample's step is bounded by: how far its action moves, or PPO's ratio of densities (the paper's)"""
    trust: Positive = 0.5
    """the bound: standard deviations of the rollout's noise, or by how much the ratio may differ from 1 (per task)"""
    kl_coef: NonNegative = 0.0
    """weight of the divergence from the rollout's policy (the paper's second term)"""
    actor_hidden: Widths = (256, 128)
    """units of the actor's hidden layers (per task)"""
    initial_log_std: Finite = -1.0
    """initial log standard deviation of the noise, before tanh (per task)"""
    actor_lr: Positive = 2e-3
    """initial learning rate of the actor"""
    td_lambda: Fraction = 0.95
    """lambda of the value estimation"""
    critic_hidden: Widths = (256, 128)
    """units of the critic's hidden layers (per task)"""
    critic_lr: Positive = 1e-3
    """initial learning rate of the critic (per task)"""
    critic_iterations: Natural = 4
    """passes over the samples of a rollout to fit the critic; 0: no value function (per task)"""
    target_alpha: Fraction = 0.9
    """target critic <- alpha target critic + (1 - alpha) critic, each iteration (per task)"""
    symmetric: bool = False
    """treat left and right alike: a mirrored state gets the mirrored action (per task; docs/sapo.md)"""
    adjoint_clip: NonNegative = 0.0
    """clip gradients with respect to a state to this many times the batch's median (per task; 0: do not clip)"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK[self.task], strict=True)) if self.task in PER_TASK else {}
        if self.device != "cpu":
            values |= ON_GPU.get(self.task, {})
        values |= BEGINNING.get(self.task, {})
        if (
            self.contact == "mujoco" and self.task not in BEGINNING
        ):  # whose gradients agree over few steps: docs/transfer.md
            values |= {"horizon": 8, "num_envs": 4 * values.get("num_envs", self.num_envs), "trust": 0.2}
        if (self.accuracy, self.contact) == ("default", "soft"):
            values |= INTEGRATION.get(self.task, {})
        return super().task_defaults() | values

    def check(self) -> None:
        super().check()
        if self.minibatches > self.num_envs:
            fail(f"--minibatches {self.minibatches} are more than the {self.num_envs} environments that they share")


# Networks -------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """pi(a|s): tanh of a Gaussian whose standard deviation does not depend on the state."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim = env.task.obs_dim, env.scene.nu
        self.normalizer = ObsNormalizer(obs_dim)
        self.mean = mlp(obs_dim, args.actor_hidden, action_dim, ELU, norm=True, columns=env.task.actor_dim)
        if args.task in GAIN:
            with torch.no_grad():
                self.mean[-1].get_parameter("weight").mul_(GAIN[args.task])
                self.mean[-1].get_parameter("bias").zero_()
        self.log_std = nn.Parameter(torch.full((action_dim,), args.initial_log_std))

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


class Samples(NamedTuple):
    """What the actor learns from, (H, N, ...)."""

    obs: Tensor  # normalized
    eps: Tensor  # the noise in units of its deviation
    mean: Tensor  # of the rollout's policy
    slope: Tensor  # dJ/du


class RPO:
    """What an iteration changes, and the iteration."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        self.actor = Actor(args, env).to(env.device)
        self.critic = mlp(env.task.obs_dim, args.critic_hidden, 1, ELU, norm=True, orthogonal=True).to(env.device)
        if args.symmetric:
            self.make_alike()
        self.policy = self.actor.deterministic()
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.actor_optimizer = ClippedAdam(self.actor, MAX_GRAD_NORM, BETAS)
        self.critic_optimizer = ClippedAdam(self.critic, MAX_GRAD_NORM, BETAS)

    def make_alike(self) -> None:
        """Treat left and right alike: mirrored states get mirrored actions, and the same value."""
        mirror = self.env.task.mirror
        mirror_statistics(self.actor.normalizer, mirror.obs)
        for network, output in ((self.actor.mean, mirror.action), (self.critic, mirror.value)):
            mirror_inputs(network, mirror.obs)
            mirror_outputs(network, output)
        mirror_parameter(self.actor, "log_std", mirror.action)

    def iterate(self) -> dict[str, Tensor]:
        """Take one rollout, one backward pass and many steps of the policy; returns metrics.

        It changes tensors in place and never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        args, actor = self.args, self.actor

        # Act for h steps in N environments, where they stand. torch records the steps, the simulator's included.
        std = actor.log_std.detach().exp()
        eps = torch.randn(args.horizon, self.env.num_envs, std.numel(), device=std.device)
        noise = (std * eps).requires_grad_()
        rollout = collect(self.env, actor, noise)

        # SHAC's loss (its Eq. 5), and its gradient in the noise: that in each action before tanh, dJ/du.
        next_value = self.next_values(rollout)
        loss = actor_loss(rollout.reward, next_value, rollout.done, args.gamma)
        (slope,) = torch.autograd.grad(loss, noise)

        # Many steps along it, without the simulator. No gradient goes back from here.
        obs, reward = actor.normalizer(rollout.obs.detach()), rollout.reward.detach()
        norm = self.improve(Samples(obs, eps, actor.mean(obs).detach(), slope), std)

        # SHAC's Eq. 7: the TD(lambda) returns, and Eq. 6: the critic fitted to them.
        value = td_lambda(reward, next_value.detach(), rollout.done, args.gamma, args.td_lambda)
        critic_loss = self.fit_critic(obs.flatten(0, 1), value.view(-1, 1))
        actor.normalizer.update(rollout.obs.detach())
        for slow, fast in zip(self.target.parameters(), self.critic.parameters(), strict=True):
            slow.lerp_(fast.detach(), 1 - args.target_alpha)

        return {
            "losses/actor": loss.detach(),
            "losses/critic": critic_loss,
            "grad/norm": norm,
            "grad/skipped": self.actor_optimizer.skipped + self.critic_optimizer.skipped,
            "charts/actor_lr": self.actor_optimizer.lr,
            "charts/std": std.mean(),
        }

    def improve(self, samples: Samples, std: Tensor) -> Tensor:
        """Take the actor's steps over samples whose noise had the deviation std; returns the first gradient's norm.

        The deviation moves with the first step only: each further one would shrink it again for the same noise, until
        the policy explores no more.
        """
        args, norms, deviations = self.args, list[Tensor](), list[Tensor]()
        parts = [Samples(*part) for part in zip(*(x.tensor_split(args.minibatches, 1) for x in samples), strict=True)]
        for part in parts * args.epochs:
            loss = args.minibatches * self.surrogate(part, std)
            norms.append(self.actor_optimizer.step(self.actor_optimizer.gradient(loss)))
            deviations.append(self.actor.log_std.detach().clone())
        self.actor.log_std.detach().copy_(deviations[0])
        return norms[0]

    def surrogate(self, samples: Samples, std: Tensor) -> Tensor:
        """Return what the loss becomes, to first order, where the policy moves the samples' actions.

        Its gradient at the rollout's policy is that of SHAC's loss. What moved beyond the bound, downhill, has none.
        """
        args, mean, log_std = self.args, self.actor.mean(samples.obs), self.actor.log_std
        slope, before = samples.slope, samples.mean + std * samples.eps
        if args.bound == "distance":
            moved = mean + log_std.exp() * samples.eps - before
            reach = args.trust * std
            loss = torch.maximum(slope * moved, slope * moved.clamp(-reach, reach)).sum()
        else:  # the action stays, and the noise that would give it changes
            eps = ((before - mean) / log_std.exp()).detach()
            density, old = (-0.5 * e.square() - s for e, s in ((eps, log_std.detach()), (samples.eps, std.log())))
            ratio = (density - old).sum(-1, keepdim=True).exp()
            weight = ratio.where((ratio - 1).abs() < args.trust, 0.0)
            loss = (weight * slope * (mean + log_std.exp() * eps)).sum()
        if not args.kl_coef:
            return loss
        spread = log_std - std.log()
        kl = spread + 0.5 * ((std.square() + (samples.mean - mean).square()) / (2 * log_std).exp() - 1)
        return loss + args.kl_coef * kl.sum(-1).mean()

    def next_values(self, rollout: Rollout) -> Tensor:
        """V(s_{t+1}) (H, N): of an episode's last state where it ran out of time, zero where it terminated."""
        if self.args.critic_iterations == 0:
            return torch.zeros_like(rollout.reward)
        values = self.target(self.actor.normalizer(rollout.next_obs)).squeeze(-1)
        return values.masked_fill(rollout.terminated, 0.0)

    def fit_critic(self, obs: Tensor, value: Tensor) -> Tensor:
        """Fit V to values (B, 1) of normalized observations (B, obs_dim); returns the mean loss of the last pass."""
        optimizer, parts = self.critic_optimizer, CRITIC_MINIBATCHES
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
    """Eq. 5 of (H, N) steps: each environment's rollout is cut at its dones, and the discount restarts after them."""
    ages, age = [], torch.zeros_like(reward[0])
    for ended in done:
        ages.append(age)
        age = (age + 1).masked_fill(ended, 0.0)
    discount = gamma ** torch.stack(ages)
    ends = done.clone()
    ends[-1] = True
    return -(discount * reward + discount * gamma * ends * next_value).mean()


def td_lambda(reward: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """Eq. 7 of (H, N) steps, as its recursion backward in time; a done ends the return as the rollout's end does."""
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
