"""SAC, Soft Actor-Critic (Haarnoja et al. 2018, https://arxiv.org/abs/1812.05905), the off-policy baseline, and REDQ.

It acts in the same environments as the other learners, without their gradients, and learns from a replay buffer on the
device. REDQ (Chen et al. 2021, https://arxiv.org/abs/2101.05982) is the same script with more critics and updates.

    python baselines/sac_baseline.py --env ant --seed 1         train; writes runs/ant__sac_baseline__1__<time>/
    python baselines/sac_baseline.py --env ant --critics 10 --critic-subset 2 --updates-per-step 20  REDQ
    python baselines/sac_baseline.py --resume <run>/checkpoint.pt  continue an interrupted run exactly
    python baselines/sac_baseline.py --evaluate <run>/checkpoint.pt  evaluate its deterministic policy
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.learning.ensemble import Ensemble
from diffsim.learning.replay import ReplayBuffer, Transition
from diffsim.training import Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import ObsNormalizer, mlp
from diffsim.training.optimizer import ClippedAdam
from diffsim.training.ranges import Batch, Count, Fraction, Natural, Positive, SomeWidths, UpTo10k, UpTo1000

# Table 3 of the SHAC paper; networks, seed steps, hopper and half_cheetah: its authors' released settings.
# fmt: off
COLUMNS = ("hidden", "num_envs", "batch_size", "temperature_lr", "lr", "seed_steps", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),              32, 1024, 5e-3, 5e-4, 640,  4_000),
    "hopper":       ((256, 128, 64),        64, 2048, 5e-3, 5e-4, 640, 20_000),
    "half_cheetah": ((256, 128, 64),        64, 2048, 5e-3, 5e-4, 640, 20_000),
    "ant":          ((256, 128, 64),       128, 4096, 5e-3, 5e-4, 640, 20_000),
    "humanoid":     ((512, 256),            64, 2048, 2e-4, 3e-4, 256, 20_000),
    "humanoid_mtu": ((512, 512, 512, 256), 256, 4096, 2e-4, 3e-4, 256, 40_000),
}
# fmt: on
# Chosen here, on hopper, ant and humanoid: on a GPU a step of 1,024 environments costs as much as one of 64.
LARGE_BATCH: dict[str, Any] = {"num_envs": 1024, "batch_size": 8192, "updates_per_step": 4, "actor_updates": 2}
LARGE_BATCH |= {"iterations": 800, "layer_norm": True, "gamma": 0.98, "tau": 0.05}
CPU = {"num_envs": 64, "batch_size": 512, "updates_per_step": 2, "actor_updates": 1}  # of those, at most
LOG_STD = (-5.0, 2.0)  # bounds of the log standard deviation
MAX_GRAD_NORM = 100.0  # few gradients reach it
TARGET_ENTROPY = -1.0  # nats per action


@dataclass
class Args(Flags):
    """The algorithm. Defaults are those of a task that is not in the table."""

    processes: ClassVar[bool] = False

    iterations: Count = 20_000
    """learning iterations: --steps control steps of all environments, each followed by updates (per task)"""
    eval_every: Natural = 500
    """evaluate the policy without noise every this many iterations (0: only at the end)"""
    save_every: Natural = 5000
    """save the checkpoint, which holds the replay buffer, every this many iterations (0: only at the end)"""
    num_envs: Count = 64
    """parallel environments N (per task)"""
    steps: Count = 32
    """control steps of an iteration"""
    seed_steps: Natural = 640
    """control steps of each environment with random actions before the first update (per task)"""
    buffer_size: Count = 1_000_000
    """transitions in the replay buffer, over all environments"""
    updates_per_step: UpTo10k = 1
    """gradient updates of the critics after each control step of all environments"""
    actor_updates: UpTo10k = 1
    """the last so many of these updates also update the actor and the temperature"""
    batch_size: Batch = 2048
    """samples of an update (per task)"""
    gamma: Fraction = 0.99
    """discount factor"""
    hidden: SomeWidths = (256, 128, 64)
    """units of the hidden layers of actor and critics (per task)"""
    critics: UpTo1000 = 2
    """value functions"""
    critic_subset: UpTo1000 = 2
    """the target is the minimum of this many critics, drawn for each update"""
    layer_norm: bool = False
    """normalize the critics' hidden layers, which steadies many updates on large batches"""
    tau: Fraction = 0.005
    """target critics <- (1 - tau) target critics + tau critics, after each update"""
    lr: Positive = 5e-4
    """learning rate of actor and critics (per task)"""
    temperature_lr: Positive = 5e-3
    """learning rate of the temperature's logarithm (per task)"""
    large_batch: bool = False
    """many environments, large batches, layer-normalized critics: hopper, ant and humanoid in minutes of a GPU"""

    def task_defaults(self) -> dict[str, Any]:
        values: dict[str, Any] = dict(zip(COLUMNS, PER_TASK.get(self.like, ()), strict=False))
        if self.large_batch:
            values |= LARGE_BATCH | (CPU | {"iterations": 2000} if self.device == "cpu" else {})
        return values

    def check(self) -> None:
        super().check()
        if self.critic_subset > self.critics:
            fail(f"--critic-subset {self.critic_subset} is larger than --critics {self.critics}")
        if self.seed_steps > (most := self.iterations * self.steps - 1):
            fail(f"--seed-steps {self.seed_steps} leave no update in --iterations {self.iterations}: at most {most}")
        if self.actor_updates > self.updates_per_step:
            fail(f"--actor-updates {self.actor_updates} are more than --updates-per-step {self.updates_per_step}")
        if self.buffer_size < self.steps * self.num_envs:
            fail(f"--buffer-size {self.buffer_size} holds no iteration of {self.steps} steps of {self.num_envs}")


# Networks -------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """pi(a|s): tanh of a Gaussian whose mean and standard deviation depend on the state."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim, seen = env.task.obs_dim, env.scene.nu, env.task.actor_dim
        self.normalizer = ObsNormalizer(obs_dim)
        self.body = mlp(obs_dim, args.hidden, None, nn.ReLU, columns=seen)
        self.mean, self.log_std = (nn.Linear(args.hidden[-1], action_dim) for _ in range(2))

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Of normalized observations (..., obs_dim): sampled actions (..., action_dim), their log density (...)."""
        features = self.body(obs)
        log_std = self.log_std(features).clamp(*LOG_STD)
        noise = torch.randn_like(log_std)
        u = self.mean(features) + log_std.exp() * noise
        log_slope = 2 * (math.log(2) - u - F.softplus(-2 * u))  # of tanh
        density = -0.5 * noise.square() - 0.5 * math.log(2 * math.pi) - log_std - log_slope
        return torch.tanh(u), density.sum(-1)

    def deterministic(self) -> nn.Sequential:
        """Return the action without noise, of observations as they come, with the same weights."""
        return nn.Sequential(self.normalizer, *self.body, self.mean, nn.Tanh())


# The algorithm --------------------------------------------------------------------------------------------------------


class SAC:
    """What an iteration changes, and the iteration."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        obs_dim, action_dim = env.task.obs_dim, env.scene.nu
        self.actor = Actor(args, env).to(env.device)
        inputs = obs_dim + action_dim
        critics = [mlp(inputs, args.hidden, 1, nn.ReLU, args.layer_norm) for _ in range(args.critics)]
        self.critics = Ensemble(critics).to(env.device)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.temperature = nn.ParameterDict({"log": torch.zeros(())}).to(env.device)  # the entropy's weight
        self.policy = self.actor.deterministic()
        self.actor_optimizer = ClippedAdam(self.actor, MAX_GRAD_NORM, lr=args.lr)
        self.critic_optimizer = ClippedAdam(self.critics, MAX_GRAD_NORM, lr=args.lr)
        self.temperature_optimizer = ClippedAdam(self.temperature, MAX_GRAD_NORM, lr=args.temperature_lr)
        self.buffer = ReplayBuffer(args.buffer_size, obs_dim, action_dim).to(env.device)

    def iterate(self, learning: bool = True) -> dict[str, Tensor]:
        """Algorithm 1: control steps of all environments into the buffer, each followed by updates; returns metrics.

        Before learning begins, actions are random and nothing is updated. An iteration changes tensors in place and
        never waits for the device, so that on a GPU it becomes one CUDA graph.
        """
        args, normalizer, rows = self.args, self.actor.normalizer, list[dict[str, Tensor]]()
        obs = self.env.detach()
        for _ in range(args.steps):
            obs = self.act(obs, random=not learning)
            for left in reversed(range(args.updates_per_step if learning else 0)):
                batch = self.buffer.sample(args.batch_size)
                seen, next_seen = normalizer(batch.obs), normalizer(batch.next_obs)
                found = self.update_critics(batch, seen, next_seen)
                if left < args.actor_updates:
                    found |= self.update_actor(seen)
            if learning:
                rows.append(found)  # of each step's last update
        optimizers = self.actor_optimizer, self.critic_optimizer, self.temperature_optimizer
        return {
            **{name: torch.stack([row[name] for row in rows]).mean() for name in (rows[0] if rows else ())},
            "grad/skipped": torch.stack([optimizer.skipped for optimizer in optimizers]).sum(),
            "charts/learning_rate": self.actor_optimizer.lr,
            "charts/temperature": self.temperature["log"].detach().exp(),
        }

    def explore(self) -> dict[str, Tensor]:
        """An iteration of uniformly random actions, from which only the buffer and the normalizer learn."""
        return self.iterate(learning=False)

    @torch.no_grad()
    def act(self, obs: Tensor, random: bool) -> Tensor:
        """Take a control step of all environments into the buffer; returns the observations after it."""
        env = self.env
        if random:
            action = 2 * torch.rand(env.num_envs, env.scene.nu, device=env.device) - 1
        else:
            action, _ = self.actor(self.actor.normalizer(obs))
        next_obs, reward, terminated, _, info = env.step(action)
        self.buffer.add(Transition(obs, action, reward, info["final_obs"], terminated.to(reward.dtype)))
        self.actor.normalizer.update(obs)
        return next_obs

    def update_critics(self, batch: Transition, obs: Tensor, next_obs: Tensor) -> dict[str, Tensor]:
        """Descend the soft Bellman residual, and let the target critics follow."""
        args = self.args
        with torch.no_grad():
            action, density = self.actor(next_obs)
            values = self.targets.value(next_obs, action)
            if args.critic_subset < args.critics:
                values = values[torch.rand(args.critics, device=obs.device).argsort()[: args.critic_subset]]
            value = values.amin(0) - self.temperature["log"].exp() * density
            target = batch.reward + args.gamma * (1 - batch.terminated) * value  # none after a fall
        values = self.critics.value(obs, batch.action)
        loss = (values - target).square().mean(1).sum()
        norm = self.critic_optimizer.step(self.critic_optimizer.gradient(loss))
        for slow, fast in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast.detach(), args.tau)
        found = {"losses/critic": loss.detach() / args.critics, "charts/value": values.detach().mean()}
        return found | {"grad/norm": norm}

    def update_actor(self, obs: Tensor) -> dict[str, Tensor]:
        """Ascend value and entropy; steer the temperature to the target entropy."""
        action, density = self.actor(obs)
        values = self.critics.value(obs, action)
        value = values.amin(0) if self.args.critic_subset == self.args.critics else values.mean(0)  # REDQ: the mean
        loss = (self.temperature["log"].detach().exp() * density - value).mean()
        self.actor_optimizer.step(self.actor_optimizer.gradient(loss))
        surplus = -density.detach().mean() - TARGET_ENTROPY * action.shape[1]  # of entropy over the target
        weighted = self.temperature["log"].exp() * surplus
        self.temperature_optimizer.step(self.temperature_optimizer.gradient(weighted))
        return {"losses/actor": loss.detach(), "charts/entropy": -density.detach().mean() / action.shape[1]}


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.steps)
    sac = run.restore(SAC(args, env))
    explore, iterate = run.capture(sac.explore, env), run.capture(sac.iterate, env)
    for iteration in run:
        run.log(explore() if iteration * args.steps <= args.seed_steps else iterate())
        if run.evaluation_due:
            run.evaluate(sac.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
