"""System: the robot of an environment as planning takes it, with what its task observes and rewards."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.planning.dynamics import REAL, Dynamics
from diffsim.terrain import Elevation, root


class System(Dynamics):
    """States x, actions u before tanh: see Dynamics. On a terrain the root's height in x is that over the ground below.

    An observation may hold the action before, which is not of the state: it is zero here.

    Args:
        env: its robot, integration and device are taken, its state is not.
        threads: see Simulator.
        terrain: in place of the environment's: (K, 2), or (M, K, 2) with number i % M for trajectory i of a rollout.

    Attributes:
        observed: (obs_dim,) 1 where an observation is of the state, 0 where it is of the action before.
        counts: (nd,) 0 for the root's place along x if there is a terrain, 1 elsewhere.
    """

    def __init__(self, env: DiffEnv, threads: int | None = None, terrain: ArrayLike | None = None) -> None:
        scene = env.scene if terrain is None else env.scene.with_terrain(terrain)
        self._elevations: dict[int, Elevation] = {}
        super().__init__(scene, env.sim.integration, env.control_dt, device=env.device, threads=threads)
        self.task = type(env.task)(self.device, REAL).bind(scene)
        self._no_action = torch.zeros(self.nu, dtype=REAL, device=self.device)
        start = self.start()
        still, moved = (self._observe(start, action.unsqueeze(0)) for action in (self._no_action, self._no_action + 1))
        self.observed = (still == moved)[0].to(REAL)
        self.counts = torch.ones(self.nd, dtype=REAL, device=self.device)
        if scene.terrain is not None:
            self.counts[: self.nv] -= torch.tensor(root(scene)[1][: self.nv]).to(self.counts)

    def start(self) -> Tensor:
        """(1, nx) the task's unperturbed start."""
        middle = torch.full((1, self.task.num_random), 0.5, dtype=REAL, device=self.device)
        return torch.cat(self.task.reset(middle), -1)

    def in_world(self, x: Tensor) -> Tensor:
        """Trajectories x (n, T, nx) with the root's height in the world."""
        return self._moved(x, self._elevation(len(x)).lift) if self.scene.terrain is not None else x

    def rollout(
        self, x: Tensor, steps: int, act: Callable[[int, Tensor], Tensor], push: tuple[int, Tensor] | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        if self.scene.terrain is None:
            return super().rollout(x, steps, act, push)
        ground = self._elevation(len(x))
        start = self._moved(x, ground.lift)
        x, u, finite = super().rollout(start, steps, lambda t, x: act(t, self._moved(x, ground.lower)), push)
        return self._moved(x, ground.lower), u, finite

    def jacobians(self, x: Tensor, u: Tensor, following: Tensor) -> Tensor:
        if self.scene.terrain is None:
            return super().jacobians(x, u, following)
        if len(self.scene.terrain) > 1:
            raise ValueError("Jacobians need one terrain for all steps")
        ground, nq, nv = self._elevation(1), self.nq, self.nv
        f_z = super().jacobians(self._moved(x, ground.lift), u, self._moved(following, ground.lift))
        before, after = (F.pad(ground.gradient(part[:, :nq])[..., :nv, :nv], (0, nv, 0, nv)) for part in (x, following))
        f_z[..., : self.nd] = f_z[..., : self.nd] + f_z[..., : self.nd] @ before
        return f_z - after @ f_z

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

    def _elevation(self, count: int) -> Elevation:
        """The ground below so many trajectories."""
        if count not in self._elevations:
            self._elevations[count] = Elevation(self.copies(count), self.device, REAL)
        return self._elevations[count]

    def _moved(self, x: Tensor, move: Callable[[Tensor], Tensor]) -> Tensor:
        """x (n, nx) or (n, T, nx), a row for each ground, with qpos lifted or lowered."""
        qpos = move(x[..., : self.nq].movedim(0, -2)).movedim(-2, 0)
        return torch.cat((qpos, x[..., self.nq :]), -1)
