"""Find a robot's friction and mass from a recording of how it moved, by the exact gradient of the simulation.

    python examples/system_identification.py --plot found.png

MuJoCo moves a hopper that is heavier and more slippery than its file says; for a robot of yours, load such arrays in
place of `record`. The fit simulates 0.1 s from random rows and compares the velocities at the end. Each of these
segments has factors of its own, so one backward pass for each velocity gives the exact Jacobian of all segments.
"""

import sys
from pathlib import Path

import mujoco.rollout
import numpy as np
import torch
import tyro
from torch import Tensor

import diffsim
from diffsim.robot.scene import FACTORS

STEPS = 6  # control steps of a segment: so few that errors of its start do not grow
TRUTH = {"mu": 0.7, "mass": 1.2}  # MuJoCo's friction and mass, as factors of the file's
SELECT = torch.eye(len(FACTORS))[[FACTORS.index(name) for name in TRUTH]]  # all other factors are 1


def record(env: diffsim.DiffEnv, steps: int = 120, substeps: int = 16, noise: float = 1e-3) -> tuple[Tensor, ...]:
    """Noisy qpos (E, T, nq), qvel (E, T, nv) and ctrl (E, T, nu) of MuJoCo, at a quarter of the fit's time step."""
    model, rng = mujoco.MjModel.from_xml_path(env.scene.path), np.random.default_rng(0)
    model.opt.timestep, model.opt.cone = env.control_dt / substeps, mujoco.mjtCone.mjCONE_ELLIPTIC
    model.geom_friction[:, 0] *= TRUTH["mu"]
    model.body_mass *= TRUTH["mass"]
    model.body_inertia *= TRUTH["mass"]
    mujoco.mj_setConst(model, data := mujoco.MjData(model))
    env.reset(seed=0)
    start = torch.cat((torch.zeros(env.num_envs, 1), env.qpos, env.qvel), dim=1).double()
    ctrl = rng.uniform(-1, 1, (env.num_envs, steps // 5, model.nu)).repeat(5, axis=1)
    states, _ = mujoco.rollout.rollout(model, data, start.numpy(), ctrl.repeat(substeps, axis=1))
    qpos, qvel = np.split(rng.normal(states[:, substeps - 1 :: substeps, 1:], noise), [model.nq], axis=2)
    return tuple(torch.from_numpy(x).float() for x in (qpos, qvel, np.roll(ctrl, -1, axis=1)))


def identify(sim: diffsim.Simulator, recording: tuple[Tensor, ...], iterations: int = 12) -> Tensor:
    """Estimates (iterations + 1, 2) of the factors by Gauss-Newton, from those of the file."""
    (qpos, qvel, ctrl), logs = recording, [torch.zeros(len(TRUTH))]  # of the factors, which so stay positive
    for iteration in range(iterations):
        e, t = (torch.randint(n, (sim.num_envs,)) for n in (len(qpos), qpos.shape[1] - STEPS))
        own = logs[-1].repeat(sim.num_envs, 1).requires_grad_()
        sim.rewind()
        sim.factors = (own @ SELECT).exp()
        q, v = qpos[e, t], qvel[e, t]
        for k in range(STEPS):
            q, v = sim.step(q, v, ctrl[e, t + k])
        J = torch.stack([torch.autograd.grad(x.sum(), own, retain_graph=True)[0] for x in v.T], dim=1)
        error = (qvel[e, t + STEPS] - v).detach()
        size, miss = J.flatten(1).norm(dim=1), error.norm(dim=1)  # both are large in some contacts, so they are bounded
        weight = ((1 + (size / size.median()) ** 2) * (1 + miss / miss.median())).rsqrt()[:, None]
        step = torch.linalg.lstsq((weight[:, None] * J).flatten(0, 1), (weight * error).flatten()[:, None]).solution
        logs.append(logs[-1] + step[:, 0].clamp(-0.5, 0.5))
        print(f"iteration {iteration}: median error {miss.median():.2e}, factors {logs[-1].exp().numpy().round(3)}")
    return torch.stack(logs).exp()


def main(plot: Path | None = None) -> None:
    if plot:  # before the work
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(5, 2.8), layout="constrained")
        if plot.suffix[1:] not in (allowed := figure.canvas.get_supported_filetypes()):
            sys.exit(f"--plot: {plot} must end in one of .{', .'.join(allowed)}")
    torch.manual_seed(0)
    sim = diffsim.make("hopper", 256, horizon=STEPS, contact="mujoco", factors=True).sim
    estimates = identify(sim, record(diffsim.make("hopper", 20)))
    if plot:
        axes.plot(estimates, "o-")
        axes.hlines([*TRUTH.values()], 0, len(estimates) - 1, ["C0", "C1"], "dashed")
        axes.set(xlabel="iteration", ylabel="factor of the file's constant")
        axes.legend(["friction", "mass", "in MuJoCo"])
        figure.savefig(plot, dpi=120)


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
