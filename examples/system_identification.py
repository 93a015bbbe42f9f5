"""Find a robot's friction, the time constant of its contact, its mass and its motors' strength from how it moved.

    python examples/system_identification.py                                  a hopper of other constants in MuJoCo
    python examples/system_identification.py --recording walk.npz --env ant   the motion of your own robot

A recording holds qpos (E, T + 1, nq), qvel (E, T + 1, nv) and ctrl (E, T, nu) of E episodes, or of one without the E: a
row for each control step of 1/60 s, ctrl in [-1, 1]. The fit simulates 0.1 s from random rows, with MuJoCo's contact,
and compares the velocities at the end. Each of these segments has factors of its own, so one backward pass for each
velocity gives the exact Jacobian of all segments, and Gauss-Newton needs few iterations. What has no factor, such as
the mass of one link, can be changed in the scene with `dataclasses.replace` and found by differences.
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
import torch
import tyro
from torch import Tensor

import diffsim
from diffsim.robot.scene import FACTORS
from diffsim.training import command, fail

STEPS = 6  # control steps of a segment: so few that errors of its start do not grow
TRUTH = {"mu": 0.7, "k_n": 0.6, "mass": 1.1, "motor": 0.9}  # of the robot in MuJoCo, as factors of its file's constants
Recording = tuple[Tensor, Tensor, Tensor]  # qpos, qvel and ctrl


@dataclass
class Args:
    recording: Path | None = None  # .npz file (default: a motion in MuJoCo of a robot that the fit does not know)
    env: str = "hopper"  # the task of the robot
    fit: tuple[Literal["mu", "k_n", "k_d", "k_limit", "mass", "motor"], ...] = ("mu", "k_n", "mass", "motor")
    # factors to find; k_n and k_limit divide the squares of time constants, k_d multiplies all force of a contact
    segments: int = 256  # in each iteration
    iterations: int = 12


def record(env: diffsim.DiffEnv, steps: int = 60, noise: float = 1e-3) -> Recording:
    """The motion of another robot in MuJoCo, under smooth random controls and measured with noise."""
    model, generator = mujoco.MjModel.from_xml_path(env.scene.path), torch.Generator().manual_seed(0)
    substeps = env.sim.integration.substeps
    model.opt.timestep, model.opt.cone = env.control_dt / substeps, mujoco.mjtCone.mjCONE_ELLIPTIC
    model.geom_friction[:, 0] *= TRUTH["mu"]
    model.geom_solref[:, 0] *= TRUTH["k_n"] ** -0.5
    model.body_mass *= TRUTH["mass"]
    model.body_inertia *= TRUTH["mass"]
    model.actuator_gear *= TRUTH["motor"]
    mujoco.mj_setConst(model, data := mujoco.MjData(model))
    low, high = model.actuator_ctrlrange.T
    qpos, qvel, ctrl = (torch.zeros(env.num_envs, steps + 1, n) for n in (model.nq, model.nv, model.nu))
    env.reset(seed=0)
    for e in range(env.num_envs):
        mujoco.mj_resetData(model, data)
        data.qpos, data.qvel = env.qpos[e], env.qvel[e]
        for t in range(steps + 1):
            qpos[e, t], qvel[e, t] = torch.from_numpy(data.qpos), torch.from_numpy(data.qvel)
            ctrl[e, t] = (0.7 * ctrl[e, t - 1] + 0.5 * torch.randn(model.nu, generator=generator)).clamp(-1, 1)
            data.ctrl = low + (ctrl[e, t].numpy() + 1) / 2 * (high - low)
            mujoco.mj_step(model, data, substeps)
    qpos, qvel = (x + noise * torch.randn(x.shape, generator=generator) for x in (qpos, qvel))
    return qpos, qvel, ctrl[:, :-1]


def read(path: Path, scene: diffsim.Scene) -> Recording:
    """A user's recording; one that does not fit the robot ends the example with one line."""
    try:
        with np.load(path) as file:
            arrays = [np.asarray(file[key], np.float32) for key in ("qpos", "qvel", "ctrl")]
    except (KeyError, ValueError, zipfile.BadZipFile, OSError) as error:
        fail(f"{path} is no .npz of qpos, qvel and ctrl: {error}")
    qpos, qvel, ctrl = (torch.from_numpy(x[None] if x.ndim == 2 else x) for x in arrays)
    E, T = (*ctrl.shape, 0, 0)[:2]
    shapes = (E, T + 1, scene.nq), (E, T + 1, scene.nv), (E, T, scene.nu)
    for key, x, shape in zip(("qpos", "qvel", "ctrl"), (qpos, qvel, ctrl), shapes, strict=True):
        if x.shape != shape or T < STEPS:
            fail(f"{path}: {key} has shape {tuple(x.shape)}, must be {shape} with at least {STEPS} control steps")
        if not x.isfinite().all():
            fail(f"{path}: {key} holds numbers that are not finite")
    return qpos, qvel, ctrl


def identify(args: Args, sim: diffsim.Simulator, recording: Recording) -> Tensor:
    """The factors (len(args.fit),) of the file's constants that explain the recording best."""
    qpos, qvel, ctrl = recording
    generator, logs = torch.Generator().manual_seed(0), torch.zeros(len(args.fit))  # as logarithms they stay positive
    columns = torch.tensor([FACTORS.index(name) for name in args.fit])
    for iteration in range(args.iterations):
        e, t = (torch.randint(n, (args.segments,), generator=generator) for n in (len(ctrl), ctrl.shape[1] - STEPS + 1))
        own = logs.repeat(args.segments, 1).requires_grad_()
        sim.rewind()
        sim.factors = torch.ones(args.segments, len(FACTORS)).index_copy(1, columns, own.exp())
        q, v = qpos[e, t], qvel[e, t]
        for k in range(STEPS):
            q, v = sim.step(q, v, ctrl[e, t + k])
        J = torch.stack([torch.autograd.grad(x.sum(), own, retain_graph=True)[0] for x in v.T], 1)
        error = (qvel[e, t + STEPS] - v).detach()
        # Some segments' Jacobians explode in contact, and some errors are large: the influence of both is bounded.
        size, miss = J.flatten(1).norm(dim=1), error.norm(dim=1)
        size, large = (x / x.median().clamp(min=1e-9) for x in (size, miss))
        weight = 1 / ((1 + size.square()) * (1 + large)).sqrt()[:, None]
        A, b = (weight[:, None] * J).flatten(0, 1), (weight * error).flatten()
        print(f"iteration {iteration}: median error {miss.median():.2e}, {describe(args, logs.exp())}")
        logs = logs + torch.linalg.lstsq(A, b[:, None], driver="gelsd").solution[:, 0].clamp(-0.5, 0.5)
    return logs.exp()


def describe(args: Args, factors: Tensor) -> str:
    return ", ".join(f"{name} x {value:.3f}" for name, value in zip(args.fit, factors.tolist(), strict=True))


def main(args: Args) -> Tensor:
    env = diffsim.make(args.env, args.segments, horizon=STEPS, contact="mujoco", factors=True)
    if args.recording:
        recording = read(args.recording, env.scene)
    elif "muscle" in env.scene.features:
        fail(f"MuJoCo does not simulate the muscles of {args.env}: give a --recording")
    else:
        recording = record(diffsim.make(args.env, 20, contact="mujoco"))
    found = identify(args, env.sim, recording)
    print(f"found {describe(args, found)}" + ("" if args.recording else f"; true {TRUTH}"))
    return found


@command
def run() -> None:
    main(tyro.cli(Args))


if __name__ == "__main__":
    run()
