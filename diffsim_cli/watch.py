"""Watch a saved policy: the task as it was trained on it, and a video of an episode."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from diffsim.env import DiffEnv
from diffsim.tasks import find_task
from diffsim.training import Evaluation, SavedPolicy
from diffsim.training.evaluation import fitting, make_env
from diffsim.training.flags import Flags
from diffsim.training.provenance import compare
from diffsim_cli import render

VIDEO_SECONDS = 10.0  # how much of an episode is filmed


def make_policy_env(saved: SavedPolicy, num_envs: int, forces: bool = False, **changes: Any) -> DiffEnv:
    """Make the task on which a policy was trained, simulated as there, on the CPU; changes replace its flags.

    Of a task of your own, env is its file.
    """
    changes |= {"env": saved.task(changes.get("env"))}
    args = SimpleNamespace(**vars(Flags()) | saved.args | {"device": "cpu", "threads": 0} | changes)
    args.task_class = find_task(args.env)
    env = make_env(args, num_envs, forces=forces)
    fitting(saved.network, env)
    compare(saved.robot, env.scene)
    return env


def film_median(evaluation: Evaluation, path: Path, seconds: float = VIDEO_SECONDS, **options: Any) -> Path:
    """Film the first seconds of the episode of median return, as .mp4 or .gif; returns the file.

    options: of render.film, such as size (width, height) in pixels.

    Raises:
        OSError, RuntimeError: what is missing to draw or to write, see render.film.
    """
    steps, scene, median = max(1, round(seconds / evaluation.control_dt)), evaluation.scene, evaluation.median
    qpos, action = (rows[:steps] for rows in evaluation.episode(median))
    ghost = None if evaluation.ghost is None else evaluation.ghost[:, median].numpy(force=True)
    if scene.terrain is not None:
        scene = scene.with_terrain(scene.terrain[median % len(scene.terrain)])
    return render.film(path, scene, qpos, evaluation.control_dt, action, ghost=ghost, **options)
