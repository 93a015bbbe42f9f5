"""Policies, the states that they visit, and motions from there: what the benchmarks of the simulator share."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import mujoco
import numpy as np
import torch
from common import CommonFlags, TaskName
from tables import ROOT
from torch import Tensor, nn

import diffsim
from diffsim import Integration, Simulator
from diffsim.__main__ import POLICIES
from diffsim.training import Count, fail, load_policy

sys.path.append(str(ROOT))
import shac as shac  # noqa: E402

CONTROL_DT = 1 / 60
Array = np.ndarray

Integrator = Literal["semi_implicit", "implicit 0", "implicit 0.5", "extrapolated"]  # with its theta
INTEGRATORS: tuple[Integrator, ...] = get_args(Integrator)


def integration(integrator: Integrator, substeps: int) -> Integration:
    name, _, theta = integrator.partition(" ")
    return Integration(integrator=name, theta=float(theta or 0), substeps=substeps)


def label(setting: Integration) -> str:
    return setting.integrator if setting.integrator != "implicit" else f"implicit {setting.theta:g}"


@dataclass
class PolicyFlags(CommonFlags):
    checkpoint: Path | None = None  # of any script, whose policy acts (default: the one that comes with the package)
    states: Count = 32  # start states, which the policy visits

    def policy(self, name: TaskName) -> tuple[nn.Module, str]:
        """Observations -> actions in float64, and what to call it."""
        if self.checkpoint and len(self.env) != 1:
            fail("--checkpoint is of one task: name it with --env")
        saved = load_policy(path := self.checkpoint or Path(str(POLICIES / f"{name}.pt")))
        if saved.args["env"] != name:
            fail(f"{path} was trained on {saved.args['env']}, not {name}")
        return saved.network.double(), f"{path.name}, iteration {saved.iteration}"


class Case:
    """A task (float64), its scene, and a policy with the states that it visits."""

    def __init__(self, args: PolicyFlags, name: TaskName) -> None:
        self.task, self.n = diffsim.TASKS[name](dtype=torch.float64), args.states
        self.scene = diffsim.make(name, num_envs=1).scene
        self.policy, called = args.policy(name)
        self.qpos, self.qvel = visited_states(name, self.policy, args.states)
        print(f"{name}: states of {called}", flush=True)

    @torch.no_grad()
    def actions_in(self, sim: Simulator) -> Tensor:
        """The policy's actions (120, N, nu) of 2 s, rounded to float32 so that every precision replays the same."""
        actions, qpos, qvel = [torch.zeros(self.n, sim.nu, dtype=torch.float64)], self.qpos, self.qvel
        for _ in range(120):
            actions.append(self.policy(self.task.observe(qpos, qvel, actions[-1])).clamp(-1, 1).float().double())
            qpos, qvel = sim.step(qpos, qvel, actions[-1])
        return torch.stack(actions[1:])


@torch.no_grad()
def visited_states(name: str, policy: nn.Module, count: int) -> tuple[Tensor, Tensor]:
    """(count, nq), (count, nv) in float64: a quarter each after 0.25, 0.5, 1 and 2 s of episodes under the policy."""
    env = diffsim.make(name, num_envs=count, seed=0)
    obs, _ = env.reset(seed=0)
    qpos, qvel = env.qpos.double(), env.qvel.double()
    for first, steps in enumerate((15, 15, 30, 60)):
        for _ in range(steps):
            obs = env.step(policy(obs.double()).float())[0]
        qpos[first::4], qvel[first::4] = env.qpos[first::4].double(), env.qvel[first::4].double()
    return qpos, qvel


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
