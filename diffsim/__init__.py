"""Parallel differentiable simulation of articulated robots, and the tasks of the SHAC paper on it."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, Literal

import gymnasium
import torch
from numpy.typing import ArrayLike

from diffsim import startup
from diffsim.env import DiffEnv, check_seed
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.robot.types import SceneError
from diffsim.sim.integration import Integration, check_count
from diffsim.sim.modes import in_plain_mode
from diffsim.sim.options import check_device, check_dtype
from diffsim.sim.simulator import Simulator
from diffsim.tasks import TASKS, Accuracy, Contact, Task, TaskError, find_task

__version__ = "1.0.0"
__all__ = [
    "TASKS",
    "DiffEnv",
    "Integration",
    "Scene",
    "SceneError",
    "Simulator",
    "Task",
    "TaskError",
    "load_scene",
    "make",
]


@in_plain_mode
def make(
    name: str | type[Task],
    num_envs: int = 64,
    device: str | torch.device = "cpu",
    seed: int | None = None,
    horizon: int = 32,
    contact: Contact | None = None,
    accuracy: Accuracy = "default",
    substeps: int | None = None,
    implicit: bool | None = None,
    tolerance: float | None = None,
    onset: float | None = None,
    penalty: Mapping[str, float] | None = None,
    dtype: torch.dtype = torch.float32,
    terrain: ArrayLike | None = None,
    control_dt: float | None = None,
    stochastic_init: bool = True,
    early_termination: bool = True,
    max_episode_steps: int | None = None,
    adjoint_clip: float = 0.0,
    render_mode: Literal["rgb_array"] | None = None,
    threads: int | None = None,
    factors: bool = False,
    forces: bool = False,
    block: int | None = None,
    division: tuple[int, int] | None = None,
    **unknown: Any,
) -> DiffEnv:
    """Build the tensor environment of a task.

    Example:
        env = diffsim.make("ant", num_envs=64, horizon=32)
        obs, info = env.reset(seed=1)  # (64, 37)
        obs, reward, terminated, truncated, info = env.step(torch.zeros(64, 8))

    Args:
        name: one of diffsim.TASKS, one with options ("go2:rough=20", "g1_track:walk.npz", see docs/tasks.md), a file
            with a task of your own ("my_task.py" or "my_task.py:Class"), or its class.
        num_envs: number of environments N.
        device: "cpu" or a CUDA device.
        seed: of the random start states, commands and noise; by default, each call of `make` draws a new one.
        horizon: largest number of differentiable steps between two calls of DiffEnv.detach.
        contact: "soft" (penalty law) or "mujoco" (MuJoCo's constraints). Default: the task's, "mujoco" for go1, go2,
            g1, g1_track and tasks of your own, "soft" for the others.
        accuracy: preset of the integration, "fast" (soft contact only), "default" (the papers') or "accurate", see
            docs/numerics.md.
        substeps, implicit, tolerance, onset: replace parts of the preset, see Integration.
        penalty: constants of the penalty law that replace the MJCF's, e.g. {"k_n": 1e5}, see docs/physics.md.
        dtype: torch.float32 or torch.float64.
        terrain: replaces the task's ground: vertices (x, z) [m] of one profile, (K, 2), or of one for each
            environment, (N, K, 2), see docs/physics.md.
        control_dt: seconds of a control step. Default: the task's.
        stochastic_init: draw start states; otherwise each episode starts from the task's unperturbed one.
        early_termination: end episodes where the task reports a fall.
        max_episode_steps: control steps after which an episode is truncated. Default: the task's episode_length.
        adjoint_clip: bound of each environment's state gradients, as a multiple of the batch's median; 0: none.
        render_mode: "rgb_array": DiffEnv.render returns pictures.
        threads: CPU threads of the kernels. Default: as many as have work.
        factors, forces: enable Simulator.factors (constants that differ between environments), Simulator.forces.
        block: environments per vector of a CPU thread, 1, 8 or 16. Default: the fastest.
        division: GPU threads of an environment, and how many of them share each limb. Default: the fastest.

    Returns:
        A gymnasium.vector.VectorEnv on torch tensors: observations (N, obs_dim), actions (N, nu) in [-1, 1], rewards
        (N,). docs/tasks.md lists obs_dim, nu, rate and episode length of each task.

    Raises:
        ValueError: an argument out of range, with what is allowed; a kernel cache that cannot be written.
        TypeError: an argument with an unknown name.
        SceneError, TaskError: a robot or a task that cannot be simulated.
    """
    if unknown:
        known = sorted(inspect.signature(make).parameters.keys() - {"unknown"})
        raise TypeError(f"make has no argument {min(unknown)!r}: choose from {', '.join(known)}")
    device, dtype = check_device(device), check_dtype(dtype)
    kind = find_task(name)
    startup.check_kernel_cache()
    task = kind(device, dtype)
    if control_dt is not None and control_dt != task.control_dt:
        if task.num_memory:  # its times count in control steps
            raise ValueError(f"task {kind.name!r} has control steps of {task.control_dt:.4g} s, not {control_dt!r}")
        task.control_dt = control_dt
    scene = task.scene()
    asked: Any = dict(substeps=substeps, implicit=implicit, tolerance=tolerance, onset=onset)
    given = {name: value for name, value in asked.items() if value is not None}
    integration = task.integration(accuracy, contact)._replace(**given)
    if penalty and integration.contact == "mujoco":
        raise ValueError("penalty sets constants of the penalty law, but the contact is mujoco")
    scene = scene.with_penalty(penalty or {})
    if terrain is None:
        count = check_count("num_envs", num_envs)
        terrain = kind.terrain(count, 0 if seed is None else check_seed(seed))
    scene = scene if terrain is None else scene.with_terrain(terrain)
    episodes: Any = dict(stochastic_init=stochastic_init, early_termination=early_termination)
    episodes |= dict(max_episode_steps=max_episode_steps, adjoint_clip=adjoint_clip, render_mode=render_mode)
    options: Any = dict(threads=threads, factors=factors, forces=forces, block=block, division=division)
    options |= dict(integration=integration, device=device, dtype=dtype)
    return DiffEnv(task, scene, num_envs, seed=seed, horizon=horizon, **episodes, **options)


EPISODE_STEPS = {"cartpole": 240, "g1_track": 500}  # of the others Task.episode_length

# Two ids of each task: gymnasium.make makes the same environment of both, gymnasium.make_vec one on tensors and one in
# NumPy, which has an id of its own because many libraries take an id and no further argument.
for _name in TASKS:
    for _suffix, _vector in (("", "diffsim:make"), ("-numpy", "diffsim.numpy_env:make_vec")):
        gymnasium.register(
            id=f"diffsim/{_name.title().replace('_', '')}{_suffix}-v0",
            entry_point="diffsim.numpy_env:make_one",
            vector_entry_point=_vector,
            max_episode_steps=EPISODE_STEPS.get(_name, Task.episode_length),
            kwargs={"name": _name},
        )
