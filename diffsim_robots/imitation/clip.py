"""Clips: recorded motions of a robot with a free root, which a task may track."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path
from zipfile import BadZipFile

import mujoco
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from diffsim.tasks.base import ASSETS, TaskError
from diffsim_robots.imitation.kinematics import difference

CONTROL_DT = 1 / 60  # s
SHORTEST, LONGEST = 6, 216_000  # frames: 0.1 s and an hour
LAYOUT = "an .npz file with finite qpos (frames, nq), in columns 3 to 6 the root's quaternion, fps [1/s] or dt [s]"
LAYOUT += ", and perhaps loop, True or False"
ROWS = "a .csv file with finite rows of root position, quaternion xyzw and joints, without a header"
RATE = 30.0  # 1/s of a .csv file that does not say: those of Unitree's LAFAN1
BEYOND = math.radians(30)  # joint limits are springs, so that recorded motions pass them a little
FASTEST = 40.0  # rad/s: Unitree's motors reach 20 to 37
SEAM = 3.0  # the ends of a loop may be this many times as far apart as any two successive frames


def tangent(a: Tensor, b: Tensor) -> Tensor:
    """(..., nv) what moves a to b, both (..., nq): positions, the rotation vector in the frame of a, joint angles."""
    return torch.cat((b[..., :3] - a[..., :3], difference(a[..., 3:7], b[..., 3:7]), b[..., 7:] - a[..., 7:]), dim=-1)


class Clip:
    """A motion at the rate of control, or several.

    The last frame of a loop is the first one of the next round: equal except for x and y.

    Attributes:
        name: name of the file, without its suffix, or of the folder.
        qpos: (T, nq) float64 in MuJoCo's convention, the world's frame, m and rad; quaternions wxyz of unit length.
        loop: whether it goes on from the beginning.
        lengths: number of frames of each motion, if qpos holds several in a row; empty for one.
    """

    lengths: tuple[int, ...] = ()

    def __init__(self, name: str, qpos: Tensor, loop: bool, lengths: tuple[int, ...] = ()) -> None:
        self.name, self.qpos, self.loop, self.lengths = name, qpos, loop, lengths

    def __str__(self) -> str:
        return self.name

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Clip) or (self.loop, self.lengths) != (other.loop, other.lengths):
            return False
        return torch.equal(self.qpos, other.qpos)

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

    def motions(self) -> list[Clip]:
        """Each motion, of which none is a loop; those of a folder have their number in the order of its files."""
        if not self.lengths:
            return [Clip(self.name, self.qpos, loop=False)]
        return [Clip(f"{self}, file {k}", part, loop=False) for k, part in enumerate(self.qpos.split(self.lengths), 1)]

    def smoothed(self, frames: int) -> Clip:
        """The mean over so many frames around each, so that single bad ones do no harm; at the ends over fewer."""
        near = F.avg_pool1d(self.qpos.mT, frames, stride=1, padding=frames // 2, count_include_pad=False).mT
        near[:, 3:7] /= near[:, 3:7].norm(dim=1, keepdim=True)
        return Clip(self.name, near, self.loop)

    def velocity(self, control_dt: float = CONTROL_DT) -> Tensor:
        """qvel (T, nv) of each frame, the mean of the differences to the frames before and after it."""
        step = tangent(self.qpos[:-1], self.qpos[1:])
        before, after = (step[-1:], step[:1]) if self.loop else (step[:1], step[-1:])
        return 0.5 * (torch.cat((before, step)) + torch.cat((step, after))) / control_dt

    def check(self, model: mujoco.MjModel) -> None:
        """Check that a robot can follow it; raises TaskError for another width, joints far beyond limits, or a loop
        that does not end as it begins."""
        if self.qpos.shape[1] != model.nq:
            raise TaskError(f"clip {self}: qpos has {self.qpos.shape[1]} columns, the robot has {model.nq}")
        angles, limited, (low, high) = self.qpos.numpy()[:, 7:], model.jnt_limited[1:] != 0, model.jnt_range[1:].T
        most = np.abs(angles - angles.clip(low, high)).max(0) * limited
        if most.max() > BEYOND:
            k = int(most.argmax())
            raise TaskError(
                f"clip {self}: joint {model.joint(k + 1).name!r} is up to {most[k]:.3g} rad beyond its limits "
                f"{low[k]:.3g} to {high[k]:.3g}; are the angles in radians?"
            )
        ends, pairs = self.qpos[[0, -1]], (self.qpos[:-1], self.qpos[1:])
        gap, step = (tangent(a, b)[..., 2:].abs().max() for a, b in (ends, pairs))
        if self.loop and gap > SEAM * step:
            raise TaskError(
                f"clip {self} is a loop, but its last frame differs from its first by up to {gap:.2g} (m, rad); "
                "end it where the next round begins, or add loop=False"
            )


def shipped() -> dict[str, Path]:
    """The files of the clips that are part of the package, by name."""
    return {path.stem: path for path in sorted((ASSETS / "clips").glob("*.npz"))}


def read_clip(source: str | Path) -> Clip:
    """Read a clip and resample it to the rate of control.

    Positions and joint angles are interpolated linearly, the root's rotation along the shorter arc. The duration
    becomes a whole number of control steps.

    Args:
        source: an .npz file with qpos (T, nq), either fps [1/s] or dt [s], and loop (optional, true if not there); a
            .csv file with the rows of Unitree's LAFAN1, 30 in a second, or with another number as in "walk.csv:60"; a
            folder of such files; or the name of a shipped clip.

    Raises:
        ValueError: no such file, or one of another LAYOUT.
    """
    name, _, rate = str(source).rpartition(":")
    path, fps = (Path(name), float(rate)) if name and re.fullmatch(r"\d+(\.\d+)?", rate) else (Path(source), RATE)
    path = path if path.exists() else shipped().get(str(source), path)
    if path.is_dir() and (found := sorted(each for each in path.iterdir() if each.suffix in READERS)):
        motions = [_read_file(each, fps).qpos for each in found]
        if len(widths := {motion.shape[1] for motion in motions}) > 1:
            raise TaskError(f"the clips of {path} are for several robots: their qpos have {widths} columns")
        return Clip(path.name, torch.cat(motions), loop=False, lengths=tuple(map(len, motions)))
    if not path.is_file():
        raise TaskError(
            f"no such clip: {source}; give an .npz or .csv file, a folder of them, or one of {', '.join(shipped())}"
        )
    return _read_file(path, fps)


def _read_npz(path: Path, _: float) -> tuple[Tensor, float, bool]:
    with np.load(path, allow_pickle=False) as arrays:
        qpos, loop = arrays["qpos"], arrays.get("loop", np.array(True))
        if qpos.dtype.kind not in "iuf" or loop.dtype.kind not in "biu" or loop not in (0, 1):  # texts, complex numbers
            raise TypeError("numbers of another kind")
        dt = float(arrays["dt"]) if "dt" in arrays else 1.0 / float(arrays["fps"])
        return torch.from_numpy(qpos.astype(np.float64)), dt, bool(loop)


def _read_csv(path: Path, fps: float) -> tuple[Tensor, float, bool]:
    rows = torch.from_numpy(np.loadtxt(path, delimiter=",", ndmin=2))
    return torch.cat((rows[:, :3], rows[:, 6:7], rows[:, 3:6], rows[:, 7:]), 1), 1.0 / fps, False


READERS = {".npz": (_read_npz, LAYOUT), ".csv": (_read_csv, ROWS)}


def _read_file(path: Path, fps: float) -> Clip:
    """The clip of one file, with fps rows in a second if it does not say."""
    reader, layout = READERS.get(path.suffix, READERS[".npz"])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's, that a file is empty
            qpos, dt, loop = reader(path, fps)
        frames, norm = (len(qpos) - 1) * dt / CONTROL_DT, qpos[:, 3:7].norm(dim=1, keepdim=True)
        if not (
            qpos.shape[1] >= 7 and qpos.isfinite().all() and norm.min() >= 0.5 and SHORTEST - 1.5 <= frames <= LONGEST
        ):
            raise ValueError("numbers that are no motion")
    except (OSError, EOFError, LookupError, TypeError, ValueError, RuntimeError, ArithmeticError, BadZipFile) as error:
        raise TaskError(f"clip {path} must be {layout}; of 0.1 s to 1 h") from error
    qpos[:, 3:7] /= norm
    return Clip(path.stem, _resample(qpos, round(frames) + 1), loop)


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
