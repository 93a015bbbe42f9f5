"""Draws a strip of frames of a learned gait, muscles coloured by activation (as the SHAC paper's Fig. 5).

    python tools/draw_gait.py runs/<run>/checkpoint.pt --start 2 --every 0.1 --frames 8

Writes docs/<task>_gait.png. The first of a few random episodes that lasts long enough is drawn.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import shac  # noqa: E402
from diffsim import evaluation  # noqa: E402
from diffsim.render import render_frames  # noqa: E402
from diffsim.run import fail  # noqa: E402


@dataclass
class Args:
    checkpoint: Annotated[Path, tyro.conf.Positional]
    """of shac.py"""
    start: float = 2.0
    """seconds into the episode of the first frame"""
    every: float = 0.1
    """seconds between frames"""
    frames: int = 8
    """number of frames"""
    size: int = 240
    """width and height of a frame in pixels"""
    output: Path | None = None
    """the picture; None: docs/<task>_gait.png"""


@torch.no_grad()
def main(args: Args) -> None:
    import imageio.v3 as imageio

    if min(args.frames, args.size) < 1 or args.start < 0 or args.every <= 0:
        fail("--frames and --size must be at least 1, --start not negative, --every positive")
    options, saved = shac.parse(["--evaluate", str(args.checkpoint), "--device", "cpu"])
    env = shac.make_env(options, num_envs=16, horizon=1)
    actor, normalise = shac.build(options, env)
    actor.load_state_dict(saved["actor"])
    normalise.load_state_dict(saved["normalise"])
    wanted = [round((args.start + k * args.every) / env.control_dt) for k in range(args.frames)]
    obs, _ = env.reset(seed=evaluation.SEED)
    alive = torch.ones(env.num_envs, dtype=torch.bool)
    states, controls = [], []
    for step in range(wanted[-1] + 1):
        action = actor(normalise(obs))
        if step in wanted:
            states.append(env.qpos)
            controls.append(action)
        lasting = alive
        obs, _, terminated, truncated, _ = env.step(action)
        alive = alive & ~(terminated | truncated)
    if not lasting.any():
        fail(f"none of {env.num_envs} episodes lasts {args.start + (args.frames - 1) * args.every:.2f} s")
    first = int(lasting.int().argmax())
    qpos, ctrl = (torch.stack(values)[:, first].numpy() for values in (states, controls))
    side = 2 * args.size
    strip = np.concatenate(render_frames(env.scene, qpos, side, side, ctrl=ctrl), axis=1)
    strip = strip.reshape(args.size, 2, args.frames * args.size, 2, 3).mean(axis=(1, 3))  # 2 x 2 pixels into one
    output = args.output or ROOT / "docs" / f"{options.env}_gait.png"
    imageio.imwrite(output, strip.round().astype(np.uint8))
    print(output)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
