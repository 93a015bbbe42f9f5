"""Tasks of a user's own: a class in a file, and its mistakes in one line each."""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib.util
import math
import sys
import traceback
from collections.abc import Sequence
from difflib import get_close_matches
from numbers import Integral
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import torch
from torch import Tensor

from diffsim.robot.actuator import joints_of
from diffsim.robot.elements import control_range, home_key, label, listed, servos
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.robot.types import Array
from diffsim.sim.integration import is_real
from diffsim.tasks import FILE, Task, TaskError
from diffsim.tasks.base import OURS

LIKENESS = 0.9  # difflib ratio above which a name counts as misspelt


def task_of_file(name: str) -> type[Task]:
    """Load the task my_task.py:Class, or the only one of my_task.py, named after the file unless it has a name."""
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
    """Import a file as a module, which can import other modules of its folder."""
    spec = importlib.util.spec_from_file_location(str(path), path)
    sys.modules[str(path)] = module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)  # type: ignore[union-attr]
    except (Exception, SystemExit) as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1]
        raise TaskError(f"{path.name}, line {line}: {type(error).__name__}: {' '.join(str(error).split())}") from error
    finally:
        sys.path.remove(str(path.parent))
    return module


# Actions about the start ----------------------------------------------------------------------------------------------


def start_control(m: mujoco.MjModel, start: Sequence[float] = ()) -> Array:
    """Return the controls (nu,) of the start: the ctrl of its keyframe, see elements.home_key.

    Without keyframe, with one that has no ctrl, or for another start (qpos first), they are those without force there.
    """
    key = -1 if len(start) else home_key(m)
    if key >= 0 and m.key_ctrl[key].any():
        return np.array(m.key_ctrl[key])
    qpos = np.array(start[: m.nq]) if len(start) else m.key_qpos[key] if key >= 0 else m.qpos0
    control, (gain, (constant, stiffness)) = np.zeros(m.nu), (m.actuator_gainprm[:, 0], m.actuator_biasprm[:, :2].T)
    for a in np.flatnonzero(servos(m) & (gain != 0)).tolist():  # each on a hinge, a slide or a fixed tendon
        joints, coefs = joints_of(m, a)
        length = coefs @ qpos[m.jnt_qposadr[joints]]
        control[a] = -(constant[a] + stiffness[a] * m.actuator_gear[a, 0] * length) / gain[a]
    return control


def around_start(task: Task) -> Scene:
    """Return the task's robot so that action 0 is the start's control, to which actions add up to task.action_scale.

    Where the ctrlrange ends nearer, actions reach as far to both sides. Raises TaskError if the start's control is no
    inner point of it.
    """
    scale, scene = task.action_scale, task.load_robot()
    m = copy.copy(scene.mj_model)
    if not is_real(scale) or not 0 < scale < math.inf:
        raise TaskError(f"task {task.name!r}: action_scale is {scale!r}, must be positive, or None")
    zero, (low, high) = start_control(m, task.start), control_range(m)
    room = np.where(m.actuator_ctrllimited != 0, np.minimum(zero - low, high - zero), np.inf)
    if len(out := np.flatnonzero(room <= 0).tolist()):
        names = listed(label(m, mujoco.mjtObj.mjOBJ_ACTUATOR, a) for a in out)
        raise TaskError(f"task {task.name!r}: with action_scale the start's control must lie within ctrlrange: {names}")
    m.actuator_ctrllimited[:] = 1
    m.actuator_ctrlrange[:] = np.stack((zero, zero), 1) + np.minimum(scale, room)[:, None] * (-1.0, 1.0)
    return dataclasses.replace(load_scene(m), name=scene.name, path=scene.path, geom_pairs=scene.geom_pairs)


# Checks, which Task.bind asks for ------------------------------------------------------------------------------------


def check_attributes(task: Task, nq: int) -> None:
    """Raise TaskError for a missing method, a misspelt name, or an attribute that would fail during a run."""
    own = {name for kind in type(task).__mro__ if not kind.__module__.startswith(OURS) for name in vars(kind)}
    known = {name for name in (*vars(Task), *Task.__annotations__) if not name.startswith("_")}
    for name in sorted(own - known):
        if meant := get_close_matches(name, known - own, 1, LIKENESS):
            raise TaskError(f"task {task.name!r} has {name!r}: is {meant[0]!r} meant?")
    if "ground" in own:
        raise TaskError(f"task {task.name!r} has 'ground', which is the terrain: give it another name")
    for names in (("observe", "observe_with"), ("reward",)):
        if all(getattr(type(task), name) is getattr(Task, name) for name in names):
            raise TaskError(f"task {task.name!r} has no method {names[0]!r}")
    name, length, height, column = task.name, task.episode_length, task.min_height, task.forward_column
    whole, numbered = (isinstance(value, Integral) and is_real(value) for value in (length, column))
    found = column is None or (numbered and column in range(nq))
    named = isinstance(name, str) and name == Path(name).name and name not in ("", "..")
    for attribute, fits, allowed in (
        ("name", named, "the name of a folder, without a slash"),
        ("episode_length", whole and length >= 1, "an integer of at least 1"),
        ("min_height", height is None or (is_real(height) and height > -math.inf), "a number of meters, or None"),
        ("forward_column", found, f"a column of qpos, 0 to {nq - 1}, or None"),
    ):
        if not fits:
            raise TaskError(f"task {name!r}: {attribute} is {getattr(task, attribute)!r}, must be {allowed}")


def check_methods(task: Task, scene: Scene) -> None:
    """Raise TaskError where what a method returns for two starts does not fit, or an episode is over there."""

    def check(name: str, value: object, expected: object, source: str = "") -> None:
        if value != expected:
            raise TaskError(f"task {task.name!r}: {name} is {value}, must be {expected}{source and f' ({source})'}")

    def tensor(method: str, value: Tensor) -> Tensor:
        if not isinstance(value, Tensor):
            raise TaskError(f"task {task.name!r}: {method} returns {type(value).__name__}, must return a torch tensor")
        if not value.isfinite().all():
            raise TaskError(f"task {task.name!r}: what {method} returns for the start is not finite")
        return value

    n, start, spread = scene.nq + scene.nv, task._start, task._spread
    if type(task).reset is Task.reset:
        check("num_random", task.num_random, n, "nq + nv")
        check("the length of start", len(start), n, "nq + nv")
        check("the length of spread", len(spread) if spread.ndim else n, n, "nq + nv")
    rand = torch.full((2, task.num_random), 0.5, device=task.device, dtype=task.dtype)
    qpos, qvel = task.reset(rand)
    check("the width of qpos and of qvel from reset", (qpos.shape[-1], qvel.shape[-1]), (scene.nq, scene.nv))
    action, memory = rand.new_zeros(2, scene.nu), task.begin(rand)
    check("the width of what begin returns", memory.shape[-1], task.num_memory, "num_memory")
    obs = tensor("observe", task.observe_with(qpos, qvel, action, memory))
    check("the shape of two observations", tuple(obs.shape), (2, obs.shape[-1]))
    check("obs_dim", getattr(task, "obs_dim", obs.shape[-1]), obs.shape[-1], "what observe returns")
    if task.obs_parts:
        check("the sum of obs_parts", sum(size for _, size in task.obs_parts), obs.shape[-1], "obs_dim")
    reward = tensor("reward", task.reward(obs, action))
    check("the shape of two rewards", tuple(reward.shape), (2,))
    for k in scene.quaternion_adr:
        if not qpos[:, k : k + 4].any(1).all():
            raise TaskError(f"task {task.name!r}: the quaternion qpos[{k}:{k + 4}] of the start is zero")
    over = tensor("terminated", task.terminated(obs))
    check("what terminated returns for two observations", (over.dtype, tuple(over.shape)), (torch.bool, (2,)))
    if over.any():
        bound = "" if task.min_height is None else f", and min_height is {task.min_height}"
        raise TaskError(f"task {task.name!r}: an episode ends where it starts; obs[0] is {obs[0, 0]:.4g}{bound}")
