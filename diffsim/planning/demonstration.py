"""A recorded trajectory: how it is read and written, and how a system follows it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.planning.cost import Tracking
from diffsim.planning.ilqr import backward_pass, follow, step_jacobian
from diffsim.planning.system import REAL, System

PERIOD = 1 / 60  # s: the control step of a file that does not tell it


def load_demonstration(system: System, path: Path, steps: int) -> list[tuple[Tensor, Tensor]]:
    """States (steps + 1, nx) and actions (steps, nu) of an .npz of qpos, qvel and action in [-1, 1], a row a step.

    A file of several trajectories has a first dimension for them.

    Raises:
        ValueError: no such file, not of this robot or control step, shorter than steps, or not finite real numbers.
    """
    if not path.is_file():
        raise ValueError(f"no such trajectory: {path}")
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in ("qpos", "qvel", "action")}
            control_dt = float(file["control_dt"]) if "control_dt" in file else PERIOD
    except Exception as error:  # zipfile and numpy raise whatever broken bytes lead them to
        why = f": {error.args[0]}" if isinstance(error, KeyError) else ""  # others advise to load what is no data
        raise ValueError(f"{path} is not an .npz with qpos, qvel and action{why}") from error
    if not math.isclose(control_dt, system.control_dt, rel_tol=1e-6):
        raise ValueError(f"{path} has control steps of {control_dt:.4g} s, not of {system.control_dt:.4g} s")
    parts, sizes = [], {"qpos": (steps + 1, system.nq), "qvel": (steps + 1, system.nv), "action": (steps, system.nu)}
    for name, (rows, width) in sizes.items():
        array = arrays[name][None] if arrays[name].ndim == 2 else arrays[name]
        if array.ndim != 3 or array.shape[2] != width or array.shape[1] < rows or array.dtype.kind not in "fiu":
            found = f"{arrays[name].shape} of {array.dtype}"
            raise ValueError(f"{path}: {name} has shape {found}, must be at least ({rows}, {width}) for {steps} steps")
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: {name} holds numbers that are not finite")
        parts.append(torch.tensor(array[:, :rows], dtype=REAL, device=system.device))
    if len({len(part) for part in parts}) > 1:
        raise ValueError(f"{path}: qpos, qvel and action hold {', '.join(str(len(p)) for p in parts)} trajectories")
    qpos, qvel, action = parts
    return list(zip(torch.cat((qpos, qvel), -1), torch.atanh(action.clamp(-0.995, 0.995)), strict=True))


def save_demonstration(system: System, x: Tensor, u: Tensor, path: Path, **others: Any) -> None:
    """Write a trajectory x (T + 1, nx), u (T, nu), or several with a first dimension, for load_demonstration."""
    qpos, qvel = (part.numpy(force=True) for part in x.split((system.nq, system.nv), -1))
    path.parent.mkdir(parents=True, exist_ok=True)
    action, period = u.tanh().numpy(force=True), np.float64(system.control_dt)
    np.savez_compressed(path, qpos=qpos, qvel=qvel, action=action, control_dt=period, **others)


def follow_demonstration(system: System, x: Tensor, u: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """A trajectory x (1, T + 1, nx), u (1, T, nu) that tracks an example x (T + 1, nx), u (T, nu); see Tracking.

    Raises:
        ValueError: the linear controller about the example left the finite numbers.
    """
    x, u = x.unsqueeze(0), u.unsqueeze(0)
    f_z, zero = step_jacobian(system, x, u), x.new_zeros(1)
    cost = Tracking(system, x, u, weight, x.new_full((system.nu,), weight))
    gains = backward_pass(f_z, *cost.quadratic(x, u, f_z), zero)
    xs, us, finite = follow(system, x, u, gains, zero)
    if not bool(finite.all()):
        raise ValueError("no controller follows the demonstration to its end")
    return xs[:, 0], us[:, 0]
