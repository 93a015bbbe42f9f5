"""Swimmer and walker: their scenes, observations and rewards, and that they move as such robots do."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import task_scene

import diffsim
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks import TASKS

REAL = torch.float64


@pytest.mark.parametrize("name, links, motors, mass", [("swimmer", 5, 2, 3.1416), ("walker", 9, 6, 29.95)])
def test_scenes(name: str, links: int, motors: int, mass: float) -> None:
    scene, task = task_scene(name), TASKS[name]()
    assert (scene.nv, scene.nu, scene.floating) == (links, motors, False)
    assert task.integration("default") == Integration("semi_implicit", task.substeps)
    assert ("drag" in scene.features) == (name == "swimmer") and ("contact" in scene.features) == (name == "walker")
    assert scene.mj_model.body_mass.sum() == pytest.approx(mass, rel=1e-3)
    qpos, qvel = task.reset(torch.rand(4, task.num_random))
    assert qpos.shape == qvel.shape == (4, links) and qpos.abs().max() <= 0.05
    assert task.observe(qpos, qvel, torch.zeros(4, motors)).shape == (4, task.obs_dim)
    assert not task.terminated(task.observe(qpos, qvel, torch.zeros(4, motors))).any()


def test_observations_and_rewards(rng: np.random.Generator) -> None:
    for name, speed, height, v_x in (("swimmer", 2.0, None, 3), ("walker", 1.2, 0, 8)):
        task, nv = TASKS[name](dtype=REAL), task_scene(name).nv
        q, v, a = (torch.tensor(rng.normal(size=n)) for n in (nv, nv, task_scene(name).nu))
        obs = task.observe(q, v, a)
        assert obs.tolist() == [*q[2 if name == "swimmer" else 1 :].tolist(), *v.tolist()]
        cost = (v[0] - speed) ** 2 + 1e-4 * (a**2).sum() + (0 if height is None else 10 * q[1] ** 2)
        assert task.reward(obs, a).item() == pytest.approx(-cost.item()) and obs[v_x] == v[0]


def test_swimmer_is_carried_by_its_fluid() -> None:
    """A wave that travels along the body, held by springs, drives it against the wave; in a vacuum it stays."""
    scene, ends = task_scene("swimmer"), []
    for lag in (0.5 * np.pi, -0.5 * np.pi):
        for fluid in (scene, dataclasses.replace(scene, density=1e-300, viscosity=0.0)):
            sim = Simulator(fluid, 1, Integration(substeps=10), dtype=REAL)
            qpos, qvel = torch.zeros(1, 5, dtype=REAL), torch.zeros(1, 5, dtype=REAL)
            for t in range(300):
                wave = torch.sin(torch.tensor([[0.0, -lag]], dtype=REAL) + 2 * np.pi * t / 30)
                with torch.no_grad():
                    qpos, qvel = sim.step(qpos, qvel, 0.05 * (wave - qpos[:, 3:]) - 0.005 * qvel[:, 3:])
            ends.append(qpos[0, 0].item())
    forward, vacuum, backward, still = ends
    assert forward > 1 and backward < -1 and abs(vacuum) < 0.05 and abs(still) < 0.05


def test_walker_stands_on_its_feet_for_a_moment() -> None:
    """It drops 5 cm to the ground, which carries its weight; nothing passes through."""
    env, heights = diffsim.make("walker", 2, stochastic_init=False), []
    with torch.no_grad():
        for _ in range(24):
            env.step(torch.zeros(2, 6))
            heights.append(env.qpos[0, 1].item())
    assert -0.12 < min(heights) < -0.03 and abs(env.qvel[0, 1].item()) < 1.0


@pytest.mark.parametrize("name", ["swimmer", "walker"])
def test_they_have_no_presets(name: str) -> None:
    for accuracy in ("fast", "accurate"):
        with pytest.raises(ValueError, match=f"task '{name}' has no preset '{accuracy}'; choose default"):
            diffsim.make(name, 1, horizon=1, accuracy=accuracy)  # type: ignore[arg-type]
