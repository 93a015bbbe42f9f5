"""The flags that scripts share, and how a command line becomes complete, checked arguments."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

import torch
import tyro

from diffsim.tasks import FILE, TASKS, Accuracy, Contact, Task, base_name, find_task
from diffsim.training import checkpoint
from diffsim.training.errors import fail, in_one_line
from diffsim.training.ranges import Count, Fraction, Natural, Range, check_ranges, flag

FIXED = ("env", "seed", "num_envs", "control_dt")  # with --resume; what else must fit, `restore` tells
# Flags that diffsim.make takes as they are; control_dt is one of gps.py.
OPTIONS = {*"contact accuracy substeps implicit control_dt".split()}
EVALUATED = OPTIONS - {"control_dt"} | {*"device eval_episodes evaluate quiet run_dir threads".split()}
ENV = (
    f"task: {', '.join(TASKS)}, with options as in go2:rough=20 or g1_track:walk.npz (docs/tasks.md); "
    "or a file of your own, my_task.py or my_task.py:Class (docs/own_robot.md)"
)
Seed = Annotated[int, Range("below 2^62 in size", lambda value: abs(value) < 2**62)]  # ranks add to it


@dataclass
class Flags:
    """Flags of every script: the run, the task, and how it is simulated. Each script adds its hyperparameters."""

    fixed: ClassVar[tuple[str, ...]] = ()  # flags of a script that --resume keeps
    processes: ClassVar[bool] = True  # whether torchrun may split its environments among several
    differentiates: ClassVar[bool] = False  # whether it learns from the gradient of the reward

    env: Annotated[str, tyro.conf.arg(aliases=["--env-id"], help=ENV)] = "ant"
    seed: Seed = 1
    """seed of all random numbers"""
    iterations: Count = 2000
    """learning iterations (per task)"""
    device: str = "auto"
    """torch device of simulation and learning, e.g. cpu or cuda:0 (auto: the GPU if there is one)"""
    run_dir: Path | None = None
    """directory of the run (default: a new runs/{env}__{script}__{seed}__{time}, or the resumed checkpoint's)"""
    eval_every: Natural = 200
    """evaluate the policy without noise every this many iterations (0: only at the end)"""
    eval_episodes: Count = 64
    """episodes of an evaluation, each in its own environment"""
    save_every: Natural = 100
    """save the checkpoint every this many iterations (0: only at the end)"""
    resume: Path | None = None
    """checkpoint, or directory of a run, to continue with its arguments unless the command line gives others"""
    evaluate: Path | None = None
    """checkpoint, or directory of a run, to evaluate, e.g. with more --substeps; writes evaluation.json to --run-dir"""
    quiet: bool = False
    """no progress bar, and no messages until the end"""
    contact: Contact = "soft"
    """contact and limits: the paper's springs, or MuJoCo's own (docs/transfer.md; per task)"""
    accuracy: Accuracy = "default"
    """preset of substeps and --implicit (docs/numerics.md); default: the papers' settings"""
    substeps: Count = 16
    """simulation steps per control step (per task, --contact and --accuracy)"""
    implicit: bool = False
    """on soft contact, damping and friction act at the end of a substep (per task and --accuracy)"""
    onset: tuple[Fraction, Fraction] = (0.0, 0.0)
    """on MuJoCo's contact, metres over which contacts begin, first and last in training (0: as in the file)"""
    compile: bool = False
    """fuse torch's operations with torch.compile: on a GPU shorter iterations, a longer start (docs/performance.md)"""
    threads: Natural = 0
    """CPU threads of the simulator; they do not change results (0: chosen by the amount of work)"""

    @property
    def task(self) -> str:
        """The task's name without options: tables of defaults are by it."""
        return base_name(self.env)

    @functools.cached_property
    def task_class(self) -> type[Task]:
        """The task: a file's code runs once, and options are read once."""
        return find_task(self.env)

    @property
    def like(self) -> str:
        """The name of the task whose settings it begins with: Task.like, or its own."""
        like = self.task_class.like
        return self.task if like is None else find_task(like).name

    def task_defaults(self) -> dict[str, Any]:
        """Return the learner's defaults that depend on other flags, such as the task, the device or the preset.

        What the task itself sets (Task.defaults, Task.symmetric) replaces them.
        """
        return {}

    def check(self) -> None:
        """Raise a ValueError where arguments do not fit together; flags that several scripts have are checked here."""
        if self.contact == "mujoco" and self.implicit:
            fail("--implicit is for --contact soft, and the contact is MuJoCo's")
        if self.contact != "mujoco" and any(self.onset):
            fail(f"--onset is for --contact mujoco, and the contact is {self.contact}")
        if getattr(self, "symmetric", False) and not self.task_class.has_mirror():
            fail(f"--symmetric: task {self.env!r} has no mirror image")

    @classmethod
    def script(cls) -> str:
        """Name the script that declares the class, without .py."""
        return Path(str(sys.modules[cls.__module__].__file__)).stem


Args = TypeVar("Args", bound=Flags)


def parse(kind: type[Args], argv: Sequence[str] | None = None) -> Args:
    """Parse a command line into complete, checked arguments.

    Defaults that depend on the task, its preset and the device fill what is not given. With --resume and --evaluate
    the arguments of the checkpoint take their place.

    Raises:
        ValueError: an argument out of range, or one that does not fit to the others or to the checkpoint.
        SystemExit: --help, or what tyro cannot parse.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    # The first pass finds what the defaults of the second depend on, so that its --help shows the task's own.
    args = _cli(kind, [word for word in argv if word not in ("-h", "--help")], kind())
    if args.resume and args.evaluate:
        fail("--resume and --evaluate exclude each other")
    if path := args.resume or args.evaluate:
        try:
            args = _continue(kind, argv, args, path)
            check_ranges(args)
        except (AttributeError, KeyError, TypeError) as error:
            fail(f"{path} is damaged: {error}")
    else:
        if not any(word.partition("=")[0] == flag("contact") for word in argv):
            args.contact = args.task_class.contact
        defaults = dataclasses.replace(
            kind(), contact=args.contact, **(_presets(args) | args.task_defaults() | _of_task(args))
        )
        args = _cli(kind, argv, defaults)
    check_ranges(args)
    (Flags.check if args.evaluate else kind.check)(args)  # an evaluation skips checks that concern training
    if path and args.run_dir is None:
        args.run_dir = path.parent
    return args


def _presets(args: Flags) -> dict[str, Any]:
    """Look up what --accuracy and --contact stand for."""
    try:
        how = args.task_class.integration(args.accuracy, args.contact)
    except ValueError as error:
        fail(error)
    onset = {} if how.contact == "mujoco" else {"onset": (0.0, 0.0)}
    return {"substeps": how.substeps, "implicit": how.implicit} | onset


def _of_task(args: Flags) -> dict[str, Any]:
    """Look up the defaults that the task sets for this script, on this device."""
    task, script, device = args.task_class, args.script(), "cpu" if args.device == "cpu" else "gpu"
    values = {"symmetric": task.symmetric} if hasattr(args, "symmetric") else {}
    if wrong := [key for key, given in task.defaults.items() if not isinstance(given, Mapping)]:
        fail(f"task {args.env!r}: defaults are by script, such as {{'shac': {{'horizon': 16}}}}, not {wrong[0]!r}")
    values |= {**task.defaults.get(script, {}), **task.defaults.get(f"{script} {device}", {})}
    if unknown := ", ".join(flag(name) for name in values if not hasattr(args, name)):
        fail(f"task {args.env!r} has defaults of flags that {script}.py lacks: {unknown}")
    return values


def _continue(kind: type[Args], argv: list[str], given: Args, path: Path) -> Args:
    """Parse a command line with --resume or --evaluate, whose defaults are the checkpoint's arguments."""
    saved = checkpoint.load(path, kind.script())
    if given.resume and "modules" not in saved:
        fail(f"{path} holds only a policy, which can be evaluated but not resumed")
    hints = get_type_hints(kind, include_extras=True)
    choices = {name: get_args(hint) for name, hint in hints.items() if get_origin(hint) is Literal}
    known = {
        name: value for name, value in saved["args"].items() if name in hints and value in choices.get(name, (value,))
    }
    others = {name: value for name, value in saved["args"].items() if name not in known and value}
    if gone := ", ".join(f"{flag(name)} {value}" for name, value in others.items()):
        message = f"{path} was written by a {kind.script()}.py with other flags: {gone}"
        if given.resume:
            fail(message)
        print(f"{Path(sys.argv[0]).name}: {message}; they are ignored", file=sys.stderr)
    defaults = kind(**known)
    if given.evaluate:
        defaults.device = "auto"  # wherever it was trained
    if FILE.fullmatch(given.env) and FILE.fullmatch(defaults.env):
        defaults.env = given.env  # the same file, seen from another directory
    words = {word.partition("=")[0] for word in argv}
    if chosen := {name: getattr(given, name) for name in ("accuracy", "contact") if flag(name) in words}:
        # A preset replaces the saved numbers.
        defaults = dataclasses.replace(defaults, **_presets(dataclasses.replace(defaults, **chosen)))
    args = _cli(kind, argv, defaults)
    fixed: Iterable[str] = FIXED + kind.fixed if args.resume else [name for name in hints if name not in EVALUATED]
    may = f"; --evaluate takes {', '.join(map(flag, sorted(EVALUATED & hints.keys())))}" if args.evaluate else ""
    for name in fixed:
        own, wanted = (str(getattr(each, name, None)) for each in (defaults, args))  # a saved path is a text
        if own != wanted and not (name == "env" and base_name(own) == base_name(wanted)):
            fail(f"{path} has {flag(name)} {own}, which cannot change to {wanted}{may}")
    if args.resume:
        if saved["iteration"] >= args.iterations:
            fail(f"{path} is at iteration {saved['iteration']} already: give more --iterations")
        if args.device.partition(":")[0] != defaults.device.partition(":")[0]:
            fail(f"{path} was trained on {defaults.device}, which {args.device} cannot continue exactly")
    return args


def _cli(kind: type[Args], argv: list[str], defaults: Args) -> Args:
    with in_one_line(argv):
        about = sys.modules[kind.__module__].__doc__
        args = tyro.cli(kind, prog=Path(sys.argv[0]).name, args=argv, default=defaults, description=about)
    if args.device == "auto":
        args.device = "cuda" if torch.cuda.is_available() else "cpu"
    for name in ("resume", "evaluate"):
        if (path := getattr(args, name)) and path.is_dir():
            setattr(args, name, path / "checkpoint.pt")
    return args
