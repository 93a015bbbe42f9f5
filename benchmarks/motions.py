"""Policies, the states that they visit, and motions from there: what the benchmarks of the simulator share."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import mujoco
import numpy as np
import torch
from common import CommonFlags, TaskName
from tables import ROOT
from torch import Tensor, nn

import diffsim
from diffsim import Integration, Scene, Simulator
from diffsim.tasks import Task
from diffsim.training import Count, fail, load_policy, parse

sys.path.append(str(ROOT))
import shac  # noqa: E402

RUNS = ROOT / "runs" / "learning"  # where benchmarks/learning.py trains
CONTROL_DT = 1 / 60
Array = np.ndarray

Integrator = Literal["semi_implicit", "implicit 0", "implicit 0.5", "extrapolated"]  # with its theta
INTEGRATORS: tuple[Integrator, ...] = get_args(Integrator)


def integration(integrator: Integrator, substeps: int) -> Integration:
    name, _, theta = integrator.partition(" ")
    return Integration(integrator=name, theta=float(theta or 0), substeps=substeps)


def label(setting: Integration) -> str:
    return setting.integrator if setting.integrator != "implicit" else f"implicit {setting.theta:g}"


def simulator(
    scene: Scene, setting: Integration, num_envs: int, dtype: torch.dtype = torch.float32, **options: Any
) -> Simulator:
    """By default of single steps on the CPU; options as Simulator takes them."""
    return Simulator(scene, num_envs, setting, dtype=dtype, **options)


@dataclass
class PolicyFlags(CommonFlags):
    checkpoint: Path | None = None  # of any script, whose policy acts (default: shac.py's in --runs, else untrained)
    runs: Path = RUNS  # directory of the runs of benchmarks/learning.py
    states: Count = 32  # start states, which the policy visits

    def policy(self, name: TaskName) -> tuple[nn.Module, str]:
        """Observations -> actions in float64, and what to call it."""
        if self.checkpoint and len(self.env) != 1:
            fail("--checkpoint is of one task: name it with --env")
        path = self.checkpoint or self.runs / "shac" / f"{name}__1" / "checkpoint.pt"
        if self.checkpoint or path.is_file():
            saved = load_policy(path)
            if saved.args["env"] != name:
                fail(f"{path} was trained on {saved.args['env']}, not {name}")
            return saved.network.double(), f"{path.parent.name}, iteration {saved.iteration}"
        torch.manual_seed(0)
        args = parse(shac.Args, ["--env", name, "--device", "cpu"])
        return shac.SHAC(args, diffsim.make(name, num_envs=1)).policy.double(), "no training"


class Case:
    """A task (float64), its scene, and a policy with the states that it visits."""

    def __init__(self, args: PolicyFlags, name: TaskName) -> None:
        self.task, self.n = diffsim.TASKS[name](dtype=torch.float64), args.states
        self.scene = diffsim.make(name, num_envs=1).scene
        self.policy, called = args.policy(name)
        self.qpos, self.qvel = visited_states(name, self.policy, args.states)
        print(f"{name}: states of {called}", flush=True)


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


def idle(scene: Scene) -> Tensor:
    """(nu,) the control without any force: 0 of a motor, -1 of a muscle."""
    return torch.where(torch.tensor(scene.motor_link) > 0, 0.0, -1.0).double()


@torch.no_grad()
def closed_loop(sim: Simulator, task: Task, policy: nn.Module, qpos: Tensor, qvel: Tensor, steps: int) -> Tensor:
    """The policy's actions (T, N, nu), rounded to float32 so that every precision replays the same."""
    actions, action = [], torch.zeros(sim.num_envs, sim.nu, dtype=torch.float64)
    for _ in range(steps):
        action = policy(task.observe(qpos, qvel, action)).clamp(-1, 1).float().double()
        actions.append(action)
        qpos, qvel = sim.step(qpos, qvel, action)
    return torch.stack(actions)


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


def state_errors(model: mujoco.MjModel, qpos: Tensor, expected: Tensor) -> Array:
    """(N,) root mean square over degrees of freedom."""
    errors, difference = [], np.zeros(model.nv)
    for a, b in zip(qpos.numpy(), expected.numpy(), strict=True):
        mujoco.mj_differentiatePos(model, difference, 1.0, b, a)
        errors.append(np.sqrt(np.mean(difference**2)))
    return np.array(errors)


def heights(model: mujoco.MjModel, qpos: Tensor) -> Array:
    """Heights over the ground of spheres and capsules' ends (..., spheres) of all geoms that could touch it, m."""
    data, capsule = mujoco.MjData(model), mujoco.mjtGeom.mjGEOM_CAPSULE
    geoms = np.flatnonzero(((model.geom_contype | model.geom_conaffinity) != 0) & (model.geom_bodyid != 0))
    length = np.where(model.geom_type[geoms] == capsule, model.geom_size[geoms, 1], 0.0)
    rows = []
    for q in qpos.flatten(0, -2).numpy():
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        centre, half = data.geom_xpos[geoms, 2] - model.geom_size[geoms, 0], length * data.geom_xmat[geoms, 8]
        rows.append(np.concatenate([centre - half, (centre + half)[length > 0]]))
    return np.array(rows).reshape(*qpos.shape[:-1], -1)


def deepest(model: mujoco.MjModel, qpos: Tensor) -> Array:
    """(N,) how far each environment's geoms reach below z = 0 in qpos (T, N, nq), m."""
    return np.maximum(-heights(model, qpos).min(-1), 0.0).max(0)


def mechanics(model: mujoco.MjModel, qpos: Tensor, qvel: Tensor) -> tuple[Array, Array, Array]:
    """Kinetic energy (N,), energy (N,), and linear and angular momentum about the centre of mass (N, 6)."""
    data, rows = mujoco.MjData(model), []
    for q, v in zip(qpos.numpy(), qvel.numpy(), strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        linear = model.body_subtreemass[0] * data.subtree_linvel[0]
        rows.append([data.energy[1], data.energy.sum(), *linear, *data.subtree_angmom[0]])
    table = np.array(rows)
    return table[:, 0], table[:, 1], table[:, 2:]
