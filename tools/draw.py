"""Pictures of policies at work, written to docs/figures: a gif of each task, a strip of frames, a gif of videos.

    python tools/draw.py loops
    python tools/draw.py gait runs/<run>/checkpoint.pt --start 2 --every 0.1 --frames 8
    python tools/draw.py stack humanoid.mp4 ant.mp4          videos of benchmarks/transfer.py --video below each other

Muscles are coloured by activation, as in the SHAC paper's Figure 5. A gif shows the median one of several episodes of
the policy in diffsim/policies; that of a runner ends where it resembles its first frame most, so that it plays in a
loop. The gait is that of the first of a few random episodes that lasts long enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import imageio.v3 as imageio
import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor

import diffsim
from diffsim.__main__ import DEMO_EPISODES, POLICIES
from diffsim.training import Count, NonNegative, Positive, evaluate, fail, load_policy, make_policy_env, parse_penalty
from diffsim.training.evaluation import travels
from diffsim.training.ranges import check_ranges
from diffsim.view.render import VIDEO_FPS, Frame, render_frames

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
# How many times closer than the robot's camera, and at which share of that one's height the picture's middle is.
CLOSER = {
    "cartpole": (1.6, 0.38),
    "hopper": (1.6, 0.62),
    "half_cheetah": (1.4, 0.5),
    "ant": (1.4, 0.53),
    "humanoid": (1.6, 0.56),
    "humanoid_mtu": (1.2, 0.52),
}
COLOURS = 128


@dataclass
class Loops:
    """A gif of each trained policy that comes with the package."""

    tasks: tuple[str, ...] = tuple(CLOSER)
    """of these tasks"""
    size: tuple[int, int] = (320, 240)
    """width and height in pixels"""
    every: Count = 3
    """control steps between frames"""
    start: NonNegative = 2.0
    """seconds into the episode before which no loop begins; a cart-pole is shown from its start"""
    seconds: tuple[float, float] = (2.0, 3.0)
    """of a loop, at least and at most; a cart-pole, which does not travel, is shown for 3.5 s"""


@dataclass
class Gait:
    """Frames of a policy at work."""

    checkpoint: Annotated[Path, tyro.conf.Positional]
    """of any script"""
    start: NonNegative = 2.0
    """seconds into the episode of the first frame"""
    every: Positive = 0.1
    """seconds between frames"""
    frames: Count = 8
    """number of frames"""
    size: Count = 240
    """width and height of a frame in pixels"""


@dataclass
class Stack:
    """A gif of videos, below each other and half as large."""

    videos: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """of one width, 30 frames/s and true speed"""
    start: NonNegative = 2.0
    """seconds into the videos at which the gif begins"""
    seconds: Positive = 3.0
    """of the gif"""
    every: Count = 3
    """frames of the videos between its frames"""


def halve(frame: Frame) -> Frame:
    """2 x 2 pixels into one: smooth edges."""
    height, width = frame.shape[0] // 2, frame.shape[1] // 2
    return frame.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)).round().astype(np.uint8)


def draw_loop(task: str, args: Loops) -> None:
    saved = load_policy(Path(str(POLICIES / f"{task}.pt")))
    episodes = evaluate(make_policy_env(saved, DEMO_EPISODES), saved.network)
    qpos, action = (rows[:: args.every] for rows in episodes.median_episode())
    (zoom, middle), (width, height) = CLOSER[task], args.size
    wide, high = round(2 * zoom * width), round(2 * zoom * height)
    left, top = wide // 2 - width, round(middle * high) - height
    shown = slice(top, top + 2 * height), slice(left, left + 2 * width)
    frames = [halve(frame[shown]) for frame in render_frames(episodes.scene, qpos, wide, high, ctrl=action)]
    fps = 1 / (args.every * episodes.control_dt)
    first, last = find_loop(frames, fps, args) if travels(episodes.scene) else (0, round(3.5 * fps))
    write_gif(FIGURES / f"{task}.gif", frames[first:last], fps)


def find_loop(frames: Sequence[Frame], fps: float, args: Loops) -> tuple[int, int]:
    """The range of frames whose end resembles its begin most: gait and floor, of which 8 x 8 pixels are compared."""
    small = np.array([frame[::8, ::8] for frame in frames], dtype=np.float32)
    shortest, longest = (round(seconds * fps) for seconds in args.seconds)
    ranges = [
        (first, first + length)
        for length in range(shortest, longest + 1)
        for first in range(round(args.start * fps), len(frames) - length)
    ]
    return min(ranges, key=lambda ends: np.abs(small[ends[1]] - small[ends[0]]).mean())


def write_gif(path: Path, frames: Sequence[Frame], fps: float) -> None:
    """In the same colours throughout, without dithering: small, and nothing flickers."""
    palette = Image.fromarray(np.concatenate(frames[::8])).quantize(COLOURS, Image.Quantize.FASTOCTREE)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    images[0].save(path, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
    print(f"{path}, {len(frames) / fps:.2f} s, {path.stat().st_size / 1000:.0f} kB")


@torch.no_grad()
def draw_gait(args: Gait) -> None:
    saved, actions = load_policy(args.checkpoint), list[Tensor]()
    trained = saved.args
    how = {name: trained[name] for name in ("substeps", "integrator", "theta")}
    env = diffsim.make(trained["env"], 16, horizon=1, penalty=parse_penalty(trained["penalty"]), **how)

    def act(obs: Tensor) -> Tensor:
        actions.append(saved.network(obs))
        return actions[-1]

    episodes = evaluate(env, act)
    wanted = [round((args.start + k * args.every) / env.control_dt) for k in range(args.frames)]
    lasting = episodes.lengths > wanted[-1]
    if not lasting.any():
        fail(f"none of {env.num_envs} episodes lasts {args.start + (args.frames - 1) * args.every:.2f} s")
    first = int(lasting.int().argmax())
    qpos, ctrl = episodes.qpos[wanted, first].numpy(), torch.stack(actions)[wanted, first].numpy()
    frames = render_frames(env.scene, qpos, 2 * args.size, 2 * args.size, ctrl=ctrl)
    path = FIGURES / f"{env.task.name}_gait.png"
    imageio.imwrite(path, halve(np.concatenate(frames, axis=1)))
    print(path)


def stack(args: Stack) -> None:
    chosen = slice(round(args.start * VIDEO_FPS), round((args.start + args.seconds) * VIDEO_FPS), args.every)
    videos = [[halve(frame) for frame in imageio.imread(path)[chosen]] for path in args.videos]
    write_gif(
        FIGURES / "transfer.gif",
        [np.concatenate(frames) for frames in zip(*videos, strict=True)],
        VIDEO_FPS / args.every,
    )


if __name__ == "__main__":
    args = tyro.cli(Loops | Gait | Stack, description=__doc__)
    check_ranges(args)
    torch.set_num_threads(1)
    if isinstance(args, Gait):
        draw_gait(args)
    elif isinstance(args, Stack):
        stack(args)
    else:
        for task in args.tasks:
            draw_loop(task, args)
