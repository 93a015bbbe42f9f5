"""Terrain: profiles z(x) to walk over, and the heights of robots above them.

A profile is an array (K, 2) of vertices (x, z) [m] in the world, joined by straight segments of which the first and the
last go on for ever. It is the same at every y. Scene.with_terrain and diffsim.make(..., terrain=profile) take one for
all environments or, stacked to (num_envs, K, 2), one for each:

    env = diffsim.make("walker", num_envs=8, terrain=np.stack([rough(seed) for seed in range(8)]))

All functions here leave the ground at z = 0 up to x = `start` [m], so that a robot can start at x = 0.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from diffsim.robot.scene import Array, Scene

MOST_SEGMENTS = 10_000  # of rough ground
STEEPEST = 45.0  # degrees, of uneven ground that robots are put on
SEGMENT, LENGTH, LEVEL = 0.4, 30.0, 0.5  # m, of uneven ground: its segments, its sides, its level middle


def incline(degrees: float, start: float = 1.0) -> Array:
    """(3, 2) a slope without end between -90 and 90 degrees, upward if positive."""
    return np.array([[start - 1.0, 0.0], [start, 0.0], [start + 1.0, _slope(degrees)]])


def step(height: float, start: float = 1.0) -> Array:
    """(4, 2) a wall of this height [m], not 0, at x = start, upward if positive; level before and after."""
    if not 0 < abs(height) < math.inf:
        raise ValueError(f"height is {height!r}, must be finite and not 0")
    return np.array([[start - 1.0, 0.0], [start, 0.0], [start, height], [start + 1.0, height]], np.float64)


def rough(seed: int, segment: float = 1.0, degrees: float = 10.0, length: float = 50.0, start: float = 1.0) -> Array:
    """(K, 2) segments of random slope, then level; K = 3 + length / segment, rounded.

    Args:
        seed: of the slopes, an integer of at least 0; each has another profile.
        segment: length of each segment along x [m], positive.
        degrees: the steepest slope, below 90; they are uniform between it and its opposite.
        length: of all segments together, along x [m]: one to MOST_SEGMENTS segments.
    """
    if not float(seed).is_integer() or seed < 0:
        raise ValueError(f"seed is {seed!r}, must be an integer of at least 0")
    steepest = math.atan(abs(_slope(degrees)))
    if not (segment > 0 and 0.5 < length / segment <= MOST_SEGMENTS):
        raise ValueError(f"length is {length!r}, must be 1 to {MOST_SEGMENTS} segments of {segment!r}")
    count = round(length / segment)
    angles = steepest * np.random.default_rng(int(seed)).uniform(-1.0, 1.0, count)
    x = [-1.0, 0.0, *np.cumsum([segment] * count + [1.0])]
    z = [0.0, 0.0, *np.cumsum([*(segment * np.tan(angles)), 0.0])]
    return np.stack([start + np.array(x), z], 1)


def uneven(degrees: float, count: int, seed: int = 0) -> Array:
    """(count, K, 2) profiles of ground that is rough before and behind the robot; a seed has the same ones always.

    Within 0.5 m of x = 0 they are level. Then come segments of 0.4 m as of `rough`, for 30 m to both sides: robots that
    follow commands stay there in an episode, those that run do not. The steepest slope grows evenly from profile to
    profile; the last one's is `degrees`.
    """
    seeds = np.random.default_rng(seed % 2**64).integers(2**31, size=(count, 2))
    steepest = np.linspace(degrees / count, degrees, count).tolist()
    sides = (
        [rough(each, SEGMENT, most, LENGTH, LEVEL)[1:] for each in pair]
        for most, pair in zip(steepest, seeds.tolist(), strict=True)
    )
    return np.stack([np.concatenate([behind[::-1] * [-1.0, 1.0], before]) for behind, before in sides])


def _slope(degrees: float) -> float:
    if not -90 < degrees < 90:
        raise ValueError(f"degrees is {degrees!r}, must lie between -90 and 90")
    return math.tan(math.radians(degrees))


class Elevation:
    """Carries a task, which knows a plane at z = 0 only, to a terrain and back: by the height of the ground below.

    The root is raised by the terrain's z at the root's own x. A robot whose root cannot be raised stays where it is.
    """

    def __init__(self, scene: Scene, device: torch.device | str, dtype: torch.dtype) -> None:
        def tensor(values: Array) -> Tensor:
            return torch.tensor(values, device=device, dtype=dtype)

        if scene.terrain is None:
            raise ValueError(f"{scene.name} has no terrain")
        place, along, up = scene.root
        self._x0, self._along, self._up = float(place[0]), tensor(along), tensor(up)
        x, z = scene.terrain[..., 0], scene.terrain[..., 1]
        run = np.diff(x)
        slope = np.divide(np.diff(z), run, out=np.zeros_like(run), where=run > 0)  # of a wall nobody asks
        self._profiles = tensor(np.stack([x[:, :-1], z[:, :-1], slope]))  # (3, M, K - 1)

    def at(self, x: Tensor) -> Tensor:
        """z (..., N, L) [m] of the terrain at x (..., N, L) [m] of N environments, of any number if one serves all."""
        start, level, slope = self._below(x)
        return level + slope * (x - start)

    def height(self, qpos: Tensor) -> Tensor:
        """z (...) [m] of the terrain at the root's x, of qpos (..., nq).

        The dimension before the last of qpos is that of the environments, unless one terrain serves all.
        """
        return self.at(self._root(qpos)).squeeze(-1)

    def gradient(self, qpos: Tensor) -> Tensor:
        """(..., nq, nq) by which qpos (..., nq) of the root's `lift` changes beside itself; walls do not count."""
        return self._below(self._root(qpos))[2].unsqueeze(-1) * torch.outer(self._up, self._along)

    def _root(self, qpos: Tensor) -> Tensor:
        """x (..., 1) of the root."""
        return (self._x0 + qpos @ self._along).unsqueeze(-1)

    def _below(self, x: Tensor) -> tuple[Tensor, ...]:
        """(..., N, L) each: where the segment below begins, its height there, its slope."""
        profiles = self._profiles
        if profiles.shape[1] == 1:
            profiles = profiles[:, 0]
        segment = ((x.unsqueeze(-1) >= profiles[0].unsqueeze(-2)).sum(-1) - 1).clamp(min=0)
        return tuple(p.expand(*x.shape[:-1], -1).gather(-1, segment) for p in profiles)

    def lift(self, qpos: Tensor) -> Tensor:
        """World qpos (..., nq) of one over the plane."""
        return qpos + self.height(qpos).unsqueeze(-1) * self._up

    def lower(self, qpos: Tensor) -> Tensor:
        """qpos (..., nq) over the plane of one in the world."""
        return qpos - self.height(qpos).unsqueeze(-1) * self._up
