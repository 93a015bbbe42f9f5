"""System: the robot of an environment as planning takes it, with what its task observes and rewards."""

from __future__ import annotations

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.planning.dynamics import REAL, Dynamics
from diffsim.terrain import Elevation


class System(Dynamics):
    """States x, actions u before tanh: see Dynamics.

    An observation may hold the action before, which is not of the state: it is zero here.

    Args:
        env: its robot, integration and device are taken, its state is not. Of terrains it has one for all environments.
        threads: see Simulator.
        terrain: profile (K, 2) in place of the environment's; see diffsim.terrain.

    Raises:
        ValueError: a terrain for each of several environments; see Scene.with_terrain.

    Attributes:
        observed: (obs_dim,) 1 where an observation is of the state, 0 where it is of the action before.
    """

    def __init__(self, env: DiffEnv, threads: int | None = None, terrain: ArrayLike | None = None) -> None:
        scene = env.scene if terrain is None else env.scene.with_terrain(terrain)
        super().__init__(scene, env.sim.integration, env.control_dt, device=env.device, threads=threads)
        self.task = type(env.task)(self.device, REAL)
        self._elevation = None if scene.terrain is None else Elevation(scene, self.device, REAL)
        self._no_action = torch.zeros(self.nu, dtype=REAL, device=self.device)
        start = self.start()
        still, moved = (self._observe(start, action.unsqueeze(0)) for action in (self._no_action, self._no_action + 1))
        self.observed = (still == moved)[0].to(REAL)

    def start(self) -> Tensor:
        """(1, nx) the task's unperturbed start."""
        middle = torch.full((1, self.task.num_random), 0.5, dtype=REAL, device=self.device)
        qpos, qvel = self.task.reset(middle)
        return torch.cat((qpos if self._elevation is None else self._elevation.lift(qpos), qvel), -1)

    def over_ground(self, x: Tensor) -> Tensor:
        """x (..., nx) as over a plane at z = 0: the root's height is that over the terrain, if there is one."""
        if self._elevation is None:
            return x
        return torch.cat((self._elevation.lower(x[..., : self.nq]), x[..., self.nq :]), -1)

    def observe(self, x: Tensor) -> Tensor:
        """What a policy sees (..., obs_dim) of x (..., nx)."""
        return self._observe(x, self._no_action.expand(*x.shape[:-1], -1))

    def reward(self, x: Tensor, u: Tensor) -> Tensor:
        """The task's reward (...) of u (..., nu), which led to x (..., nx)."""
        action = torch.tanh(u)
        return self.task.reward(self._observe(x, action), action)

    def _observe(self, x: Tensor, action: Tensor) -> Tensor:
        qpos, qvel = self.over_ground(x).split((self.nq, self.nv), -1)
        return self.task.observe(qpos, qvel, action)
