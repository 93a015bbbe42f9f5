"""Swimmer and walker: their scenes, observations and rewards, and that they move as such robots do."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import task_scene

from diffsim.sim.integration import Integration
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
