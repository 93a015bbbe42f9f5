"""Tasks of a user's own: a class in a file."""

from __future__ import annotations

import functools
import importlib.util
import re
import sys
import traceback
from pathlib import Path
from types import ModuleType

from diffsim.tasks.base import Task, TaskError

FILE = re.compile(r"(.+\.py)(?::(\w+))?")  # my_task.py or my_task.py:Class


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
