"""A recorded trajectory: how it is read, and how a system follows it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffsim.planning.cost import Tracking
from diffsim.planning.dynamics import REAL, Dynamics
from diffsim.planning.ilqr import backward_pass, follow, step_jacobian


def load_demonstration(system: Dynamics, path: Path, steps: int) -> tuple[Tensor, Tensor]:
    """States (steps + 1, nx) and actions (steps, nu) of an .npz of qpos, qvel and action in [-1, 1], by steps.

    Raises:
        ValueError: no such file, not of this robot, shorter than steps, or not finite.
    """
    if not path.is_file():
        raise ValueError(f"no such trajectory: {path}")
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: torch.tensor(data[name], dtype=REAL) for name in ("qpos", "qvel", "action")}
    except Exception as error:  # np.load raises whatever broken bytes lead it to
        raise ValueError(f"{path} is not an .npz with qpos, qvel and action") from error
    for name, width, rows in (("qpos", system.nq, 1), ("qvel", system.nv, 1), ("action", system.nu, 0)):
        array = arrays[name]
        if array.ndim != 2 or array.shape[1] != width or len(array) < steps + rows:
            size = f"at least ({steps + rows}, {width}) for {steps} steps"
            raise ValueError(f"{path}: {name} has shape {tuple(array.shape)}, must be {size}")
        if not bool(torch.isfinite(array).all()):
            raise ValueError(f"{path}: {name} holds numbers that are not finite")
    x = torch.cat((arrays["qpos"], arrays["qvel"]), -1)[: steps + 1].to(system.device)
    return x, torch.atanh(arrays["action"].clamp(-0.995, 0.995))[:steps].to(system.device)


def save_demonstration(system: Dynamics, x: Tensor, u: Tensor, path: Path) -> None:
    """Writes a trajectory x (T + 1, nx), u (T, nu) as load_demonstration reads it."""
    qpos, qvel, action = (part.cpu().numpy() for part in (x[:, : system.nq], x[:, system.nq :], u.tanh()))
    np.savez_compressed(path, qpos=qpos, qvel=qvel, action=action)


def follow_demonstration(system: Dynamics, x: Tensor, u: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """A trajectory of the system that tracks an example x (T + 1, nx), u (T, nu), which it need not reproduce.

    Args:
        weight: of the squared deviation, see Tracking.

    Returns:
        x (1, T + 1, nx), u (1, T, nu).

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
