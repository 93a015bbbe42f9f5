"""Parallel differentiable simulation of articulated robots, and the tasks of the SHAC paper on it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import torch
from numpy.typing import ArrayLike

from diffsim import startup
from diffsim.env import DiffEnv
from diffsim.numpy_env import NumpyEnv, NumpyVectorEnv
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene, SceneError
from diffsim.sim.integration import Integration
from diffsim.sim.modes import in_plain_mode
from diffsim.sim.options import Options, check_device, check_dtype
from diffsim.sim.simulator import Simulator
from diffsim.tasks import TASKS, Accuracy, Contact, Imitation, Task, find_task, tracking
from diffsim.tasks.imitation.clip import Clip, read_clip

__all__ = [
    "TASKS",
    "Clip",
    "DiffEnv",
    "Integration",
    "NumpyEnv",
    "NumpyVectorEnv",
    "Scene",
    "SceneError",
    "Simulator",
    "load_scene",
    "make",
    "read_clip",
]


# Arguments of `make` that it hands on
KEYWORDS = {*"stochastic_init early_termination max_episode_steps adjoint_clip render_mode".split(), *Options._fields}
KEYWORDS -= {"integration", "device", "dtype"}


@in_plain_mode
def make(
    name: str | type[Task],
    num_envs: int = 64,
    device: str | torch.device = "cpu",
    seed: int | None = None,
    horizon: int = 32,
    substeps: int | None = None,
    integrator: str | None = None,
    theta: float | None = None,
    passes: int | None = None,
    tolerance: float | None = None,
    touchdown: bool | None = None,
    accuracy: Accuracy = "default",
    contact: Contact | None = None,
    penalty: Mapping[str, float] | None = None,
    dtype: torch.dtype = torch.float32,
    clip: Clip | Path | str | None = None,
    terrain: ArrayLike | None = None,
    control_dt: float | None = None,
    **others: Any,
) -> DiffEnv:
    """Build the tensor environment of a task.

    Args:
        name: one of diffsim.TASKS, a file with a task of your own, "my_task.py" or "my_task.py:Class", or its class.
        num_envs, device, dtype: how many environments, where, and in which precision.
        seed, horizon: see DiffEnv.
        accuracy: the task's preset of integrator, theta and substeps, "fast", "default" (the paper's) or "accurate";
            docs/numerics.md has what each costs and how much it errs.
        substeps, integrator, theta, passes, tolerance, touchdown: each in place of the preset's, if given.
        contact: "soft" (the paper's springs) or "mujoco" (MuJoCo's own constraints, see Integration): the laws of
            contact and limits and how they are integrated; docs/transfer.md has what policies keep of their speed.
            Default the task's: soft for those of the papers, mujoco for go1, go2, g1 and tasks of your own.
        penalty: constants of contact and limits in place of the MJCF's, e.g. {"k_n": 1e5}; docs/physics.md lists them.
        terrain: the ground in place of the plane z = 0, vertices (x, z) [m] of one profile (K, 2), or (num_envs, K, 2)
            of one for each environment: see Scene.with_terrain; diffsim.terrain makes some. Heights that the task
            observes, rewards and ends by are then those over the ground below the root.
        control_dt: seconds of a control step in place of the task's; the substeps divide it.
        clip: the motions that g1_track tracks, or the one of humanoid_imitation; or their file or folder, see
            read_clip. Default a shipped one.
        **others: stochastic_init, early_termination, max_episode_steps, adjoint_clip, render_mode: see DiffEnv;
            threads, factors, forces: see sim.Options.

    Raises:
        ValueError: an argument out of range, with what is allowed, or a kernel cache that cannot be written.
        TypeError: an argument of another name.
    """
    if unknown := sorted(others.keys() - KEYWORDS):
        raise TypeError(f"make has no argument {unknown[0]!r}: choose from {', '.join(sorted(KEYWORDS))}")
    device, dtype = check_device(device), check_dtype(dtype)
    kind = find_task(name)
    startup.check_kernel_cache()
    if clip is None:
        task = kind(device, dtype)
    elif issubclass(kind, Imitation):
        task = kind(device, dtype, clip if isinstance(clip, Clip) else read_clip(clip))
    else:
        raise ValueError(f"task {kind.name!r} tracks no clip; {', '.join(tracking())} do")
    if control_dt is not None and control_dt != task.control_dt:
        if task.num_memory:  # its times count in control steps
            raise ValueError(f"task {kind.name!r} has control steps of {task.control_dt:.4g} s, not {control_dt!r}")
        task.control_dt = control_dt
    scene = task.scene()
    asked = dict(substeps=substeps, theta=theta, passes=passes, tolerance=tolerance, touchdown=touchdown)
    integration = task.integration(accuracy, contact).replaced(integrator, **asked)
    if penalty and integration.constrained:
        raise ValueError("penalty: constants of springs and dampers, which the integrator mujoco has not")
    scene = scene.with_penalty(penalty or {})
    scene = scene if terrain is None else scene.with_terrain(terrain)
    return DiffEnv(
        task, scene, num_envs, integration=integration, seed=seed, horizon=horizon, device=device, dtype=dtype, **others
    )


def _make_one(name: str, **arguments: Any) -> NumpyEnv:
    return NumpyEnv(make(name, num_envs=1, horizon=1, **arguments))


def _make_numpy(name: str, num_envs: int, **arguments: Any) -> NumpyVectorEnv:
    return NumpyVectorEnv(make(name, num_envs, horizon=1, **arguments))


# Two ids of each task: gymnasium.make makes the same environment of both, gymnasium.make_vec one on tensors and one in
# NumPy, which has an id of its own because many libraries take an id and no further argument.
for _name, _task in TASKS.items():
    for _suffix, _vector in (("", "make"), ("-numpy", "_make_numpy")):
        gymnasium.register(
            id=f"diffsim/{_name.title().replace('_', '')}{_suffix}-v0",
            entry_point="diffsim:_make_one",
            vector_entry_point=f"diffsim:{_vector}",
            max_episode_steps=_task.episode_length,
            kwargs={"name": _name},
        )
