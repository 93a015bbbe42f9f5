"""A recorded trajectory: how it is read, and how a system follows it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffsim.planning.cost import Tracking
from diffsim.planning.dynamics import REAL, Dynamics
from diffsim.planning.ilqr import backward_pass, follow, step_jacobian


def load_demonstration(
    system: Dynamics, path: Path, steps: int, terrain: str = "level", beginning: int | None = None
) -> tuple[Tensor, Tensor]:
    """A trajectory of an .npz of qpos, qvel and action in [-1, 1], by steps.

    A file of several has a first dimension for them, and in `terrain` their terrains' names. Without it the one is of
    level ground.

    Args:
        terrain: which trajectory; if there is none of it, the first.
        beginning: so many steps are taken of a trajectory of another terrain, at most `steps`, which is the default.

    Returns:
        States (steps + 1, nx) and actions (steps, nu).

    Raises:
        ValueError: no such file, not of this robot, shorter than steps, or not finite.
    """
    if not path.is_file():
        raise ValueError(f"no such trajectory: {path}")
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: torch.tensor(data[name], dtype=REAL) for name in ("qpos", "qvel", "action")}
            names = data["terrain"].tolist() if "terrain" in data else ["level"]
    except Exception as error:  # np.load raises whatever broken bytes lead it to
        raise ValueError(f"{path} is not an .npz with qpos, qvel and action") from error
    for name, width, rows in (("qpos", system.nq, 1), ("qvel", system.nv, 1), ("action", system.nu, 0)):
        array = arrays[name] if arrays[name].ndim == 3 else arrays[name].unsqueeze(0)
        if array.ndim != 3 or len(array) != len(names) or array.shape[2] != width or array.shape[1] < steps + rows:
            size = f"at least ({steps + rows}, {width}) for {steps} steps"
            raise ValueError(f"{path}: {name} has shape {tuple(arrays[name].shape)}, must be {size}")
        if not bool(torch.isfinite(array).all()):
            raise ValueError(f"{path}: {name} holds numbers that are not finite")
        arrays[name] = array[names.index(terrain) if terrain in names else 0]
    count = steps if terrain in names or beginning is None else min(beginning, steps)
    x = torch.cat((arrays["qpos"], arrays["qvel"]), -1)[: count + 1].to(system.device)
    return x, torch.atanh(arrays["action"].clamp(-0.995, 0.995))[:count].to(system.device)


def save_demonstration(
    system: Dynamics, trajectories: Sequence[tuple[Tensor, ...]], path: Path, terrains: Iterable[str] = ("level",)
) -> None:
    """Writes trajectories, which begin with x (T + 1, nx) and u (T, nu), each of a terrain, for load_demonstration."""
    x, u = (torch.stack([trajectory[i] for trajectory in trajectories]).cpu() for i in range(2))
    qpos, qvel, action = x[..., : system.nq].numpy(), x[..., system.nq :].numpy(), u.tanh().numpy()
    if (names := list(terrains)) == ["level"]:
        np.savez_compressed(path, qpos=qpos[0], qvel=qvel[0], action=action[0])
    else:
        np.savez_compressed(path, qpos=qpos, qvel=qvel, action=action, terrain=names)


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
