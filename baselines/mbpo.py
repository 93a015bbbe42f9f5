"""MBPO, Model-Based Policy Optimization (Janner et al. 2019, https://arxiv.org/abs/1906.08253), and SE-MBPO.

An ensemble of networks learns the dynamics, and SAC learns from its short rollouts, which branch from real states.
--sample-enhance (Qiao et al. 2021, https://arxiv.org/abs/2109.07719) adds transitions around each real one by the
simulator's Jacobians.

    python baselines/mbpo.py --env ant --seed 1              train; writes runs/ant__mbpo__1__<time>/
    python baselines/mbpo.py --env ant --sample-enhance 4    SE-MBPO: four more transitions around each real one
    python baselines/mbpo.py --resume <run>/checkpoint.pt    continue an interrupted run exactly
    python baselines/mbpo.py --evaluate <run>/checkpoint.pt  evaluate its deterministic policy
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call

from diffsim import DiffEnv
from diffsim.learning.ensemble import Ensemble
from diffsim.learning.replay import ReplayBuffer, Transition
from diffsim.planning import System
from diffsim.training import Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import ObsNormalizer, mlp
from diffsim.training.optimizer import ClippedAdam
from diffsim.training.ranges import Batch, Count, Fraction, Natural, Positive, SomeWidths, UpTo10k, Widths

# Policies and values: as SAC's, from Table 3 of the SHAC paper. Rollout lengths: MBPO's released settings.
# fmt: off
COLUMNS = ("hidden", "model_hidden", "rollout_lengths", "num_envs", "actor_lr", "temperature_lr", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),             (128, 128),           (1, 5),  16, 1e-3, 1e-3,   600),
    "hopper":       ((256, 128, 64),       (200, 200, 200, 200), (1, 15), 64, 5e-4, 5e-4, 2_000),
    "ant":          ((256, 128, 64),       (200, 200, 200, 200), (1, 25), 64, 5e-4, 5e-4, 2_000),
    "humanoid":     ((512, 256),           (400, 400, 400, 400), (1, 25), 64, 3e-4, 2e-4, 2_000),
    "humanoid_mtu": ((512, 512, 512, 256), (400, 400, 400, 400), (1, 25), 64, 3e-4, 2e-4, 2_000),
}
# fmt: on
MAX_GRAD_NORM = 100.0  # gradients of large values reach it
MODELS, ELITES = 7, 5  # networks of the ensemble; those that predict held-out transitions best make the rollouts
MODEL_LR = 1e-3
ENHANCE_SCALE = 0.2  # distance of added states, in root mean square changes of a control step, and of actions
TAU = 0.005  # target critics <- (1 - tau) target critics + tau critics, after each update
LOG_STD = (-5.0, 2.0)  # bounds of the policy's log standard deviation
LOG_VAR = (-10.0, 0.5)  # where the bounds of the models' log variance begin, in normalized units
BOUND_WEIGHT = 0.01  # of the pull that closes them
HELD_OUT = 10  # one environment of so many is kept from learning; their transitions measure the models
HELD_OUT_BATCH = 1024


@dataclass
class Args(Flags):
    """The algorithm. Defaults are those of half_cheetah and of tasks that are not in the table."""

    processes: ClassVar[bool] = False

    num_envs: Count = 64
    """parallel environments N (per task)"""
    steps: Count = 16
    """control steps of an iteration"""
    seed_steps: Natural = 64
    """control steps of each environment with random actions before the first update"""
    buffer_size: Count = 1_000_000
    """real transitions in the replay buffer, over all environments"""
    model_hidden: Widths = (200, 200, 200, 200)
    """units of the models' hidden layers (per task)"""
    model_updates: UpTo10k = 50
    """gradient updates of the models in an iteration"""
    model_batch_size: Batch = 256
    """samples per model in each of these updates"""
    branches: Count = 1000
    """rollouts that each elite makes at once, branched from real states"""
    rollout_lengths: tuple[Count, Count] = (1, 1)
    """steps of a rollout at first and from half of the iterations on; they grow linearly between (per task)"""
    retain: UpTo10k = 4
    """iterations whose rollouts stay in the buffer"""
    sample_enhance: Natural = 0
    """SE-MBPO: transitions added around each real one with the simulator's Jacobians (0: MBPO)"""
    updates: UpTo10k = 160
    """gradient updates of actor, critics and temperature in an iteration"""
    batch_size: Batch = 256
    """samples of each of these updates"""
    real_ratio: Fraction = 0.05
    """share of these samples that are real transitions; models predict the others"""
    hidden: SomeWidths = (256, 128, 64)
    """units of the hidden layers of actor and critics (per task)"""
    actor_lr: Positive = 5e-4
    """learning rate of actor and critics (per task)"""
    temperature_lr: Positive = 5e-4
    """learning rate of the temperature's logarithm (per task)"""
    gamma: Fraction = 0.99
    """discount factor"""

    def task_defaults(self) -> dict[str, Any]:
        own = dict(zip(COLUMNS, PER_TASK.get(self.like, ()), strict=False))
        return own | {"save_every": 500}  # a checkpoint holds the buffers

    def check(self) -> None:
        super().check()
        first, last = self.rollout_lengths
        rows, task = self.num_envs * (1 + self.sample_enhance), self.task_class
        jacobians = "--sample-enhance takes Jacobians of"
        most = self.iterations * self.steps - 1
        seeding = f"--seed-steps {self.seed_steps} leave no update in --iterations {self.iterations}: at most {most}"
        wrong = {
            seeding: self.seed_steps > most,
            "--num-envs must be at least 2: one environment is held out": self.num_envs < 2,
            f"--rollout-lengths {first} {last}: the first must not exceed the second": first > last,
            f"--buffer-size {self.buffer_size} is less than the {rows} transitions of a step": self.buffer_size < rows,
            f"{jacobians} states that do not hold the past, on which {self.env} depends": self.sample_enhance
            and task.num_memory,
            f"{jacobians} one robot, but {self.env} has ranges": self.sample_enhance and task.varied_by,
            f"{jacobians} a robot on a plane, but {self.env} is rough": self.sample_enhance and hasattr(task, "slope"),
        }
        for message, found in wrong.items():
            if found:
                fail(message)


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
        """The action without noise, of observations as they come, with the same weights."""
        return nn.Sequential(self.normalizer, *self.body, self.mean, nn.Tanh())


class Models(nn.Module):
    """p(s' - s, r | s, a): Gaussians of E networks, in units in which changes and rewards have variance 1."""

    def __init__(self, args: Args, obs_dim: int, action_dim: int) -> None:
        super().__init__()
        size = obs_dim + 1
        networks = [mlp(obs_dim + action_dim, args.model_hidden, 2 * size, nn.SiLU) for _ in range(MODELS)]
        self.ensemble = Ensemble(networks)
        self.least, self.most = (nn.Parameter(torch.full((size,), bound)) for bound in LOG_VAR)
        self.target = ObsNormalizer(size)
        self.elites: Tensor = nn.Buffer(torch.arange(ELITES))
        self.fits: Tensor = nn.Buffer(torch.zeros(()))  # iterations in which they learnt

    def forward(self, obs: Tensor, action: Tensor, which: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Of normalized observations and actions (E, B, ...): mean and log variance (E, B, obs_dim + 1).

        The first size runs over all networks, or over those named.
        """
        named = self.ensemble.named_parameters()
        weights: dict[str, Tensor] = {name: weight if which is None else weight[which] for name, weight in named}
        mean, log_var = functional_call(self.ensemble, weights, torch.cat((obs, action), -1)).chunk(2, -1)
        log_var = self.most - F.softplus(self.most - log_var)
        return mean, self.least + F.softplus(log_var - self.least)

    @torch.no_grad()
    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Sampled change of the observation (B, obs_dim) and reward (B,); each elite predicts an equal part of them."""
        parts = [x.unflatten(0, (len(self.elites), -1)) for x in (obs, action)]
        mean, log_var = (x.flatten(0, 1) for x in self(*parts, self.elites))
        drawn = self.target.inverse(mean + (0.5 * log_var).exp() * torch.randn_like(mean))
        return drawn[:, :-1], drawn[:, -1]


def changes(batch: Transition) -> Tensor:
    """What the models predict (B, obs_dim + 1)."""
    return torch.cat((batch.next_obs - batch.obs, batch.reward.unsqueeze(1)), 1)


# The algorithm --------------------------------------------------------------------------------------------------------


class MBPO:
    """All that the next iteration depends on.

    Its methods change tensors in place and never wait for the device, so that on a GPU each becomes one CUDA graph.
    """

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        obs_dim, action_dim = env.task.obs_dim, env.scene.nu
        self.held_out = -(-args.num_envs // HELD_OUT)
        self.actor = Actor(args, env).to(env.device)
        critics = [mlp(obs_dim + action_dim, args.hidden, 1, nn.ReLU) for _ in range(2)]
        self.critics = Ensemble(critics).to(env.device)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.temperature = nn.ParameterDict({"log": torch.zeros(())}).to(env.device)  # the entropy's weight
        self.models = Models(args, obs_dim, action_dim).to(env.device)
        self.policy = self.actor.deterministic()
        self.actor_optimizer = ClippedAdam(self.actor, MAX_GRAD_NORM, lr=args.actor_lr)
        self.critic_optimizer = ClippedAdam(self.critics, MAX_GRAD_NORM, lr=args.actor_lr)
        self.temperature_optimizer = ClippedAdam(self.temperature, MAX_GRAD_NORM, lr=args.temperature_lr)
        self.model_optimizer = ClippedAdam(self.models, MAX_GRAD_NORM, lr=MODEL_LR)
        imagined = args.retain * ELITES * args.branches * args.rollout_lengths[1]
        held_out = max(args.steps * self.held_out, args.buffer_size // HELD_OUT)
        buffers = (ReplayBuffer(size, obs_dim, action_dim) for size in (args.buffer_size, held_out, imagined))
        self.real, self.unseen, self.imagined = (buffer.to(env.device) for buffer in buffers)
        if args.sample_enhance:
            self.system = System(env, args.threads or None)

    # Real transitions ------------------------------------------------------------------------------------------------

    def explore(self) -> dict[str, Tensor]:
        """Control steps with uniformly random actions."""
        return self.collect(random=True)

    @torch.no_grad()
    def collect(self, random: bool = False) -> dict[str, Tensor]:
        """Control steps of all environments, with the policy if not at random, into the buffers."""
        env = self.env
        obs = env.detach()
        for _ in range(self.args.steps):
            if random:
                action = 2 * torch.rand(env.num_envs, env.scene.nu, device=env.device) - 1
            else:
                action, _ = self.actor(self.actor.normalizer(obs))
            state = torch.cat((env.qpos, env.qvel), 1) if self.args.sample_enhance else None
            next_obs, reward, terminated, _, info = env.step(action)
            made = Transition(obs, action, reward, info["final_obs"], terminated.to(reward.dtype))
            self.unseen.add(Transition(*(x[: self.held_out] for x in made)))
            seen = Transition(*(x[self.held_out :] for x in made))
            self.real.add(seen)
            if state is not None:
                self.real.add(enhance(self, state[self.held_out :], seen))
            self.actor.normalizer.update(obs)
            self.models.target.update(changes(seen))
            obs = next_obs
        optimizers = self.actor_optimizer, self.critic_optimizer, self.temperature_optimizer, self.model_optimizer
        return {"grad/skipped": torch.stack([optimizer.skipped for optimizer in optimizers]).sum()}

    # Models ----------------------------------------------------------------------------------------------------------

    def fit(self) -> dict[str, Tensor]:
        """Descend each model's negative log likelihood, on samples of its own; then choose the elites."""
        args, models, losses = self.args, self.models, []
        for _ in range(args.model_updates):
            batch = self.real.sample(MODELS * args.model_batch_size)
            target = models.target(changes(batch))
            each = (self.actor.normalizer(batch.obs), batch.action, target)
            obs, action, target = (x.unflatten(0, (MODELS, -1)) for x in each)
            mean, log_var = models(obs, action)
            nll = 0.5 * ((target - mean).square() * (-log_var).exp() + log_var + math.log(2 * math.pi))
            width = (models.most - models.least).sum()
            loss = nll.mean((1, 2)).sum() + BOUND_WEIGHT * width
            self.model_optimizer.step(self.model_optimizer.gradient(loss))
            losses.append(nll.detach().mean())
        with torch.no_grad():
            batch = self.unseen.sample(HELD_OUT_BATCH)
            obs, action = self.actor.normalizer(batch.obs), batch.action
            mean, _ = models(*(x.expand(MODELS, *x.shape) for x in (obs, action)))
            error = (mean - models.target(changes(batch))).square().mean(1)  # (models, obs_dim + 1)
            models.elites.copy_(error.mean(1).topk(ELITES, largest=False).indices)
            models.fits += 1
            chosen = error[models.elites].mean(0)
        found = {"models/train_nll": torch.stack(losses).mean(), "models/holdout_mse": chosen[:-1].mean()}
        return found | {"models/holdout_reward_mse": chosen[-1]}

    @torch.no_grad()
    def imagine(self) -> dict[str, Tensor]:
        """Rollouts of the elites with the policy, branched from real states; one that ends is followed by another."""
        args, models = self.args, self.models
        least, most = args.rollout_lengths
        length = (least + (most - least) * (2 * models.fits / args.iterations).clamp(max=1.0)).floor()
        obs = self.real.sample(ELITES * args.branches).obs
        age = torch.zeros_like(obs[:, 0])
        for _ in range(most):
            order = torch.rand(len(obs), device=obs.device).argsort()  # each step another elite's
            obs, age = obs[order], age[order] + 1
            seen = self.actor.normalizer(obs)
            action, _ = self.actor(seen)
            change, reward = models.predict(seen, action)
            next_obs = obs + change
            terminated = self.env.task.terminated(next_obs)
            self.imagined.add(Transition(obs, action, reward, next_obs, terminated.to(reward.dtype)))
            over = terminated | (age >= length)
            obs = torch.where(over.unsqueeze(1), self.real.sample(len(obs)).obs, next_obs)
            age = age.masked_fill(over, 0.0)
        return {"models/rollout_length": length}

    # SAC -------------------------------------------------------------------------------------------------------------

    def update(self) -> dict[str, Tensor]:
        """SAC on a mixture of imagined and real transitions."""
        metrics, real = [], round(self.args.real_ratio * self.args.batch_size)
        for _ in range(self.args.updates):
            parts = self.real.sample(real), self.imagined.sample(self.args.batch_size - real)
            batch = Transition(*(torch.cat(pair) for pair in zip(*parts, strict=True)))
            obs, next_obs = (self.actor.normalizer(x) for x in (batch.obs, batch.next_obs))
            metrics.append(self.update_critics(batch, obs, next_obs) | self.update_actor(obs))
        found = {name: torch.stack([row[name] for row in metrics]).mean() for name in metrics[0]}
        found["charts/learning_rate"] = self.actor_optimizer.lr
        return found | {"charts/temperature": self.temperature["log"].detach().exp()}

    def update_critics(self, batch: Transition, obs: Tensor, next_obs: Tensor) -> dict[str, Tensor]:
        """Descend the soft Bellman residual, and let the target critics follow."""
        args = self.args
        with torch.no_grad():
            action, density = self.actor(next_obs)
            value = self.targets.value(next_obs, action).amin(0) - self.temperature["log"].exp() * density
            target = batch.reward + args.gamma * (1 - batch.terminated) * value  # none after a fall
        values = self.critics.value(obs, batch.action)
        loss = (values - target).square().mean(1).sum()
        norm = self.critic_optimizer.step(self.critic_optimizer.gradient(loss))
        for slow, fast in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            slow.lerp_(fast.detach(), TAU)
        return {"losses/critic": loss.detach() / 2, "charts/value": values.detach().mean(), "grad/norm": norm}

    def update_actor(self, obs: Tensor) -> dict[str, Tensor]:
        """Ascend value and entropy; steer the temperature to an entropy of minus one nat per action."""
        action, density = self.actor(obs)
        value = self.critics.value(obs, action).amin(0)
        loss = (self.temperature["log"].detach().exp() * density - value).mean()
        self.actor_optimizer.step(self.actor_optimizer.gradient(loss))
        surplus = action.shape[1] - density.detach().mean()  # of entropy over the target
        weighted = self.temperature["log"].exp() * surplus
        self.temperature_optimizer.step(self.temperature_optimizer.gradient(weighted))
        return {"losses/actor": loss.detach(), "charts/entropy": -density.detach().mean() / action.shape[1]}


# SE-MBPO --------------------------------------------------------------------------------------------------------------


def nearby(system: System, x: Tensor, action: Tensor, samples: int, scale: float) -> tuple[Tensor, ...]:
    """Steps near those from states x (n, nx) with actions (n, nu), to first order; all in float64.

    x + d -> f(x, u) + J d, where u = artanh(action), so no action leaves its bounds, and d is a random tangent vector.

    Returns:
        States, actions and next states (samples, n, ...); whether the given steps are finite (n,).
    """
    u = action.clamp(-1 + 1e-6, 1 - 1e-6).atanh()
    following, _, finite = system.rollout(x, 1, lambda *_: u)
    following = following[:, 1]
    change = system.difference(following, x).square().mean(0).sqrt()  # of a control step: a scale for each number
    d = scale * torch.randn(samples, len(x), system.nd + system.nu, dtype=x.dtype, device=x.device)
    d[..., : system.nd] *= change
    end = (system.jacobians(x, u) @ d.unsqueeze(-1)).squeeze(-1)
    start, push = d.split((system.nd, system.nu), -1)
    return system.retract(x, start), (u + push).tanh(), system.retract(following, end), finite[:, 0]


def enhance(mbpo: MBPO, state: Tensor, made: Transition) -> Transition:
    """Transitions near those made from states (n, nx), observed and rewarded as the task does (Qiao et al. 2021)."""
    args, task, nq = mbpo.args, mbpo.env.task, mbpo.system.nq
    *near, finite = nearby(mbpo.system, state.double(), made.action.double(), args.sample_enhance, ENHANCE_SCALE)
    start, action, end = (x.to(state.dtype) for x in near)

    def observe(x: Tensor, action: Tensor) -> Tensor:
        return task.observe(x[..., :nq], x[..., nq:], action)

    # A part of the observation may be the action before, which stays as it was.
    obs = made.obs + observe(start, 0 * action) - observe(state, 0 * made.action)
    next_obs = observe(end, action)
    terminated = task.terminated(next_obs) | ~finite
    reward = task.reward(next_obs, action) * finite
    parts = Transition(obs, action, reward, next_obs, terminated.to(reward.dtype))
    return Transition(*(x.flatten(0, 1) for x in parts))


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.steps)
    mbpo = run.restore(MBPO(args, env))
    explore, collect = run.capture(mbpo.explore, env), run.capture(mbpo.collect, env)
    fit, imagine, update = (run.capture(part) for part in (mbpo.fit, mbpo.imagine, mbpo.update))
    for iteration in run:
        seeding = iteration * args.steps <= args.seed_steps
        run.log(explore() if seeding else collect() | fit() | imagine() | update())
        if run.evaluation_due:
            run.evaluate(mbpo.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
