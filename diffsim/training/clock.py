"""Time the parts of an iteration on a device, without waiting for it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch


class Mark:
    """A moment in a device's work, which goes on."""

    def __init__(self, device: torch.device) -> None:
        self.time, self.event = time.perf_counter(), None
        if device.type == "cuda":
            self.event = torch.cuda.Event(enable_timing=True)
            self.event.record(torch.cuda.current_stream(device))

    def since(self, earlier: Mark) -> float:
        """Return the seconds from an earlier mark to this one, whose work is done."""
        if self.event is not None and earlier.event is not None:
            return earlier.event.elapsed_time(self.event) / 1e3
        return self.time - earlier.time


Spans = dict[str, tuple[Mark, Mark]]  # begin and end, by name


class Clock:
    """Marks where iterations and their parts begin and end."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._begin, self._parts = Mark(device), Spans()

    def restart(self) -> None:
        """Begin the iteration here: what came since the last lap counts for none."""
        self._begin = Mark(self.device)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Around a part of an iteration; one that raises is not counted."""
        begin = Mark(self.device)
        yield
        self._parts[f"time/{name}"] = begin, Mark(self.device)

    def lap(self) -> Spans:
        """End the iteration and begin the next one; return its parts, and its whole as time/total."""
        end = Mark(self.device)
        spans = self._parts | {"time/total": (self._begin, end)}
        self._begin, self._parts = end, {}
        return spans
