"""One training run: its directory and schedule, its log and its checkpoints."""

from __future__ import annotations

import dataclasses
import json
import math
import pkgutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TextIO, TypeVar

import torch
from torch import Tensor, nn

from diffsim.env import ActionError, DiffEnv
from diffsim.sim.options import check_device
from diffsim.tasks import FILE, find_task
from diffsim.training import checkpoint, distributed, graph
from diffsim.training.checkpoint import Learner
from diffsim.training.directory import EpisodeStatistics, ProgressLog, check_writable, lock, make_unused, say
from diffsim.training.errors import fail
from diffsim.training.evaluation import Evaluation, Player, compare, make_env, write_evaluation
from diffsim.training.flags import Flags
from diffsim.training.graph import Mark
from diffsim.training.layers import ObsNormalizer

L = TypeVar("L", bound=Learner)
Metrics = dict[str, Tensor]
Iterate = Callable[[], Metrics]

TOTALS = ("nonfinite", "nonfinite_gradients")  # of env.take_statistics, logged as running totals sim/...
REPORTED = {  # totals that are reported each time they double
    "grad/skipped": "updates skipped so far because of their gradients: {:.0f}; if many, shorten --horizon",
    "sim/unconverged": "control steps so far in which Newton's method did not converge: {:.0f}; give more --substeps",
}
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
RANK_SEED = 1_000_003  # between the seeds of two ranks
LOG_EVERY = 10  # a GPU's iterations are written in batches of this many, so that the host rarely waits
ONSET_EVERY = 10  # iterations between two lengths of the onset
RUNS = Path("runs")  # parent of runs without --run-dir


def is_due(iteration: int, every: int) -> bool:
    return every > 0 and iteration % every == 0


@dataclass
class Record:
    """An iteration that is not written yet: the device may still work on it."""

    iteration: int
    steps: int  # control steps that it took
    names: list[str]
    numbers: Tensor  # of the names, then how many signals have arrived
    scalars: dict[str, float]  # that are known already
    times: dict[str, tuple[Mark, Mark]]  # begin and end, by name


class Run:
    """Iterate over it: it yields the number of each iteration, and evaluates, saves and stops when due.

    Of several ranks only the first writes anything. The script's arguments must be complete. Random numbers are seeded
    by args.seed here.

    Tests and benchmarks change the class attributes.
    """

    simulator = checkpoint.HOME  # of its environments
    stop_after = 0  # iteration after which it stops and saves as after Ctrl-C; 0: none
    graphs = True  # on a GPU, replay iterations as CUDA graphs

    def __init__(self, args: Flags) -> None:
        self.args = args
        self.writes, processes = distributed.rank() == 0, distributed.size()
        self._lock: TextIO | None = None
        if processes > 1 and not args.processes:
            fail("this learner trains in one process: start it without torchrun")
        if self.writes:
            self._check_directory()
        self._state = checkpoint.load(args.resume, args.script()) if args.resume else None
        if self._state and (ranks := len(self._state["ranks"])) != processes:
            fail(f"{args.resume} was trained by {ranks} processes, not {processes}")
        if torch.get_default_dtype() != torch.float32:
            fail(f"training computes in float32: torch's default dtype must be that, not {torch.get_default_dtype()}")
        args.device = distributed.choose_device(args.device)
        try:
            self.device = check_device(args.device)
        except ValueError as error:
            fail(error)
        distributed.initialize(self.device)
        torch.set_num_threads(1)  # operations this small gain little from more; idle threads disturb the simulator's
        torch.manual_seed(args.seed)
        self.iteration, self.seconds, self.control_steps = 0, 0.0, 0
        self._saved = self._state["iteration"] if self._state else 0
        self.last = min(args.iterations, self.stop_after or args.iterations)
        self._totals, self._episodes = {f"sim/{name}": 0 for name in TOTALS}, EpisodeStatistics()
        self._env: DiffEnv | None = None
        self._variation: Any = None
        self._samples = 0  # control steps of an iteration, of all ranks
        self._learner: Learner | None = None
        self._normalizers: list[ObsNormalizer] = []  # of observations
        self._log: ProgressLog | None = None
        self._records: list[Record] = []
        self._times: dict[str, tuple[Mark, Mark]] = {}
        self._mark = Mark(self.device)
        self._evaluation: tuple[int, Evaluation] | None = None
        self._player: Player | None = None
        self._scalars: dict[str, float] = {}  # that were written last
        self._reported = dict.fromkeys(REPORTED, 0.0)
        self._signals: list[int] = []
        self._handlers: dict[int, Any] = {}
        self._opened = self._stopping = False

    # Setting up ------------------------------------------------------------------------------------------------------

    def make_env(self, num_envs: int, horizon: int, **options: Any) -> DiffEnv:
        """This rank's share of the training environments, with its own random start states, and options of DiffEnv."""
        self._samples = num_envs * horizon
        args, processes = self.args, distributed.size()
        if num_envs % processes:
            fail(f"--num-envs {num_envs} cannot be split evenly among {processes} processes")
        seed = args.seed + distributed.rank() * RANK_SEED
        varied_by = find_task(args.env).varied_by
        options |= {"factors": varied_by is not None, "onset": args.onset[0]}
        self._env = make_env(args, num_envs // processes, horizon, seed, **options)
        if varied_by is not None:
            self._variation = pkgutil.resolve_name(varied_by)(self._env, seed)
        return self._env

    @cached_property
    def eval_env(self) -> DiffEnv:
        """The environments of evaluations, made when they are first needed."""
        return make_env(self.args, self.args.eval_episodes)

    @cached_property
    def directory(self) -> Path:
        """Made and locked when it is first needed: a run that fails at its start leaves nothing behind."""
        args = self.args
        with self._writing():
            if args.run_dir is None:
                name = f"{find_task(args.env).name}__{args.script()}__{args.seed}__{int(time.time())}"
                args.run_dir = make_unused(RUNS / name)
            args.run_dir.mkdir(parents=True, exist_ok=True)
            self._lock = self._lock or lock(args.run_dir)
        self._check_unused(args.run_dir)  # again: a run may have ended there since this one started
        return args.run_dir

    def restore(self, learner: L) -> L:
        """Register the learner, which checkpoints hold from now on, and continue it if the run is resumed.

        All ranks start with equal weights; from here on they draw different random numbers.
        """
        self._learner, rank = learner, distributed.rank()
        modules = nn.ModuleList(part for part in vars(learner).values() if isinstance(part, nn.Module)).modules()
        self._normalizers = [m for m in modules if isinstance(m, ObsNormalizer) and m.size is not None]
        if rank > 0:
            torch.manual_seed(self.args.seed + rank * RANK_SEED)
        if state := self._state:
            own, robot = state["ranks"][rank], state.get("robot")
            same = state["args"]["env"] == self.args.env or FILE.fullmatch(self.args.env)  # or new episodes begin
            episodes = (self._env, own["env"]) if self._env is not None and same else None
            checkpoint.restore(learner, state, episodes)
            if self.writes:
                pkgutil.resolve_name(checkpoint.PROVENANCE).compare(robot, (self._env or self.eval_env).scene)
            self._random_numbers().set_state(own["rng"])
            self.iteration, self.seconds = state["iteration"], state["seconds"]
            self.control_steps = state["control_steps"]
            self._totals |= state["totals"]
            self._episodes.rollouts.extend(state["episodes"])
        return learner

    def capture(self, function: Iterate, env: DiffEnv | None = None, eager: bool = False) -> Iterate:
        """Time an iteration, or a part of it, as time/{name}; on a GPU, unless eager, its calls replay one CUDA graph.

        See graph.capture.
        """
        if self.args.compile:
            function = pkgutil.resolve_name("diffsim.training.fuse:fused")(function, self._learner, env)
        call = graph.capture(function, self.device, env) if self.graphs and not eager else function

        def timed() -> Metrics:
            begin = Mark(self.device)
            try:
                metrics = call()
            except ActionError:
                self._check_learner()  # they say more
                raise
            self._times[f"time/{function.__name__}"] = begin, Mark(self.device)
            return metrics

        return timed

    # Iterating -------------------------------------------------------------------------------------------------------

    @property
    def evaluation_due(self) -> bool:
        """Whether this iteration ends with an evaluation, on the rank that evaluates."""
        if due := self.writes and self._evaluates():
            self._check_learner()
        return due

    def _evaluates(self) -> bool:
        return self.iteration == self.args.iterations or is_due(self.iteration, self.args.eval_every)

    def __iter__(self) -> Iterator[int]:
        self._open()
        self._mark = Mark(self.device)
        try:
            while self.iteration < self.last and not self._stopping:
                self.iteration += 1
                if self._variation is not None:
                    self._variation.set(self.iteration)
                self._set_onset()
                yield self.iteration
                self._end_iteration()
        finally:
            self._close()
        self._summarise()
        if self._signals:
            sys.exit(128 + self._signals[0])

    def _set_onset(self) -> None:
        """Move the onset of contacts along its way from the first to the last."""
        first, last = self.args.onset
        if self._env is not None and first != last and is_due(self.iteration - 1, ONSET_EVERY):
            self._env.sim.set_onset(first + (last - first) * (self.iteration - 1) / self.args.iterations)

    def log(self, metrics: Mapping[str, Tensor | float], control_steps: int | None = None) -> None:
        """Take an iteration's metrics; those of its episodes come from the environment of `make_env`.

        Args:
            metrics: by their names in tensorboard: () tensors, averaged over the ranks, and numbers.
            control_steps: how many this iteration took, of all ranks; by default a rollout of all environments.
        """
        self._open()
        tensors = {name: value.detach() for name, value in metrics.items() if isinstance(value, Tensor)}
        scalars = {name: float(value) for name, value in metrics.items() if not isinstance(value, Tensor)}
        if self._env is not None:
            tensors |= self._env.take_statistics()
        signals = torch.full((), float(len(self._signals)), device=self.device)
        numbers = distributed.average(torch.stack([*tensors.values(), signals]))
        steps, begin, self._mark = control_steps or self._samples, self._mark, Mark(self.device)
        times = self._times | {"time/total": (begin, self._mark)}
        self._records.append(Record(self.iteration, steps, list(tensors), numbers, scalars, times))
        self._times = {}

    def evaluate(self, policy: nn.Module) -> None:
        """Evaluate the deterministic policy, always of one architecture, in the iteration that was logged last."""
        begin = Mark(self.device)
        self._player = self._player or Player(self.eval_env, policy, self.graphs)
        self._player.take(policy)
        self.log_evaluation(self._player.evaluate())
        self._records[-1].times["time/evaluation"] = begin, Mark(self.device)

    def log_evaluation(self, evaluation: Evaluation) -> None:
        """Take the evaluation of the iteration that was logged last."""
        self._records[-1].scalars |= evaluation.scalars()
        self._evaluation = self.iteration, evaluation
        self.message(f"iteration {self.iteration}: {evaluation}")

    def message(self, text: str) -> None:
        """Print a line, unless --quiet."""
        if self.writes and not self.args.quiet:
            say(text)

    def _end_iteration(self) -> None:
        """Write and save what is due. Ranks write after the same iterations, as only then they learn of signals."""
        saving = self.iteration == self.last or is_due(self.iteration, self.args.save_every)
        pausing = saving or self._evaluates()
        interrupted = bool(self._signals) and distributed.size() == 1
        if self.device.type == "cpu" or pausing or interrupted or len(self._records) == LOG_EVERY:
            for record in self._records:
                self._write(record)
            self._records.clear()
        if saving or self._stopping:
            self._save(distributed.gather(self._own_state()))
        if pausing:
            self._mark = Mark(self.device)

    def _write(self, record: Record) -> None:
        """Wait until the device has finished an iteration, and write it."""
        ranks, (*numbers, signals) = distributed.size(), record.numbers.tolist()
        self._stopping = self._stopping or signals > 0
        times = {name: end.since(begin) for name, (begin, end) in record.times.items()}
        self.seconds += times["time/total"]
        self.control_steps += record.steps
        scalars = dict(zip(record.names, numbers, strict=True)) | record.scalars | times
        if "episodes" in scalars:
            if not math.isfinite(scalars["return"]):
                self._check_observations()  # they say more
                self._fail(f"a reward of {self.args.env} is not finite")
            self._episodes.add(*(ranks * scalars.pop(name) for name in ("episodes", "return", "length")))
            for name in (*TOTALS, *({"unconverged"} & scalars.keys())):
                self._totals[f"sim/{name}"] = self._totals.get(f"sim/{name}", 0) + round(ranks * scalars.pop(name))
            scalars |= self._totals
            if self._episodes.rollouts:
                scalars["charts/episodic_return"], scalars["charts/episodic_length"] = self._episodes.means()
        scalars["charts/SPS"] = record.steps / times["time/total"]
        self._scalars = scalars
        for name, text in REPORTED.items():
            if (total := scalars.get(name, 0.0)) > 2 * self._reported[name]:
                self._reported[name] = total
                self.message(f"iteration {record.iteration}: {text.format(total)}")
        if self._log is not None:
            with self._writing():
                self._log.write(record.iteration, self.control_steps, self.seconds, scalars)

    # Files and signals -----------------------------------------------------------------------------------------------

    def _check_directory(self) -> None:
        """That a run can be written there; leaves nothing behind."""
        args, path = self.args, self.args.run_dir or RUNS
        check_writable(path)
        self._check_unused(path)
        if args.resume and path.is_dir():
            self._lock = lock(path)  # before its checkpoint is read

    def _check_unused(self, path: Path) -> None:
        existing, resumed = path / "checkpoint.pt", self.args.resume
        if existing.exists() and (resumed is None or not resumed.samefile(existing)):
            fail(f"{path} holds another run's checkpoint.pt: --resume it, or choose another --run-dir")

    def _open(self) -> None:
        """Begin to write and to receive signals, once."""
        if self._opened:
            return
        self._opened = True
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup asks for
                self._handlers[number] = signal.signal(number, self._receive)
        if not self.writes:
            return
        directory, args = self.directory, self.args
        arguments = dataclasses.asdict(args)
        with self._writing():
            (directory / "args.json").write_text(json.dumps(arguments, indent=2, default=str) + "\n")
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
            fail(f"cannot write to {self.args.run_dir or RUNS}: {error.strerror}; {self._kept()}")

    def _kept(self) -> str:
        path = (self.args.run_dir or RUNS) / "checkpoint.pt"
        return f"{path} is of iteration {self._saved}" if path.is_file() else "no checkpoint was saved"

    def _check_learner(self) -> None:
        """End the script where training has diverged."""
        self._check_observations()
        if self._learner is not None and (name := checkpoint.find_nonfinite(self._learner)):
            self._fail(f"weight {name} is not finite")

    def _check_observations(self) -> None:
        seen = [normalizer.mean.unsqueeze(0) for normalizer in self._normalizers]
        seen += [self._env.state_dict()["obs"]] if self._env is not None else []
        for obs in seen:
            if columns := (~obs.isfinite()).any(0).nonzero().flatten().tolist():
                self._fail(f"observation {columns[0]} of {self.args.env} is not finite")

    def _fail(self, message: str) -> NoReturn:
        fail(f"iteration {self.iteration}: {message}; {self._kept()}")

    def _random_numbers(self) -> torch.Generator:
        if self.device.type == "cuda":
            return torch.cuda.default_generators[self.device.index]
        return torch.default_generator

    def _own_state(self) -> dict[str, Any]:
        env = self._env.state_dict() if self._env is not None else None
        return {"env": env, "rng": self._random_numbers().get_state()}

    def _save(self, ranks: list[dict[str, Any]]) -> None:
        assert self._learner is not None
        if not self.writes:
            return
        self._check_learner()
        args = {k: None if isinstance(v, Path) else v for k, v in dataclasses.asdict(self.args).items()}
        args["device"] = self.args.device if len(ranks) == 1 else self.device.type
        state: dict[str, Any] = dict(args=args, iteration=self.iteration, control_steps=self.control_steps)
        state |= dict(seconds=self.seconds, totals=self._totals, episodes=list(self._episodes.rollouts), ranks=ranks)
        state |= dict(simulator=self.simulator, task=find_task(self.args.env).stored())
        state |= dict(robot=pkgutil.resolve_name(checkpoint.PROVENANCE).fingerprint((self._env or self.eval_env).scene))
        with self._writing():
            checkpoint.save(self.directory / "checkpoint.pt", self.args.script(), self._learner, state)
        self._saved = self.iteration

    def _close(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self._log is not None:
            with suppress(OSError) if sys.exc_info()[0] else self._writing():  # one message is enough
                self._log.close()
        if self._lock is not None:
            self._lock.close()
        distributed.finalize()

    def _summarise(self) -> None:
        if not self.writes:
            return
        args, path = self.args, self.directory
        say(
            f"{args.env}: {self.iteration} iterations, {self.control_steps:,} control steps, "
            f"{self.seconds:.1f} s of training"
        )
        if (skipped := self._scalars.get("grad/skipped")) is not None:
            states, gradients = (self._totals[f"sim/{name}"] for name in TOTALS)
            say(f"skipped {skipped:.0f} updates, contained {states} non-finite states and {gradients} gradients")
        if self._evaluation:
            iteration, evaluation = self._evaluation
            say(f"evaluation of iteration {iteration}, {args.eval_episodes} episodes: {evaluation}")
        say(f"written to {path}")
        if self.iteration < args.iterations:
            say(f"stopped early: python {args.script()}.py --resume {path / 'checkpoint.pt'} continues")
        elif self._evaluation:
            evaluation, player = self._evaluation[1], self._player
            found = compare(args, evaluation, self._evaluate_again) if player is not None else {}
            write_evaluation(args, evaluation, self.iteration, **found)

    def _evaluate_again(self, args: Flags, **options: Any) -> Evaluation:
        """Evaluate the policy of the last evaluation once more, in environments of other arguments and options."""
        assert self._player is not None
        return Player(make_env(args, args.eval_episodes, **options), self._player.policy, self.graphs).evaluate()
