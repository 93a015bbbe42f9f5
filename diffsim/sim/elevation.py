"""Elevation: the height of the terrain below a robot, for tasks that are defined on a plane."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.robot.scene import Scene
from diffsim.robot.types import Array


class Elevation:
    """Converts states between a terrain and the plane z = 0, on which tasks are defined, by the height of the ground.

    The root is raised by the terrain's z at the root's own x. A robot whose root cannot be raised stays where it is.
    """

    def __init__(self, scene: Scene, device: torch.device | str, dtype: torch.dtype) -> None:
        def tensor(values: Array) -> Tensor:
            return torch.tensor(values, device=device, dtype=dtype)

        if scene.terrain is None:
            raise ValueError(f"{scene.name} has no terrain")
        root = scene.root
        self._x0, self._along, self._up = float(root.position[0]), tensor(root.along), tensor(root.up)
        x, z = scene.terrain[..., 0], scene.terrain[..., 1]
        run = np.diff(x)
        # Undefined on walls, where nobody queries it
        slope = np.divide(np.diff(z), run, out=np.zeros_like(run), where=run > 0)
        self._profiles = tensor(np.stack([x[:, :-1], z[:, :-1], slope]))  # (3, M, K - 1)

    def at(self, x: Tensor) -> Tensor:
        """Return the terrain's z at x (..., N, L) [m] of N environments; any N if they share a profile."""
        start, level, slope = self._below(x)
        return level + slope * (x - start)

    def height(self, qpos: Tensor) -> Tensor:
        """Return the terrain's z (...) [m] at the root's x in qpos (..., nq).

        The last dimension but one of qpos is that of the environments, unless they share a profile.
        """
        return self.at(self._root(qpos)).squeeze(-1)

    def gradient(self, qpos: Tensor) -> Tensor:
        """Return the derivative (..., nq, nq) of `lift` minus the identity, at qpos (..., nq), without walls."""
        return self._below(self._root(qpos))[2].unsqueeze(-1) * torch.outer(self._up, self._along)

    def _root(self, qpos: Tensor) -> Tensor:
        """Return the root's x (..., 1)."""
        return (self._x0 + qpos @ self._along).unsqueeze(-1)

    def _below(self, x: Tensor) -> tuple[Tensor, ...]:
        """Find the segment below x: where it begins, its height there and its slope, (..., N, L) each."""
        profiles = self._profiles
        if profiles.shape[1] == 1:
            profiles = profiles[:, 0]
        segment = ((x.unsqueeze(-1) >= profiles[0].unsqueeze(-2)).sum(-1) - 1).clamp(min=0)
        return tuple(p.expand(*x.shape[:-1], -1).gather(-1, segment) for p in profiles)

    def lift(self, qpos: Tensor) -> Tensor:
        """Convert qpos (..., nq) from the plane to the terrain."""
        return qpos + self.height(qpos).unsqueeze(-1) * self._up

    def lower(self, qpos: Tensor) -> Tensor:
        """Convert qpos (..., nq) from the terrain to the plane."""
        return qpos - self.height(qpos).unsqueeze(-1) * self._up
