"""Motions from which settings are judged: start states on the way of a policy, and the actions that follow."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from diffsim.env import DiffEnv
from diffsim.robot.scene import Scene, Spheres
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

Array = NDArray[np.float64]
HORIZONS = (8, 32)  # control steps of the gradients
SPANS = (0.1, 0.5)  # s after which states are compared
SPREAD = (0.25, 0.5, 1.0, 2.0)  # s after the start, where a quarter of the start states each is taken
CHUNK = 8  # environments whose gradients are held at once


class Setting(NamedTuple):
    """How a scene is integrated, and in which precision."""

    integration: Integration
    dtype: torch.dtype = torch.float32

    def __str__(self) -> str:
        return f"{self.kind}, {self.integration.substeps} substeps"

    @property
    def kind(self) -> str:
        """What it shares with the settings of other substeps."""
        how = self.integration
        newton = f" to {how.tolerance:g}, {how.passes} passes"
        of = {"mujoco": newton, "implicit": f" {how.theta:g}"}.get(how.integrator, "")
        return how.integrator + of + " float64" * (self.dtype == torch.float64)

    @property
    def flags(self) -> str:
        """What a script is given to use it."""
        how = self.integration
        if how.constrained:
            words = f"--contact mujoco --substeps {how.substeps}"
            words += f" --passes {how.passes} --tolerance {how.tolerance:g}"
        else:
            theta = f" --theta {how.theta:g}" if how.integrator == "implicit" else ""
            words = f"--contact soft --integrator {how.integrator}{theta} --substeps {how.substeps}"
        return words + (" (float64: dtype=torch.float64 in diffsim.make)" if self.dtype == torch.float64 else "")


class Motion:
    """Start states (N, nq), (N, nv) that an environment visits, and the actions (T, N, nu) that follow, in float64."""

    @torch.no_grad()
    def __init__(self, env: DiffEnv, policy: torch.nn.Module | None, seed: int = 0) -> None:
        dt, n, nu = env.control_dt, env.num_envs, env.scene.nu
        self.steps = max(*HORIZONS, round(SPANS[-1] / dt))
        starts = [round(SPREAD[k % len(SPREAD)] / dt) for k in range(n)]
        length = max(starts) + self.steps
        obs, _ = env.reset(seed=seed)
        knots = torch.randn(nu, n, 2 + int(length * dt / 0.2), generator=torch.Generator().manual_seed(seed))
        smooth = F.interpolate(knots, size=length, mode="linear").permute(2, 1, 0)  # a new goal each 0.2 s
        states, actions = [], []
        for k in range(length):
            action = (0.5 * smooth[k].to(obs) if policy is None else policy(obs)).clamp(-1, 1)
            states.append((env.qpos.double().cpu(), env.qvel.double().cpu()))
            actions.append(action.double().cpu())
            obs = env.step(action)[0]
        self.scene, self.dt = env.scene, dt
        self.qpos = torch.stack([states[first][0][k] for k, first in enumerate(starts)])
        self.qvel = torch.stack([states[first][1][k] for k, first in enumerate(starts)])
        rows = [torch.stack([a[k] for a in actions[first : first + self.steps]]) for k, first in enumerate(starts)]
        self.actions = torch.stack(rows, 1)

    def simulator(self, setting: Setting, num_envs: int, scene: Scene | None = None, **options: object) -> Simulator:
        how, dtype = setting
        return Simulator(scene or self.scene, num_envs, how, self.dt, max(HORIZONS), dtype=dtype, **options)

    @torch.no_grad()
    def replay(self, setting: Setting) -> tuple[dict[float, Tensor], float, float]:
        """qpos (N, nq) after SPANS, the largest residual (median over environments) and the share contained."""
        sim = self.simulator(setting, len(self.qpos))
        q, v, found = self.qpos.to(sim.dtype), self.qvel.to(sim.dtype), dict[float, Tensor]()
        bad, residual = torch.zeros(len(q), dtype=torch.bool), torch.zeros(len(q), dtype=sim.dtype)
        for k, action in enumerate(self.actions.to(sim.dtype), start=1):
            q, v = sim.step(q, v, action)
            bad, residual = bad | sim.nonfinite, residual.maximum(sim.residual)
            found |= {span: q.double() for span in SPANS if k == max(1, round(span / self.dt))}
        return found, residual.median().item(), bad.double().mean().item()

    def gradients(self, setting: Setting) -> dict[int, Tensor]:
        """Over HORIZONS: (N, steps * nu), of the sum of the velocities, weighted 0.5 to 1.5 along dofs, in actions."""
        found: dict[int, list[Tensor]] = {h: [] for h in HORIZONS}
        sims = {n: self.simulator(setting, n) for n in {min(CHUNK, len(self.qpos)), len(self.qpos) % CHUNK} if n}
        for rows in torch.arange(len(self.qpos)).split(CHUNK):
            sim = sims[len(rows)]
            weights = torch.linspace(0.5, 1.5, self.scene.nv, dtype=sim.dtype)
            for horizon, gradients in found.items():
                sim.rewind()
                leaves = [a.to(sim.dtype).requires_grad_() for a in self.actions[:horizon, rows]]
                q, v, total = self.qpos[rows].to(sim.dtype), self.qvel[rows].to(sim.dtype), torch.zeros(())
                for leaf in leaves:
                    q, v = sim.step(q, v, leaf)
                    total = total + (v * weights).sum()
                gradients.append(torch.stack(torch.autograd.grad(total, leaves), 1).flatten(1).double())
        return {h: torch.cat(gradients) for h, gradients in found.items()}

    def fall(self, setting: Setting) -> tuple[Array, bool]:
        """Energies of a fall of 0.5 s without ground and without actuators' forces, see energies."""
        muscle = torch.tensor(self.scene.motor_link) == 0
        passive = copy.copy(self)
        passive.scene, passive.actions = (
            without(self.scene, "contact"),
            torch.where(muscle, -1.0, 0.0).expand_as(self.actions),
        )
        return passive.energies(setting)

    @torch.no_grad()
    def energies(self, setting: Setting) -> tuple[Array, bool]:
        """Kinetic energy and energy (T, N, 2) [J] over 0.5 s, and whether all environments stay finite."""
        sim = self.simulator(setting, len(self.qpos))
        model = copy.deepcopy(self.scene.mj_model)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        data, rows, finite = mujoco.MjData(model), list[tuple[float, float]](), True
        q, v = self.qpos.to(sim.dtype), self.qvel.to(sim.dtype)
        for action in self.actions[: round(SPANS[-1] / self.dt)].to(sim.dtype):
            q, v = sim.step(q, v, action)
            finite &= not bool(sim.nonfinite.any())
            for data.qpos[:], data.qvel[:] in zip(q.numpy(), v.numpy(), strict=True):
                mujoco.mj_forward(model, data)
                mujoco.mj_energyPos(model, data)
                mujoco.mj_energyVel(model, data)
                rows.append((data.energy[1], data.energy.sum()))
        return np.array(rows).reshape(-1, len(self.qpos), 2), finite


def without(scene: Scene, part: str) -> Scene:
    """The scene without its contact, limits, dry friction, muscles, terrain or fluid."""
    n = scene.nlink
    nothing = {name: getattr(scene, name)[:0] for name in ("contact_link", "contact_position", "contact_radius")}
    spheres: Any = (values[:0] for values in scene.spheres)
    changes: dict[str, Any] = {
        "contact": nothing | {"spheres": Spheres(*spheres), "terrain": None},
        "limit": {"lower": np.full(n, -np.inf), "upper": np.full(n, np.inf)},
        "muscle": {name: getattr(scene, name)[:0] for name in ("segment_link", "segment_position", "segment_muscle")},
        "terrain": {"terrain": None},
        "drag": {"density": 0.0, "viscosity": 0.0},
        "frictionloss": {"mj_model": frictionless(scene.mj_model)},
    }[part]
    return dataclasses.replace(scene, **changes)


def frictionless(model: mujoco.MjModel) -> mujoco.MjModel:
    model = copy.deepcopy(model)
    model.dof_frictionloss[:] = 0.0
    return model
