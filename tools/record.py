"""Record a clip for humanoid_imitation: the cycle of a policy's motion that ends best where it begins.

python tools/record.py diffsim/policies/humanoid.pt run.npz
python tools/record.py runs/<run>/checkpoint.pt walk.npz --seconds 2

humanoid_run.npz is of SHAC's seed 1, the humanoid that was shipped before RPO's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor
from tyro.conf import Positional

from diffsim.training import command, evaluate, fail, load_policy
from diffsim_cli.render import whole_file
from diffsim_cli.watch import make_policy_env
from diffsim_robots.imitation.clip import Clip, tangent

SETTLING = 3.0  # s at the start of the episode that are left out
SHORTEST = 0.3  # s


def cycle(qpos: Tensor, shortest: int, longest: int) -> tuple[Tensor, float]:
    """Frames (P + 1, nq) of qpos (T, nq) whose ends are closest, and how far apart these are (RMS)."""
    best = float("inf"), 0, 0
    for period in range(shortest, longest + 1):
        error = tangent(qpos[:-period], qpos[period:])[:, 2:].square().mean(-1)
        error = error.unfold(0, 3, 1).mean(-1)  # the frames before and after, too: the velocities
        best = min(best, (error.min().item(), int(error.argmin()) + 1, period))
    gap, start, period = best
    return qpos[start : start + period + 1], gap**0.5


def close(qpos: Tensor) -> Tensor:
    """The last frame made equal to the first but in x, the difference spread evenly over the cycle."""
    gap = qpos[:1] - qpos[-1:]
    gap[:, 0] = 0.0
    closed = qpos + torch.linspace(0.0, 1.0, len(qpos), dtype=qpos.dtype)[:, None] * gap
    closed[:, :2] -= closed[:1, :2].clone()
    closed[:, 3:7] /= closed[:, 3:7].norm(dim=1, keepdim=True)  # enough, as the quaternions' ends are close
    return closed


@command
def record(policy: Positional[Path], output: Positional[Path], seconds: float = 1.0, episodes: int = 8) -> None:
    """Write a clip of the episode of median return.

    Args:
        policy: checkpoint of any script, of a robot with a free root and hinges.
        output: the .npz file.
        seconds: the longest cycle.
        episodes: how many there are.
    """
    torch.set_num_threads(1)
    saved = load_policy(policy)
    env = make_policy_env(saved, episodes)
    seen = evaluate(env, saved.network)
    motion = torch.tensor(seen.episode(seen.median)[0], dtype=torch.float64)
    first, shortest, longest = (round(t / env.control_dt) for t in (SETTLING, SHORTEST, seconds))
    if len(motion) < first + 2 * longest:
        fail(f"the episode lasts {len(motion) * env.control_dt:.1f} s, too short for cycles of {seconds} s")
    qpos, seam = cycle(motion[first:], shortest, longest)
    clip = Clip(output.stem, close(qpos), loop=True)
    clip.check(env.scene.mj_model)
    with whole_file(output) as part:
        np.savez_compressed(part, qpos=clip.qpos.numpy().astype(np.float32), fps=round(1 / env.control_dt))
    speed, size = clip.advance[0].item() / (len(clip) * env.control_dt), output.stat().st_size / 1e3
    print(f"{output}: {len(clip)} frames, {speed:.2f} m/s, ends {seam:.1e} apart (RMS, m and rad), {size:.1f} kB")


if __name__ == "__main__":
    tyro.cli(record, description=__doc__)
