"""Tasks of a user's own: where they and their robots come from, what they may leave out, whether their numbers fit."""

from __future__ import annotations

import functools
import os
import re
import sys
import traceback
from pathlib import Path
from types import ModuleType

import mujoco
import torch

from diffsim.robot.scene import Scene
from diffsim.tasks.base import Asset, Task

FILE = re.compile(r"(.+\.py)(?::(\w+))?")  # my_task.py or my_task.py:Class
ASSETS = Path(__file__).resolve().parents[1] / "assets"


class TaskError(ValueError):
    """There is no such task, or it does not fit its robot. The message is one line that says all."""


def task_of_file(name: str) -> type[Task]:
    """The task my_task.py:Class, or the only one of my_task.py, by the file's name unless it has one of its own."""
    file, wanted = FILE.fullmatch(name).groups()  # type: ignore[union-attr]
    path = Path(file).resolve()
    if not path.is_file():
        raise TaskError(f"no such file: {file} in {Path.cwd()}; give its path, in scripts --env path/to/{path.name}")
    module = _module(path, path.stat().st_mtime_ns)
    own = (kind for kind in vars(module).values() if isinstance(kind, type) and kind.__module__ == str(path))
    tasks = {kind.__name__: kind for kind in own if issubclass(kind, Task)}
    if not tasks:
        raise TaskError(f"{file} defines no task, a class that extends diffsim.tasks.Task")
    wanted = wanted or (None if len(tasks) > 1 else next(iter(tasks)))
    if wanted not in tasks:
        found = f"no task {wanted}" if wanted else "several tasks"
        raise TaskError(f"{file} has {found}: choose from {', '.join(f'{file}:{kind}' for kind in tasks)}")
    if "name" not in vars(tasks[wanted]):
        tasks[wanted].name = path.stem
    return tasks[wanted]


@functools.cache
def _module(path: Path, _changed: int) -> ModuleType:
    """A file as a module, which finds other modules beside it."""
    sys.modules[str(path)] = module = ModuleType(str(path))  # where dataclasses look for it
    module.__file__ = str(path)
    sys.path.insert(0, str(path.parent))
    try:
        exec(compile(path.read_bytes(), path, "exec"), vars(module))
    except (Exception, SystemExit) as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1]
        raise TaskError(f"{path.name}, line {line}: {type(error).__name__}: {' '.join(str(error).split())}") from error
    finally:
        sys.path.remove(str(path.parent))
    return module


def robot(task: Task) -> Asset:
    """The asset for load_scene. A file of diffsim's tasks is in diffsim/assets; another's is sought beside the file of
    the class that names it, in the working directory and in diffsim/assets."""
    owner = next((kind for kind in type(task).__mro__ if "asset" in vars(kind)), type(task)).__module__
    asset: Asset | None = getattr(task, "asset", None)
    if asset is None:
        raise TaskError(f"task {task.name!r} names no robot: give it an asset, such as a file's path")
    if not isinstance(asset, str | os.PathLike):
        return asset
    beside = getattr(sys.modules.get(owner), "__file__", None) or "."
    folders = [] if owner.startswith("diffsim.") else [Path(beside).resolve().parent, Path.cwd()]
    for folder in (*folders, ASSETS):
        if (folder / asset).is_file():
            return folder / asset
    raise TaskError(f"task {task.name!r}: no robot file {str(asset)!r} in {' or '.join(map(str, folders))}")


@torch.no_grad()
def fit(task: Task, scene: Scene) -> None:
    """Give a task start, num_random, obs_dim and forward if it lacks them; a TaskError names a number that is wrong."""
    n, m = scene.nq + scene.nv, scene.mj_model
    task.forward, task.num_random = getattr(task, "forward", forward(scene)), getattr(task, "num_random", n)
    if type(task).reset is Task.reset:
        task._nq, task._quaternions = scene.nq, scene.quaternion_adr.tolist()
        if not len(task._start):
            key = max(mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)
            home = torch.tensor(m.key_qpos[key] if m.nkey else scene.qpos0)
            task._start = torch.cat((home.to(task._start), task._start.new_zeros(scene.nv)))
        sizes = {"num_random": task.num_random, "the length of start": len(task._start)}
        for name, size in (sizes | {"the length of spread": len(task._spread) if task._spread.ndim else n}).items():
            _check(task, name, size, n, "nq + nv")
    rand = task._start.new_full((2, task.num_random), 0.5)
    qpos, qvel, action = state = *task.reset(rand), task._start.new_zeros(2, scene.nu)
    _check(task, "the width of qpos and of qvel from reset", (qpos.shape[-1], qvel.shape[-1]), (scene.nq, scene.nv))
    memory = task.begin(rand)
    _check(task, "the width of what begin returns", memory.shape[-1], task.num_memory, "num_memory")
    obs = task.observe_with(*state, memory)
    _check(task, "the shape of two observations", tuple(obs.shape), (2, obs.shape[-1]))
    task.obs_dim = getattr(task, "obs_dim", obs.shape[-1])
    _check(task, "obs_dim", task.obs_dim, obs.shape[-1], "what observe returns")
    if task.obs_parts:
        _check(task, "the sum of obs_parts", sum(size for _, size in task.obs_parts), task.obs_dim, "obs_dim")
    if type(task).reward is not Task.reward:  # who only watches needs none
        _check(task, "the shape of two rewards", tuple(task.reward(obs, action).shape), (2,))


def _check(task: Task, name: str, value: object, expected: object, source: str = "") -> None:
    if value != expected:
        raise TaskError(f"task {task.name!r}: {name} is {value}, must be {expected}{source and f' ({source})'}")


def forward(scene: Scene) -> int | None:
    """Column of qpos that is the root's x, of its free joint or its slide along x; None if neither ground nor fluid
    carries the robot, or if it has no such joint, as an arm."""
    m = scene.mj_model
    mujoco.mj_kinematics(m, data := mujoco.MjData(m))
    along = (m.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE) & (data.xaxis[:, 0] > 0.99)
    along |= m.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    found = m.jnt_qposadr[along & (m.body_weldid[m.body_parentid[m.jnt_bodyid]] == 0)]
    return int(found[0]) if len(found) and scene.features & {"contact", "drag"} else None
