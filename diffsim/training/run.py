"""One training run: what happens in an iteration, and after which it evaluates, saves and stops."""

from __future__ import annotations

import dataclasses
import pkgutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import torch
from torch import Tensor, nn

from diffsim.env import ActionError, DiffEnv
from diffsim.sim.options import check_device
from diffsim.tasks import FILE
from diffsim.training import checkpoint, distributed, divergence, graph, provenance
from diffsim.training.checkpoint import Learner
from diffsim.training.clock import Mark
from diffsim.training.directory import RunDirectory
from diffsim.training.errors import fail
from diffsim.training.evaluation import Evaluation, Player, compare, make_env, write_evaluation
from diffsim.training.flags import Flags
from diffsim.training.fuse import fused
from diffsim.training.log import ProgressLog, say
from diffsim.training.recorder import TOTALS, Recorder
from diffsim.training.signals import Signals

L = TypeVar("L", bound=Learner)
Metrics = dict[str, Tensor]
Iterate = Callable[[], Metrics]

ONSET_EVERY = 10  # iterations between two lengths of the onset


def is_due(iteration: int, every: int) -> bool:
    return every > 0 and iteration % every == 0


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
        self.args, self.writes, processes = args, distributed.rank() == 0, distributed.size()
        self.directory = RunDirectory(args.run_dir, args.resume)
        if processes > 1 and not args.processes:
            fail("this learner trains in one process: start it without torchrun")
        if self.writes:
            self.directory.check()
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
        self.iteration, self.last = 0, min(args.iterations, self.stop_after or args.iterations)
        self.directory.saved = self._state["iteration"] if self._state else 0
        self.signals = Signals()
        self.recorder = Recorder(self.device, self.signals, args.quiet or not self.writes)
        self._opened = False
        self._env: DiffEnv | None = None
        self._variation: Any = None
        self._learner: Learner | None = None
        self._player: Player | None = None
        self._evaluation: tuple[int, Evaluation] | None = None  # the last one, with its iteration

    # Setting up ------------------------------------------------------------------------------------------------------

    def make_env(self, num_envs: int, horizon: int, **options: Any) -> DiffEnv:
        """Make this rank's share of the training environments, with random start states of its own.

        Args:
            options: of DiffEnv.
        """
        processes = distributed.size()
        if num_envs % processes:
            fail(f"--num-envs {num_envs} cannot be split evenly among {processes} processes")
        seed, varied_by = distributed.own_seed(self.args.seed), self.args.task_class.varied_by
        options |= {"factors": varied_by is not None, "onset": self.args.onset[0]}
        self._env = make_env(self.args, num_envs // processes, horizon, seed, **options)
        if varied_by is not None:
            self._variation = pkgutil.resolve_name(varied_by)(self._env, seed)
        if self.args.differentiates and not divergence.reward_has_gradient(self._env):
            self.message(
                f"the reward of {self.args.env} has no gradient in the robot's state: it is detached, jumps or is an "
                f"integer. {self.args.script()} cannot learn from it, ppo_baseline can (docs/own_robot.md)"
            )
        return self._env

    @cached_property
    def eval_env(self) -> DiffEnv:
        """The environments of evaluations, made when they are first needed."""
        return make_env(self.args, self.args.eval_episodes)

    def restore(self, learner: L) -> L:
        """Register the learner, which checkpoints hold from now on, and continue it if the run is resumed.

        All ranks start with equal weights; from here on they draw different random numbers.
        """
        self._learner, rank, args = learner, distributed.rank(), self.args
        if rank > 0:
            torch.manual_seed(distributed.own_seed(args.seed))
        if state := self._state:
            own, robot = state["ranks"][rank], state.get("robot")
            same = state["args"]["env"] == args.env or FILE.fullmatch(args.env)  # or new episodes begin
            checkpoint.restore(learner, state, (self._env, own["env"]) if self._env is not None and same else None)
            if self.writes:
                provenance.compare(robot, (self._env or self.eval_env).scene)
            distributed.generator(self.device).set_state(own["rng"])
            self.iteration = state["iteration"]
            self.recorder.load_state_dict(state)
            self._set_onset(self.iteration + 1)
        return learner

    def capture(self, function: Iterate, env: DiffEnv | None = None, eager: bool = False) -> Iterate:
        """Time an iteration, or a part of it, as time/{name}; on a GPU, unless eager, its calls replay one CUDA graph.

        See graph.capture.
        """
        if self.args.compile:
            function = fused(function, self._learner, env)
        call = graph.capture(function, self.device, env) if self.graphs and not eager else function

        def timed() -> Metrics:
            try:
                with self.recorder.clock.part(function.__name__):
                    return call()
            except ActionError:
                self._check_learner()  # they say more
                raise

        return timed

    # Iterating -------------------------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[int]:
        self._open()
        self.recorder.clock.restart()
        try:
            stopping = False
            while self.iteration < self.last and not stopping:
                self.iteration += 1
                if self._variation is not None:
                    self._variation.set(self.iteration)
                if is_due(self.iteration - 1, ONSET_EVERY):
                    self._set_onset(self.iteration)
                yield self.iteration
                # Ranks write after the same iterations, as only then they learn of signals.
                saving = self.iteration == self.last or is_due(self.iteration, self.args.save_every)
                pausing = saving or self._evaluates()
                if pausing or self.recorder.is_full:
                    stopping = self._write()
                if saving or stopping:
                    self._save()
                if pausing:
                    self.recorder.clock.restart()
        finally:
            self._close()
        if self.writes:
            self._summarise()
        if self.signals.received:
            sys.exit(128 + self.signals.received[0])

    @property
    def evaluation_due(self) -> bool:
        """Whether this iteration ends with an evaluation, on the rank that evaluates."""
        if due := self.writes and self._evaluates():
            self._check_learner()
        return due

    def _evaluates(self) -> bool:
        return self.iteration == self.args.iterations or is_due(self.iteration, self.args.eval_every)

    def _set_onset(self, iteration: int) -> None:
        """Let contacts begin as far along the way from the first onset to the last as the stage of an iteration is."""
        first, last = self.args.onset
        if self._env is not None and first != last:
            done = (iteration - 1) // ONSET_EVERY * ONSET_EVERY / self.args.iterations
            self._env.sim.set_onset(first + (last - first) * done)

    def log(self, metrics: Mapping[str, Tensor | float], control_steps: int | None = None) -> None:
        """Take an iteration's metrics; those of its episodes come from the environment of `make_env`.

        Args:
            metrics: by their names in tensorboard: () tensors, averaged over the ranks, and numbers.
            control_steps: how many this iteration took, of all ranks; by default a rollout of all environments.
        """
        self._open()
        rollout = self._env.num_envs * self._env.horizon * distributed.size() if self._env is not None else 0
        self.recorder.take(self.iteration, control_steps or rollout, metrics, self._env)

    def evaluate(self, policy: nn.Module) -> None:
        """Evaluate the deterministic policy, always of one architecture, in the iteration that was logged last."""
        begin = Mark(self.device)
        self._player = self._player or Player(self.eval_env, policy, self.graphs)
        self._player.take(policy)
        self.log_evaluation(self._player.evaluate())
        self.recorder.newest.spans["time/evaluation"] = begin, Mark(self.device)

    def log_evaluation(self, evaluation: Evaluation) -> None:
        """Take the evaluation of the iteration that was logged last."""
        self.recorder.newest.scalars |= evaluation.scalars()
        self._evaluation = self.iteration, evaluation
        self.message(f"iteration {self.iteration}: {evaluation}")

    def message(self, text: str) -> None:
        """Print a line, unless --quiet."""
        self.recorder.message(text)

    # Beginning, saving, ending ---------------------------------------------------------------------------------------

    def _open(self) -> None:
        """Begin to receive signals and to write, once."""
        if self._opened:
            return
        self._opened = True
        self.signals.listen()
        if not self.writes:
            return
        args = self.args
        args.run_dir = self.directory.open(f"{args.task_class.name}__{args.script()}__{args.seed}__{int(time.time())}")
        with self.directory.writing():
            start = args.run_dir, self.iteration, self.recorder.control_steps
            self.recorder.log = ProgressLog(*start, dataclasses.asdict(args), args.iterations, args.quiet)

    def _write(self) -> bool:
        """Write what the recorder has taken; returns whether a signal had arrived."""
        try:
            with self.directory.writing():
                return self.recorder.write()
        except FloatingPointError:
            self._check_observations()  # they say more
            self._fail(f"a reward of {self.args.env} is not finite")

    def _save(self) -> None:
        env = self._env.state_dict() if self._env is not None else None
        ranks = distributed.gather({"env": env, "rng": distributed.generator(self.device).get_state()})
        if not self.writes:
            return
        assert self._learner is not None
        self._check_learner()
        args = {k: None if isinstance(v, Path) else v for k, v in dataclasses.asdict(self.args).items()}
        args["device"] = self.args.device if len(ranks) == 1 else self.device.type
        state = dict[str, Any](args=args, iteration=self.iteration) | self.recorder.state_dict()
        state |= dict(ranks=ranks, simulator=self.simulator, task=self.args.task_class.stored())
        state |= dict(robot=provenance.fingerprint((self._env or self.eval_env).scene))
        with self.directory.writing():
            checkpoint.save(self.directory.checkpoint, self.args.script(), self._learner, state)
        self.directory.saved = self.iteration

    def _close(self) -> None:
        self.signals.restore()
        if self.recorder.log is not None:
            with suppress(OSError) if sys.exc_info()[0] else self.directory.writing():  # one message is enough
                self.recorder.log.close()
        self.directory.close()
        distributed.finalize()

    def _summarise(self) -> None:
        args, done = self.args, self.recorder
        say(
            f"{args.env}: {self.iteration} iterations, {done.control_steps:,} control steps, "
            f"{done.seconds:.1f} s of training"
        )
        if (skipped := done.scalars.get("grad/skipped")) is not None:
            states, gradients = (done.totals[f"sim/{name}"] for name in TOTALS)
            say(f"skipped {skipped:.0f} updates, contained {states} non-finite states and {gradients} gradients")
        if self._evaluation:
            iteration, evaluation = self._evaluation
            say(f"evaluation of iteration {iteration}, {args.eval_episodes} episodes: {evaluation}")
        say(f"written to {self.directory.path}")
        if self.iteration < args.iterations:
            say(f"stopped early: python {args.script()}.py --resume {self.directory.checkpoint} continues")
        elif self._evaluation:
            evaluation, player = self._evaluation[1], self._player
            found = compare(args, evaluation, self._evaluate_again) if player is not None else {}
            write_evaluation(args, evaluation, self.iteration, **found)

    def _evaluate_again(self, args: Flags, **options: Any) -> Evaluation:
        """Evaluate the policy of the last evaluation once more, in environments of other arguments and options."""
        assert self._player is not None
        return Player(make_env(args, args.eval_episodes, **options), self._player.policy, self.graphs).evaluate()

    # When it cannot go on --------------------------------------------------------------------------------------------

    def _check_learner(self) -> None:
        """End the script where training has diverged."""
        self._check_observations()
        if self._learner is not None and (name := divergence.find_weight(self._learner)):
            self._fail(f"weight {name} is not finite")

    def _check_observations(self) -> None:
        if (column := divergence.find_observation(self._learner, self._env)) is not None:
            self._fail(f"observation {column} of {self.args.env} is not finite")

    def _fail(self, message: str) -> NoReturn:
        fail(f"iteration {self.iteration}: {message}; {self.directory.kept()}")
