"""Shipped policies, the states that they visit, and motions from there: what the benchmarks of the simulator share."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from common import TaskName
from torch import Tensor, nn
from worlds import Array, Here, State, in_double, rollout, starts

import diffsim
from diffsim import DiffEnv, Integration, Simulator
from diffsim.training import load_policy
from diffsim.training.checkpoint import POLICIES

VISITED = 15, 30, 60, 120  # control steps after which a quarter of the states is taken
INTEGRATORS = "semi_implicit", "implicit 0", "implicit 0.5", "extrapolated"  # with theta


def integration(integrator: str, substeps: int) -> Integration:
    name, _, theta = integrator.partition(" ")
    return Integration(integrator=name, theta=float(theta or 0), substeps=substeps)


def shipped(name: TaskName) -> nn.Module:
    """The policy of a task that comes with the package, as a map from observations to actions."""
    return load_policy(POLICIES / f"{name}.pt").network


class Case:
    """A task (float64), its scene, and the policy that comes with the package, with the states that it visits."""

    def __init__(self, name: TaskName, states: int) -> None:
        env, self.n = diffsim.make(name, states, seed=0), states
        self.task, self.scene, self.policy = in_double(env), env.scene, shipped(name)
        self.qpos, self.qvel = visited_states(env, self.policy)

    def actions_in(self, sim: Simulator) -> Tensor:
        """The policy's actions (120, N, nu) of 2 s, in float32 so that every precision replays the same."""
        nothing = torch.zeros(self.n, sim.nu).double()
        start = State(self.qpos, self.qvel, nothing, nothing[:, :0])
        return torch.stack([step.state.action for step in rollout(Here(sim), self.task, self.policy, start, 120)])


def visited_states(env: DiffEnv, policy: nn.Module) -> tuple[Tensor, Tensor]:
    """(N, nq), (N, nv) in float64: a quarter each after 0.25, 0.5, 1 and 2 s under the policy."""
    path = [step.state for step in rollout(Here(env.sim), env.task, policy, starts(env, seed=0), max(VISITED))]
    quarters = [path[steps - 1] for steps in VISITED]
    qpos = torch.cat([state.qpos[k::4] for k, state in enumerate(quarters)])
    return qpos.double(), torch.cat([state.qvel[k::4] for k, state in enumerate(quarters)]).double()


@torch.no_grad()
def replay(sim: Simulator, qpos: Tensor, qvel: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, int]:
    """Open-loop: qpos (T + 1, N, nq), qvel (T + 1, N, nv) in float64, and how many environments did not stay finite."""
    q, v = qpos.to(sim.dtype), qvel.to(sim.dtype)
    path, bad = [(q.double(), v.double())], torch.zeros(sim.num_envs, dtype=torch.bool)
    for action in actions.to(sim.dtype):
        q, v = sim.step(q, v, action)
        bad |= sim.nonfinite
        path.append((q.double(), v.double()))
    qpos, qvel = (torch.stack(states) for states in zip(*path, strict=True))
    return qpos, qvel, int(bad.sum())


def mechanics(model: mujoco.MjModel, qpos: Tensor, qvel: Tensor) -> tuple[Array, Array]:
    """Kinetic energy (N,) and energy (N,)."""
    data, rows = mujoco.MjData(model), []
    for q, v in zip(qpos.numpy(), qvel.numpy(), strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        rows.append((data.energy[1], data.energy.sum()))
    kinetic, energy = np.array(rows).T
    return kinetic, energy
