"""System: the task as an environment plays it."""

from __future__ import annotations

import pytest
import torch
from systems import task_system

import diffsim
from diffsim.planning import System
from diffsim.terrain import incline


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
