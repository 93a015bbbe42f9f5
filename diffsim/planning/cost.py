"""Compute the cost of trajectories and its positive semidefinite quadratic model; their sum is ilqr.Cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.planning.controller import gaussian_log_prob
from diffsim.planning.ilqr import Cost, symmetric
from diffsim.planning.system import System


def _jacobian(y: Tensor, d: Tensor) -> Tensor:
    """(..., k, n) derivatives of y (..., k), each row of which depends only on its own d (..., n)."""
    return torch.stack([torch.autograd.grad(part.sum(), d, retain_graph=True)[0] for part in y.unbind(-1)], -2)


class AfterStep(NamedTuple):
    """A loss of each action and the state that it led to, e.g. minus a reward."""

    system: System
    loss: Callable[[Tensor, Tensor], Tensor]  # (...) of x_{t+1} (..., nx), u_t (..., nu)

    def value(self, x: Tensor, u: Tensor) -> Tensor:
        return self.loss(x[..., 1:, :], u)

    def quadratic(self, x: Tensor, u: Tensor, f_z: Tensor) -> tuple[Tensor, Tensor]:
        """Its derivatives come back through f_z, without second derivatives of the dynamics."""
        nd, nz = f_z.shape[-2:]
        d = u.new_zeros(*u.shape[:2], nz, requires_grad=True)
        with torch.enable_grad():
            total = self.loss(self.system.retract(x[:, 1:], d[..., :nd]), u + d[..., nd:]).sum()
            (g,) = torch.autograd.grad(total, d, create_graph=True)
            hessian = _jacobian(g, d)
        # The joint Hessian is made positive, not its blocks: the cross terms would break them again.
        values, vectors = torch.linalg.eigh(symmetric(hessian))
        h = (vectors * values.clamp(min=0.0).unsqueeze(-2)) @ vectors.mT
        actions = torch.eye(nz, dtype=f_z.dtype, device=f_z.device)[nd:].expand(*u.shape[:2], -1, -1)
        y_z = torch.cat((f_z, actions), -2)
        return (y_z.mT @ g.detach().unsqueeze(-1)).squeeze(-1), y_z.mT @ h @ y_z


class Tracking(NamedTuple):
    """The weighted squared deviation from an example's states and actions."""

    system: System
    x: Tensor  # (R, T + 1, nx)
    u: Tensor  # (R, T, nu)
    weight: float  # of states
    action_weight: Tensor  # (nu,)

    def value(self, x: Tensor, u: Tensor) -> Tensor:
        dx = self.system.difference(x[..., :-1, :], self.x[:, None, :-1])
        du = u - self.u[:, None]
        return self.weight * dx.square().sum(-1) + (self.action_weight * du.square()).sum(-1)

    def quadratic(self, x: Tensor, u: Tensor, f_z: Tensor) -> tuple[Tensor, Tensor]:
        dx = self.system.difference(x[:, :-1], self.x[:, :-1])
        slope = 2 * torch.cat((self.action_weight.new_full((dx.shape[-1],), self.weight), self.action_weight))
        return slope * torch.cat((dx, u - self.u), -1), slope.diag().expand(*u.shape[:2], -1, -1)


class Surprisal(NamedTuple):
    """The negative log density of the actions under a policy of the states, normal about its mean."""

    system: System
    mean: Callable[[Tensor], Tensor]  # (..., nu) of x (..., nx)
    sigma: Tensor  # (nu,)

    def value(self, x: Tensor, u: Tensor) -> Tensor:
        return -gaussian_log_prob(u, self.mean(x[..., :-1, :]), self.sigma)

    def quadratic(self, x: Tensor, u: Tensor, f_z: Tensor) -> tuple[Tensor, Tensor]:
        """Gauss-Newton of |(u - mean(x)) / sigma|^2 / 2."""
        nd, nu = f_z.shape[-2], u.shape[-1]
        d = u.new_zeros(*u.shape[:2], nd, requires_grad=True)
        with torch.enable_grad():
            mean = self.mean(self.system.retract(x[:, :-1], d))
            slopes = _jacobian(mean, d)
        eye = torch.eye(nu, dtype=u.dtype, device=u.device).expand(*u.shape[:2], -1, -1)
        e_z = torch.cat((-slopes, eye), -1) / self.sigma.unsqueeze(-1)
        e = ((u - mean.detach()) / self.sigma).unsqueeze(-1)
        return (e_z.mT @ e).squeeze(-1), e_z.mT @ e_z


class Sum(NamedTuple):
    """Several costs at once."""

    terms: tuple[Cost, ...]

    def value(self, x: Tensor, u: Tensor) -> Tensor:
        first, *others = (term.value(x, u) for term in self.terms)
        return sum(others, start=first)

    def quadratic(self, x: Tensor, u: Tensor, f_z: Tensor) -> tuple[Tensor, Tensor]:
        gradients, hessians = zip(*(term.quadratic(x, u, f_z) for term in self.terms), strict=True)
        return sum(gradients[1:], start=gradients[0]), sum(hessians[1:], start=hessians[0])
