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
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
import tyro
from PIL import Image
from tyro.conf import Positional

from diffsim.__main__ import DEMO_EPISODES, POLICIES
from diffsim.training import command, evaluate, fail, load_policy, make_policy_env
from diffsim.training.evaluation import travels
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
        saved = load_policy(Path(str(POLICIES / f"{task}.pt")))
        episodes = evaluate(make_policy_env(saved, DEMO_EPISODES), saved.network)
        qpos, action = (rows[::every] for rows in episodes.median_episode())
        (zoom, middle), (width, height) = CLOSER[task], size
        wide, high = round(2 * zoom * width), round(2 * zoom * height)
        left, top = wide // 2 - width, round(middle * high) - height
        shown = slice(top, top + 2 * height), slice(left, left + 2 * width)
        frames = [halve(frame[shown]) for frame in render_frames(episodes.scene, qpos, wide, high, ctrl=action)]
        fps = 1 / (every * episodes.control_dt)
        first, last = 0, round(3.5 * fps)
        if travels(episodes.scene):
            first, last = find_loop(frames, round(start * fps), *(round(length * fps) for length in seconds))
        write_gif(FIGURES / f"{task}.gif", frames[first:last], fps)


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
    saved = load_policy(checkpoint)
    episodes = evaluate(make_policy_env(saved, 16), saved.network)
    wanted = [round((start + k * every) / episodes.control_dt) for k in range(frames)]
    lasting = episodes.lengths > wanted[-1]
    if not lasting.any():
        fail(f"none of {len(lasting)} episodes lasts {start + (frames - 1) * every:.2f} s")
    qpos, action = (rows[wanted] for rows in episodes.episode(int(lasting.int().argmax())))
    path = FIGURES / f"{saved.args['env']}_gait.png"
    pictures = render_frames(episodes.scene, qpos, 2 * size, 2 * size, ctrl=action)
    imageio.imwrite(path, halve(np.concatenate(pictures, axis=1)))
    print(path)


def stack(videos: Positional[tuple[Path, ...]], start: float = 2.0, seconds: float = 3.0, every: int = 3) -> None:
    """A gif of videos, below each other and half as large.

    Args:
        videos: of one width, 30 frames/s and true speed.
        start: seconds into the videos at which the gif begins.
        seconds: length of the gif.
        every: frames of the videos between its frames.
    """
    chosen = slice(round(start * VIDEO_FPS), round((start + seconds) * VIDEO_FPS), every)
    columns = zip(*([halve(frame) for frame in imageio.imread(path)[chosen]] for path in videos), strict=True)
    write_gif(FIGURES / "transfer.gif", [np.concatenate(frames) for frames in columns], VIDEO_FPS / every)


def halve(frame: Frame) -> Frame:
    """2 x 2 pixels into one: smooth edges."""
    height, width = frame.shape[0] // 2, frame.shape[1] // 2
    return frame.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)).round().astype(np.uint8)


def write_gif(path: Path, frames: Sequence[Frame], fps: float) -> None:
    """In the same colours throughout, without dithering: small, and nothing flickers."""
    palette = Image.fromarray(np.concatenate(frames[::8])).quantize(COLOURS, Image.Quantize.FASTOCTREE)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    images[0].save(path, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
    print(f"{path}, {len(frames) / fps:.2f} s, {path.stat().st_size / 1000:.0f} kB")


@command
def main() -> None:
    torch.set_num_threads(1)
    tyro.extras.subcommand_cli_from_dict({"loops": loops, "gait": gait, "stack": stack}, description=__doc__)


if __name__ == "__main__":
    main()
