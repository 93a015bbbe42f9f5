"""Options after a task's name: domain randomisation, rough ground and clips, as in `--env go2:rough=20,push=0:1`.

Constants of training environments that are drawn at random keep a policy from overfitting one robot or one ground.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeAlias

import torch

from diffsim.env import DiffEnv
from diffsim.robot.scene import FACTORS
from diffsim.robot.types import Array
from diffsim.sim.integration import is_real
from diffsim.tasks import Task, TaskError, base_name
from diffsim_robots.terrain import STEEPEST, uneven

Ranges: TypeAlias = Mapping[str, tuple[float, float]]  # least and largest value by name

# Options that are ranges, and the factors of the simulator that each draws, by itself. Others are those of a task's
# `disturbances`: "latency" [control steps], "push" [m/s], "pull" [m/s^2].
VARIED = {
    "friction": ("mu",),
    "stiffness": ("k_n", "k_d", "k_t", "k_limit", "d_limit"),
    "mass": ("mass",),
    "motor": ("motor",),
}
MOST_LATENCY = 2.0  # control steps, of which tasks remember the actions
REDRAW = 10  # iterations with the same factors
SEEDS = 15_485_863  # between the random numbers of one drawing and the next; ranks are 1_000_003 apart


def configure(kind: type[Task], options: str) -> type[Task]:
    """Return a task with options, separated by commas.

    Args:
        options: "rough=20": slopes of up to 20 degrees, see `uneven`; "friction=0.7:1.3": a range that each training
            environment draws from, in place of the task's own of that name; "randomise=none": no ranges but those that
            follow; "walk.npz", without an equals sign: what `kind.with_clip` takes.

    Raises:
        TaskError: an option that the task does not have, or a value out of range.
    """
    values: dict[str, Any] = {"ranges": dict(getattr(kind, "ranges", {})), "options": options}
    for item in options.split(","):
        name, equals, text = item.partition("=")
        if not equals and hasattr(kind, "with_clip"):
            kind = kind.with_clip(item)
        elif item == "randomise=none":
            values["ranges"] = {}
        elif name == "rough":
            values["slope"] = _slope(item, text)
        else:
            values["ranges"][name] = _range(kind, item)
    values["varied_by"] = f"{__name__}:Variation" if values["ranges"] else None
    if "slope" in values:
        values["terrain"] = classmethod(_terrain)
    return type(kind.__name__, (kind,), values | {"__module__": kind.__module__})


def _terrain(kind: Any, num_envs: int, seed: int) -> Array:
    return uneven(kind.slope, num_envs, seed)


def _slope(item: str, text: str) -> float:
    try:
        slope = float(text)
    except ValueError:
        slope = math.nan
    if not 0 < slope <= STEEPEST:
        raise TaskError(f"{item!r}: the steepest slope must be above 0 and at most {STEEPEST:g} degrees")
    return slope


def _range(kind: type[Task], item: str) -> tuple[float, float]:
    """Read friction=0.7:1.3, the least and the largest value."""
    name, _, text = item.partition("=")
    disturbances = getattr(kind, "disturbances", {})
    try:
        least, most = map(float, text.split(":"))
    except ValueError:
        clip = "a clip, " if hasattr(kind, "with_clip") else ""
        example = f"{clip}rough=20, randomise=none or a range like friction=0.7:1.3"
        raise TaskError(f"task {kind.name!r} has no option {item!r}: write {example}") from None
    if name not in VARIED and name not in disturbances:
        raise TaskError(f"task {kind.name!r} cannot vary {name!r}: choose from {', '.join((*VARIED, *disturbances))}")
    if name in disturbances:
        bound = MOST_LATENCY if name == "latency" else math.inf
        if not (is_real(least) and 0 <= least <= most <= bound and most < math.inf):
            raise TaskError(f"{item!r}: must be from 0 to {bound:g}, the smaller one first")
    elif not (is_real(least) and 0 < least <= most < math.inf):
        raise TaskError(f"{item!r}: factors must be positive and finite, the smaller one first")
    return least, most


def on_a_plane(name: str) -> str:
    """Return a task's name without the option of rough ground."""
    base = base_name(name)
    others = [option for option in name[len(base) + 1 :].split(",") if option and not option.startswith("rough=")]
    return ":".join((base, *([",".join(others)] if others else [])))


class Variation:
    """Sets the factors of a training environment's constants, before each iteration, by the number of the iteration.

    Args:
        env: made with factors; the `ranges` of its task count. The logarithm of a factor is uniform. Disturbances
            are the task's own to draw from, in each episode.
        seed: of the factors.
    """

    def __init__(self, env: DiffEnv, seed: int) -> None:
        self.factors, self.seed, task = env.sim.factors, seed, env.task
        ranges, disturbances = task.ranges, getattr(task, "disturbances", {})  # type: ignore[attr-defined]
        if own := {name: ranges[name] for name in disturbances if name in ranges}:
            task.disturbances = {**disturbances, **own}  # type: ignore[attr-defined]
            env.reset()  # into episodes that have them
        drawn = {factor: ranges[name] for name, factors in VARIED.items() if name in ranges for factor in factors}
        least = [math.log(drawn[name][0]) if name in drawn else 0.0 for name in FACTORS]
        most = [math.log(drawn[name][1]) if name in drawn else 0.0 for name in FACTORS]
        self.least, self.width = torch.tensor(least), torch.tensor(most) - torch.tensor(least)
        self._drawing = -1

    def set(self, iteration: int) -> None:
        """Set the factors (N, len(FACTORS)) of an iteration."""
        drawing = (iteration - 1) // REDRAW
        if drawing != self._drawing:
            self._drawing = drawing
            generator = torch.Generator().manual_seed(self.seed + SEEDS * drawing)
            self.factors.copy_((self.least + self.width * torch.rand(self.factors.shape, generator=generator)).exp())
