"""Terrains by their names, as the flags of commands have them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from diffsim.robot.scene import Array, TerrainError
from diffsim.terrain import incline, rough, step

MAKERS: dict[str, Callable[..., Array]] = {
    "level": lambda: incline(0.0),
    "incline": incline,
    "step": lambda height, start=1.0: step(height / 100, start),
    "rough": lambda degrees, segment=1.0, seed=0.0, start=1.0: rough(seed, segment, degrees, start=start),
}


def named_terrains(*names: str) -> Array:
    """(M, K, 2) profiles of M names, as flags of a command have them, K of the longest.

    A name is "level", "incline:DEGREES", "step:CENTIMETRES" or "rough:DEGREES". Further numbers after colons are
    `start` of the first two, and `segment`, `seed` (0) and `start` of rough ground.

    Raises:
        TerrainError: no name or another one, a number too few or too many, or one that its function refuses.
    """
    usage = "level, incline:DEGREES[:START], step:CENTIMETRES[:START] or rough:DEGREES[:SEGMENT[:SEED[:START]]]"
    if not names:
        raise TerrainError(f"a terrain is missing: {usage}")
    profiles = []
    for name in names:
        kind, *numbers = name.split(":")
        try:
            profiles.append(_make(f"terrain {name!r}", kind, numbers))
        except (KeyError, TypeError) as error:
            raise TerrainError(f"terrain {name!r} must be {usage}") from error
    most = max(map(len, profiles))
    for i, p in enumerate(profiles):  # the last segment goes on
        more = p[-1] + np.arange(1, most - len(p) + 1)[:, None] * (p[-1] - p[-2])
        profiles[i] = np.concatenate((p, more))
    return np.stack(profiles)


def random_terrain(kind: str, rng: torch.Generator) -> str:
    """The name of a terrain drawn from those of a kind, a name without place or seed, up to its size up and down.

    It begins between x = 0.5 and 1.5 m.

    Raises:
        TerrainError: level ground, a place or a seed, what is no number, or a size that no terrain can have.
    """
    name, *numbers = kind.split(":")
    if (name, len(numbers)) not in {("incline", 1), ("step", 1), ("rough", 1), ("rough", 2)}:
        usage = "incline:DEGREES, step:CENTIMETRES or rough:DEGREES[:SEGMENT]"
        raise TerrainError(f"kind of terrain {kind!r} must be {usage}")
    _make(f"kind of terrain {kind!r}", name, numbers)  # the steepest or highest one
    size, place = torch.rand(2, generator=rng, dtype=torch.float64).tolist()
    if name == "rough":
        seed = int(torch.randint(2**31, (1,), generator=rng))
        return ":".join((name, *numbers, *["1"] * (2 - len(numbers)), f"{seed}", f"{0.5 + place:.4f}"))
    return f"{name}:{(2 * size - 1) * float(numbers[0]):.6g}:{0.5 + place:.4f}"


def _make(what: str, kind: str, numbers: Sequence[str]) -> Array:
    try:
        return MAKERS[kind](*map(float, numbers))
    except ValueError as error:
        raise TerrainError(f"{what}: {error}") from error
