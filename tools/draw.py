"""Pictures of policies at work, written to docs/figures: a gif of each task, a strip of frames.

    python tools/draw.py loops
    python tools/draw.py gait runs/<run>/checkpoint.pt --start 2 --every 0.1 --frames 8

Muscles are coloured by activation, as in the SHAC paper's Figure 5. A gif shows the median one of several episodes of
the policy in diffsim/policies; that of a runner ends where it resembles its first frame most, so that it plays in a
loop. The gait is that of the first of a few random episodes that lasts long enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import tyro
from tyro.conf import Positional

from diffsim.__main__ import DEMO_EPISODES, POLICIES
from diffsim.training import Evaluation, command, evaluate, fail, load_policy, make_policy_env
from diffsim.view.render import Frame, Renderer, save_video

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
# How many times closer than the robot's camera, and at which share of that one's height the picture's middle is.
CLOSER = {
    "cartpole": (1.6, 0.38),
    "hopper": (1.6, 0.62),
    "half_cheetah": (1.4, 0.5),
    "ant": (1.4, 0.53),
    "humanoid": (1.6, 0.56),
    "humanoid_mtu": (1.2, 0.52),
    "go2": (1.3, 0.55),
    "g1": (1.4, 0.51),
}


def loops(
    tasks: tuple[str, ...] = tuple(CLOSER),
    size: tuple[int, int] = (320, 240),
    every: int = 3,
    start: float = 2.0,
    seconds: tuple[float, float] = (2.0, 3.0),
) -> None:
    """A gif of each trained policy that comes with the package.

    Args:
        tasks: which ones.
        size: width and height in pixels.
        every: control steps between frames.
        start: seconds into the episode before which no loop begins; a cart-pole is shown from its start.
        seconds: least and most of a loop; a cart-pole, which does not travel, is shown for 3.5 s.
    """
    for task in tasks:
        episodes = episodes_of(Path(str(POLICIES / f"{task}.pt")), DEMO_EPISODES)
        qpos, action = (rows[::every] for rows in episodes.median_episode())
        (zoom, middle), (width, height) = CLOSER[task], size
        wide, high = round(2 * zoom * width), round(2 * zoom * height)
        left, top = wide // 2 - width, round(middle * high) - height
        with Renderer(episodes.scene, wide, high) as renderer:
            drawn = map(renderer.draw, qpos, action)
            frames = [halve(frame[top : top + 2 * height, left : left + 2 * width]) for frame in drawn]
        fps = 1 / (every * episodes.control_dt)
        first, last = 0, round(3.5 * fps)
        if episodes.speed is not None:
            first, last = find_loop(frames, round(start * fps), *(round(length * fps) for length in seconds))
        path = save_video(FIGURES / f"{task}.gif", frames[first:last], fps)
        print(f"{path}, {(last - first) / fps:.2f} s, {path.stat().st_size / 1000:.0f} kB")


def find_loop(frames: Sequence[Frame], start: int, shortest: int, longest: int) -> tuple[int, int]:
    """The range of frames whose end resembles its begin most: gait and floor, of which 8 x 8 pixels are compared."""
    small = np.array([frame[::8, ::8] for frame in frames], dtype=np.float32)
    lengths = range(shortest, longest + 1)
    ranges = [(first, first + length) for length in lengths for first in range(start, len(frames) - length)]
    return min(ranges, key=lambda ends: np.abs(small[ends[1]] - small[ends[0]]).mean())


def gait(
    checkpoint: Positional[Path], start: float = 2.0, every: float = 0.1, frames: int = 8, size: int = 240
) -> None:
    """Frames of a policy at work, beside each other.

    Args:
        checkpoint: the policy's, of any script.
        start: seconds into the episode of the first frame.
        every: seconds between frames.
        frames: how many.
        size: width and height of a frame in pixels.
    """
    from PIL import Image

    episodes = episodes_of(checkpoint, 16)
    wanted = [round((start + k * every) / episodes.control_dt) for k in range(frames)]
    lasting = episodes.lengths > wanted[-1]
    if not lasting.any():
        fail(f"none of {len(lasting)} episodes lasts {start + (frames - 1) * every:.2f} s")
    qpos, action = (rows[wanted] for rows in episodes.episode(int(lasting.int().argmax())))
    path = FIGURES / f"{load_policy(checkpoint).args['env']}_gait.png"
    with Renderer(episodes.scene, 2 * size, 2 * size) as renderer:
        Image.fromarray(halve(np.concatenate([*map(renderer.draw, qpos, action)], axis=1))).save(path)
    print(path)


def episodes_of(checkpoint: Path, count: int) -> Evaluation:
    saved = load_policy(checkpoint)
    return evaluate(make_policy_env(saved, count), saved.network)


def halve(frame: Frame) -> Frame:
    """2 x 2 pixels into one: smooth edges."""
    height, width = frame.shape[0] // 2, frame.shape[1] // 2
    return frame.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)).round().astype(np.uint8)


@command
def main() -> None:
    torch.set_num_threads(1)
    tyro.extras.subcommand_cli_from_dict({"loops": loops, "gait": gait}, description=__doc__)


if __name__ == "__main__":
    main()
