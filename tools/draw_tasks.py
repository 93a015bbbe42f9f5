"""Draws docs/tasks.png, the SHAC paper's robots side by side as an episode starts: python tools/draw_tasks.py"""

from pathlib import Path

import numpy as np
import torch

from diffsim.render import render_frames
from diffsim.tasks import SHAC_TASKS, TASKS

ROOT = Path(__file__).resolve().parent.parent
SIZE = 320  # pixels


def main() -> None:
    import imageio.v3 as imageio

    pictures = []
    for name in SHAC_TASKS:
        task = TASKS[name]()
        qpos, _ = task.reset(torch.full((1, task.num_random), 0.5))
        pictures.append(render_frames(ROOT / "diffsim" / "assets" / task.asset, qpos.numpy(), 2 * SIZE, 2 * SIZE)[0])
    strip = np.concatenate(pictures, axis=1).astype(np.float32)
    strip = strip.reshape(SIZE, 2, len(pictures) * SIZE, 2, 3).mean(axis=(1, 3))  # 2 x 2 pixels into one: smooth edges
    imageio.imwrite(ROOT / "docs" / "tasks.png", strip.round().astype(np.uint8))


if __name__ == "__main__":
    main()
