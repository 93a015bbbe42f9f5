"""A recorded trajectory: how it is read, and how a system follows it."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffsim.planning.cost import Tracking
from diffsim.planning.dynamics import REAL, Dynamics
from diffsim.planning.ilqr import backward_pass, follow, step_jacobian

PERIOD = 1 / 60  # s: the control step of a file that does not tell it
MOST = 10**9  # bytes of an array; 500 steps of the humanoid have 10**5


def load_demonstration(
    system: Dynamics, path: Path, steps: int, terrain: str = "level", beginning: int | None = None
) -> tuple[Tensor, Tensor]:
    """A trajectory of an .npz of qpos, qvel and action in [-1, 1], one row a control step.

    A file of several trajectories has a first dimension for them, and their terrains' names in `terrain`. One without
    these names is of level ground, one without `control_dt` of PERIOD.

    Args:
        terrain: which trajectory; if there is none of it, the first.
        beginning: of a trajectory of another terrain only so many steps are taken (default: all `steps`).

    Returns:
        States (steps + 1, nx) and actions (steps, nu).

    Raises:
        ValueError: no such file, not of this robot or control step, shorter than steps, or not finite real numbers.
    """
    if not path.is_file():
        raise ValueError(f"no such trajectory: {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = {name: _read(archive, name, "fiu") for name in ("qpos", "qvel", "action")}
            several, timed = (f"{name}.npy" in archive.namelist() for name in ("terrain", "control_dt"))
            control_dt = _read(archive, "control_dt", "f").item() if timed else PERIOD
            names = _read(archive, "terrain", "U").tolist() if several else ["level"]
    except Exception as error:  # zipfile and numpy raise whatever broken bytes lead them to
        why = " ".join(str(error).split())
        raise ValueError(f"{path} is not an .npz with qpos, qvel and action: {why}") from error
    if not math.isclose(control_dt, system.control_dt, rel_tol=1e-6):
        raise ValueError(f"{path} has control steps of {control_dt:.4g} s, not of {system.control_dt:.4g} s")
    parts = []
    for name, width, rows in (("qpos", system.nq, 1), ("qvel", system.nv, 1), ("action", system.nu, 0)):
        shape, array = arrays[name].shape, arrays[name] if arrays[name].ndim == 3 else arrays[name][None]
        if array.ndim != 3 or len(array) != len(names) or array.shape[2] != width or array.shape[1] < steps + rows:
            size = f"at least ({steps + rows}, {width}) for {steps} steps"
            raise ValueError(f"{path}: {name} has shape {shape}, must be {size}")
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: {name} holds numbers that are not finite")
        parts.append(torch.tensor(array[names.index(terrain) if terrain in names else 0], dtype=REAL))
    count = steps if terrain in names or beginning is None else min(beginning, steps)
    x, u = torch.cat(parts[:2], -1)[: count + 1], torch.atanh(parts[2].clamp(-0.995, 0.995))[:count]
    return x.to(system.device), u.to(system.device)


def _read(archive: zipfile.ZipFile, name: str, kinds: str) -> NDArray[Any]:
    """An array of one of these kinds of dtype. Its header is read first: it may ask for more memory than there is."""
    with archive.open(f"{name}.npy") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    if dtype.kind not in kinds or math.prod(shape) * dtype.itemsize > MOST:
        raise ValueError(f"{name} has shape {shape} of {dtype}, must be {MOST:,} bytes of real numbers at most")
    with archive.open(f"{name}.npy") as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def save_demonstration(
    system: Dynamics, trajectories: Sequence[tuple[Tensor, Tensor]], path: Path, terrains: Iterable[str] = ("level",)
) -> None:
    """Writes trajectories x (T + 1, nx), u (T, nu), each of a terrain, for load_demonstration."""
    x, u = (torch.stack(parts).cpu() for parts in zip(*trajectories, strict=True))
    qpos, qvel, action = x[..., : system.nq].numpy(), x[..., system.nq :].numpy(), u.tanh().numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    names, period = list(terrains), np.float64(system.control_dt)
    if names == ["level"]:
        np.savez_compressed(path, qpos=qpos[0], qvel=qvel[0], action=action[0], control_dt=period)
    else:
        np.savez_compressed(path, qpos=qpos, qvel=qvel, action=action, terrain=names, control_dt=period)


def follow_demonstration(system: Dynamics, x: Tensor, u: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """A trajectory x (1, T + 1, nx), u (1, T, nu) that tracks an example x (T + 1, nx), u (T, nu); see Tracking.

    Raises:
        ValueError: the linear controller about the example left the finite numbers.
    """
    x, u = x.unsqueeze(0), u.unsqueeze(0)
    f_z, zero = step_jacobian(system, x, u), x.new_zeros(1)
    gains = backward_pass(f_z, *Tracking(system, x, u, weight).quadratic(x, u, f_z), zero)
    xs, us, finite = follow(system, x, u, gains, zero)
    if not bool(finite.all()):
        raise ValueError("no controller follows the demonstration to its end")
    return xs[:, 0], us[:, 0]
