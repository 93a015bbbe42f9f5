"""Take the numbers of iterations while the device works, and write them when it has finished."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.training import distributed
from diffsim.training.clock import Clock, Spans
from diffsim.training.log import ProgressLog, say
from diffsim.training.signals import Signals

TOTALS = ("nonfinite", "nonfinite_gradients")  # of env.take_statistics, logged as running totals sim/...
REPORTED = {  # totals that are reported each time they double
    "grad/skipped": "updates skipped so far because of their gradients: {:.0f}; if many, shorten --horizon",
    "sim/unconverged": "control steps so far in which Newton's method did not converge: {:.0f}; give more --substeps",
}
WRITE_EVERY = 10  # a GPU's iterations are written in batches of this many, so that the host rarely waits


class EpisodeStatistics:
    """Mean return and length of the last finished episodes: of the newest rollouts that hold a hundred of them."""

    def __init__(self) -> None:
        self.rollouts: deque[tuple[float, float, float]] = deque()  # episodes finished, sums of return and of length

    def add(self, count: float, total_return: float, total_length: float) -> None:
        if count > 0:
            self.rollouts.append((count, total_return, total_length))
        while len(self.rollouts) > 1 and sum(rollout[0] for rollout in self.rollouts) - self.rollouts[0][0] >= 100:
            self.rollouts.popleft()

    def means(self) -> tuple[float, float]:
        """Return both, once an episode has ended."""
        count, total_return, total_length = (sum(column) for column in zip(*self.rollouts, strict=True))
        return total_return / count, total_length / count


@dataclass
class Record:
    """An iteration that is not written yet: the device may still work on it."""

    iteration: int
    control_steps: int  # that it took
    names: list[str]
    numbers: Tensor  # of the names, then how many signals have arrived
    scalars: dict[str, float]  # that are known already
    spans: Spans


class Recorder:
    """Keeps the numbers of a run.

    Args:
        device: whose work the numbers come from.
        signals: a record tells how many had arrived when it was taken; so all ranks learn of them together.
        quiet: print no messages.

    Attributes:
        log: where records are written; None on all ranks except the first.
        seconds, control_steps: of all iterations that were written.
        totals, episodes: their running totals, and their newest episodes.
        scalars: of the iteration that was written last.
    """

    def __init__(self, device: torch.device, signals: Signals, quiet: bool) -> None:
        self.clock, self.signals, self.quiet = Clock(device), signals, quiet
        self.log: ProgressLog | None = None
        self.seconds, self.control_steps = 0.0, 0
        self.totals, self.episodes = {f"sim/{name}": 0 for name in TOTALS}, EpisodeStatistics()
        self.scalars: dict[str, float] = {}
        self._records: list[Record] = []
        self._reported = dict.fromkeys(REPORTED, 0.0)

    def take(
        self, iteration: int, control_steps: int, metrics: Mapping[str, Tensor | float], env: DiffEnv | None
    ) -> None:
        """Take an iteration's metrics and those of its environment's episodes; never waits for the device."""
        tensors = {name: value.detach() for name, value in metrics.items() if isinstance(value, Tensor)}
        scalars = {name: float(value) for name, value in metrics.items() if not isinstance(value, Tensor)}
        if env is not None:
            tensors |= env.take_statistics()
        arrived = torch.full((), float(len(self.signals.received)), device=self.clock.device)
        numbers = distributed.average(torch.stack([*tensors.values(), arrived]))
        self._records.append(Record(iteration, control_steps, list(tensors), numbers, scalars, self.clock.lap()))

    @property
    def newest(self) -> Record:
        """The iteration that was taken last, before it is written."""
        return self._records[-1]

    @property
    def is_full(self) -> bool:
        """Whether to write now, although the device may have work left. Several ranks must agree on it."""
        interrupted = bool(self.signals.received) and distributed.size() == 1
        return self.clock.device.type == "cpu" or interrupted or len(self._records) >= WRITE_EVERY

    def write(self) -> bool:
        """Wait until the device has finished what was taken, and write it.

        Returns:
            whether a signal had arrived.

        Raises:
            FloatingPointError: a reward was not finite.
            OSError: the files cannot be written.
        """
        arrived = [self._write(record) for record in self._records]
        self._records.clear()
        return any(arrived)

    def _write(self, record: Record) -> bool:
        *numbers, arrived = record.numbers.tolist()  # waits
        times = {name: end.since(begin) for name, (begin, end) in record.spans.items()}
        self.seconds += times["time/total"]
        self.control_steps += record.control_steps
        scalars = dict(zip(record.names, numbers, strict=True)) | record.scalars | times
        if "episodes" in scalars:
            self._count(scalars)
        scalars["charts/SPS"] = record.control_steps / times["time/total"]
        self.scalars = scalars
        for name, text in REPORTED.items():
            if (total := scalars.get(name, 0.0)) > 2 * self._reported[name]:
                self._reported[name] = total
                self.message(f"iteration {record.iteration}: {text.format(total)}")
        if self.log is not None:
            self.log.write(record.iteration, self.control_steps, self.seconds, scalars)
        return arrived > 0

    def _count(self, scalars: dict[str, float]) -> None:
        """Replace an environment's statistics, means over the ranks, by those that are logged."""
        if not math.isfinite(scalars["return"]):
            raise FloatingPointError("a reward is not finite")
        ranks = distributed.size()
        self.episodes.add(*(ranks * scalars.pop(name) for name in ("episodes", "return", "length")))
        for name in (*TOTALS, *({"unconverged"} & scalars.keys())):
            self.totals[f"sim/{name}"] = self.totals.get(f"sim/{name}", 0) + round(ranks * scalars.pop(name))
        scalars |= self.totals
        if self.episodes.rollouts:
            scalars["charts/episodic_return"], scalars["charts/episodic_length"] = self.episodes.means()

    def message(self, text: object) -> None:
        """Print a line, unless quiet."""
        if not self.quiet:
            say(text)

    def state_dict(self) -> dict[str, Any]:
        """Return what continues the counts; part of a checkpoint."""
        counted = dict(control_steps=self.control_steps, seconds=self.seconds, totals=self.totals)
        return counted | {"episodes": list(self.episodes.rollouts)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.control_steps, self.seconds = state["control_steps"], state["seconds"]
        self.totals |= state["totals"]
        self.episodes.rollouts.extend(state["episodes"])
