"""What a run logs: its arguments, progress.csv, tensorboard and a progress bar."""

from __future__ import annotations

import csv
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

# The first columns of every progress.csv.
COLUMNS = ("iteration", "control_steps", "seconds", "return", "length", "eval_return", "eval_length", "eval_speed")


class ProgressFile:
    """progress.csv: a row per iteration, a column per scalar. Columns may join later; older rows leave them empty.

    A resumed run goes on after its iteration, and rows of later ones are dropped; iteration 0 begins a new file.
    """

    def __init__(self, path: Path, iteration: int) -> None:
        self.path, self.columns = path, list(COLUMNS)
        self._replace(iteration)

    def write(self, row: Mapping[str, float]) -> None:
        new = [name for name in row if name not in self.columns]
        if new or not self.path.is_file():  # someone may have moved it
            self._replace(math.inf, new)
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, self.columns, restval="").writerow(row)

    def _replace(self, last: float, new: Sequence[str] = ()) -> None:
        """Replace the file in one step: its rows up to an iteration, with new columns.

        A crash may have left rows of later iterations, and half of a line.
        """
        rows = list[dict[str, str]]()
        if last > 0 and self.path.is_file():
            with self.path.open(newline="") as file:
                reader = csv.DictReader(file)
                self.columns = list(reader.fieldnames or COLUMNS)
                rows = [row for row in reader if None not in row.values() and int(row["iteration"]) <= last]
        self.columns += new
        temporary = self.path.with_suffix(".csv.tmp")
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.columns, restval="")
            writer.writeheader()
            writer.writerows(rows)
        os.replace(temporary, self.path)


def column(scalar: str) -> str:
    """The column of progress.csv for a scalar of tensorboard: eval/return -> eval_return."""
    return scalar.removeprefix("charts/episodic_").replace("/", "_")


class Screen:
    """Stdout for as long as someone reads it; what trains goes on without."""

    def write(self, text: str) -> None:
        with suppress(OSError):
            print(text, end="", flush=True)

    def flush(self) -> None:
        """`write` does it."""


SCREEN = Screen()


def say(text: object) -> None:
    """Print a line, above the progress bar if there is one."""
    tqdm.write(str(text), file=SCREEN)


class ProgressLog:
    """The four of them for one run. A resumed run goes on after iteration and control_steps, which are 0 otherwise."""

    def __init__(
        self, directory: Path, iteration: int, control_steps: int, args: Mapping[str, object], total: int, quiet: bool
    ) -> None:
        (directory / "args.json").write_text(json.dumps(args, indent=2, default=str) + "\n")
        self.file = ProgressFile(directory / "progress.csv", iteration)
        self.tensorboard = SummaryWriter(str(directory), purge_step=control_steps + 1 if iteration else None)
        table = "\n".join(f"|{name}|{value}|" for name, value in args.items())
        self.tensorboard.add_text("hyperparameters", f"|name|value|\n|-|-|\n{table}")
        self.total, self.quiet = total, quiet
        self.bar: tqdm[NoReturn] | None = None

    def write(self, iteration: int, control_steps: int, seconds: float, scalars: Mapping[str, float]) -> None:
        self.file.path.parent.mkdir(parents=True, exist_ok=True)  # someone may have moved it
        for key, value in scalars.items():
            self.tensorboard.add_scalar(key, value, control_steps)
        row = {"iteration": iteration, "control_steps": control_steps, "seconds": round(seconds, 3)}
        self.file.write(row | {column(key): float(f"{value:.7g}") for key, value in scalars.items()})
        if self.quiet:
            return
        if self.bar is None:  # after the first iteration, which compiled and says nothing about the rest
            interval = 0.1 if sys.stdout is not None and sys.stdout.isatty() else 10.0
            self.bar = tqdm(total=self.total, initial=iteration, file=SCREEN, mininterval=interval, ncols=100)
        self.bar.update(iteration - self.bar.n)
        if "charts/episodic_return" in scalars:
            self.bar.set_postfix_str(f"return {scalars['charts/episodic_return']:.1f}", refresh=False)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()
        self.tensorboard.close()
