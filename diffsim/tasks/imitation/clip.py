"""Clips: recorded motions of a robot with a free root, which a task may track."""

from __future__ import annotations

import math
from importlib.resources import files
from pathlib import Path
from zipfile import BadZipFile

import mujoco
import numpy as np
import torch
from torch import Tensor

from diffsim.tasks.imitation.kinematics import difference

CONTROL_DT = 1 / 60  # s
SHORTEST, LONGEST = 6, 216_000  # frames: 0.1 s and an hour
LAYOUT = "finite qpos (frames, nq), in columns 3 to 6 the root's quaternion, and fps [1/s] or dt [s]; of 0.1 s to 1 h"
BEYOND = math.radians(30)  # joint limits are springs, so that recorded motions pass them a little
SEAM = 3.0  # the ends of a loop may be this many times as far apart as any two successive frames


def tangent(a: Tensor, b: Tensor) -> Tensor:
    """(..., nv) what moves a to b, both (..., nq): positions, the rotation vector in the frame of a, joint angles."""
    return torch.cat((b[..., :3] - a[..., :3], difference(a[..., 3:7], b[..., 3:7]), b[..., 7:] - a[..., 7:]), dim=-1)


class Clip:
    """A motion at the rate of control.

    The last frame of a loop is the first one of the next round: equal but for x and y.

    Attributes:
        name: of the file, without .npz.
        qpos: (T, nq) float64 in MuJoCo's convention, the world's frame, m and rad; quaternions wxyz of unit length.
        loop: whether it goes on from the beginning.
    """

    def __init__(self, name: str, qpos: Tensor, loop: bool) -> None:
        self.name, self.qpos, self.loop = name, qpos, loop

    def __str__(self) -> str:
        return self.name

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Clip) and self.loop == other.loop and torch.equal(self.qpos, other.qpos)

    def __len__(self) -> int:
        """Frames of a round, which are numbered from 0."""
        return len(self.qpos) - self.loop

    @property
    def advance(self) -> Tensor:
        """(2,) m, by which x and y grow in a round; 0 if it is no loop."""
        return (self.qpos[-1, :2] - self.qpos[0, :2]) * self.loop

    def at(self, control_dt: float) -> Clip:
        """The motion with a frame every control_dt seconds, of which its duration becomes a whole number."""
        frames = round((len(self.qpos) - 1) * CONTROL_DT / control_dt) + 1
        return self if frames == len(self.qpos) else Clip(self.name, _resample(self.qpos, frames), self.loop)

    def velocity(self, control_dt: float = CONTROL_DT) -> Tensor:
        """qvel (T, nv) of each frame, the mean of the differences to the frames before and after it."""
        step = tangent(self.qpos[:-1], self.qpos[1:])
        before, after = (step[-1:], step[:1]) if self.loop else (step[:1], step[-1:])
        return 0.5 * (torch.cat((before, step)) + torch.cat((step, after))) / control_dt

    def check(self, model: mujoco.MjModel) -> None:
        """That a robot can follow it; raises ValueError for another width or joints far beyond their limits."""
        if self.qpos.shape[1] != model.nq:
            raise ValueError(f"clip {self}: qpos has {self.qpos.shape[1]} columns, the robot has {model.nq}")
        angles, limited, (low, high) = self.qpos.numpy()[:, 7:], model.jnt_limited[1:] != 0, model.jnt_range[1:].T
        most = np.abs(angles - angles.clip(low, high)).max(0) * limited
        if most.max() > BEYOND:
            k = int(most.argmax())
            raise ValueError(
                f"clip {self}: joint {model.joint(k + 1).name!r} is up to {most[k]:.3g} rad beyond its limits "
                f"{low[k]:.3g} to {high[k]:.3g}; are the angles in radians?"
            )


def shipped() -> dict[str, Path]:
    """The files of the clips that are part of the package, by name."""
    folder = Path(str(files("diffsim") / "assets" / "clips"))
    return {path.stem: path for path in sorted(folder.glob("*.npz"))}


def read_clip(source: str | Path) -> Clip:
    """Read a clip and resample it to the rate of control.

    Positions and joint angles are interpolated linearly, the root's rotation along the shorter arc. The duration
    becomes a whole number of control steps.

    Args:
        source: an .npz file with qpos (T, nq), either fps [1/s] or dt [s], and loop (optional, true if not there); or
            the name of a shipped clip.

    Raises:
        ValueError: no such file, one of another LAYOUT, or a loop that does not end as it begins.
    """
    path = Path(source)
    if not path.is_file():
        if str(source) not in shipped():
            raise ValueError(f"no such clip: {source}; give an .npz file or one of {', '.join(shipped())}")
        path = shipped()[str(source)]
    try:
        with np.load(path, allow_pickle=False) as arrays:
            qpos, loop = torch.from_numpy(arrays["qpos"].astype(np.float64)), bool(arrays.get("loop", True))
            dt = float(arrays["dt"]) if "dt" in arrays else 1.0 / float(arrays["fps"])
        frames, norm = (len(qpos) - 1) * dt / CONTROL_DT, qpos[:, 3:7].norm(dim=1, keepdim=True)
        if not (qpos.isfinite().all() and norm.min() >= 0.5 and SHORTEST - 1.5 <= frames <= LONGEST):
            raise ValueError("numbers that are no motion")
    except (OSError, EOFError, LookupError, TypeError, ValueError, RuntimeError, ArithmeticError, BadZipFile) as error:
        raise ValueError(f"clip {path} must be an .npz file with {LAYOUT}") from error
    qpos[:, 3:7] /= norm
    clip = Clip(path.stem, _resample(qpos, round(frames) + 1), loop)
    gap, step = (tangent(a, b)[..., 2:].abs().max() for a, b in (clip.qpos[[0, -1]], (clip.qpos[:-1], clip.qpos[1:])))
    if loop and gap > SEAM * step:
        raise ValueError(
            f"clip {path} is a loop, but its last frame differs from its first by up to {gap:.2g} (m, rad); "
            "end it where the next round begins, or add loop=False"
        )
    return clip


def _resample(qpos: Tensor, frames: int) -> Tensor:
    """(frames, nq) at equal times from the first to the last of qpos (T, nq)."""
    time = torch.linspace(0.0, len(qpos) - 1.0, frames, dtype=qpos.dtype, device=qpos.device)
    k = time.long().clamp(max=len(qpos) - 2)
    a, b, s = qpos[k], qpos[k + 1], (time - k).unsqueeze(1)
    turn = s * difference(a[:, 3:7], b[:, 3:7])
    half = 0.5 * turn.norm(dim=1, keepdim=True)
    w, u = half.cos(), 0.5 * torch.sinc(half / math.pi) * turn
    aw, au = a[:, 3:4], a[:, 4:7]
    quat = torch.cat((aw * w - (au * u).sum(1, keepdim=True), aw * u + w * au + torch.linalg.cross(au, u)), 1)
    # The product starts anew from each frame of the file: keep the sign, which a step never turns round.
    signs = torch.where((quat[1:] * quat[:-1]).sum(1) < 0, -1.0, 1.0).cumprod(0).unsqueeze(1)
    quat[1:] *= signs
    return torch.cat((a[:, :3] + s * (b[:, :3] - a[:, :3]), quat, a[:, 7:] + s * (b[:, 7:] - a[:, 7:])), 1)
