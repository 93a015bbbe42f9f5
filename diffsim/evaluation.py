"""Evaluate a policy: the first episode of each of many fresh environments."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim import render
from diffsim.env import DiffEnv

SEED = 1_000_000  # of the start states: the same for every policy, and far from those of training


class Evaluation(NamedTuple):
    returns: Tensor  # (n,) undiscounted, of one episode each
    lengths: Tensor  # (n,) control steps
    speed: float | None  # mean forward speed, m/s; None for a robot without ground
    qpos: Tensor  # (T, n, nq) before each step; valid up to an episode's length

    def scalars(self) -> dict[str, float]:
        values = {"eval/return": self.returns.median().item(), "eval/length": self.lengths.float().mean().item()}
        return values if self.speed is None else values | {"eval/speed": self.speed}

    def __str__(self) -> str:
        r = self.returns
        speed = "" if self.speed is None else f", forward speed {self.speed:.2f} m/s"
        spread = f"mean {r.mean():.1f}, std {r.std(correction=0):.1f}, min {r.min():.1f}"
        return f"return median {r.median():.1f}, {spread}, length {self.lengths.float().mean():.1f}{speed}"


@torch.no_grad()
def evaluate(env: DiffEnv, policy: Callable[[Tensor], Tensor]) -> Evaluation:
    """The first episode of each environment under policy(obs (n, obs_dim)) -> action (n, nu)."""
    obs, _ = env.reset(seed=SEED)
    alive = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
    returns, lengths, qpos = torch.zeros_like(obs[:, 0]), torch.zeros_like(alive, dtype=torch.long), []
    while alive.any():
        qpos.append(env.qpos)
        obs, reward, terminated, truncated, _ = env.step(policy(obs))
        returns += torch.where(alive, reward, torch.zeros_like(reward))
        lengths += alive
        alive &= ~(terminated | truncated)
    path = torch.stack(qpos)
    speed = None
    if "contact" in env.scene.features:  # the first coordinate of a robot that walks is its x
        distance = path[..., 0].gather(0, lengths.unsqueeze(0) - 1)[0] - path[0, :, 0]
        speed = (distance.sum() / ((lengths - 1).sum().clamp(min=1) * env.control_dt)).item()
    return Evaluation(returns, lengths, speed, path)


def write_video(path: Path, env: DiffEnv, evaluation: Evaluation) -> Path:
    """Film the episode of median return, every other control step; returns the file written, an mp4 or a gif.

    Raises:
        ImportError, OSError, RuntimeError: what is missing to draw or to write, see render.py.
    """
    episode = evaluation.returns.argsort()[(len(evaluation.returns) - 1) // 2]
    qpos = evaluation.qpos[: evaluation.lengths[episode] : 2, episode].cpu().numpy()
    frames = render.render_frames(env.scene, qpos, width=480, height=360)
    return render.write_video(path, frames, fps=0.5 / env.control_dt)
