"""What surrounds every learner: a run's directory, its checkpoint and logs, its progress line, its end by a signal."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import signal
import sys
import tempfile
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from statistics import median
from typing import IO, Any, NoReturn, TypeVar

import torch
import tyro
from torch.utils.tensorboard import SummaryWriter

from diffsim import distributed

Args = TypeVar("Args")


def fail(message: object) -> NoReturn:
    """End the script, for a mistake of its user: one line, exit code 2."""
    if distributed.rank() == 0:
        print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    sys.exit(2)


def flag(name: str) -> str:
    """The command line's name of a field of Args."""
    return "--" + name.replace("_", "-")


def load_checkpoint(path: Path, kind: str) -> dict[str, Any]:
    """The checkpoint that `Run.save` wrote for this kind of learner; anything else ends the script."""
    if not path.is_file():
        fail(f"no such checkpoint: {path}")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
        if checkpoint["format"] == kind:
            return checkpoint
    except Exception:  # torch.load raises whatever broken bytes lead it to
        pass
    fail(f"{path} is not a whole checkpoint of {kind.partition('-')[0]}.py")


def read_arguments(
    kind: type[Args], argv: list[str] | None, description: str, form: str, fixed: Sequence[str], tasks: Collection[str]
) -> tuple[Args, dict[str, Any] | None]:
    """The command line over the defaults or, with --resume and --evaluate, over the arguments that a checkpoint holds.

    Args:
        kind: dataclass of the arguments.
        argv: None: of the process.
        description: what --help says first.
        form: of the checkpoints, see load_checkpoint.
        fixed: arguments that a checkpoint decides.
        tasks: names that --env may have.

    Returns:
        The arguments, device included, and the checkpoint, if any. Anything wrong ends the script.
    """
    args: Any = tyro.cli(kind, args=argv, description=description)
    checkpoint = None
    if args.resume and args.evaluate:
        fail("--resume and --evaluate exclude each other")
    if path := args.resume or args.evaluate:
        checkpoint = load_checkpoint(path, form)
        saved: Any = kind(**checkpoint["args"])
        if args.evaluate:
            saved.device = None  # wherever it was trained
        if args.accuracy:  # a preset on the command line replaces the saved numbers, its own or given one by one
            saved.substeps = saved.integrator = None
        args = tyro.cli(kind, args=argv, description=description, default=saved)
        for name in fixed:
            if getattr(args, name) != getattr(saved, name):
                fail(f"{path} has {flag(name)} {getattr(saved, name)}, not {getattr(args, name)}")
    if args.resume and checkpoint:
        if checkpoint["iteration"] >= min(args.iterations, args.stop_after or args.iterations):
            fail(f"{path} is at iteration {checkpoint['iteration']} already: give more --iterations or --stop-after")
        if (ranks := len(checkpoint.get("ranks", [None]))) != distributed.size():
            fail(f"{path} was trained by {ranks} processes, not {distributed.size()}")
        if args.device.partition(":")[0] != saved.device.partition(":")[0]:
            fail(f"{path} was trained on {saved.device}, which {args.device} cannot continue exactly")
    if args.env not in tasks:
        fail(f"unknown task {args.env!r}: choose from {', '.join(tasks)}")
    args.device = distributed.choose_device(args.device)
    return args, checkpoint


def constants(items: Sequence[str]) -> dict[str, float]:
    """Of the flag --penalty k_n=1e5 k_d=1e4: {"k_n": 1e5, "k_d": 1e4}; anything else ends the script."""
    try:
        return {name: float(value) for name, _, value in (item.partition("=") for item in items)}
    except ValueError:
        fail(f"--penalty takes pairs like k_n=1e5, not {' '.join(items)!r}")


class Mark:
    """A moment in a device's work; on a GPU it is not waited for until someone asks."""

    def __init__(self, device: torch.device) -> None:
        self.time, self.event = time.perf_counter(), None
        if device.type == "cuda":
            self.event = torch.cuda.Event(enable_timing=True)
            self.event.record(torch.cuda.current_stream(device))

    def wait(self) -> None:
        if self.event is not None:
            self.event.synchronize()

    def since(self, earlier: Mark) -> float:
        """Seconds from an earlier mark to this one, which must have been waited for."""
        if self.event is not None and earlier.event is not None:
            return earlier.event.elapsed_time(self.event) / 1e3
        return self.time - earlier.time


class Run:
    """One training run. Of several ranks only the first writes anything.

    Args:
        args: the script's arguments (a dataclass): env, seed, iterations, run_dir, resume, track and quiet are read
            here, all are logged.
        name: of the algorithm.
        columns: {scalar of tensorboard: column of progress.csv}, beside iteration, control_steps and seconds.

    Attributes:
        directory: where it writes: args.run_dir, or the resumed checkpoint's, or runs/{env}__{name}__{seed}__{time}.
        signals: those (SIGINT, SIGTERM) received while it was open. The learner is to save and stop; the same signal
            a second time has its usual effect.
    """

    def __init__(self, args: Any, name: str, columns: Mapping[str, str]) -> None:
        self.args, self.columns, self.writes = args, columns, distributed.rank() == 0
        default = Path("runs") / f"{args.env}__{name}__{args.seed}__{int(time.time())}"
        self.directory: Path = args.run_dir or (args.resume.parent if args.resume else default)
        self.signals: list[int] = []
        if self.writes:
            self._check()

    def _check(self) -> None:
        """That a run can be written there; leaves nothing behind."""
        path, args = self.directory, self.args
        checkpoint = path / "checkpoint.pt"
        if checkpoint.exists() and (args.resume is None or not args.resume.samefile(checkpoint)):
            fail(f"{path} holds another run's checkpoint.pt: --resume it, or choose another --run-dir")
        existing = next(p for p in (path, *path.absolute().parents) if p.exists())
        try:
            tempfile.TemporaryFile(dir=existing).close()
        except OSError as error:
            fail(f"cannot write to run directory {path}: {error.strerror}")
        if args.track:
            try:
                import wandb  # noqa: F401
            except ImportError:
                fail("--track needs Weights & Biases: pip install wandb")

    def open(self, iteration: int, control_steps: int) -> None:
        """Begin to write, after the given iteration of a resumed run (0: from the start), and to heed signals."""
        self._handlers: dict[int, Any] = {}
        for number in (signal.SIGINT, signal.SIGTERM):
            self._handlers[number] = signal.signal(number, self._receive)
        self._durations: deque[float] = deque(maxlen=50)
        self._shown = 0.0
        if not self.writes:
            return
        self.directory.mkdir(parents=True, exist_ok=True)
        arguments = dataclasses.asdict(self.args)
        (self.directory / "args.json").write_text(json.dumps(arguments, indent=2, default=str) + "\n")
        if self.args.track:
            import wandb

            options = dict(name=self.directory.name, dir=self.directory, config=arguments, sync_tensorboard=True)
            wandb.init(project="diffsim", **options)
        self._tensorboard = SummaryWriter(str(self.directory), purge_step=control_steps + 1 if iteration else None)
        table = "\n".join(f"|{name}|{value}|" for name, value in arguments.items())
        self._tensorboard.add_text("hyperparameters", f"|name|value|\n|-|-|\n{table}")
        self._file, self._progress = self._open_progress(iteration)

    def _open_progress(self, iteration: int) -> tuple[IO[str], csv.DictWriter[str]]:
        path, rows = self.directory / "progress.csv", []
        if iteration > 0 and path.is_file():
            with path.open(newline="") as file:
                rows = [row for row in csv.DictReader(file) if int(row["iteration"]) <= iteration]
        file = path.open("w", newline="")
        writer = csv.DictWriter(file, ["iteration", "control_steps", "seconds", *self.columns.values()])
        writer.writeheader()
        writer.writerows(rows)
        return file, writer

    def _receive(self, number: int, _frame: Any) -> None:
        self.signals.append(number)
        signal.signal(number, self._handlers[number])

    def log(self, iteration: int, control_steps: int, seconds: float, scalars: Mapping[str, float]) -> None:
        """Write an iteration's scalars; seconds are those of training up to it."""
        if not self.writes:
            return
        for key, value in scalars.items():
            self._tensorboard.add_scalar(key, value, control_steps)
        row: dict[str, float] = dict(iteration=iteration, control_steps=control_steps, seconds=round(seconds, 3))
        self._progress.writerow(
            row | {self.columns[key]: value for key, value in scalars.items() if key in self.columns}
        )
        self._file.flush()

    def show(self, iteration: int, duration: float, mean_return: float, last: bool) -> None:
        """The progress line, now and then: what it took since the last call, and what is left to do."""
        self._durations.append(duration)
        terminal = sys.stdout.isatty()
        first = len(self._durations) < 2  # it compiled, and says nothing about the rest
        if not last and (first or time.monotonic() - self._shown < (0.1 if terminal else 10.0)):
            return
        self._shown, rate = time.monotonic(), 1.0 / median(self._durations)
        total = self.args.iterations
        bar = f"{'#' * (20 * iteration // total):<20}"
        left = timedelta(seconds=round((total - iteration) / rate))
        self.print(
            f"[{bar}] {iteration}/{total}, return {mean_return:.1f}, {rate:.2f} it/s, {left} left",
            end="\r" if terminal and not last else "\n",
        )

    def print(self, text: str, end: str = "\n") -> None:
        if self.writes and not self.args.quiet:
            print(f"{text:<79}", end=end, flush=True)

    def save(self, checkpoint: dict[str, Any]) -> None:
        """Replace checkpoint.pt in one step: whoever reads it finds the old one or the new one, whole."""
        if self.writes:
            path = self.directory / "checkpoint.pt"
            torch.save(checkpoint, path.with_suffix(".tmp"))
            os.replace(path.with_suffix(".tmp"), path)

    def close(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self.writes:
            self._tensorboard.close()
            self._file.close()


class EpisodeStatistics:
    """Mean return and length of the last finished episodes: of the newest windows that hold a hundred of them."""

    def __init__(self) -> None:
        self.windows: deque[tuple[float, float, float]] = deque()  # episodes finished, sums of return and of length

    def add(self, count: float, total_return: float, total_length: float) -> None:
        if count > 0:
            self.windows.append((count, total_return, total_length))
        while len(self.windows) > 1 and sum(window[0] for window in self.windows) - self.windows[0][0] >= 100:
            self.windows.popleft()

    def means(self) -> tuple[float, float]:
        """NaN before the first episode's end."""
        if not self.windows:
            return math.nan, math.nan
        count, total_return, total_length = (sum(column) for column in zip(*self.windows, strict=True))
        return total_return / count, total_length / count
