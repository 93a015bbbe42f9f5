"""System: the robot of an environment in discrete time, as planning takes it, with what its task observes and pays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.robot.scene import Scene
from diffsim.sim.simulator import Simulator

REAL = torch.float64  # a dynamic program multiplies hundreds of Jacobians
BATCH = 8192  # steps whose Jacobians are computed at once: bounds the memory of their checkpoints


class System:
    """x' = f(x, u) over one control step, in float64. The ground is level.

    A state x = (qpos, qvel) has nx = nq + nv numbers in MuJoCo's conventions. An action u (nu) is squashed: the motors
    get tanh(u), so that planning has no bounds to heed. Both may have leading dimensions where nothing else is said.

    Differences of states are tangent vectors of nd = 2 nv numbers. A vector v of the body's frame moves a quaternion q
    to q (1, v / 2), normalised, which is the exponential map to second order. Its inverse is 2 vec / w for q and -q.

    An observation may hold the action before, which is not of the state: it is zero here.

    Args:
        env: its robot, integration and device are taken, its state is not.
        threads: see Simulator.
        scene: in place of the environment's.

    Attributes:
        observed: (obs_dim,) 1 where an observation is of the state, 0 where it is of the action before.
        steps: control steps simulated so far, over all trajectories.
    """

    def __init__(self, env: DiffEnv, threads: int | None = None, scene: Scene | None = None) -> None:
        if scene is None and env.scene.terrain is not None:
            raise ValueError("plans need level ground, not a terrain")
        self.scene = scene = scene or env.scene
        self.nq, self.nv, self.nu, self.nx, self.nd = scene.nq, scene.nv, scene.nu, scene.nq + scene.nv, 2 * scene.nv
        self.control_dt, self.device, self.steps = env.control_dt, env.device, 0
        self._options: dict[str, Any] = dict(device=self.device, dtype=REAL, threads=threads)
        self._integration, self._simulators = env.sim.integration, dict[int, Simulator]()
        self.tangent = self.simulator(1).tangent
        self.task = type(env.task)(self.device, REAL).bind(scene)
        self._no_action = torch.zeros(self.nu, dtype=REAL, device=self.device)
        start = self.start()
        still, moved = (self._observe(start, action.unsqueeze(0)) for action in (self._no_action, self._no_action + 1))
        self.observed = (still == moved)[0].to(REAL)

    def simulator(self, num_envs: int) -> Simulator:
        if num_envs not in self._simulators:
            arguments = self.copies(num_envs), num_envs, self._integration, self.control_dt
            self._simulators[num_envs] = Simulator(*arguments, **self._options)
        return self._simulators[num_envs]

    def copies(self, count: int) -> Scene:
        """The scene of so many trajectories."""
        return self.scene

    def split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """qpos and qvel of x."""
        return x[..., : self.nq].contiguous(), x[..., self.nq :].contiguous()

    # States ----------------------------------------------------------------------------------------------------------

    def start(self) -> Tensor:
        """(1, nx) the task's unperturbed start."""
        middle = torch.full((1, self.task.num_random), 0.5, dtype=REAL, device=self.device)
        return torch.cat(self.task.reset(middle), -1)

    def retract(self, x: Tensor, tangent: Tensor) -> Tensor:
        """x moved by a tangent vector (..., nd)."""
        moved = x + (self.tangent.basis(x) @ tangent.unsqueeze(-1)).squeeze(-1)
        parts, start = [], 0
        for q, _ in self.tangent.quaternions:
            parts += [moved[..., start:q], F.normalize(moved[..., q : q + 4], dim=-1)]
            start = q + 4
        return torch.cat([*parts, moved[..., start:]], dim=-1)

    def difference(self, x: Tensor, origin: Tensor) -> Tensor:
        """The tangent vector (..., nd) that moves origin to x."""
        if not self.tangent.quaternions:
            return x - origin
        tangent = (self.tangent.left_inverse(origin) @ (x - origin).unsqueeze(-1)).squeeze(-1)
        for q, d in self.tangent.quaternions:
            w = (x[..., q : q + 4] * origin[..., q : q + 4]).sum(-1, keepdim=True)
            tangent[..., d : d + 3] /= torch.where(w < 0, w.clamp(max=-1e-6), w.clamp(min=1e-6))
        return tangent

    def observe(self, x: Tensor) -> Tensor:
        """Return what a policy sees (..., obs_dim) of x (..., nx)."""
        return self._observe(x, self._no_action.expand(*x.shape[:-1], -1))

    def reward(self, x: Tensor, u: Tensor) -> Tensor:
        """The task's reward (...) of u (..., nu), which led to x (..., nx)."""
        action = torch.tanh(u)
        return self.task.reward(self._observe(x, action), action)

    def _observe(self, x: Tensor, action: Tensor) -> Tensor:
        qpos, qvel = x.split((self.nq, self.nv), -1)
        return self.task.observe(qpos, qvel, action)

    # Steps -----------------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def rollout(self, x: Tensor, steps: int, act: Callable[[int, Tensor], Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """n trajectories from x (n, nx) under u = act(t, x (n, nx)).

        Returns:
            States (n, steps + 1, nx), actions (n, steps, nu) and whether finite (n, steps). A trajectory that leaves
            the finite numbers stays where it was.
        """
        sim = self.simulator(len(x))
        finite = torch.ones(len(x), dtype=torch.bool, device=self.device)
        states, actions, alive = [x], [], []
        for t in range(steps):
            u = act(t, x)
            finite = finite & torch.isfinite(u).all(-1)
            u = torch.where(finite.unsqueeze(-1), u, torch.zeros_like(u))
            following = torch.cat(sim.step(*self.split(x), u.tanh()), -1)
            finite = finite & ~sim.nonfinite
            x = torch.where(finite.unsqueeze(-1), following, x)
            states.append(x)
            actions.append(u)
            alive.append(finite)
        self.steps += len(x) * steps
        return torch.stack(states, 1), torch.stack(actions, 1), torch.stack(alive, 1)

    def jacobians(self, x: Tensor, u: Tensor) -> Tensor:
        """(n, nd, nd + nu) d x' / d (x, u) of steps from x (n, nx) with u (n, nu), in tangent coordinates."""
        parts = []
        for at, ctrl in zip(x.split(BATCH), u.tanh().split(BATCH), strict=True):
            A, B = self.simulator(len(at)).jacobians(*self.split(at), ctrl)
            parts.append(torch.cat((A, B * (1.0 - ctrl.square()).unsqueeze(1)), -1))
        self.steps += len(x) * self.nd  # each row is a backward pass
        return torch.cat(parts)
