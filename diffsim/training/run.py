"""One training run: its directory and schedule, its log, written without waiting for the device, its checkpoints."""

from __future__ import annotations

import dataclasses
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffsim.env import ActionError, DiffEnv
from diffsim.sim.options import check_device
from diffsim.training import checkpoint, distributed, graph
from diffsim.training.checkpoint import Learner
from diffsim.training.directory import EpisodeStatistics, Lock, ProgressLog, check_writable
from diffsim.training.errors import fail
from diffsim.training.evaluation import Evaluation, make_env, write_evaluation
from diffsim.training.flags import Flags, ParallelFlags
from diffsim.training.variation import Variation, parse_ranges

L = TypeVar("L", bound=Learner)
Metrics = dict[str, Tensor]

TOTALS = ("nonfinite", "nonfinite_gradients")  # of env.take_statistics, logged as running totals sim/...
REPORT_EVERY = 10.0  # s between lines about skipped updates
RANK_SEED = 1_000_003  # between the seeds of two ranks


def is_due(iteration: int, every: int) -> bool:
    return every > 0 and iteration % every == 0


class Mark:
    """A moment in a device's work; a GPU is not waited for until someone asks."""

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


Timing = tuple[str, Mark, Mark]  # name, begin, end


@dataclass
class Entry:
    """An iteration that is not written yet: the device may still work on it."""

    iteration: int
    steps: int  # control steps that it took
    names: list[str]
    numbers: Tensor  # of the names, then how many signals have arrived
    scalars: dict[str, float]  # that are known already
    begin: Mark
    end: Mark
    timings: list[Timing]
    evaluation: Evaluation | None = None


class Run:
    """Iterate over it: it yields the number of each iteration, and evaluates, saves and stops when due.

    `log` neither waits for the device nor writes: on a GPU an iteration is written while the next one is computed. Of
    several ranks only the first writes anything.

    The script's arguments must be complete. Random numbers are seeded by args.seed here.
    """

    simulator = checkpoint.HOME  # which its environments have

    def __init__(self, args: Flags) -> None:
        assert args.run_dir
        self.args, self.directory = args, args.run_dir
        self.writes = distributed.rank() == 0
        self._state = checkpoint.load(args.resume, args.script()) if args.resume else None
        self._lock = Lock()
        if self.writes:
            self._check_directory()
        try:
            self.device = check_device(args.device)
        except ValueError as error:
            fail(error)
        distributed.initialize(self.device)
        torch.set_num_threads(1)  # operations this small gain little from more; idle threads disturb the simulator's
        torch.manual_seed(args.seed)
        self.iteration, self.seconds, self.control_steps = 0, 0.0, 0
        self._saved = self._state["iteration"] if self._state else 0
        self.last = min(args.iterations, args.stop_after or args.iterations)
        self._totals, self._episodes = {f"sim/{name}": 0 for name in TOTALS}, EpisodeStatistics()
        self._env: DiffEnv | None = None
        self._variation: Variation | None = None
        self._samples = 0  # control steps of an iteration, of all ranks
        self._learner: Learner | None = None
        self._log: ProgressLog | None = None
        self._pending: Entry | None = None
        self._timings: list[Timing] = []
        self._evaluation: tuple[int, Evaluation] | None = None
        self._scalars: dict[str, float] = {}
        self._mark = Mark(self.device)
        self._signals: list[int] = []
        self._handlers: dict[int, Any] = {}
        self._stopping = False
        self._skipped = self._report = 0.0  # updates told to be skipped, when the next line may come [s]

    # Setting up ------------------------------------------------------------------------------------------------------

    def make_env(self, num_envs: int, horizon: int) -> DiffEnv:
        """This rank's share of the training environments, with its own random start states."""
        self._samples = num_envs * horizon
        seed = self.args.seed + distributed.rank() * RANK_SEED
        args, size = self.args, num_envs // distributed.size()
        if args.eval_episodes > size:
            self.eval_env.detach()  # makes them now: an error of what does not fit should not wait
        if not isinstance(args, ParallelFlags) or not args.randomise:
            self._env = make_env(args, size, horizon, seed)
            return self._env
        self._env = make_env(args, size, horizon, seed, factors=True)
        self._variation = Variation(self._env, parse_ranges(args.randomise), args.redraw, seed)
        return self._env

    @cached_property
    def eval_env(self) -> DiffEnv:
        """The environments of evaluations, made when they are first needed."""
        return make_env(self.args, self.args.eval_episodes)

    def restore(self, learner: L) -> L:
        """Register the learner, which checkpoints hold from now on, and continue it if the run is resumed.

        All ranks start with equal weights; from here on they draw different random numbers.
        """
        self._learner, rank = learner, distributed.rank()
        if rank > 0:
            torch.manual_seed(self.args.seed + rank * RANK_SEED)
        if state := self._state:
            own = state["ranks"][rank]
            checkpoint.restore(learner, state, (self._env, own["env"]) if self._env is not None else None)
            self._random_numbers().set_state(own["rng"])
            self.iteration, self.seconds = state["iteration"], state["seconds"]
            self.control_steps = state["control_steps"]
            self._totals |= state["totals"]
            self._episodes.windows.extend(state["episodes"])
        return learner

    def capture(self, function: Callable[[], Metrics], env: DiffEnv | None = None) -> Callable[[], Metrics]:
        """Half an iteration, timed as time/{name}; on a GPU its calls replay one CUDA graph. See graph.capture."""
        graphs = isinstance(self.args, ParallelFlags) and self.args.cuda_graph
        call = graph.capture(function, self.device, env) if graphs else function

        def timed() -> Metrics:
            begin = Mark(self.device)
            try:
                metrics = call()
            except ActionError:
                self._check_weights()  # they say more
                raise
            self._timings.append((f"time/{function.__name__}", begin, Mark(self.device)))
            return metrics

        return timed

    # Iterating -------------------------------------------------------------------------------------------------------

    @property
    def evaluation_due(self) -> bool:
        """Whether this iteration ends with an evaluation, on the rank that evaluates."""
        if due := self.writes and self._evaluates():
            self._check_weights()
        return due

    def _evaluates(self) -> bool:
        return self.iteration == self.args.iterations or is_due(self.iteration, self.args.eval_every)

    def __iter__(self) -> Iterator[int]:
        self._open()
        self._start_clock()
        try:
            while self.iteration < self.last and not self._stopping:
                self.iteration += 1
                if self._variation is not None:
                    self._variation.set(self.iteration)
                yield self.iteration
                self._end_iteration()
        finally:
            self._close()
        self._summarise()
        if self._signals:
            sys.exit(128 + self._signals[0])

    def log(self, metrics: Mapping[str, Tensor | float], control_steps: int | None = None) -> None:
        """Take an iteration's metrics; those of its episodes come from the environment of `make_env`.

        Args:
            metrics: by their names in tensorboard: () tensors, averaged over the ranks, and numbers.
            control_steps: how many this iteration took, of all ranks; by default a window of all environments.
        """
        self._open()
        tensors = {name: value.detach() for name, value in metrics.items() if isinstance(value, Tensor)}
        if self._env is not None:
            tensors |= self._env.take_statistics()
        signals = torch.full((), float(len(self._signals)), device=self.device)
        numbers = distributed.average(torch.stack([*tensors.values(), signals])).to("cpu", non_blocking=True)
        scalars = {name: float(value) for name, value in metrics.items() if not isinstance(value, Tensor)}
        previous, end = self._pending, Mark(self.device)
        steps = self._samples if control_steps is None else control_steps
        self._pending = Entry(self.iteration, steps, list(tensors), numbers, scalars, self._mark, end, self._timings)
        self._start_clock(end)
        self._write(previous)  # while the device works on this one

    def log_evaluation(self, evaluation: Evaluation) -> None:
        """Take the evaluation of the iteration that was logged last."""
        entry = self._pending
        assert entry is not None, "log the iteration first"
        entry.evaluation = evaluation
        entry.scalars |= evaluation.scalars()
        self._evaluation = self.iteration, evaluation

    def message(self, text: str) -> None:
        """Print a line above the progress bar, unless --quiet."""
        if self._log is not None:
            self._log.message(text)
        elif self.writes and not self.args.quiet:
            print(text, flush=True)

    def _start_clock(self, mark: Mark | None = None) -> None:
        self._mark, self._timings = mark or Mark(self.device), []

    def _end_iteration(self) -> None:
        saving = self.iteration == self.last or is_due(self.iteration, self.args.save_every)
        if self.device.type == "cpu" or self._evaluates() or saving or self._stopping:
            self._write(self._pending)
            self._pending = None
        if saving or self._stopping:
            self._save()
        if saving or self._evaluates():
            self._start_clock()

    def _write(self, entry: Entry | None) -> None:
        """Wait until the device has finished an iteration, if there is one, and write it."""
        if entry is None:
            return
        entry.end.wait()
        ranks, (*numbers, signals) = distributed.size(), entry.numbers.tolist()
        self._stopping = self._stopping or signals > 0
        seconds = entry.end.since(entry.begin)
        self.seconds += seconds
        self.control_steps += entry.steps
        scalars = dict(zip(entry.names, numbers, strict=True)) | entry.scalars
        if "episodes" in scalars:
            self._episodes.add(*(ranks * scalars.pop(name) for name in ("episodes", "return", "length")))
            for name in TOTALS:
                self._totals[f"sim/{name}"] += round(ranks * scalars.pop(name))
            scalars |= self._totals
            if self._episodes.windows:
                scalars["charts/episodic_return"], scalars["charts/episodic_length"] = self._episodes.means()
        scalars |= {"charts/SPS": entry.steps / seconds, "time/total": seconds}
        scalars |= {name: end.since(begin) for name, begin, end in entry.timings}
        self._scalars = scalars
        if entry.evaluation is not None:
            self.message(f"iteration {entry.iteration}: {entry.evaluation}")
        skipped = scalars.get("grad/skipped", 0.0)
        if skipped > self._skipped and time.monotonic() >= self._report:
            self._skipped, self._report = skipped, time.monotonic() + REPORT_EVERY
            self.message(f"iteration {entry.iteration}: updates skipped so far for their gradients: {skipped:.0f}")
        if self._log is not None:
            with self._writing():
                self._log.write(entry.iteration, self.control_steps, self.seconds, scalars)

    # Files and signals -----------------------------------------------------------------------------------------------

    def _check_directory(self) -> None:
        """That a run can be written there; leaves nothing behind."""
        path, args = self.directory, self.args
        existing = path / "checkpoint.pt"
        if existing.exists() and (args.resume is None or not args.resume.samefile(existing)):
            fail(f"{path} holds another run's checkpoint.pt: --resume it, or choose another --run-dir")
        check_writable(path)
        self._lock.acquire(path)
        if args.track:
            try:
                import wandb  # noqa: F401
            except ImportError:
                fail("--track needs Weights & Biases: pip install wandb")

    def _open(self) -> None:
        """Begin to write and to receive signals, once."""
        if self._handlers:
            return
        for number in (signal.SIGINT, signal.SIGTERM):
            self._handlers[number] = signal.signal(number, self._receive)
        if not self.writes:
            return
        args, directory, arguments = self.args, self.directory, dataclasses.asdict(self.args)
        with self._writing():
            directory.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(directory)
            (directory / "args.json").write_text(json.dumps(arguments, indent=2, default=str) + "\n")
            if args.track:
                import wandb

                options = dict(name=directory.name, dir=directory, config=arguments, sync_tensorboard=True)
                wandb.init(project="diffsim", **options)
            start = directory, self.iteration, self.control_steps
            self._log = ProgressLog(*start, arguments, args.iterations, args.quiet)

    def _receive(self, number: int, _frame: FrameType | None) -> None:
        """Stop after the present iteration; a second time at once, as Ctrl-C does elsewhere."""
        self._signals.append(number)
        signal.signal(number, signal.default_int_handler)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Around what writes files: a full disk or the like ends the script."""
        try:
            yield
        except OSError as error:
            fail(f"cannot write to {self.directory}: {error.strerror}; {self._kept()}")

    def _kept(self) -> str:
        path = self.directory / "checkpoint.pt"
        return f"{path} is of iteration {self._saved}" if path.is_file() else "no checkpoint was saved"

    def _check_weights(self) -> None:
        """End the script where training has diverged."""
        if self._learner is not None and (name := checkpoint.find_nonfinite(self._learner)):
            fail(f"iteration {self.iteration}: weight {name} is not finite; {self._kept()}")

    def _random_numbers(self) -> torch.Generator:
        if self.device.type == "cuda":
            return torch.cuda.default_generators[self.device.index]
        return torch.default_generator

    def _save(self) -> None:
        assert self._learner is not None
        env = self._env.state_dict() if self._env is not None else None
        ranks = distributed.gather({"env": env, "rng": self._random_numbers().get_state()})
        if not self.writes:
            return
        self._check_weights()
        args = {k: None if isinstance(v, Path) else v for k, v in dataclasses.asdict(self.args).items()}
        args |= dict(stop_after=0, device=self.args.device if len(ranks) == 1 else self.device.type)
        state: dict[str, Any] = dict(args=args, iteration=self.iteration, control_steps=self.control_steps)
        state |= dict(seconds=self.seconds, totals=self._totals, episodes=list(self._episodes.windows), ranks=ranks)
        state |= dict(simulator=self.simulator)
        with self._writing():
            checkpoint.save(self.directory / "checkpoint.pt", self.args.script(), self._learner, state)
        self._saved = self.iteration

    def _close(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self._log is not None:
            with suppress(OSError) if sys.exc_info()[0] else self._writing():  # one message is enough
                self._log.close()
        self._lock.release()
        distributed.finalize()

    def _summarise(self) -> None:
        if not self.writes:
            return
        args, path = self.args, self.directory
        print(
            f"{args.env}: {self.iteration} iterations, {self.control_steps:,} control steps, "
            f"{self.seconds:.1f} s of training"
        )
        if "grad/skipped" in self._scalars:
            states, gradients = (self._totals[f"sim/{name}"] for name in TOTALS)
            skipped = int(self._scalars["grad/skipped"])
            print(f"skipped {skipped} updates, contained {states} non-finite states and {gradients} gradients")
        if self._evaluation:
            iteration, evaluation = self._evaluation
            print(f"evaluation of iteration {iteration}, {args.eval_episodes} episodes: {evaluation}")
        print(f"written to {path}")
        if self.iteration < args.iterations:
            print(f"stopped early: python {args.script()}.py --resume {path / 'checkpoint.pt'} goes on")
        elif self._evaluation:
            write_evaluation(args, self._evaluation[1], self.iteration)
