"""System: the task as an environment plays it, Jacobians against differences, tangents of rotations, and blow-ups."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from systems import jacobian_errors, normal, random_states, task_system

import diffsim
from diffsim.planning import System
from diffsim_robots.terrain import incline


@pytest.mark.parametrize("name", ["cartpole", "ant"])
def test_steps_observations_and_rewards_are_the_environments(name: str) -> None:
    system = task_system(name)
    env = diffsim.make(name, 1, horizon=1, dtype=torch.float64, stochastic_init=False)
    obs, _ = env.reset()
    torch.testing.assert_close(system.observe(system.start()), obs)
    u = torch.linspace(-2, 2, system.nu).double()[None]
    x, _, _ = system.rollout(system.start(), 3, lambda t, _: u)
    for t in range(1, 4):
        obs, reward, _, _, _ = env.step(torch.tanh(u))
        torch.testing.assert_close(system.reward(x[:, t], u), reward)
        torch.testing.assert_close(system.observe(x[:, t]), system.observed * obs)
    assert system.observed.sum() == {"cartpole": 5, "ant": 37 - 8}[name]  # all but the action before


def test_robot_and_integration_are_the_environments() -> None:
    env = diffsim.make("hopper", 1, accuracy="fast", substeps=4, penalty={"k_n": 1e5})
    system = System(env, threads=1)
    assert system.scene.k_n == 1e5 and system.simulator(1).integration.substeps == 4


def test_a_terrain_is_refused() -> None:
    with pytest.raises(ValueError, match="plans need level ground"):
        System(diffsim.make("hopper", 1, terrain=incline(10.0)))


@pytest.mark.parametrize("name", ["cartpole", "hopper", "ant"])
def test_jacobians_are_those_of_differences(
    name: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = task_system(name)
    x, u = random_states(system, rng)
    assert jacobian_errors(system, x, u).max() < 1e-5
    alone = system.jacobians(x[2:3], u[2:3])
    together = system.jacobians(x, u)
    assert torch.equal(alone[0], together[2])  # environments do not know each other
    assert (together.abs().amax(0) > 0).any(0).all()  # no column that never reached the simulator
    monkeypatch.setattr("diffsim.planning.system.BATCH", 4)  # six states: four, and two
    assert torch.equal(system.jacobians(x, u), together)


def test_tangents_of_a_free_joint(rng: np.random.Generator) -> None:
    system = task_system("ant")
    x, u = random_states(system, rng)
    tangent = normal(rng, 6, system.nd)
    moved = system.retract(x, tangent)
    torch.testing.assert_close(moved[:, 3:7].norm(dim=-1), torch.ones(6).double())
    torch.testing.assert_close(system.difference(moved, x), tangent, rtol=0, atol=1e-12)
    moved[:, 3:7] *= -1  # the same rotation
    torch.testing.assert_close(system.difference(moved, x), tangent, rtol=0, atol=1e-12)
    # To first order it is a rotation vector of the body's frame: what its angular velocity integrates to
    turn = 1e-6 * torch.tensor([0.3, -0.2, 0.5]).double()
    step = torch.zeros(6, system.nd).double()
    step[:, 3:6] = turn
    w, v = x[:, 3:4], x[:, 4:7]
    turned = torch.cat((w - v @ turn[:, None] / 2, v + (w * turn + torch.linalg.cross(v, turn.expand(6, -1))) / 2), 1)
    torch.testing.assert_close(system.retract(x, step)[:, 3:7], turned, rtol=0, atol=1e-12)


def test_a_trajectory_that_blows_up_stays_where_it_was() -> None:
    system = task_system("cartpole")
    wild, before = torch.tensor([[0.0], [math.nan], [0.0]]).double(), system.steps
    x, u, finite = system.rollout(torch.zeros(3, 4).double(), 5, lambda t, _: wild if t == 2 else 0 * wild.nan_to_num())
    assert finite.tolist() == [[True] * 5, [True, True, False, False, False], [True] * 5]
    assert torch.isfinite(x).all() and torch.isfinite(u).all() and torch.equal(x[1, 2], x[1, 5])
    assert system.steps - before == 15
