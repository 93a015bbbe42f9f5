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
BATCH = 8192  # environments of one backward pass: bounds the memory of its checkpoints


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
        self.simulator(1)
        model = scene.mj_model
        # mjtJoint: 0 is a free joint, whose quaternion follows three coordinates, 1 a ball joint
        offsets = [(j, 3 * (model.jnt_type[j] == 0)) for j in range(model.njnt) if model.jnt_type[j] <= 1]
        self.quaternions = [(int(model.jnt_qposadr[j] + k), int(model.jnt_dofadr[j] + k)) for j, k in offsets]
        rows = [i for i in range(self.nx) if not any(q <= i < q + 4 for q, _ in self.quaternions)]
        columns = [i for i in range(self.nd) if not any(d <= i < d + 3 for _, d in self.quaternions)]
        self._flat = torch.zeros(self.nx, self.nd, dtype=REAL, device=self.device)
        self._flat[rows, columns] = 1.0

    def simulator(self, num_envs: int) -> Simulator:
        if num_envs not in self._simulators:
            self._simulators[num_envs] = Simulator(
                self.copies(num_envs), num_envs, self._integration, self.control_dt, **self._options
            )
        return self._simulators[num_envs]

    def copies(self, count: int) -> Scene:
        """The scene of so many trajectories."""
        return self.scene

    def basis(self, x: Tensor) -> Tensor:
        """(..., nx, nd) derivative of `retract` at zero."""
        basis = self._flat.expand(*x.shape[:-1], self.nx, self.nd)
        if self.quaternions:
            basis = basis.clone()
        for q, d in self.quaternions:
            w, i, j, k = (0.5 * x[..., q : q + 4]).unbind(-1)
            columns = ((-i, w, k, -j), (-j, -k, w, i), (-k, j, -i, w))  # q times each unit vector
            basis[..., q : q + 4, d : d + 3] = torch.stack([torch.stack(column, -1) for column in columns], -1)
        return basis

    def left_inverse(self, x: Tensor) -> Tensor:
        """(..., nd, nx) derivative of `difference` from x at x itself."""
        inverse = self.basis(x).mT
        for _, d in self.quaternions:
            inverse[..., d : d + 3, :] *= 4.0
        return inverse

    def retract(self, x: Tensor, tangent: Tensor) -> Tensor:
        """x moved by a tangent vector (..., nd)."""
        moved = x + (self.basis(x) @ tangent.unsqueeze(-1)).squeeze(-1)
        parts, start = [], 0
        for q, _ in self.quaternions:
            parts += [moved[..., start:q], F.normalize(moved[..., q : q + 4], dim=-1)]
            start = q + 4
        return torch.cat([*parts, moved[..., start:]], dim=-1)

    def difference(self, x: Tensor, origin: Tensor) -> Tensor:
        """The tangent vector (..., nd) that moves origin to x."""
        if not self.quaternions:
            return x - origin
        tangent = (self.left_inverse(origin) @ (x - origin).unsqueeze(-1)).squeeze(-1)
        for q, d in self.quaternions:
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

    def jacobians(self, x: Tensor, u: Tensor, following: Tensor) -> Tensor:
        """(n, nd, nd + nu) d following / d (x, u) of steps from x (n, nx) with u (n, nu), in tangent coordinates.

        A backward pass gives one row. Environments are independent: n x nd copies give all rows of all steps at once.
        """
        n, nd, nq = len(x), self.nd, self.nq
        cotangents, result = self.left_inverse(following), x.new_empty(n, nd, nd + self.nu)
        count = min(n, max(1, BATCH // nd))
        sim = self.simulator(count * nd)
        for start in range(0, n, count):
            first = min(start, n - count)  # the last batch may overlap
            rows = slice(first, first + count)
            parts = x[rows, :nq], x[rows, nq:], torch.tanh(u[rows])
            leaves = [part.repeat_interleave(nd, 0).requires_grad_() for part in parts]
            g = cotangents[rows].reshape(-1, self.nx)
            with torch.enable_grad():
                outputs = sim.step(*leaves)
            g_qpos, g_qvel, g_ctrl = torch.autograd.grad(outputs, leaves, (g[:, :nq], g[:, nq:]))
            result[rows, :, :nd] = torch.cat((g_qpos, g_qvel), -1).view(count, nd, -1) @ self.basis(x[rows])
            result[rows, :, nd:] = g_ctrl.view(count, nd, -1) * (1.0 - parts[2].square()).unsqueeze(1)
            self.steps += count * nd
        return result
