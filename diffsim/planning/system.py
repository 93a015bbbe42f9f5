"""System: the robot of an environment as planning takes it, with what its task observes and rewards."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.planning.dynamics import REAL, Dynamics
from diffsim.robot.scene import Scene


class System(Dynamics):
    """States x, actions u before tanh: see Dynamics. It knows level ground alone.

    An observation may hold the action before, which is not of the state: it is zero here.

    Args:
        env: its robot, integration and device are taken, its state is not.
        threads: see Simulator.
        scene: in place of the environment's.

    Attributes:
        observed: (obs_dim,) 1 where an observation is of the state, 0 where it is of the action before.
        counts: (nd,) 0 for coordinates that feedback by similarity does not heed, 1 elsewhere.
    """

    def __init__(self, env: DiffEnv, threads: int | None = None, scene: Scene | None = None) -> None:
        if scene is None and env.scene.terrain is not None:
            raise ValueError("plans need level ground, not a terrain")
        scene = scene or env.scene
        super().__init__(scene, env.sim.integration, env.control_dt, device=env.device, threads=threads)
        self.task = type(env.task)(self.device, REAL).bind(scene)
        self._no_action = torch.zeros(self.nu, dtype=REAL, device=self.device)
        start = self.start()
        still, moved = (self._observe(start, action.unsqueeze(0)) for action in (self._no_action, self._no_action + 1))
        self.observed = (still == moved)[0].to(REAL)
        self.counts = torch.ones(self.nd, dtype=REAL, device=self.device)

    def start(self) -> Tensor:
        """(1, nx) the task's unperturbed start."""
        middle = torch.full((1, self.task.num_random), 0.5, dtype=REAL, device=self.device)
        return torch.cat(self.task.reset(middle), -1)

    def observe(self, x: Tensor) -> Tensor:
        """What a policy sees (..., obs_dim) of x (..., nx)."""
        return self._observe(x, self._no_action.expand(*x.shape[:-1], -1))

    def reward(self, x: Tensor, u: Tensor) -> Tensor:
        """The task's reward (...) of u (..., nu), which led to x (..., nx)."""
        action = torch.tanh(u)
        return self.task.reward(self._observe(x, action), action)

    def _observe(self, x: Tensor, action: Tensor) -> Tensor:
        qpos, qvel = x.split((self.nq, self.nv), -1)
        return self.task.observe(qpos, qvel, action)
