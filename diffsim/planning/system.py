"""System: the robot of an environment as planning takes it, with what its task observes and rewards."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.planning.dynamics import REAL, Dynamics


class System(Dynamics):
    """States x, actions u before tanh: see Dynamics.

    An observation may hold the action before, which is not of the state: it is zero here.

    Args:
        env: its robot, integration and device are taken, its state is not.
        threads: see Simulator.

    Attributes:
        observed: (obs_dim,) 1 where an observation is of the state, 0 where it is of the action before.
    """

    def __init__(self, env: DiffEnv, threads: int | None = None) -> None:
        super().__init__(env.scene, env.sim.integration, env.control_dt, device=env.device, threads=threads)
        self.task = type(env.task)(self.device, REAL)
        self._no_action = torch.zeros(self.nu, dtype=REAL, device=self.device)
        qpos, qvel = self.start().split((self.nq, self.nv), -1)
        still, moved = (
            self.task.observe(qpos, qvel, action.unsqueeze(0)) for action in (self._no_action, self._no_action + 1)
        )
        self.observed = (still == moved)[0].to(REAL)

    def start(self) -> Tensor:
        """(1, nx) the task's unperturbed start."""
        middle = torch.full((1, self.task.num_random), 0.5, dtype=REAL, device=self.device)
        return torch.cat(self.task.reset(middle), -1)

    def observe(self, x: Tensor) -> Tensor:
        """What a policy sees (..., obs_dim) of x (..., nx)."""
        action = self._no_action.expand(*x.shape[:-1], -1)
        return self.task.observe(x[..., : self.nq], x[..., self.nq :], action)

    def reward(self, x: Tensor, u: Tensor) -> Tensor:
        """The task's reward (...) of u (..., nu), which led to x (..., nx)."""
        action = torch.tanh(u)
        return self.task.reward(self.task.observe(x[..., : self.nq], x[..., self.nq :], action), action)
