"""What the benchmarks share: their flags, where their files go, their tables, and how their pictures are drawn."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np
import tables
import torch
import tyro
from tables import ROOT, Row

from diffsim import DiffEnv
from diffsim.sim.options import check_device
from diffsim.tasks import FILE, TaskError, find_task
from diffsim.training import NonNegative, Positive, SavedPolicy, command, fail, load_policy
from diffsim.training.errors import in_one_line
from diffsim.training.ranges import check_ranges
from diffsim_cli.watch import make_policy_env
from diffsim_robots.variation import on_a_plane

RESULTS, DOCS = ROOT / "results", ROOT / "docs"  # written with --update-results alone
OUTPUT = ROOT / "runs" / "benchmarks"
TaskName = Literal["cartpole", "hopper", "half_cheetah", "ant", "humanoid", "humanoid_mtu", "humanoid_imitation"]
LEARNT: tuple[TaskName, ...] = get_args(TaskName)
TASKS = LEARNT[:-1]  # those of the SHAC paper
Tasks = Annotated[tuple[TaskName, ...], tyro.conf.arg(aliases=["--env-id"])]
F = TypeVar("F", bound="CommonFlags")


@dataclass
class CommonFlags:
    """What every benchmark takes."""

    env: Tasks = TASKS  # tasks
    device: str = "cpu"  # torch device of the measurements, cpu or cuda (auto: the GPU if there is one)
    output: Path | None = None  # directory of csv files (default: runs/benchmarks/cpu or, by the GPU, e.g. .../h100)
    update_results: bool = False  # write to results/ and docs/figures/ of this repository, and fill the tables of docs/
    draw_only: bool = False  # measure nothing, read csv files
    machine: str = ""  # whose results these are, a folder of results/ (default: that of --device)
    arguments: tyro.conf.Suppress[tuple[str, ...]] = ()  # what follows "--" on the command line

    @property
    def measured(self) -> Sequence[Any]:
        """The tasks to measure, or what a benchmark measures instead: none with --draw-only."""
        return () if self.draw_only else self.env

    @property
    def place(self) -> str:
        return self.machine or machine(self.device)

    @property
    def directory(self) -> Path:
        tree = RESULTS if self.update_results else OUTPUT
        return self.output.resolve() if self.output else tree / self.place

    def csv(self, name: str) -> Path:
        return self.directory / f"{name}.csv"

    def read(self, name: str) -> list[dict[str, str]]:
        return tables.read_csv(self.csv(name))

    def replace(self, name: str, rows: Sequence[Row], key: Sequence[str]) -> list[dict[str, str]]:
        return tables.replace_csv(self.csv(name), rows, key, self.device)

    def keep(self, name: str, row: Row, key: Sequence[str]) -> None:
        """Print a row, and write it in place of the one with its key, as soon as it is measured."""
        shown = (f"{k} {tables.digits(v)}" for k, v in row.items() if k == "task" or k not in ABOUT)
        print("  " + ", ".join(shown), flush=True)
        self.replace(name, [row], key)

    def picture(self, name: str) -> Path:
        pages = DOCS / "figures" / self.directory.name.replace("cpu", "")
        return (pages if self.update_results else self.directory) / f"{name}.png"

    def publish(self, name: str, text: str, page: str, everywhere: bool = False) -> None:
        """Print a table; with --update-results fill the part of a page that has its name.

        Of one GPU's results the name is {name}_{machine}.
        """
        print(text)
        name = name if everywhere or self.directory.name == "cpu" else f"{name}_{self.directory.name}"
        if self.update_results and page and f"<!-- {name} -->" in (DOCS / page).read_text():
            tables.fill(DOCS / page, name, text)


def check_names(flag: str, names: Iterable[str], known: Iterable[str]) -> None:
    """End the benchmark with one line if a flag names what is not known."""
    if unknown := [name for name in names if name not in known]:
        fail(f"{flag}: there is no {unknown[0]!r}; choose from {', '.join(known)}")


@dataclass
class CheckpointFlags(CommonFlags):
    """What benchmarks of saved policies take. A policy says its task."""

    checkpoints: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="CHECKPOINT", help="checkpoint of any script, or its run"),
    ] = ()
    env: tyro.conf.Suppress[Tasks] = TASKS

    @property
    def measured(self) -> tuple[Path, ...]:
        """Those to measure. Without any the benchmark ends with one line."""
        if not (self.checkpoints or self.draw_only):
            fail("of what? give a checkpoint or the directory of a run")
        return () if self.draw_only else self.checkpoints


@dataclass
class ServoFlags(CheckpointFlags):
    """What benchmarks of robots with servos take: worlds in MuJoCo."""

    file: Path | None = None  # MJCF of the robot with a ground, in place of the task's
    friction: tuple[Positive, ...] = (0.7, 1.0, 1.3)  # factors of the friction in MuJoCo
    push: NonNegative = 0.0  # m/s, a change of the root's velocity in a random direction every 4 s
    race: bool = False  # checkpoints are those along the way of runs: seconds of training until they are good enough


ABOUT = ("checkpoint", "task", "learner", "contact", "seed", "iteration")  # columns that say which policy a row is of


class Case(NamedTuple):
    """A policy with the task on which it was trained."""

    label: str
    path: Path
    saved: SavedPolicy
    env: DiffEnv

    @property
    def about(self) -> dict[str, object]:
        """The cells of ABOUT."""
        args = self.saved.args
        learner = " ".join((self.saved.script, *(args[name] for name in ("policy",) if name in args)))
        learner += " --symmetric" if args.get("symmetric") else ""
        learner += " randomised" if self.env.task.varied_by else ""
        learner += f" --initial-log-std {first:g}" if (first := args.get("initial_log_std")) else ""
        learner += " --onset {:g} {:g}".format(*onset) if any(onset := args.get("onset", ())) else ""
        if not FILE.fullmatch(args["env"]) and (slope := getattr(find_task(args["env"]), "slope", 0.0)):
            learner += f" rough {slope:g}"
        contact = " ".join((args.get("contact", "soft"), *args.get("penalty", ())))
        values = self.label, self.env.task.name, learner, contact, args["seed"], self.saved.iteration
        return dict(zip(ABOUT, values, strict=True))


def checkpoint_of(path: Path) -> Path:
    """A checkpoint, or that of a run."""
    return (path / "checkpoint.pt" if path.is_dir() else path).resolve()


def load_case(path: Path, num_envs: int, device: str, own: str | None = None) -> Case:
    """The policy of a checkpoint or of a run's, on a plane; own: FILE:CLASS of its task, whose code runs. One of
    another task ends the benchmark with one line."""
    path = checkpoint_of(path)
    saved = load_policy(path)
    try:
        find_task(task := saved.task(own))
    except TaskError as error:
        fail(f"{path} was trained elsewhere: {error}")
    run = path.parent if path.name == "checkpoint.pt" else path.with_suffix("")
    return Case(
        f"{run.parent.name}/{run.name}",
        path,
        saved,
        make_policy_env(saved, num_envs, device=device, env=on_a_plane(task)),
    )


def machine(device: str) -> str:
    """cpu, or a GPU's short name: "NVIDIA H100 80GB HBM3" is h100."""
    if not device.startswith("cuda"):
        return "cpu"
    name = torch.cuda.get_device_name(device).lower()
    return found[0] if (found := re.search(r"[a-z]*\d+", name)) else name


def parse(kind: type[F], description: str | None, argv: Sequence[str] | None = None) -> F:
    """The command line, checked before anything is measured; what follows "--" goes to the scripts that it runs."""
    words = [*(sys.argv[1:] if argv is None else argv), "--"]
    end = words.index("--")
    with in_one_line(words[:end]):
        args = tyro.cli(kind, args=words[:end], description=description, config=(tyro.conf.FlagCreatePairsOff,))
    args.arguments = tuple(words[end + 1 : -1])
    check_ranges(args)
    if args.output and args.update_results:
        fail("--output and --update-results exclude each other")
    if args.device == "auto":
        args.device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        check_device(args.device)
    except ValueError as error:
        fail(error)
    if args.update_results and (found := tables.unknown(tables.origin(args.device))):
        fail(f"--update-results needs a known machine, known versions and a committed revision, not {found}")
    torch.set_num_threads(1)  # as in training: idle threads of torch disturb the simulator's
    return args


@command
def run(main: Callable[[F], None], kind: type[F], description: str | None) -> None:
    """A benchmark from its command line; what its user got wrong ends it with one line."""
    main(parse(kind, description))


class Part(NamedTuple):
    """One table of a benchmark: what measures it, and where it goes."""

    csv: str
    measure: Callable[[Any, Any], Iterable[Row]]  # called with the flags, and a task or a checkpoint
    key: tuple[str, ...]  # columns in which a new row and the one that it replaces agree
    table: str = ""  # its name in a page
    page: str = ""
    shown: Callable[[list[dict[str, str]]], Sequence[Row]] = list  # what the page shows of the rows
    columns: tuple[str, ...] | None = None  # and of these; all if None


def measured(args: CommonFlags, part: Part) -> list[dict[str, str]]:
    """All rows of a part's csv file, by their tasks; each of those asked for is kept as soon as it is measured."""
    for case in args.measured:
        for row in part.measure(args, case):
            args.keep(part.csv, row, part.key)
    order: dict[str, int] = {name: place for place, name in enumerate(LEARNT)}
    rows = sorted(args.read(part.csv), key=lambda row: order.get(row.get("task", "").partition(" ")[0], len(order)))
    args.publish(part.table, tables.markdown(part.shown(rows), part.columns), part.page)
    return rows


# Learners' names and colours in tables and pictures. What is not here, such as a learner with other flags, has a colour
# of OTHERS in its picture.
NAMES = {
    **{"rpo": "RPO", "shac": "SHAC", "sapo": "SAPO", "bptt": "BPTT", "mbpo": "MBPO", "se_mbpo": "SE-MBPO"},
    **{"ppo_baseline": "PPO, default", "ppo_4096": "PPO, 4,096 environments"},
    **{"sac_baseline": "SAC", "sac_large": "SAC, large batches", "redq": "REDQ", "redq_500": "REDQ, 500 iterations"},
    **{"shac_8": "SHAC", "ppo_8": "PPO, 4,096 environments", "ppo_16": "PPO, 4,096 environments"},
    **{f"shac_h{steps}": f"SHAC, rollouts of {steps} steps" for steps in (4, 8, 16, 64, 128)},
    **{"shac_no_critic": "SHAC without critic", "pods": "PODS", "pods_second": "PODS, second order"},
    **dict.fromkeys(("pfpn_ppo", "pfpn_sac"), "particles"),
    **dict.fromkeys(("pfpn_gaussian_ppo", "pfpn_gaussian_sac"), "Gaussian"),
}
COLOURS = {
    **{"rpo": "C0", "shac": "C1", "sapo": "C2", "ppo_baseline": "C3", "ppo_4096": "C3", "ppo_8": "C3", "ppo_16": "C3"},
    **{"bptt": "C4", "sac_baseline": "C5", "sac_large": "C5", "redq": "C6", "redq_500": "C6", "mbpo": "C7"},
    **{"se_mbpo": "C8", "pods": "C8", "pfpn_ppo": "C9", "pfpn_sac": "C9", "shac_8": "C1"},
}
OTHERS = "kbgmcy"


def colours(learners: Sequence[str]) -> dict[str, str]:
    """Give each learner of a picture its colour."""
    others = [learner for learner in learners if learner not in COLOURS]
    return COLOURS | dict(zip(others, OTHERS, strict=False))


Numbers = Sequence[float] | np.ndarray


class Line(NamedTuple):
    x: Numbers
    y: Numbers
    style: str = "-"  # colour, marker and line as matplotlib takes them, e.g. C0o-
    label: str = ""  # equal ones are one entry of the picture's legend
    width: float = 1.5
    notes: Sequence[str] = ()  # beside the points


def lines(rows: Iterable[Mapping[str, str]], x: str, y: str, by: str) -> list[Line]:
    """A line for each value of the column `by`, through its rows by their x."""
    found: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        found.setdefault(row[by], []).append((float(row[x]), float(row[y])))
    curves = {label: np.array(sorted(points)) for label, points in found.items()}
    return [Line(curve[:, 0], curve[:, 1], f"C{k}o-", label) for k, (label, curve) in enumerate(curves.items())]


class Panel(NamedTuple):
    lines: Sequence[Line]
    title: str = ""
    x: str = ""
    y: str = ""
    log: str = ""  # the logarithmic axes: x, y or xy


def label_decades(axis: Any) -> None:
    """Label a logarithmic axis with numbers that do not collide: few on one decade, 1, 2 and 5 on several."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    decades = np.log10(np.divide(*axis.get_view_interval()[::-1]))
    if decades < 1:
        axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]))
    if decades < 3:
        axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())
    if 1 <= decades < 1.8:
        axis.set_minor_locator(LogLocator(subs=(2, 5)))
        axis.set_minor_formatter("{x:g}")
    axis.set_tick_params(which="both", labelsize=8)


WIDE = 3  # panels in a row: their text can be read where a page shows 800 pixels


def plot(path: Path, grid: Sequence[Sequence[Panel]], size: tuple[float, float] = (3.4, 2.9)) -> None:
    """Draw rows of panels, each of a size in inches, in blocks of WIDE columns below each other."""
    if not grid[0]:
        return
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    width = min(WIDE, len(grid[0]))
    blocks = [row[k : k + width] for k in range(0, len(grid[0]), width) for row in grid]
    grid = [[*row, *[Panel([])] * (width - len(row))] for row in blocks]
    figure = Figure(figsize=(width * size[0], len(grid) * size[1]), layout="constrained")
    axes = figure.subplots(len(grid), width, squeeze=False)
    legend: dict[str, Line2D] = {}
    for axis, panel in zip(axes.flat, chain(*grid), strict=True):
        axis.set_visible(bool(panel.lines))
        for line in panel.lines:
            (drawn,) = axis.plot(line.x, line.y, line.style, linewidth=line.width, markersize=4)
            legend |= {line.label: drawn} if line.label else {}
            for x, y, note in zip(line.x, line.y, line.notes, strict=False):
                axis.annotate(note, (x, y), xytext=(3, 3), textcoords="offset points", fontsize=8)
        axis.set(xlabel=panel.x, ylabel=panel.y)
        axis.set(xscale="log" if "x" in panel.log else "linear", yscale="log" if "y" in panel.log else "linear")
        for name in panel.log if panel.lines else "":
            label_decades(getattr(axis, f"{name}axis"))
        axis.set_title(panel.title, fontsize=10)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    columns = max(1, int(width * size[0] / (0.5 + 0.08 * max(map(len, legend), default=1))))  # inches
    if legend:
        figure.legend(legend.values(), legend, loc="outside lower center", ncols=columns, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(path)
