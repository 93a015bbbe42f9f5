"""Pictures of the robots, written to docs/figures: the six tasks side by side, or a strip of frames of a learned gait.

    python tools/draw.py tasks
    python tools/draw.py gait runs/<run>/checkpoint.pt --start 2 --every 0.1 --frames 8

Muscles are coloured by activation, as in the SHAC paper's Figure 5. The gait is that of the first of a few random
episodes that lasts long enough.
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
from numpy.typing import NDArray
from torch import Tensor

import diffsim
from diffsim.render import render_frames
from diffsim.training import Count, NonNegative, Positive, evaluate, fail, load_policy, parse_penalty
from diffsim.training.flags import check_ranges

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
TASKS = ("cartpole", "hopper", "half_cheetah", "ant", "humanoid", "humanoid_mtu")


@dataclass
class Tasks:
    """The start of an episode of each task."""

    size: Count = 320
    """width and height of a robot's picture in pixels"""


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


def write_strip(name: str, frames: Sequence[NDArray[np.uint8]], size: int) -> None:
    """Frames of twice the size side by side, 2 x 2 pixels into one: smooth edges."""
    strip = np.concatenate(frames, axis=1).astype(np.float32)
    strip = strip.reshape(size, 2, len(frames) * size, 2, 3).mean(axis=(1, 3))
    path = FIGURES / f"{name}.png"
    imageio.imwrite(path, strip.round().astype(np.uint8))
    print(path)


def draw_tasks(args: Tasks) -> None:
    envs = [diffsim.make(name, num_envs=1, stochastic_init=False) for name in TASKS]
    frames = [render_frames(env.scene, env.qpos.numpy(), 2 * args.size, 2 * args.size)[0] for env in envs]
    write_strip("tasks", frames, args.size)


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
    write_strip(f"{env.task.name}_gait", list(frames), args.size)


if __name__ == "__main__":
    args = tyro.cli(Tasks | Gait, description=__doc__)
    check_ranges(args)
    draw_tasks(args) if isinstance(args, Tasks) else draw_gait(args)
