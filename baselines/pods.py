"""PODS, Policy Optimization via Differentiable Simulation (Mora et al. 2021, proceedings.mlr.press/v139/mora21a.html).

The policy acts, the simulator's derivatives improve each sequence of its actions under a line search, and the policy
imitates the result. First order steps along the gradient of the return, second order takes Gauss-Newton steps.

    python baselines/pods.py --env cartpole --seed 1         train; writes runs/cartpole__pods__1__<time>/
    python baselines/pods.py --env cartpole --order 2        Gauss-Newton steps from exact Jacobians
    python baselines/pods.py --resume <run>/checkpoint.pt    continue an interrupted run exactly
    python baselines/pods.py --evaluate <run>/checkpoint.pt  evaluate its policy
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.planning import REAL, AfterStep, Cost, Sum, System, ilqr
from diffsim.sim.simulator import Simulator
from diffsim.tasks import Task
from diffsim.training import ClippedAdam, ObsNormalizer, Run, fail, script
from diffsim.training.flags import Flags
from diffsim.training.layers import mlp
from diffsim.training.ranges import Count, NonNegative, Positive, UpTo10k, Widths

# fmt: off
COLUMNS = ("hidden", "horizon", "normalize_obs")
PER_TASK = {
    "cartpole":     ((64, 64),      240, False),
    "half_cheetah": ((128, 64, 32),  50, True),
    "ant":          ((128, 64, 32),  50, True),
}
ORDER_COLUMNS = ("num_envs", "iterations", "improvements", "imitate", "epochs", "lr")
PER_ORDER = {
    1: (32, 120,  1, "visited",   4, 1e-3),
    2: (16,  13, 20, "improved", 50, 2e-3),
}
# fmt: on
MAX_GRAD_NORM = 1.0  # of the imitation


@dataclass
class Args(Flags):
    """The algorithm. Defaults are those of a task that is not in the table."""

    processes: ClassVar[bool] = False

    iterations: Count = 120
    """learning iterations (per order)"""
    order: Literal[1, 2] = 1
    """order of the improvement: 1 follows the gradient of the return, 2 takes Gauss-Newton steps (iLQR)"""
    num_envs: Count = 32
    """action sequences N of an iteration (per order)"""
    horizon: Count = 50
    """control steps T of a sequence; an episode must be a multiple of them (per task)"""
    improvements: UpTo10k = 1
    """line-searched steps of each sequence in an iteration (per order)"""
    candidates: UpTo10k = 8
    """first order: step sizes of the line search, each half the one before"""
    max_step: Positive = 1.0
    """first order: largest step size, as root mean square change of the actions before tanh"""
    regularization: Positive = 0.01
    """second order: initial weight of the distance from the previous sequence's states"""
    action_cost: NonNegative = 1e-2
    """second order: cost of the squared action before tanh, which bounds it where tanh is flat"""
    imitate: Literal["visited", "improved"] = "visited"
    """states at which improved actions are taught: those visited by the policy, or by these actions (per order)"""
    epochs: UpTo10k = 4
    """passes of the imitation over the sequences (per order)"""
    batch_size: Count = 512
    """states of an imitation update"""
    lr: Positive = 1e-3
    """learning rate of the imitation (per order)"""
    hidden: Widths = (128, 64, 32)
    """units of the policy's hidden layers (per task)"""
    normalize_obs: bool = True
    """normalize observations by their running mean and variance (per task)"""

    def task_defaults(self) -> dict[str, Any]:
        own = dict(zip(COLUMNS, PER_TASK.get(self.like, ()), strict=False))
        return own | dict(zip(ORDER_COLUMNS, PER_ORDER[self.order], strict=True))

    def check(self) -> None:
        super().check()
        task = self.task_class
        if task.num_memory:
            fail(f"{self.env} depends on the past, which planned states do not hold: choose another task")
        if task.varied_by or hasattr(task, "slope"):
            fail(f"planned sequences are of one robot on a plane, but {self.env} varies: leave its options out")
        if task.episode_length % self.horizon:
            fail(f"--horizon {self.horizon} does not divide the {task.episode_length} control steps of an episode")


# Network --------------------------------------------------------------------------------------------------------------


class Actor(nn.Module):
    """The deterministic policy a = tanh(u(s))."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        super().__init__()
        obs_dim, action_dim, seen = env.task.obs_dim, env.scene.nu, env.task.actor_dim
        self.normalizer = ObsNormalizer(obs_dim)
        self.mean = mlp(obs_dim, args.hidden, action_dim, nn.ELU, norm=True, columns=seen)

    def forward(self, obs: Tensor) -> Tensor:
        """u (..., action_dim), the action before tanh."""
        return self.mean(self.normalizer(obs))

    def deterministic(self) -> nn.Sequential:
        """Observations to actions, with the same weights."""
        return nn.Sequential(self.normalizer, *self.mean, nn.Tanh())


# Improvement of action sequences --------------------------------------------------------------------------------------


class Start(NamedTuple):
    """Where N sequences start."""

    qpos: Tensor  # (N, nq)
    qvel: Tensor  # (N, nv)
    obs: Tensor  # (N, obs_dim)


class Sequences(NamedTuple):
    """N sequences of T actions."""

    u: Tensor  # (T, N, nu) before tanh
    obs: Tensor  # (T, N, obs_dim) on which they act
    returns: Tensor  # (N,) -inf where the simulation left the finite numbers


def simulate(sim: Simulator, task: Task, start: Start, u: Tensor) -> Sequences:
    """What open-loop actions u (T, N, nu) lead to."""
    qpos, qvel, obs = start
    seen, total, bad = [], torch.zeros_like(qpos[:, 0]), torch.zeros_like(qpos[:, 0], dtype=torch.bool)
    for action in torch.tanh(u).unbind():
        seen.append(obs)
        qpos, qvel = sim.step(qpos, qvel, action)
        bad = bad | sim.nonfinite
        obs = task.observe(qpos, qvel, action)
        total = total + task.reward(obs, action)
    return Sequences(u, torch.stack(seen), total.masked_fill(bad, -math.inf))


def steepest_ascent(
    sim: Simulator, trials: Simulator, task: Task, start: Start, u: Tensor, sizes: Tensor
) -> tuple[Sequences, Sequences]:
    """A step of each sequence u (T, N, nu) along the gradient of its return, of the best of A sizes (A,).

    Args:
        sim: of N environments, differentiable over T steps.
        trials: of A N environments, in which all sizes are tried at once.

    Returns:
        The sequences before and after the step; where no size gains anything they are the same.
    """
    sim.rewind()
    u = u.detach().requires_grad_()
    old = simulate(sim, task, start, u)
    (gradient,) = torch.autograd.grad(old.returns.sum(), u)
    with torch.no_grad():
        old, N = Sequences(*(part.detach() for part in old)), u.shape[1]
        rms = gradient.square().mean((0, 2)).sqrt().clamp(min=torch.finfo(u.dtype).tiny)
        direction = gradient / rms.unsqueeze(1)
        tried = old.u.unsqueeze(1) + sizes.view(-1, 1, 1) * direction.unsqueeze(1)  # (T, A, N, nu)
        copies = Start(*(part.repeat(len(sizes), 1) for part in start))
        new = simulate(trials, task, copies, tried.flatten(1, 2))
        returns, choice = new.returns.view(-1, N).max(0)
        rows = choice * N + torch.arange(N, device=u.device)
        better = returns > old.returns
        u, obs = (torch.where(better.unsqueeze(1), x[:, rows], y) for x, y in ((new.u, old.u), (new.obs, old.obs)))
        return old, Sequences(u, obs, torch.where(better, returns, old.returns))


def gauss_newton(
    system: System, cost: Cost, reward: Cost, x: Tensor, u: Tensor, iterations: int, mu: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Iterations of iLQR on each sequence u (N, T, nu) from states x (N, nx).

    An iteration is a Gauss-Newton step in all actions at once, whose normal equations dynamic programming solves; its
    candidates follow the step with linear feedback.

    Args:
        cost: what they minimise: minus the reward, with a cost of actions.
        reward: minus the reward, which decides.
        mu: initial regularization.

    Returns:
        States (N, T + 1, nx), actions (N, T, nu), and returns (N,) before and after; where the return did not improve,
        all is as before.
    """
    x, u, finite = system.rollout(x, u.shape[1], lambda t, _: u[:, t])
    plan = ilqr(system, cost, x, u, iterations, mu)
    old, new = (-reward.value(*pair).sum(-1) for pair in ((x, u), (plan.x, plan.u)))
    old = old.masked_fill(~finite.all(1), -math.inf)
    better = (new > old) & torch.isfinite(old)
    rows = better.view(-1, 1, 1)
    return torch.where(rows, plan.x, x), torch.where(rows, plan.u, u), old, torch.where(better, new, old)


# The algorithm --------------------------------------------------------------------------------------------------------


class PODS:
    """What an iteration changes, and the iteration."""

    def __init__(self, args: Args, env: DiffEnv) -> None:
        self.args, self.env = args, env
        self.actor = Actor(args, env).to(env.device)
        self.policy = self.actor.deterministic()
        self.optimizer = ClippedAdam(self.actor, MAX_GRAD_NORM, lr=args.lr)
        self.control_steps = 0  # of the iteration
        threads = args.threads or None
        if args.order == 1:
            self.sizes = args.max_step * 0.5 ** torch.arange(args.candidates, device=env.device)
            settings = env.scene, args.candidates * env.num_envs, env.sim.integration, env.control_dt
            self.trials = Simulator(*settings, device=env.device, dtype=env.dtype, threads=threads)
        else:
            self.system = System(env, threads)
            self.reward = AfterStep(self.system, lambda x, u: -self.system.reward(x, u))
            self.cost = Sum((self.reward, AfterStep(self.system, lambda _, u: args.action_cost * u.square().sum(-1))))

    def iterate(self) -> dict[str, Tensor]:
        """Act for T steps, improve the actions, and imitate them; returns metrics."""
        args, env, count = self.args, self.env, self.args.horizon * self.env.num_envs
        start = Start(env.qpos, env.qvel, env.detach())
        u, visited, whole = self.act()
        self.control_steps = count
        first, new = None, Sequences(u, visited, u[0, :, 0])
        if args.order == 1:
            for _ in range(args.improvements):
                old, new = steepest_ascent(env.sim, self.trials, env.task, start, new.u, self.sizes)
                first = old.returns if first is None else first
                self.control_steps += count * (1 + args.candidates)
        else:
            first, new = self.plan(start, u)
        assert first is not None
        whole = whole & torch.isfinite(first)
        if args.normalize_obs:
            self.actor.normalizer.update(visited)

        def mean(x: Tensor) -> Tensor:
            return torch.where(whole, x, 0.0).sum() / whole.sum()

        return {
            "pods/return": mean(first),
            "pods/improved_return": mean(new.returns),
            "pods/step": mean((new.u - u).square().mean((0, 2)).sqrt()),
            "pods/failed": 1.0 - mean((new.returns > first).float()),
            "pods/left_out": (~whole).float().mean(),
            **self.imitate(visited if args.imitate == "visited" else new.obs, torch.tanh(new.u), whole),
        }

    @torch.no_grad()
    def act(self) -> tuple[Tensor, Tensor, Tensor]:
        """T steps of the policy: u (T, N, nu), obs (T, N, obs_dim), and which sequences (N,) no episode's end cuts."""
        steps, env = [], self.env
        obs = env.detach()
        for _ in range(self.args.horizon):
            u = self.actor(obs)
            next_obs, _, terminated, truncated, info = env.step(torch.tanh(u))
            steps.append((u, obs, terminated | truncated))
            obs = next_obs
        u, visited, done = (torch.stack(column) for column in zip(*steps, strict=True))
        return u, visited, ~(done[:-1].any(0) | info["nonfinite"])

    def plan(self, start: Start, u: Tensor) -> tuple[Tensor, Sequences]:
        """Second order: the returns (N,) of the sequences u (T, N, nu), and what they become."""
        args, system, before = self.args, self.system, self.system.steps
        x0 = torch.cat((start.qpos, start.qvel), 1).to(REAL)
        x, u, old, returns = gauss_newton(
            system, self.cost, self.reward, x0, u.transpose(0, 1).to(REAL), args.improvements, args.regularization
        )
        self.control_steps += system.steps - before
        x, u = x.transpose(0, 1).to(start.qpos), u.transpose(0, 1).to(start.qpos)
        qpos, qvel = x[1:-1].split((system.nq, system.nv), -1)
        obs = torch.cat((start.obs.unsqueeze(0), self.env.task.observe(qpos, qvel, torch.tanh(u[:-1]))))
        return old, Sequences(u, obs, returns)

    def imitate(self, obs: Tensor, action: Tensor, whole: Tensor) -> dict[str, Tensor]:
        """Regress the policy on actions (T, N, nu) at observations (T, N, obs_dim), of whole sequences (N,)."""
        args = self.args
        weight = whole.float().expand(len(obs), -1).flatten()
        obs, action = obs.flatten(0, 1), action.flatten(0, 1)
        losses = []
        for _ in range(args.epochs):
            for index in torch.rand(len(obs), device=obs.device).argsort().split(args.batch_size):
                error = (torch.tanh(self.actor(obs[index])) - action[index]).square().sum(-1)
                loss = 0.5 * (weight[index] * error).sum() / weight[index].sum().clamp(min=1.0)
                norm = self.optimizer.step(self.optimizer.gradient(loss))
                losses.append(loss.detach())
        per_epoch = torch.stack(losses).view(args.epochs, -1).mean(1)
        found = {"losses/imitation": per_epoch[-1], "losses/first_epoch": per_epoch[0]}
        found |= {"grad/norm": norm, "grad/skipped": self.optimizer.skipped}
        return found | {"charts/learning_rate": self.optimizer.lr}


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args) -> None:
    run = Run(args)
    env = run.make_env(args.num_envs, args.horizon, early_termination=False)  # all sequences have one length
    pods = run.restore(PODS(args, env))
    iterate = run.capture(pods.iterate, eager=True)
    for _ in run:
        run.log(iterate(), pods.control_steps)
        if run.evaluation_due:
            run.evaluate(pods.policy)


main = script(Args, train)

if __name__ == "__main__":
    main()
