"""Constants that differ between environments and change over a training: hardening contact, robots of many kinds.

On ground as hard as MuJoCo's gradients are steep before there is a gait. So contact may begin soft and harden while the
policy learns. Constants drawn at random keep the policy from living on one ground's own errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch

from diffsim.env import DiffEnv
from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import is_real

# What --randomise may name, and the factors of the simulator that it draws, each by itself.
VARIED = {
    "friction": ("mu",),
    "stiffness": ("k_n", "k_d", "k_t", "k_limit", "d_limit"),
    "mass": ("mass",),
    "motor": ("motor",),
}
SOFT = {"k_d": 0.01}  # where --anneal begins: a contact's force at a given motion, as a factor
SEEDS = 15_485_863  # between the random numbers of one drawing and the next; ranks are 1_000_003 apart


class Range(NamedTuple):
    """Of factors, drawn so that their logarithm is uniform."""

    least: float
    most: float


def parse_ranges(items: Sequence[str]) -> dict[str, Range]:
    """Of the flag --randomise friction=0.7:1.3 mass=0.9:1.1, by name.

    Raises:
        ValueError: anything else.
    """
    ranges = {}
    for item in items:
        name, _, text = item.partition("=")
        try:
            least, most = map(float, text.split(":"))
        except ValueError:
            raise ValueError(f"{item!r} is no range of factors like friction=0.7:1.3") from None
        if name not in VARIED:
            raise ValueError(f"unknown {name!r}: choose from {', '.join(VARIED)}")
        if not (is_real(least) and 0 < least <= most < math.inf):
            raise ValueError(f"{item!r}: factors must be positive and finite, the least one first")
        ranges[name] = Range(least, most)
    return ranges


class Variation:
    """Sets the factors of an environment's constants, before each iteration, as the iteration alone decides.

    With progress t from 0 to 1 a constant is start^(1 - t) of its own, times a random factor whose range opens as t
    does.

    Args:
        env: made with factors.
        start: factors at t = 0, by their names in FACTORS; what is not named has 1.
        ranges: of random factors, by their names in VARIED.
        span: iterations between which t rises from 0 to 1.
        redraw: iterations between drawings.
        seed: of the drawings.
    """

    def __init__(
        self,
        env: DiffEnv,
        start: Mapping[str, float],
        ranges: Mapping[str, Range],
        span: tuple[float, float],
        redraw: int,
        seed: int,
    ) -> None:
        self.factors, self.span, self.redraw, self.seed = env.sim.factors, span, redraw, seed
        drawn = {factor: ranges[name] for name, factors in VARIED.items() if name in ranges for factor in factors}
        least = [math.log(drawn[name].least) if name in drawn else 0.0 for name in FACTORS]
        most = [math.log(drawn[name].most) if name in drawn else 0.0 for name in FACTORS]
        self.least, self.width = torch.tensor(least), torch.tensor(most) - torch.tensor(least)
        self.start = torch.tensor([start.get(name, 1.0) for name in FACTORS])
        self._present: tuple[float, int] | None = None

    def progress(self, iteration: int) -> float:
        begin, end = self.span
        return min(1.0, max(0.0, (iteration - begin) / (end - begin))) if end > begin else float(iteration > begin)

    def set(self, iteration: int) -> None:
        """The factors (N, len(FACTORS)) of an iteration; between drawings they change by the progress alone."""
        t, drawing = self.progress(iteration), (iteration - 1) // self.redraw
        if self._present == (t, drawing):
            return
        self._present = t, drawing
        generator = torch.Generator().manual_seed(self.seed + SEEDS * drawing)
        uniform = torch.rand(self.factors.shape, generator=generator)
        self.factors.copy_(self.start ** (1 - t) * (t * (self.least + self.width * uniform)).exp())
