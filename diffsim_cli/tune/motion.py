"""The motion by which settings are judged: start states that a policy visits, and the actions that follow."""

from __future__ import annotations

import copy
from typing import NamedTuple

import mujoco
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

HORIZONS = (8, 32)  # control steps of the gradients
SPANS = (0.1, 0.5)  # s after which states are compared
SPREAD = (0.25, 0.5, 1.0, 2.0)  # s after the start, where a quarter of the start states each is taken
CHUNK = 8  # environments whose gradients are held at once


class Trail(NamedTuple):
    """The result of integrating a motion."""

    qpos: Tensor  # (T, N, nq), (T, N, nv) after each control step, in float64
    qvel: Tensor
    residual: float  # the largest one of MuJoCo's constraints, median over environments
    contained: float  # share of environments


class Motion:
    """Start states (N, nq), (N, nv) that an environment visits, and the actions (T, N, nu) that follow, in float64."""

    @torch.no_grad()
    def __init__(self, env: DiffEnv, policy: torch.nn.Module | None, seed: int = 0) -> None:
        """Without a policy the actions are smooth and random."""
        dt, n, nu = env.control_dt, env.num_envs, env.scene.nu
        self.scene, self.dt, self.half_second = env.scene, dt, round(SPANS[-1] / dt)
        steps = max(*HORIZONS, self.half_second)
        starts = [round(SPREAD[k % len(SPREAD)] / dt) for k in range(n)]
        length = max(starts) + steps
        obs, _ = env.reset(seed=seed)
        knots = torch.randn(nu, n, 2 + int(length * dt / 0.2), generator=torch.Generator().manual_seed(seed))
        smooth = F.interpolate(knots, size=length, mode="linear").permute(2, 1, 0)  # a new goal each 0.2 s
        rows = []
        for k in range(length):
            action = (0.5 * smooth[k].to(obs) if policy is None else policy(obs)).clamp(-1, 1)
            rows.append([x.double().cpu() for x in (env.qpos, env.qvel, action)])
            obs = env.step(action)[0]
        qpos, qvel, actions = map(torch.stack, zip(*rows, strict=True))
        self.qpos, self.qvel = qpos[starts, range(n)], qvel[starts, range(n)]
        self.actions = torch.stack([actions[first : first + steps, k] for k, first in enumerate(starts)], 1)

    def simulator(self, how: Integration, num_envs: int, **options: object) -> Simulator:
        return Simulator(self.scene, num_envs, how, self.dt, max(HORIZONS), **options)

    @torch.no_grad()
    def replay(self, how: Integration, dtype: torch.dtype = torch.float32) -> Trail:
        sim = self.simulator(how, len(self.qpos), dtype=dtype)
        q, v, states = self.qpos.to(dtype), self.qvel.to(dtype), []
        bad, residual = torch.zeros_like(sim.nonfinite), torch.zeros_like(sim.residual)
        for action in self.actions.to(dtype):
            q, v = sim.step(q, v, action)
            states.append((q.double(), v.double()))
            bad, residual = bad | sim.nonfinite, residual.maximum(sim.residual)
        qpos, qvel = map(torch.stack, zip(*states, strict=True))
        return Trail(qpos, qvel, residual.median().item(), bad.double().mean().item())

    def gradients(self, how: Integration, dtype: torch.dtype = torch.float32) -> dict[int, Tensor]:
        """Over HORIZONS: (N, steps * nu), of the sum of the velocities, weighted 0.5 to 1.5 along dofs, in actions."""
        n, sim = len(self.qpos), self.simulator(how, CHUNK, dtype=dtype)
        weights = torch.linspace(0.5, 1.5, self.scene.nv, dtype=dtype)
        found = {h: torch.empty(0, h * self.scene.nu, dtype=torch.float64) for h in HORIZONS}
        for first in range(0, n, CHUNK):
            rows = torch.arange(first, first + CHUNK) % n
            for horizon in HORIZONS:
                sim.rewind()
                leaves = [a.to(dtype).requires_grad_() for a in self.actions[:horizon, rows]]
                q, v, total = self.qpos[rows].to(dtype), self.qvel[rows].to(dtype), torch.zeros(())
                for leaf in leaves:
                    q, v = sim.step(q, v, leaf)
                    total = total + (v * weights).sum()
                gradients = torch.stack(torch.autograd.grad(total, leaves), 1).flatten(1).double()
                found[horizon] = torch.cat((found[horizon], gradients))[:n]
        return found

    def error(self, found: Trail, truth: Trail, span: float) -> float:
        """Root mean square over dofs [m, rad] after a span [s], median over environments."""
        step = max(1, round(span / self.dt)) - 1
        return float(np.median(apart(self.scene.mj_model, found.qpos[step], truth.qpos[step])))

    def energies(self, trail: Trail) -> NDArray[np.float64]:
        """Kinetic energies (T, N) [J] over 0.5 s."""
        model = copy.deepcopy(self.scene.mj_model)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
        data, rows = mujoco.MjData(model), []
        states = (x[: self.half_second].flatten(0, 1).numpy() for x in (trail.qpos, trail.qvel))
        for data.qpos[:], data.qvel[:] in zip(*states, strict=True):
            mujoco.mj_forward(model, data)
            rows.append(data.energy[1])
        return np.reshape(rows, (-1, len(self.qpos)))


def apart(model: mujoco.MjModel, found: Tensor, expected: Tensor) -> NDArray[np.float64]:
    """(N,) root mean square over degrees of freedom [m, rad] between states (N, nq) and (N, nq)."""
    away, errors = np.zeros(model.nv), []
    for one, other in zip(found.double().cpu().numpy(), expected.double().cpu().numpy(), strict=True):
        mujoco.mj_differentiatePos(model, away, 1.0, other, one)
        errors.append(np.sqrt(np.mean(away**2)))
    return np.array(errors)
