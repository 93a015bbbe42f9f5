"""Types of flags that name the allowed values."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import torch

from diffsim.training.errors import fail

LARGEST = torch.finfo(torch.float32).max


@dataclass(frozen=True)
class Range:
    """Which values of a flag are allowed."""

    words: str
    holds: Callable[[Any], bool]
    minus_infinity: bool = False  # allowed

    def complaint(self, value: Any) -> str | None:
        if self.minus_infinity and value == -math.inf:
            return None
        if isinstance(value, float) and not abs(value) <= LARGEST:
            return f"must be finite{' in single precision' if math.isfinite(value) else ''}, not {value}"
        return None if self.holds(value) else f"must be {self.words}, not {value}"


def _whole(least: int, most: int) -> Range:
    return Range(f"from {least} to {most:,}", lambda value: least <= value <= most)


Count = Annotated[int, _whole(1, 10**9)]
Natural = Annotated[int, _whole(0, 10**9)]
Batch = Annotated[int, _whole(1, 10**6)]  # samples drawn at once
UpTo10k = Annotated[int, _whole(1, 10_000)]
UpTo1000 = Annotated[int, _whole(1, 1_000)]
AtLeast2 = Annotated[int, _whole(2, 1_000)]
Width = Annotated[int, _whole(1, 16_384)]
Finite = Annotated[float, Range("finite", math.isfinite)]
LogStd = Annotated[float, Range("finite or -inf", math.isfinite, minus_infinity=True)]
Positive = Annotated[float, Range("positive", lambda value: value > 0)]
NonNegative = Annotated[float, Range("at least 0", lambda value: value >= 0)]
Fraction = Annotated[float, Range("in [0, 1]", lambda value: 0 <= value <= 1)]
Decay = Annotated[float, Range("in [0, 1)", lambda value: 0 <= value < 1)]
ORDERED = Range("two numbers, the first not above the second", lambda value: value[0] <= value[1])
Bounds = Annotated[tuple[Positive, Positive], ORDERED]
Widths = tuple[Width, ...]
SomeWidths = Annotated[Widths, Range("at least one number", lambda value: len(value) > 0)]


def flag(name: str) -> str:
    """The command line's name of a field."""
    return "--" + name.replace("_", "-")


def check_ranges(args: object) -> None:
    """Raise a ValueError where a value of a dataclass of flags is not what its type asks for."""
    for name, hint in get_type_hints(type(args), include_extras=True).items():
        for value, allowed in _ranges(hint, getattr(args, name, None)):
            if complaint := allowed.complaint(value):
                fail(f"{flag(name)} {complaint}")


def _ranges(hint: Any, value: Any) -> list[tuple[Any, Range]]:
    """A value, and those inside a tuple, each with what it may be."""
    found = [(value, marker) for marker in getattr(hint, "__metadata__", ()) if isinstance(marker, Range)]
    hint = hint.__origin__ if hasattr(hint, "__metadata__") else hint
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        kinds = kinds[:1] * len(value) if kinds[-1] is Ellipsis else kinds
        found += [part for kind, number in zip(kinds, value, strict=True) for part in _ranges(kind, number)]
    return found
