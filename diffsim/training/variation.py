"""Constants that differ between environments, drawn at random: a policy cannot overfit one robot or one ground."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch

from diffsim.env import DiffEnv
from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import is_real
from diffsim.tasks import Task

# What --randomise may name, and the factors of the simulator that it draws, each by itself.
VARIED = {
    "friction": ("mu",),
    "stiffness": ("k_n", "k_d", "k_t", "k_limit", "d_limit"),
    "mass": ("mass",),
    "motor": ("motor",),
}
MOST_LATENCY = 2.0  # control steps, of which tasks remember the actions
SEEDS = 15_485_863  # between the random numbers of one drawing and the next; ranks are 1_000_003 apart


def parse_ranges(items: Sequence[str], task: type[Task] = Task) -> dict[str, tuple[float, float]]:
    """Of --randomise friction=0.7:1.3 the least and the largest factor by name, and the range of a task's disturbance.

    Raises ValueError for anything else.
    """
    ranges = {}
    for item in items:
        name, _, text = item.partition("=")
        try:
            least, most = map(float, text.split(":"))
        except ValueError:
            raise ValueError(f"{item!r} is not a range like friction=0.7:1.3") from None
        if name not in VARIED and name not in task.disturbances:
            raise ValueError(f"unknown {name!r}: choose from {', '.join((*VARIED, *task.disturbances))}")
        if name in task.disturbances:
            bound = MOST_LATENCY if name == "latency" else math.inf
            if not (is_real(least) and 0 <= least <= most <= bound and most < math.inf):
                raise ValueError(f"{item!r}: must be from 0 to {bound:g}, the smaller one first")
        elif not (is_real(least) and 0 < least <= most < math.inf):
            raise ValueError(f"{item!r}: factors must be positive and finite, the smaller one first")
        ranges[name] = least, most
    return ranges


class Variation:
    """Sets the factors of an environment's constants, before each iteration, by the number of the iteration.

    Args:
        env: made with factors.
        ranges: least and largest random factor, by their names in VARIED; their logarithm is uniform. Those of the
            task's disturbances are its own to draw from, in each episode.
        redraw: iterations between drawings.
    """

    def __init__(self, env: DiffEnv, ranges: Mapping[str, tuple[float, float]], redraw: int, seed: int) -> None:
        self.factors, self.redraw, self.seed = env.sim.factors, redraw, seed
        if disturbances := {name: ranges[name] for name in env.task.disturbances if name in ranges}:
            env.task.disturbances = {**env.task.disturbances, **disturbances}
            env.reset()  # into episodes that have them
        drawn = {factor: ranges[name] for name, factors in VARIED.items() if name in ranges for factor in factors}
        least = [math.log(drawn[name][0]) if name in drawn else 0.0 for name in FACTORS]
        most = [math.log(drawn[name][1]) if name in drawn else 0.0 for name in FACTORS]
        self.least, self.width = torch.tensor(least), torch.tensor(most) - torch.tensor(least)
        self._drawing = -1

    def set(self, iteration: int) -> None:
        """The factors (N, len(FACTORS)) of an iteration."""
        drawing = (iteration - 1) // self.redraw
        if drawing != self._drawing:
            self._drawing = drawing
            generator = torch.Generator().manual_seed(self.seed + SEEDS * drawing)
            self.factors.copy_((self.least + self.width * torch.rand(self.factors.shape, generator=generator)).exp())
