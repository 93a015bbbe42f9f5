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

from diffsim.robot.types import Array

MOST_SEGMENTS = 10_000  # of rough ground
STEEPEST = 45.0  # degrees, of uneven ground that robots are put on
SEGMENT, LENGTH, LEVEL = 0.4, 30.0, 0.5  # m, of uneven ground: its segments, its sides, its level middle


def incline(degrees: float, start: float = 1.0) -> Array:
    """Make an endless slope (3, 2) of -90 to 90 degrees, upward if positive."""
    return np.array([[start - 1.0, 0.0], [start, 0.0], [start + 1.0, _slope(degrees)]])


def step(height: float, start: float = 1.0) -> Array:
    """Make a wall (4, 2) of this height [m], not 0, at x = start, upward if positive; level before and after."""
    if not 0 < abs(height) < math.inf:
        raise ValueError(f"height is {height!r}, must be finite and not 0")
    return np.array([[start - 1.0, 0.0], [start, 0.0], [start, height], [start + 1.0, height]], np.float64)


def rough(seed: int, segment: float = 1.0, degrees: float = 10.0, length: float = 50.0, start: float = 1.0) -> Array:
    """Make segments (K, 2) of random slope, then level ground; K = 3 + length / segment, rounded.

    Example:
        from diffsim_robots.terrain import rough
        env = diffsim.make("hopper", num_envs=16, terrain=rough(seed=1))

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
    """Make profiles (count, K, 2) of ground that is rough before and behind the robot, the same ones for a seed.

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
