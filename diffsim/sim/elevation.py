"""The height of a terrain below a robot, so that a task that knows a plane only can be played on it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.robot.scene import Array, Scene


class Elevation:
    """Carries a task, which knows a plane at z = 0 only, to a terrain and back: by the height of the ground below.

    The root is raised by the terrain's z at the root's own x. A robot whose root cannot be raised stays where it is.
    """

    def __init__(self, scene: Scene, device: torch.device | str, dtype: torch.dtype) -> None:
        def tensor(values: Array) -> Tensor:
            return torch.tensor(values, device=device, dtype=dtype)

        if scene.terrain is None:
            raise ValueError(f"{scene.name} has no terrain")
        place, along, up = scene.root
        self._x0, self._along, self._up = float(place[0]), tensor(along), tensor(up)
        x, z = scene.terrain[..., 0], scene.terrain[..., 1]
        run = np.diff(x)
        slope = np.divide(np.diff(z), run, out=np.zeros_like(run), where=run > 0)  # of a wall nobody asks
        self._profiles = tensor(np.stack([x[:, :-1], z[:, :-1], slope]))  # (3, M, K - 1)

    def at(self, x: Tensor) -> Tensor:
        """z (..., N, L) [m] of the terrain at x (..., N, L) [m] of N environments, of any number if one serves all."""
        start, level, slope = self._below(x)
        return level + slope * (x - start)

    def height(self, qpos: Tensor) -> Tensor:
        """z (...) [m] of the terrain at the root's x, of qpos (..., nq).

        The dimension before the last of qpos is that of the environments, unless one terrain serves all.
        """
        return self.at(self._root(qpos)).squeeze(-1)

    def gradient(self, qpos: Tensor) -> Tensor:
        """(..., nq, nq) by which qpos (..., nq) of the root's `lift` changes beside itself; walls do not count."""
        return self._below(self._root(qpos))[2].unsqueeze(-1) * torch.outer(self._up, self._along)

    def _root(self, qpos: Tensor) -> Tensor:
        """x (..., 1) of the root."""
        return (self._x0 + qpos @ self._along).unsqueeze(-1)

    def _below(self, x: Tensor) -> tuple[Tensor, ...]:
        """(..., N, L) each: where the segment below begins, its height there, its slope."""
        profiles = self._profiles
        if profiles.shape[1] == 1:
            profiles = profiles[:, 0]
        segment = ((x.unsqueeze(-1) >= profiles[0].unsqueeze(-2)).sum(-1) - 1).clamp(min=0)
        return tuple(p.expand(*x.shape[:-1], -1).gather(-1, segment) for p in profiles)

    def lift(self, qpos: Tensor) -> Tensor:
        """World qpos (..., nq) of one over the plane."""
        return qpos + self.height(qpos).unsqueeze(-1) * self._up

    def lower(self, qpos: Tensor) -> Tensor:
        """qpos (..., nq) over the plane of one in the world."""
        return qpos - self.height(qpos).unsqueeze(-1) * self._up
