"""PODS' improvement and imitation against finite differences, closed forms and problems whose optimum is known."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pods
import pytest
import torch
from learners import assert_resumes, read_progress, run
from planning.systems import Linear, normal
from torch import Tensor

import diffsim
from diffsim import DiffEnv
from diffsim.sim.simulator import Simulator
from diffsim.training import parse


def build(*flags: str, task: str = "cartpole", num_envs: int = 3, dtype: torch.dtype = torch.float32) -> pods.PODS:
    args = parse(pods.Args, ["--env", task, "--device", "cpu", "--num-envs", str(num_envs), *flags])
    env = diffsim.make(task, num_envs=num_envs, seed=0, horizon=args.horizon, dtype=dtype)
    learner = pods.PODS(args, env)
    learner.actor.to(dtype)
    return learner


# Problems without a simulator -----------------------------------------------------------------------------------------


class Plane:
    """x' = A x + B u, in the interface of a simulator, which squashes no action."""

    A = torch.tensor([[1.0, 0.1], [-0.2, 0.9]], dtype=torch.float64)
    B = torch.tensor([[0.0], [0.5]], dtype=torch.float64)

    def __init__(self, num_envs: int, bad: int | None = None) -> None:
        self.nonfinite = torch.zeros(num_envs, dtype=torch.bool)
        if bad is not None:
            self.nonfinite[bad::3] = True

    def rewind(self) -> None:
        pass

    def step(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        u = torch.atanh(action)
        x = torch.cat((qpos, qvel), 1) @ self.A.mT + u @ self.B.mT
        return x[:, :1], x[:, 1:]


PLANE: Any = SimpleNamespace(
    observe=lambda qpos, qvel, action: torch.cat((qpos, qvel), -1),
    reward=lambda obs, action: -obs.square().sum(-1) - 0.1 * torch.atanh(action).square().sum(-1),
)


def plane_start(rng: np.random.Generator, num_envs: int = 3) -> pods.Start:
    x = 0.3 * normal(rng, num_envs, 2)
    return pods.Start(x[:, :1], x[:, 1:], x)


def optimum(start: pods.Start, steps: int) -> tuple[Tensor, Tensor]:
    """Actions (steps, N) and returns (N,) of the least-squares problem that a plane's sequence is."""
    powers = [torch.linalg.matrix_power(Plane.A, t) for t in range(steps + 1)]
    to = torch.zeros(steps, 2, steps, dtype=torch.float64)
    for t in range(steps):
        for s in range(t + 1):
            to[t, :, s] = (powers[t - s] @ Plane.B)[:, 0]
    free = torch.stack([start.obs @ powers[t + 1].mT for t in range(steps)])  # (T, N, 2)
    flat, rest = to.view(-1, steps), free.transpose(1, 2).reshape(2 * steps, -1)
    hessian = flat.mT @ flat + 0.1 * torch.eye(steps, dtype=torch.float64)
    u = -torch.linalg.solve(hessian, flat.mT @ rest)
    return u, -(flat @ u + rest).square().sum(0) - 0.1 * u.square().sum(0)


def ascend(start: pods.Start, u: Tensor, sizes: Tensor, bad: int | None = None) -> Any:
    plane = [Plane(n, bad) for n in (3, 3 * len(sizes))]
    return pods.steepest_ascent(*plane, PLANE, start, u, sizes)  # type: ignore[arg-type]


# First order ----------------------------------------------------------------------------------------------------------


def test_the_line_search_takes_the_best_size_of_each_sequence(rng: np.random.Generator) -> None:
    """Against a loop over sequences and sizes along the finite differences of the return."""
    start, u = plane_start(rng), 0.1 * normal(rng, 8, 3, 1)
    sizes = torch.tensor([3.0, 0.5, 0.1, 0.02], dtype=torch.float64)

    def value(u: Tensor) -> Tensor:
        return pods.simulate(Plane(3), PLANE, start, u).returns  # type: ignore[arg-type]

    gradient = torch.zeros_like(u)
    for t in range(8):
        d = torch.zeros_like(u)
        d[t] = 1e-6
        gradient[t, :, 0] = (value(u + d) - value(u - d)) / 2e-6
    direction = gradient / gradient.square().mean((0, 2)).sqrt().unsqueeze(1)
    values = torch.stack([value(u + size * direction) for size in sizes])
    old, new = ascend(start, u, sizes)
    torch.testing.assert_close(old.returns, value(u))
    torch.testing.assert_close(new.returns, values.amax(0), rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(new.u, u + sizes[values.argmax(0)].view(-1, 1) * direction, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(new.obs, pods.simulate(Plane(3), PLANE, start, new.u).obs)  # type: ignore[arg-type]


def test_the_line_search_never_takes_a_worse_or_a_broken_sequence(rng: np.random.Generator) -> None:
    start = plane_start(rng)
    u, _ = optimum(start, 8)
    u = u.unsqueeze(-1).clone()
    u[:, 1] += 0.1  # only this one can still gain
    old, new = ascend(start, u, torch.tensor([4.0, 0.1], dtype=torch.float64))
    assert (new.returns > old.returns).tolist() == [False, True, False]
    assert torch.equal(new.u[:, ::2], u[:, ::2]) and torch.equal(new.obs[:, ::2], old.obs[:, ::2])
    old, new = ascend(start, u, torch.tensor([4.0, 0.1], dtype=torch.float64), bad=1)
    assert torch.equal(new.u, u) and (new.returns == -math.inf).tolist() == [False, True, False]


# Second order ---------------------------------------------------------------------------------------------------------


def test_second_order_solves_a_linear_quadratic_problem_in_one_step(rng: np.random.Generator) -> None:
    """From any actions; of a cost that differs from the reward, a step that the reward loses by is not taken."""
    system: Any = Linear(rng)
    x0, u = normal(rng, 2, 3), normal(rng, 2, 9, 2)
    x, found, old, new = pods.gauss_newton(system, system.cost, system.cost, x0, u, 1, 0.0)
    for r in range(2):
        gradient, hessian = system.dense(9, x0[r])
        torch.testing.assert_close(found[r].flatten(), -torch.linalg.solve(hessian, gradient), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(new, -system.cost.value(x, found).sum(-1))
    assert (new > old).all()

    against = pods.AfterStep(system, lambda x, u: -system.loss(x, u))
    _, kept, old, new = pods.gauss_newton(system, system.cost, against, x0, u, 1, 0.0)
    assert torch.equal(kept, u) and torch.equal(old, new)


def test_second_order_gains_more_on_cartpole_and_returns_are_the_environments() -> None:
    learner = build("--order", "2", "--improvements", "2", num_envs=2)
    env = learner.env
    start = pods.Start(env.qpos, env.qvel, env.detach())
    u = torch.zeros(240, 2, 1)
    old, new = learner.plan(start, u)
    trials = Simulator(env.scene, 2, env.sim.integration, env.control_dt)
    before, after = (pods.simulate(trials, env.task, start, x) for x in (u, new.u))
    torch.testing.assert_close(before.returns.double(), old, rtol=1e-3, atol=0)
    torch.testing.assert_close(after.returns.double(), new.returns, rtol=1e-2, atol=0)
    torch.testing.assert_close(after.obs[:100], new.obs[:100], rtol=1e-2, atol=1e-2)
    _, first = pods.steepest_ascent(env.sim, trials, env.task, start, u, torch.tensor([0.01]))
    assert (new.returns > first.returns).all() and (first.returns > before.returns).all()
    # 1 rollout, then per iteration 4 rows of Jacobians and 11 candidates
    assert learner.control_steps == 2 * 240 * (1 + 2 * (4 + 11))


# Imitation and the iteration ------------------------------------------------------------------------------------------


def test_imitation_recovers_a_gain_and_leaves_broken_sequences_out(rng: np.random.Generator) -> None:
    torch.manual_seed(0)
    flags = "--epochs 30 --lr 1e-2 --batch-size 60 --hidden 32"
    learner = build(*flags.split())
    obs = 0.5 * normal(rng, 240, 3, 5).float()
    gain = torch.tensor([0.5, -0.3, 0.2, 0.0, -0.4])
    action = torch.tanh(obs @ gain).unsqueeze(-1)
    action[:, 2] = 1.0  # nonsense, of a sequence that is left out
    lessons = obs, action, torch.tensor([True, True, False])
    first = learner.imitate(*lessons)["losses/first_epoch"]
    last = learner.imitate(*lessons)["losses/imitation"]
    error = (learner.policy(obs[:, :2]) - action[:, :2]).square().mean().item()
    assert error < 2e-3 and last < 0.1 * first
    assert last.item() == pytest.approx(0.5 * error, rel=0.7)


@pytest.mark.parametrize("where", ["visited", "improved"])
def test_an_iteration_teaches_the_improved_actions(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An episode's end within a sequence leaves that sequence out, and no other."""
    torch.manual_seed(0)
    learner = build("--horizon", "40", "--imitate", where, "--improvements", "2", "--candidates", "6")
    env = learner.env
    env.episode_step[1] = env.episode_length - 10
    start = pods.Start(env.qpos, env.qvel, env.detach())
    lessons = list[tuple[Tensor, ...]]()
    monkeypatch.setattr(learner, "imitate", lambda *given: lessons.append(given) or {})
    metrics = learner.iterate()
    ((obs, action, whole),) = lessons
    assert whole.tolist() == [True, False, True] and metrics["pods/left_out"] == pytest.approx(1 / 3)
    assert learner.control_steps == 3 * 40 * (1 + 2 * (1 + 6))
    trials = Simulator(env.scene, 3, env.sim.integration, env.control_dt)
    better = pods.simulate(trials, env.task, start, torch.atanh(action))
    assert better.returns[whole].mean().item() == pytest.approx(metrics["pods/improved_return"].item(), rel=1e-4)
    assert metrics["pods/improved_return"] > metrics["pods/return"] and metrics["pods/failed"] == 0
    torch.testing.assert_close(obs[0], start.obs)
    same = torch.allclose(obs[:, whole], better.obs[:, whole], atol=1e-2)
    assert same == (where == "improved")
    if where == "visited":
        u = learner.actor(obs[:, whole])
        old = pods.simulate(trials, env.task, start, learner.actor(obs).detach())
        torch.testing.assert_close(old.obs[:, whole], obs[:, whole], rtol=1e-3, atol=1e-3)
        step = (torch.atanh(action)[:, whole] - u).square().mean((0, 2)).sqrt().mean()
        assert metrics["pods/step"].item() == pytest.approx(step.item(), rel=1e-3)


def test_a_run_of_second_order_resumes_bitwise(tmp_path: Path) -> None:
    flags = "--env cartpole --num-envs 3 --horizon 80 --iterations 4 --order 2 --improvements 1 --epochs 4 --quiet "
    flags += "--batch-size 100 --hidden 16 --device cpu --eval-every 4 --eval-episodes 2 --threads 1"
    whole, rows = assert_resumes(pods, tmp_path, flags, 2), read_progress(tmp_path / "part")
    assert whole["control_steps"] == int(rows[-1]["control_steps"])
    count = 3 * 80 * (1 + 1 + 4 + 11)
    assert [int(row["control_steps"]) for row in rows] == [count * (k + 1) for k in range(len(rows))]
    assert [row["length"] for row in rows] == ["", "", *["240.0"] * (len(rows) - 2)]
    assert all(float(row["pods_improved_return"]) >= float(row["pods_return"]) for row in rows)


def test_first_order_learns_to_swing(tmp_path: Path) -> None:
    """A wrong sign gets worse, and without imitation nothing changes."""
    flags = "--env cartpole --num-envs 16 --iterations 12 --candidates 6 --eval-every 0 --eval-episodes 16 --quiet"
    run(pods, tmp_path, *flags.split())
    rows = read_progress(tmp_path)
    assert float(rows[0]["return"]) < -2200 and float(rows[-1]["eval_return"]) > -2000


def test_sequences_of_an_ant_are_whole(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its falls do not end them, except in evaluations."""
    made, init = list[DiffEnv](), pods.PODS.__init__

    def record(self: pods.PODS, args: pods.Args, env: DiffEnv) -> None:
        made.append(env)
        init(self, args, env)

    monkeypatch.setattr(pods.PODS, "__init__", record)
    flags = "--env ant --num-envs 2 --horizon 4 --iterations 2 --hidden 16 --candidates 2 --eval-episodes 2 --quiet"
    run(pods, tmp_path, *flags.split(), "--eval-every", 0, stop_after=1)
    (env,) = made
    obs = env.set_state(env.qpos * torch.tensor([1.0, 1.0, 0.1] + 12 * [1.0]), env.qvel)
    assert env.task.terminated(obs).all() and not env.step(torch.zeros(2, 8))[2].any()
