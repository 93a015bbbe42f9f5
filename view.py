"""Show the policy of any script's checkpoint: as a video, as a web page, or in a window.

    python view.py runs/<run>/checkpoint.pt --video ant.mp4     a file for a talk or a web site; .gif as well
    python view.py runs/<run> --web ant.html                    one page for any browser, without network access
    python view.py runs/<run> --viewer                          MuJoCo's window; this simulator moves the robot
    python view.py runs/* --plot curves.png                     return against control steps and seconds

Video and page show the beginning of the median one of several episodes. `diffsim drive` lets a robot be pushed.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from diffsim import DiffEnv
from diffsim.tasks import find_task
from diffsim.training import command, evaluate, fail, load_policy, make_policy_env
from diffsim.training.evaluation import SEED, VIDEO_SECONDS, gait_lines
from diffsim.view import render, web
from diffsim.view.screen import Screen

DRAWN = "control_steps", "seconds", "return", "eval_return"  # columns of progress.csv


@dataclass
class Args:
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CHECKPOINT")]
    """checkpoint of any script, or the directory of its run; several with --plot"""
    video: Path | None = None
    """write a video: .mp4 or .gif"""
    web: Path | None = None
    """write a page that plays the motion in a browser: .html"""
    viewer: bool = False
    """open MuJoCo's window and simulate there in real time"""
    plot: Path | None = None
    """draw the progress.csv of the runs: .png, .svg or .pdf"""
    seconds: float = VIDEO_SECONDS
    """how much of an episode video and page show"""
    episodes: int = 8
    """of as many episodes they show the one of median return"""
    env: str | None = None
    """file of the task, if it is your own: it is run"""
    seed: int = SEED
    """of the start states"""
    substeps: int | None = None
    """simulation steps per control step instead of those of the training"""
    size: tuple[int, int] = (640, 480)
    """width and height of the video in pixels, multiples of 16"""

    def check(self) -> None:
        """Refuse what the machine or the arguments forbid, before any work."""
        if not (self.video or self.web or self.viewer or self.plot):
            fail("nothing to show: give --video, --web, --viewer or --plot")
        if not self.paths:
            fail("of what? give a checkpoint or the directory of a run")
        if min(self.episodes, *self.size, self.substeps or 1) <= 0 or not 0 < self.seconds < math.inf:
            fail("--seconds, --episodes, --substeps and --size must be positive")
        if len(self.paths) > 1 and (self.video or self.web or self.viewer):
            fail("--video, --web and --viewer show one checkpoint; several are for --plot")
        if self.viewer and (self.video or self.web):
            fail("--viewer goes without --video and --web")
        if self.web and self.web.suffix != ".html":
            fail(f"--web: a page ends in .html, not {self.web.suffix!r}")
        if self.plot and self.plot.suffix not in (".png", ".svg", ".pdf"):
            fail(f"--plot: a picture ends in .png, .svg or .pdf, not {self.plot.suffix!r}")
        try:
            if self.video:
                render.check_video(self.video, self.size)
                render.check_opengl()
        except (ValueError, RuntimeError) as error:
            fail(f"--video: {error}")


@command
def main(argv: Sequence[str] | None = None) -> None:
    args = tyro.cli(Args, args=argv, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,))
    args.check()
    torch.set_num_threads(1)  # operations this small gain nothing from more
    try:
        if args.plot:
            plot([path if path.is_dir() else path.parent for path in args.paths], args.plot)
        if args.video or args.web or args.viewer:
            show(args)
    except (OSError, RuntimeError, ValueError) as error:
        fail(error)


def show(args: Args) -> None:
    path = args.paths[0]
    saved = load_policy(path / "checkpoint.pt" if path.is_dir() else path)
    changes: dict[str, Any] = {"env": saved.task(args.env)} | ({"substeps": args.substeps} if args.substeps else {})
    task, name = find_task(changes["env"]).name, f"{saved.script}.py, iteration {saved.iteration}"
    if args.viewer:
        print(f"{task}, {name}")
        play(make_policy_env(saved, 1, **changes), saved.network, args.seed)
        return
    env = make_policy_env(saved, args.episodes, **changes)
    evaluation = evaluate(env, saved.network, args.seed)
    print(f"{task}, {name}, {args.episodes} episodes: {evaluation}")
    if feet := evaluation.gait():
        print(gait_lines(feet))
    (qpos, action), ghost = evaluation.median_episode(args.seconds), evaluation.median_ghost()
    if args.video:
        print(f"video: {render.film(args.video, env.scene, qpos, env.control_dt, action, args.size, ghost)}")
    if args.web:
        caption = f"{name}\nreturn {evaluation.returns.median():.1f}"
        print(f"page: {web.write_page(args.web, env.scene, qpos, env.control_dt, action, task, caption, ghost)}")


@torch.no_grad()
def play(env: DiffEnv, policy: torch.nn.Module, seed: int) -> None:
    """Let the policy act on one environment in a window, until it is closed."""
    obs, _ = env.reset(seed=seed)
    with closing(Screen(env.scene, "human", 1 / env.control_dt)) as screen:
        while screen.is_open:
            screen.show(env.qpos.numpy())
            obs, *_ = env.step(policy(obs))


def plot(directories: Sequence[Path], output: Path) -> None:
    """Return against control steps and seconds: a line for training, dots for evaluations of the policy alone."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RuntimeError("--plot needs matplotlib: pip install matplotlib") from error
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for number, directory in enumerate(directories):
        progress = read_progress(directory / "progress.csv")
        for axis, x in zip(axes, DRAWN[:2], strict=True):
            axis.plot(progress[x], progress["return"], color=f"C{number}", label=label(directory))
            axis.plot(progress[x], progress["eval_return"], "o", color=f"C{number}", markersize=4)
            axis.set_xlabel(x.replace("_", " "))
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("return (line: training, dots: evaluation)")
    axes[0].legend(frameon=False, fontsize="small")
    with render.whole_file(output) as part:
        figure.savefig(part, dpi=150)
    print(f"curves: {output}")


def label(directory: Path) -> str:
    """A run's name for a legend, which takes dollars for mathematics, hides what begins with _ and draws Unicode."""
    name = os.fsencode(directory.resolve().name).decode(errors="replace").replace("$", r"\$")
    return f" {name}" if name.startswith("_") else name


def read_progress(path: Path) -> dict[str, NDArray[np.float64]]:
    """The columns that are drawn, NaN where a row has no value."""
    if not path.is_file():
        fail(f"no such file: {path}; --plot takes directories of runs")
    try:
        with path.open(newline="") as file:
            rows = [*csv.DictReader(file)]
        columns = {name: np.array([float(row.get(name) or "nan") for row in rows]) for name in DRAWN}
    except (ValueError, csv.Error) as error:
        fail(f"{path} is not what a run has written: {error}")
    return columns if rows else fail(f"{path} holds no iteration yet")


if __name__ == "__main__":
    main()
