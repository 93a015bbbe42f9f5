"""The flags that scripts share, and how a command line becomes complete, checked arguments."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import math
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

import torch
import tyro

from diffsim.env import ActionError
from diffsim.sim.launcher import TooLargeError
from diffsim.startup import KernelCacheError, end_in_one_line
from diffsim.tasks import TASKS, HumanoidImitation
from diffsim.tasks.imitation.clip import Clip, read_clip
from diffsim.terrain import TerrainError
from diffsim.training import checkpoint, distributed
from diffsim.training.errors import fail, parse_command_line
from diffsim.training.variation import parse_ranges
from diffsim.view import render

LARGEST = torch.finfo(torch.float32).max
RANDOMISED = ("stiffness=0.45:2.2", "friction=0.85:1.17")  # with --contact firm


@dataclass(frozen=True)
class Range:
    """What a finite number on the command line may be."""

    words: str
    holds: Callable[[float], bool]

    def complaint(self, value: float) -> str | None:
        if not abs(value) <= LARGEST:
            return (
                f"must be finite in single precision, not {value}"
                if math.isfinite(value)
                else f"must be finite, not {value}"
            )
        return None if self.holds(value) else f"must be {self.words}, not {value}"


Count = Annotated[int, Range("at least 1", lambda value: value >= 1)]
Natural = Annotated[int, Range("at least 0", lambda value: value >= 0)]
Finite = Annotated[float, Range("finite", math.isfinite)]
Positive = Annotated[float, Range("positive", lambda value: value > 0)]
NonNegative = Annotated[float, Range("at least 0", lambda value: value >= 0)]
Fraction = Annotated[float, Range("in [0, 1]", lambda value: 0 <= value <= 1)]
Decay = Annotated[float, Range("in [0, 1)", lambda value: 0 <= value < 1)]
Widths = tuple[Count, ...]
ClipFile = Annotated[
    Clip | None,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="FILE",
        instance_from_str=lambda words: read_clip(words[0]),
        is_instance=lambda value: value is None or isinstance(value, Clip),
        str_from_instance=lambda clip: [str(clip)],
    ),
]
Seed = Annotated[int, Range("below 2^62 in size", lambda value: abs(value) < 2**62)]  # ranks add to it


@dataclass
class SimulatorFlags:
    """The task and how it is simulated."""

    env: Annotated[str, tyro.conf.arg(aliases=["--env-id"])] = "ant"
    """task, one of diffsim.TASKS"""
    accuracy: Literal["fast", "default", "accurate"] = "default"
    """preset of integrator, substeps and theta (docs/accuracy.md); default is the paper's"""
    integrator: Literal["semi_implicit", "implicit", "extrapolated"] = "semi_implicit"
    """time integration (per task and --accuracy)"""
    substeps: Count = 16
    """simulation steps per control step (per task and --accuracy)"""
    theta: Fraction = 0.0
    """how implicit the stiffness is with --integrator implicit (per task and --accuracy)"""
    contact: Literal["soft", "firm"] = "soft"
    """constants of contact and limits (docs/transfer.md): the paper's, or such as another simulator agrees with"""
    penalty: tuple[str, ...] = ()
    """constants of contact and limits in place of the robot file's, e.g. k_n=1e5 k_d=1e4"""
    early_termination: bool = True
    """end episodes where the robot falls, as the task says; otherwise only their time ends them"""
    clip: ClipFile = None
    """motion that humanoid_imitation tracks (docs/imitation.md): an .npz file, or the name of a shipped one"""
    threads: Natural = 0
    """CPU threads of the simulator, which change no result (0: as many as have work)"""


@dataclass
class RunFlags:
    """Where and how long it runs, what it writes."""

    seed: Seed = 1
    """seed of all random numbers"""
    iterations: Count = 2000
    """learning iterations (per task)"""
    device: str = "auto"
    """torch device of simulation and learning, e.g. cpu or cuda:0 (auto: the GPU if there is one)"""
    run_dir: Path | None = None
    """directory of the run (default: runs/{env}__{script}__{seed}__{time}, or the resumed checkpoint's)"""
    eval_every: Natural = 100
    """evaluate the deterministic policy every this many iterations (0: only at the end)"""
    eval_episodes: Count = 64
    """episodes of an evaluation, one in each of as many fresh environments"""
    save_every: Natural = 100
    """save the checkpoint every this many iterations (0: only at the end)"""
    stop_after: Natural = 0
    """stop at this iteration as Ctrl-C would, saved, to be resumed; schedules still run to --iterations (0: do not)"""
    resume: Path | None = None
    """checkpoint to continue from; its arguments hold where the command line gives no other"""
    evaluate: Path | None = None
    """checkpoint to evaluate without training, e.g. with other --substeps; writes evaluation.json to --run-dir"""
    finer: bool = True
    """with --evaluate, also measure the return at four times the substeps, explicitly integrated"""
    capture_video: bool = False
    """write video.mp4: the first 10 s of the last evaluation's median episode"""
    track: bool = False
    """also log to Weights & Biases (pip install wandb)"""
    quiet: bool = False
    """no progress bar"""


@dataclass
class Flags(SimulatorFlags, RunFlags):
    """What every script takes. Each extends it by its hyperparameters."""

    FIXED: ClassVar[tuple[str, ...]] = ("env", "clip")  # what a checkpoint decides

    def task_defaults(self) -> dict[str, Any]:
        """Defaults that depend on other flags, such as the task, the device or the preset."""
        return {}

    def check(self) -> None:
        """Ends the script where arguments do not fit together."""
        if self.clip and not issubclass(TASKS[self.env], HumanoidImitation):
            fail(f"--clip is of {HumanoidImitation.name}: {self.env} tracks no motion")

    @classmethod
    def script(cls) -> str:
        """Name of the script that declares the class, without .py."""
        return Path(str(sys.modules[cls.__module__].__file__)).stem


@dataclass
class ParallelFlags(Flags):
    """Many environments at once."""

    FIXED: ClassVar[tuple[str, ...]] = (*Flags.FIXED, "num_envs")

    num_envs: Count = 64
    """parallel environments N, over all processes of torchrun (per task)"""
    cuda_graph: bool = True
    """on a GPU, replay an iteration as CUDA graphs; otherwise the same code runs operation by operation"""
    anneal: tuple[Fraction, Fraction] = (0.2, 0.55)
    """with --contact firm, shares of the iterations between which contact goes from soft to firm"""
    randomise: tuple[str, ...] = ()
    """ranges of factors drawn for each environment: friction=0.7:1.3 stiffness mass motor (per --contact)"""
    redraw: Count = 10
    """iterations between drawings of the factors"""

    def check(self) -> None:
        super().check()
        if self.anneal[0] > self.anneal[1]:
            fail(f"--anneal {self.anneal[0]} {self.anneal[1]} are the wrong way round")
        try:
            parse_ranges(self.randomise)
        except ValueError as error:
            fail(f"--randomise: {error}")
        if self.num_envs % distributed.size():
            fail(f"--num-envs {self.num_envs} cannot be split evenly among {distributed.size()} processes")


Args = TypeVar("Args", bound=Flags)


def flag(name: str) -> str:
    """The command line's name of a field."""
    return "--" + name.replace("_", "-")


def parse(kind: type[Args], argv: Sequence[str] | None = None) -> Args:
    """The command line as complete, checked arguments; anything wrong ends the script with one line.

    Defaults that depend on the task, its preset and the device fill what is not given. With --resume and --evaluate
    the arguments of the checkpoint take their place.

    Args:
        kind: the script's dataclass of arguments.
        argv: in place of the process's.
    """
    kinds = KernelCacheError, TooLargeError, ActionError, TerrainError, FloatingPointError, torch.OutOfMemoryError
    end_in_one_line(*kinds)
    argv = list(sys.argv[1:] if argv is None else argv)
    # The first pass finds what the defaults of the second depend on, so that its --help shows the task's own.
    args = _cli(kind, [word for word in argv if word not in ("-h", "--help")], kind())
    if args.resume and args.evaluate:
        fail("--resume and --evaluate exclude each other")
    if args.env not in TASKS:
        fail(f"unknown task {args.env!r}: choose from {', '.join(TASKS)}")
    if path := args.resume or args.evaluate:
        args = _continue(kind, argv, args, path)
    else:
        args.device = distributed.choose_device(args.device)
        defaults = dataclasses.replace(kind(), **_presets(args), **args.task_defaults())
        if issubclass(task := TASKS[args.env], HumanoidImitation):
            defaults.clip = read_clip(task.default_clip)
        args = _cli(kind, argv, defaults)
        args.device = distributed.choose_device(args.device)
    check_ranges(args)
    try:
        args.check()
    except TerrainError as error:
        fail(error)
    if args.capture_video and distributed.rank() == 0:
        try:
            render.check_opengl()
            render.check_video("video.mp4")
        except RuntimeError as error:
            fail(f"--capture-video: {error}")
    if args.run_dir is None:
        name = f"{args.env}__{args.script()}__{args.seed}__{int(time.time())}"
        args.run_dir = path.parent if path else Path("runs") / name
    return args


def _presets(args: Flags) -> dict[str, Any]:
    """What --accuracy and --contact stand for."""
    ranges = {"randomise": RANDOMISED if args.contact == "firm" else ()} if isinstance(args, ParallelFlags) else {}
    try:
        return ranges | TASKS[args.env].integration(args.accuracy, args.contact)._asdict()
    except ValueError as error:
        fail(error)


def _continue(kind: type[Args], argv: list[str], given: Args, path: Path) -> Args:
    """The arguments of --resume or --evaluate: the checkpoint's, then the command line's."""
    saved = checkpoint.load(path, kind.script())
    if given.resume and "modules" not in saved:
        fail(f"{path} holds a policy alone, which can be evaluated but not resumed")
    try:
        defaults = kind(**saved["args"])
    except TypeError:
        unknown = ", ".join(flag(name) for name in saved["args"] if not hasattr(kind, name))
        fail(f"{path} was written by a {kind.script()}.py with other flags: {unknown}")
    if given.evaluate:
        defaults.device = "auto"  # wherever it was trained
    words = {word.partition("=")[0] for word in argv}
    if chosen := {name: getattr(given, name) for name in ("accuracy", "contact") if flag(name) in words}:
        # A preset replaces the saved numbers.
        presets = _presets(dataclasses.replace(defaults, **chosen))
        if "contact" not in chosen:
            presets.pop("randomise", None)
        defaults = dataclasses.replace(defaults, **presets)
    args = _cli(kind, argv, defaults)
    args.device = distributed.choose_device(args.device)
    for name in kind.FIXED:
        if getattr(args, name) != getattr(defaults, name):
            fail(f"{path} has {flag(name)} {getattr(defaults, name)}, not {getattr(args, name)}")
    if args.resume:
        last = min(args.iterations, args.stop_after or args.iterations)
        if saved["iteration"] >= last:
            fail(f"{path} is at iteration {saved['iteration']} already: give more --iterations or --stop-after")
        if (ranks := len(saved["ranks"])) != distributed.size():
            fail(f"{path} was trained by {ranks} processes, not {distributed.size()}")
        if args.device.partition(":")[0] != defaults.device.partition(":")[0]:
            fail(f"{path} was trained on {defaults.device}, which {args.device} cannot continue exactly")
    return args


def _cli(kind: type[Args], argv: list[str], defaults: Args) -> Args:
    """One pass of tyro, which shows what each class of the hierarchy declares as a group of its own."""
    fields, groups, seen = list[tuple[str, Any]](), list[Any](), set[str]()
    for owner in (base for base in kind.__mro__ if dataclasses.is_dataclass(base)):
        hints, texts = get_type_hints(owner, include_extras=True), _help_texts(owner)
        own = [name for name in texts if name not in seen]
        seen.update(own)
        if own:
            flags = [(name, Annotated[hints[name], tyro.conf.arg(help=texts[name])]) for name in own]
            group = dataclasses.make_dataclass(owner.__name__, flags, namespace={"__doc__": owner.__doc__})
            title = kind.script() if owner is kind else owner.__name__.removesuffix("Flags").lower()
            fields.append((f"group{len(groups)}", Annotated[group, tyro.conf.arg(name=title)]))
            groups.append(group(**{name: getattr(defaults, name) for name in own}))
    every = dataclasses.make_dataclass(kind.__name__, fields)
    description = sys.modules[kind.__module__].__doc__
    config = (tyro.conf.OmitArgPrefixes,)
    parsed: Any = parse_command_line(every, argv, description=description, default=every(*groups), config=config)
    return kind(**{name: value for group in vars(parsed).values() for name, value in vars(group).items()})


@cache
def _help_texts(owner: type) -> dict[str, str]:
    """The string below each field that a class itself declares."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
    texts = {}
    for field, text in itertools.pairwise(node.body if isinstance(node, ast.ClassDef) else []):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            texts[field.target.id] = ast.literal_eval(text.value)
    return texts


def check_ranges(args: object) -> None:
    """End the script where a number of a dataclass of flags is not in the range that its type asks for."""
    for name, hint in get_type_hints(type(args), include_extras=True).items():
        value = getattr(args, name)
        for number, allowed in _ranges(hint, value):
            if complaint := allowed.complaint(number):
                fail(f"{flag(name)} {complaint}")


def _ranges(hint: Any, value: Any) -> list[tuple[float, Range]]:
    """The numbers of a value with what each may be; of a tuple those of its elements."""
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        kinds = kinds[:1] * len(value) if kinds[-1] is Ellipsis else kinds
        return [found for kind, number in zip(kinds, value, strict=True) for found in _ranges(kind, number)]
    return [(value, marker) for marker in getattr(hint, "__metadata__", ()) if isinstance(marker, Range)]


def parse_penalty(items: Sequence[str]) -> dict[str, float]:
    """Of the flag --penalty k_n=1e5 k_d=1e4: {"k_n": 1e5, "k_d": 1e4}; anything else ends the script."""
    try:
        return {name: float(value) for name, _, value in (item.partition("=") for item in items)}
    except ValueError:
        fail(f"--penalty takes pairs like k_n=1e5, not {' '.join(items)!r}")
