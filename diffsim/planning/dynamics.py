"""Dynamics: a robot as a discrete-time system of states on a manifold, with the Jacobians that planning needs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from diffsim.robot.scene import Scene
from diffsim.sim.integration import Integration
from diffsim.sim.options import check_device
from diffsim.sim.simulator import Simulator

REAL = torch.float64  # a dynamic program multiplies hundreds of Jacobians
BATCH = 8192  # steps whose Jacobians are computed at once: bounds the memory of their checkpoints


class Dynamics:
    """x' = f(x, u) over one control step, in float64.

    A state x = (qpos, qvel) has nx = nq + nv numbers in MuJoCo's conventions. An action u (nu) is squashed: the motors
    get tanh(u), so that planning has no bounds to heed. Both may have leading dimensions where nothing else is said.

    Differences of states are tangent vectors of nd = 2 nv numbers. A vector v of the body's frame moves a quaternion q
    to q (1, v / 2), normalised, which is the exponential map to second order. Its inverse is 2 vec / w for q and -q.

    Arguments and errors are those of Simulator.

    Attributes:
        steps: control steps simulated so far, over all copies.
    """

    def __init__(
        self,
        scene: Scene,
        integration: Integration,
        control_dt: float,
        device: str | torch.device = "cpu",
        threads: int | None = None,
    ) -> None:
        self.scene, self.control_dt, self.device = scene, control_dt, check_device(device)
        self.nq, self.nv, self.nu, self.nx, self.nd = scene.nq, scene.nv, scene.nu, scene.nq + scene.nv, 2 * scene.nv
        self._options: dict[str, Any] = dict(device=self.device, dtype=REAL, threads=threads)
        self._integration = integration
        self._simulators: dict[int, Simulator] = {}
        self.steps = 0
        self.tangent = self.simulator(1).tangent

    def simulator(self, num_envs: int) -> Simulator:
        if num_envs not in self._simulators:
            self._simulators[num_envs] = Simulator(
                self.copies(num_envs), num_envs, self._integration, self.control_dt, **self._options
            )
        return self._simulators[num_envs]

    def copies(self, count: int) -> Scene:
        """The scene of so many trajectories."""
        return self.scene

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
            following = torch.cat(sim.step(x[:, : self.nq].contiguous(), x[:, self.nq :].contiguous(), u.tanh()), -1)
            finite = finite & ~sim.nonfinite
            x = torch.where(finite.unsqueeze(-1), following, x)
            states.append(x)
            actions.append(u)
            alive.append(finite)
        self.steps += len(x) * steps
        return torch.stack(states, 1), torch.stack(actions, 1), torch.stack(alive, 1)

    def jacobians(self, x: Tensor, u: Tensor) -> Tensor:
        """(n, nd, nd + nu) d x' / d (x, u) of steps from x (n, nx) with u (n, nu), in tangent coordinates."""
        count, parts = min(len(x), BATCH), []
        sim = self.simulator(count)
        for start in range(0, len(x), count):
            first = min(start, len(x) - count)  # the last batch may overlap
            qpos, qvel = (part.contiguous() for part in x[first : first + count].split((self.nq, self.nv), 1))
            ctrl = u[first : first + count].tanh()
            A, B = sim.jacobians(qpos, qvel, ctrl)
            parts.append(torch.cat((A, B * (1.0 - ctrl.square()).unsqueeze(1)), -1)[start - first :])
            self.steps += count * self.nd  # each row is a backward pass
        return torch.cat(parts)
