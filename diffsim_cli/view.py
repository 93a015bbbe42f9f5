"""Film the policy of any script's checkpoint: the beginning of an episode, of several the one of median return.

    diffsim view runs/<run> --video ant.mp4                   .gif as well

`diffsim drive` shows a robot live, in a browser.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from diffsim.training import command, evaluate, fail, load_policy
from diffsim.training.errors import in_one_line
from diffsim.training.evaluation import SEED
from diffsim_cli import gait, render
from diffsim_cli.watch import VIDEO_SECONDS, film_median, make_policy_env


@dataclass
class Args:
    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CHECKPOINT")]
    """checkpoint of any script, or the directory of its run"""
    video: Path = Path("video.mp4")
    """the file: .mp4 or .gif"""
    seconds: float = VIDEO_SECONDS
    """seconds of the episode to show"""
    episodes: int = 8
    """episodes; the one of median return is shown"""
    env: str | None = None
    """file of your own task; its code runs"""
    seed: int = SEED
    """seed of the start states"""
    substeps: int | None = None
    """simulation steps per control step instead of those of the training"""
    size: tuple[int, int] = (640, 480)
    """width and height of the video in pixels, multiples of 16"""

    def check(self) -> None:
        """Refuse what the machine or the arguments forbid, before any work."""
        if min(self.episodes, *self.size, self.substeps or 1) <= 0 or not 0 < self.seconds < math.inf:
            fail("--seconds, --episodes, --substeps and --size must be positive")
        try:
            render.check_video(self.video, self.size)
            render.check_opengl()
        except (ValueError, RuntimeError) as error:
            fail(f"--video: {error}")


@command
def main(argv: Sequence[str] | None = None) -> None:
    with in_one_line(argv):
        options = (tyro.conf.FlagCreatePairsOff,)
        args = tyro.cli(Args, prog="diffsim view", args=argv, description=__doc__, config=options)
    args.check()
    torch.set_num_threads(1)  # operations this small gain nothing from more
    try:
        show(args)
    except (OSError, RuntimeError, ValueError) as error:
        fail(error)


def show(args: Args) -> None:
    saved = load_policy(args.path)
    changes: dict[str, Any] = {"substeps": args.substeps} if args.substeps else {}
    env = make_policy_env(saved, args.episodes, env=args.env, **changes)
    evaluation = evaluate(env, saved.network, args.seed)
    print(f"{env.task.name}, {saved}, {args.episodes} episodes: {evaluation}")
    print(*gait.lines(gait.of_evaluation(evaluation)), sep="\n")
    print(f"video: {film_median(evaluation, args.video, args.seconds, size=args.size)}")
