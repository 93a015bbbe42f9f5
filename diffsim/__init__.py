"""Parallel differentiable simulation of articulated robots, and the tasks of the SHAC paper on it."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import gymnasium
import torch
import warp as wp

from diffsim.env import DiffEnv, NumpyEnv
from diffsim.scene import Scene, SceneError, load_scene
from diffsim.simulator import Simulator, check_device
from diffsim.tasks import TASKS

__all__ = ["TASKS", "DiffEnv", "Scene", "SceneError", "Simulator", "load_scene", "make"]

wp.config.log_level = wp.LOG_WARNING


def make(
    name: str,
    num_envs: int = 64,
    device: str | torch.device = "cpu",
    seed: int | None = None,
    horizon: int = 32,
    substeps: int | None = None,
    integrator: str = "semi_implicit",
    theta: float = 0.0,
    dtype: torch.dtype = torch.float32,
    stochastic_init: bool = True,
    early_termination: bool = True,
    threads: int | None = None,
) -> DiffEnv:
    """Build the tensor environment of a task; arguments as of DiffEnv and Simulator.

    Args:
        name: one of diffsim.TASKS.
        substeps: integration steps in a control step; default the task's.

    Raises:
        ValueError: an argument out of range, with what is allowed.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; choose from {', '.join(TASKS)}")
    device = check_device(device)
    task = TASKS[name](device, dtype)
    scene = load_scene(str(files("diffsim") / "assets" / task.asset))
    return DiffEnv(
        task,
        scene,
        num_envs,
        seed=seed,
        horizon=horizon,
        substeps=substeps,
        integrator=integrator,
        theta=theta,
        device=device,
        dtype=dtype,
        stochastic_init=stochastic_init,
        early_termination=early_termination,
        threads=threads,
    )


def _make_one(name: str, **arguments: Any) -> NumpyEnv:
    return NumpyEnv(make(name, num_envs=1, horizon=1, **arguments))


for _name in TASKS:
    gymnasium.register(
        id=f"diffsim/{_name.title().replace('_', '')}-v0",
        entry_point="diffsim:_make_one",
        vector_entry_point="diffsim:make",
        kwargs={"name": _name},
    )
