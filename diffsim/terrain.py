"""Terrain: profiles z(x) to walk over, and the heights of robots above them.

A profile is an array (K, 2) of vertices (x, z) [m] in the world, joined by straight segments of which the first and the
last go on for ever. It is the same at every y. Scene.with_terrain and diffsim.make(..., terrain=profile) take one for
all environments or, stacked to (num_envs, K, 2), one for each:

    env = diffsim.make("walker", num_envs=8, terrain=np.stack([rough(seed) for seed in range(8)]))

All functions here leave the ground at z = 0 up to x = `start`, so that a robot can start at x = 0.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from diffsim.sim.integration import is_real

if TYPE_CHECKING:
    from diffsim.robot.scene import Scene

Array = NDArray[np.float64]

DRAWN_END, DRAWN_SIZE = 50.0, (5.0, 0.05)  # m: of an endless segment; half width and half thickness of all


class TerrainError(ValueError):
    """A terrain that cannot be made of its name, or not for a robot."""


def incline(degrees: float, start: float = 1.0) -> Array:
    """(3, 2) a slope without end, upward if positive, from x = start [m].

    Raises:
        ValueError: a slope that is not within -90 and 90 degrees, or start not finite.
    """
    slope = _slope("degrees", degrees)
    return _profile(start, [1.0], [slope])


def step(height: float, start: float = 1.0) -> Array:
    """(4, 2) a wall of this height [m] at x = start [m], upward if positive; level before and after.

    Raises:
        ValueError: an argument that is not finite, or no height.
    """
    if not _finite(height) or height == 0:
        raise ValueError(f"height is {height!r}, must be finite and not 0")
    profile = _profile(start, [0.0, 1.0], [0.0, 0.0])
    profile[2:, 1] = height
    return profile


def rough(seed: int, segment: float = 1.0, degrees: float = 10.0, length: float = 50.0, start: float = 1.0) -> Array:
    """(K, 2) segments of random slope from x = start, then level; K = 3 + length / segment, rounded.

    Args:
        seed: of the slopes; each has another profile.
        segment: length of each segment along x [m].
        degrees: the steepest slope; they are uniform between it and its opposite.
        length: of all segments together, along x [m].
        start: where they begin [m].

    Raises:
        ValueError: lengths that are not positive and finite, less than one segment, or a slope of 90 degrees or more.
    """
    for name, value in (("segment", segment), ("length", length)):
        if not _finite(value) or value <= 0:
            raise ValueError(f"{name} is {value!r}, must be positive and finite")
    steepest, count = abs(_slope("degrees", degrees)), round(length / segment)
    if count < 1:
        raise ValueError(f"length is {length!r}, must be at least one segment of {segment!r}")
    angles = np.random.default_rng(seed).uniform(-1.0, 1.0, count) * math.atan(steepest)
    return _profile(start, [segment] * count + [1.0], [*np.tan(angles), 0.0])


def named_terrains(*names: str) -> Array:
    """(M, K, 2) profiles of M names, as flags of a command have them, K of the longest.

    A name is "level", "incline:DEGREES", "step:CENTIMETRES" or "rough:DEGREES". Further numbers after colons are
    `start` of the first two, and `segment`, `seed` (0) and `start` of rough ground.

    Raises:
        TerrainError: another name, a number too few or too many, or one that the function of that name refuses.
    """
    profiles = []
    for name in names:
        kind, *numbers = name.split(":")
        try:
            profiles.append(_MAKERS[kind](*map(float, numbers)))
        except (KeyError, TypeError) as error:
            usage = "incline:DEGREES[:START], step:CENTIMETRES[:START] or rough:DEGREES[:SEGMENT[:SEED[:START]]]"
            raise TerrainError(f"terrain {name!r} must be level, {usage}") from error
        except ValueError as error:
            raise TerrainError(f"terrain {name!r}: {error}") from error
    most = max(map(len, profiles))
    for i, p in enumerate(profiles):  # the last segment goes on
        more = p[-1] + np.arange(1, most - len(p) + 1)[:, None] * (p[-1] - p[-2])
        profiles[i] = np.concatenate((p, more))
    return np.stack(profiles)


def random_terrain(kind: str, rng: torch.Generator) -> str:
    """The name of a terrain drawn from those of a kind, a name without place or seed, up to its size up and down.

    It begins between x = 0.5 and 1.5 m.

    Raises:
        TerrainError: level ground, a place or a seed, or what is no number.
    """
    name, *numbers = kind.split(":")
    if (name, len(numbers)) not in {("incline", 1), ("step", 1), ("rough", 1), ("rough", 2)}:
        usage = "incline:DEGREES, step:CENTIMETRES or rough:DEGREES[:SEGMENT]"
        raise TerrainError(f"kind of terrain {kind!r} must be {usage}")
    try:
        most, *_ = map(float, numbers)
    except ValueError as error:
        raise TerrainError(f"kind of terrain {kind!r}: {error}") from error
    size, place = torch.rand(2, generator=rng, dtype=torch.float64).tolist()
    if name == "rough":
        seed = int(torch.randint(2**31, (1,), generator=rng))
        return ":".join((name, *numbers, *["1"] * (2 - len(numbers)), f"{seed}", f"{0.5 + place:.4f}"))
    return f"{name}:{(2 * size - 1) * most:.6g}:{0.5 + place:.4f}"


def check_terrain(vertices: ArrayLike) -> Array:
    """(M, K, 2) float64, M = 1 of a single profile; raises ValueError as Scene.with_terrain does."""
    try:
        profiles = np.array(vertices, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError("terrain must be numbers in an array (K, 2) or (environments, K, 2)") from error
    shape = profiles.shape
    if profiles.ndim == 2:
        profiles = profiles[None]
    if profiles.ndim != 3 or profiles.shape[2] != 2 or profiles.shape[1] < 2 or not len(profiles):
        raise ValueError(f"terrain has shape {shape}, must be (K, 2) or (environments, K, 2) with K of 2 or more")
    x, z = profiles[..., 0], profiles[..., 1]
    run, flat = np.diff(x), np.diff(x) == 0
    ends = np.zeros_like(flat)
    ends[:, [0, -1]] = True
    twice = flat & np.pad(flat, ((0, 0), (1, 0)))[:, :-1]
    for wrong, why in (
        (~(np.abs(profiles) <= np.finfo(np.float32).max).all(2), "is not finite"),
        (run < 0, "has a larger x than the next one; x must ascend"),
        (flat & (np.diff(z) == 0), "equals the next one"),
        (flat & ends, "begins a wall at an end of the terrain, where it would go on for ever"),
        (twice, "ends one wall and begins another; two vertices may share an x, not three"),
    ):
        if wrong.any():
            row, vertex = np.argwhere(wrong)[0]
            where = f" of environment {row}" if len(profiles) > 1 else ""
            raise ValueError(f"terrain: vertex {vertex}{where} ({x[row, vertex]:g}, {z[row, vertex]:g}) {why}")
    return profiles


class Slab(NamedTuple):
    """A box that shows a segment: half sizes (3,), centre (3,), rotation (3, 3) with the normal as third column."""

    size: Array
    centre: Array
    rotation: Array


def slabs(profile: Array) -> list[Slab]:
    """What is drawn of a profile (K, 2): each segment is the upper face of a box, the first and the last a long one."""
    result = []
    for k, (start, end) in enumerate(itertools.pairwise(profile)):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        if k == 0:
            start, length = start - DRAWN_END * along, length + DRAWN_END
        if k == len(profile) - 2:
            length += DRAWN_END
        t, n = np.array([along[0], 0.0, along[1]]), np.array([-along[1], 0.0, along[0]])
        size = np.array([length / 2, *DRAWN_SIZE])
        centre = np.array([start[0], 0.0, start[1]]) + size[0] * t - size[2] * n
        result.append(Slab(size, centre, np.stack([t, [0.0, 1.0, 0.0], n], 1)))
    return result


class Elevation:
    """Carries a task, which knows a plane at z = 0 only, to a terrain and back: by the height of the ground below.

    The root is raised by the terrain's z at the root's own x. A robot whose root cannot be raised stays where it is.

    Args:
        scene: with a terrain.
        device, dtype: of the tensors.
    """

    def __init__(self, scene: Scene, device: torch.device | str, dtype: torch.dtype) -> None:
        def tensor(values: Array) -> Tensor:
            return torch.tensor(values, device=device, dtype=dtype)

        if scene.terrain is None:
            raise ValueError(f"{scene.name} has no terrain")
        place, along, up = root(scene)
        self._x0, self._along, self._up = place, tensor(along), tensor(up)
        x, z = scene.terrain[..., 0], scene.terrain[..., 1]
        run = np.diff(x)
        slope = np.divide(np.diff(z), run, out=np.zeros_like(run), where=run > 0)  # of a wall nobody asks
        self._profiles = tensor(np.stack([x[:, :-1], z[:, :-1], slope]))  # (3, M, K - 1)

    def height(self, qpos: Tensor, rows: Tensor | None = None) -> Tensor:
        """z (...) [m] of the terrain at the root's x, of qpos (..., nq).

        The dimension before the last of qpos is that of the environments, all or those of rows (k,), unless one
        terrain serves all.
        """
        x, (start, level, slope) = self._below(qpos, rows)
        return (level + slope * (x - start)).squeeze(-1)

    def gradient(self, qpos: Tensor) -> Tensor:
        """(..., nq, nq) by which qpos (..., nq) of the root's `lift` changes beside itself; walls do not count."""
        return self._below(qpos, None)[1][2].unsqueeze(-1) * torch.outer(self._up, self._along)

    def _below(self, qpos: Tensor, rows: Tensor | None) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The root's x (..., 1), and (..., 1) each: where the segment below begins, its height there, its slope."""
        profiles = self._profiles
        if profiles.shape[1] == 1:
            profiles = profiles[:, 0]
        elif rows is not None:
            profiles = profiles[:, rows]
        x = (self._x0 + qpos @ self._along).unsqueeze(-1)
        segment = ((x >= profiles[0]).sum(-1, keepdim=True) - 1).clamp(min=0)
        return x, tuple(p.expand(*x.shape[:-1], -1).gather(-1, segment) for p in profiles)

    def lift(self, qpos: Tensor, rows: Tensor | None = None) -> Tensor:
        """World qpos (..., nq) of one over the plane."""
        return qpos + self.height(qpos, rows).unsqueeze(-1) * self._up

    def lower(self, qpos: Tensor) -> Tensor:
        """qpos (..., nq) over the plane of one in the world."""
        return qpos - self.height(qpos).unsqueeze(-1) * self._up


def root(scene: Scene) -> tuple[float, Array, Array]:
    """x0, along (nq,) and up (nq,): the root's x is x0 + along . qpos, and qpos + up is one metre higher."""
    along, up, place, frame = np.zeros(scene.nq), np.zeros(scene.nq), np.zeros(3), np.eye(3)
    if scene.floating:
        along[0] = up[2] = 1.0
    for link in range(1, scene.carrier + 1):  # slides, which turn nothing
        place += frame @ (scene.position[link] - scene.joint_ref[link] * scene.rotation[link] @ scene.axis[link])
        frame = frame @ scene.rotation[link]
        axis = frame @ scene.axis[link]
        along[link - 1] = axis[0]
        if abs(axis[2]) > 1 - 1e-9:
            up[link - 1] = np.sign(axis[2])
    return float(place[0]), along, up


_MAKERS: dict[str, Callable[..., Array]] = {
    "level": lambda: incline(0.0),
    "incline": incline,
    "step": lambda height, start=1.0: step(height / 100, start),
    "rough": lambda degrees, segment=1.0, seed=0.0, start=1.0: rough(int(seed), segment, degrees, start=start),
}


def _profile(start: float, runs: list[float], slopes: list[float]) -> Array:
    """Level before x = start, where z = 0; then segments of these lengths along x and these slopes."""
    if not _finite(start):
        raise ValueError(f"start is {start!r}, must be finite")
    rises = np.multiply(runs, slopes)
    x, z = (np.concatenate([[0.0, 0.0], np.cumsum(steps)]) for steps in (runs, rises))
    x[0] = -1.0
    return np.stack([start + x, z], 1)


def _slope(name: str, degrees: float) -> float:
    if not _finite(degrees) or not -90 < degrees < 90:
        raise ValueError(f"{name} is {degrees!r}, must lie between -90 and 90")
    return math.tan(math.radians(degrees))


def _finite(value: object) -> bool:
    return is_real(value) and math.isfinite(value)  # type: ignore[arg-type]
