"""Where tasks and their robots come from when they are the user's own: a file, a class, a path beside it, a model."""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import sys
import traceback
from importlib.resources import files
from pathlib import Path
from types import ModuleType

from diffsim.tasks.base import Asset, Task

ASSETS = Path(str(files("diffsim"))) / "assets"
FILE = re.compile(r"(.+\.py)(?::(\w+))?")  # my_task.py or my_task.py:Class


def is_file(name: object) -> bool:
    """Whether a task's name is that of a file."""
    return isinstance(name, str) and FILE.fullmatch(name) is not None


def task_of_file(name: str) -> type[Task]:
    """The task my_task.py:Class, or the only one of my_task.py. Without a `name` of its own it has the file's.

    Raises:
        ValueError: no such file, an error in it, no task in it or several.
    """
    file, wanted = FILE.fullmatch(name).groups()  # type: ignore[union-attr]
    path = Path(file).resolve()
    if not path.is_file():
        hint = f"give its path, in scripts as --env path/to/{path.name}"
        raise ValueError(f"no such file: {file}, seen from {Path.cwd()}; {hint}")
    module = _module(path, path.stat().st_mtime_ns)
    own = [kind for kind in vars(module).values() if isinstance(kind, type) and issubclass(kind, Task)]
    tasks = {kind.__name__: kind for kind in own if kind.__module__ == module.__name__}
    if not tasks:
        raise ValueError(f"{file} defines no task, a class that extends diffsim.tasks.Task")
    if wanted is not None and wanted not in tasks:
        raise ValueError(f"{file} has no task {wanted}; it has {', '.join(tasks)}")
    if wanted is None and len(tasks) > 1:
        raise ValueError(f"{file} has several tasks; choose from {', '.join(f'{file}:{kind}' for kind in tasks)}")
    task = tasks[wanted or next(iter(tasks))]
    if "name" not in vars(task):
        task.name = path.stem
    return task


@functools.cache
def _module(path: Path, _changed: int) -> ModuleType:
    """A file as a module, which finds other modules beside it."""
    spec = importlib.util.spec_from_file_location(str(path), path)
    assert spec and spec.loader
    sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)  # where dataclasses look for it
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        if isinstance(error, SyntaxError) and error.filename == str(path):
            lines, error = [error.lineno], SyntaxError(error.msg)
        where, why = f"{path.name}, line {lines[-1] if lines else '?'}", " ".join(str(error).split())
        raise ValueError(f"{where}: {type(error).__name__}: {why}") from error
    finally:
        sys.path.remove(str(path.parent))
    return module


def robot(task: Task) -> Asset:
    """What load_scene reads of a task: its asset, a relative path as one from where the class says so.

    That is the folder of its file, then the working directory, then diffsim/assets; for a task of diffsim the last.

    Raises:
        ValueError: the task names no robot, or no such file is there.
    """
    asset: Asset | None = getattr(task, "asset", None)
    if asset is None:
        raise ValueError(f"task {task.name!r} names no robot: give it an asset, such as a file's path")
    if not isinstance(asset, str | os.PathLike):
        return asset
    owner = next((kind for kind in type(task).__mro__ if "asset" in vars(kind)), type(task)).__module__
    folders = [ASSETS]
    if not owner.startswith("diffsim."):
        file = getattr(sys.modules.get(owner), "__file__", None)
        folders = [*([Path(file).resolve().parent] if file else []), Path.cwd(), ASSETS]
    for folder in folders:
        if (folder / asset).is_file():
            return folder / asset
    raise ValueError(f"robot file {os.fspath(asset)!r} of task {task.name!r} is not in {', '.join(map(str, folders))}")
