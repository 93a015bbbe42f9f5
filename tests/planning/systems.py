"""Systems that the tests of planning share: one with a solution in closed form, and the tasks' own."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from scenes import acting_states
from torch import Tensor

import diffsim
from diffsim.planning import AfterStep, System


def normal(rng: np.random.Generator, *shape: int) -> Tensor:
    return torch.tensor(rng.normal(size=shape))


class Linear:
    """x' = A x + B u with a quadratic loss of (x', u), in the interface of System."""

    def __init__(self, rng: np.random.Generator, nx: int = 3, nu: int = 2) -> None:
        self.nd, self.nu = nx, nu
        self.A, self.B = 0.5 * normal(rng, nx, nx), normal(rng, nx, nu)
        root = normal(rng, nx + nu, nx + nu)
        self.H, self.g = root @ root.mT + 0.1 * torch.eye(nx + nu), normal(rng, nx + nu)
        self.cost = AfterStep(self, self.loss)  # type: ignore[arg-type]

    def loss(self, x: Tensor, u: Tensor) -> Tensor:
        y = torch.cat((x, u), -1)
        return 0.5 * ((y @ self.H) * y).sum(-1) + y @ self.g

    def difference(self, x: Tensor, origin: Tensor) -> Tensor:
        return x - origin

    def retract(self, x: Tensor, tangent: Tensor) -> Tensor:
        return x + tangent

    def rollout(self, x: Tensor, steps: int, act: Callable[[int, Tensor], Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        states, actions = [x], []
        for t in range(steps):
            actions.append(act(t, states[-1]))
            states.append(states[-1] @ self.A.mT + actions[-1] @ self.B.mT)
        return torch.stack(states, 1), torch.stack(actions, 1), torch.ones(len(x), steps, dtype=torch.bool)

    def unforced(self, x: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Trajectories (R, steps + 1, nx) and zeros (R, steps, nu) from x (R, nx)."""
        x, u, _ = self.rollout(x, steps, lambda t, state: state.new_zeros(len(state), self.nu))
        return x, u

    def jacobians(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((self.A, self.B), 1).expand(len(x), -1, -1)

    def dense(self, steps: int, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient and Hessian of the total cost of `steps` actions at zero, from x (nx,).

        The states are linear in the actions, x_t+1 = A^t+1 x + sum_s A^t-s B u_s, so both are sums of products.
        """
        powers = [torch.linalg.matrix_power(self.A, t) for t in range(steps + 1)]
        size = steps * self.nu
        gradient, hessian = torch.zeros(size).double(), torch.zeros(size, size).double()
        for t in range(steps):
            y_u = torch.zeros(self.nd + self.nu, size).double()
            for s in range(t + 1):
                y_u[: self.nd, s * self.nu : (s + 1) * self.nu] = powers[t - s] @ self.B
            y_u[self.nd :, t * self.nu : (t + 1) * self.nu] = torch.eye(self.nu)
            y = torch.cat((powers[t + 1] @ x, torch.zeros(self.nu).double()))
            gradient, hessian = gradient + y_u.mT @ (self.H @ y + self.g), hessian + y_u.mT @ self.H @ y_u
        return gradient, hessian


@cache
def task_system(name: str) -> System:
    return System(diffsim.make(name, 1))


def random_states(system: System, rng: np.random.Generator, count: int = 6) -> tuple[Tensor, Tensor]:
    """States (count, nx), on the ground and at limits, and actions (count, nu)."""
    qpos, qvel, ctrl = acting_states(system.scene, count, rng)
    return torch.tensor(np.concatenate((qpos, qvel), 1)), torch.tensor(ctrl)


def jacobian_errors(system: System, x: Tensor, u: Tensor, eps: float = 1e-6) -> Tensor:
    """(n,) relative error (Frobenius norm) of the Jacobians at x (n, nx), u (n, nu) against central differences."""
    n, nz = len(x), system.nd + system.nu
    following = one_step(system, x, u)
    at, action, origin = (tensor.repeat_interleave(nz, 0) for tensor in (x, u, following))

    def step(d: Tensor) -> Tensor:
        ends = one_step(system, system.retract(at, d[:, : system.nd]), action + d[:, system.nd :])
        return system.difference(ends, origin)

    d = eps * torch.eye(nz, dtype=torch.float64).repeat(n, 1)
    differences = ((step(d) - step(-d)) / (2 * eps)).view(n, nz, system.nd).mT
    error = torch.linalg.matrix_norm(system.jacobians(x, u) - differences)
    return error / torch.linalg.matrix_norm(differences)


def one_step(system: System, x: Tensor, u: Tensor) -> Tensor:
    """(n, nx) after one step of x (n, nx), u (n, nu)."""
    return system.rollout(x, 1, lambda t, _: u)[0][:, 1]
