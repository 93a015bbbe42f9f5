"""Find a robot's mass, joint damping and friction from how it moved.

    python examples/system_identification.py

`Simulator.factors` has no gradient in the mass of one link or the damping of joints. Three unknowns do not need any:
Gauss-Newton takes a finite difference per unknown, which is one more simulator of the same batch. "Measured" is another
simulation with constants that the fit does not see, plus noise.
"""

import dataclasses
from importlib.resources import files

import torch
import tyro
from torch import Tensor

import diffsim

STEPS = 8  # control steps of 1/60 s from each measured start: short, so that errors of the start do not grow
NAMES = ("torso mass", "joint damping", "friction")
TRUTH = torch.tensor([1.3, 0.7, 0.6], dtype=torch.float64)  # relative to the file's
HOPPER = diffsim.load_scene(str(files("diffsim") / "assets" / "hopper.xml"))
TORSO = 3  # the link after the three that carry it along x, z and pitch


def robot(scale: Tensor) -> diffsim.Scene:
    """The hopper with some constants multiplied."""
    mass, inertia = HOPPER.mass.copy(), HOPPER.inertia.copy()
    mass[TORSO], inertia[TORSO] = scale[0].item() * mass[TORSO], scale[0].item() * inertia[TORSO]
    damping, mu = scale[1].item() * HOPPER.damping, scale[2].item() * HOPPER.mu
    return dataclasses.replace(HOPPER, mass=mass, inertia=inertia, damping=damping, mu=mu)


@torch.no_grad()
def simulate(scale: Tensor, qpos: Tensor, qvel: Tensor, ctrl: Tensor) -> Tensor:
    """Where the robot goes (STEPS, N, nq + nv) from qpos, qvel under ctrl (STEPS, N, nu)."""
    sim = diffsim.Simulator(robot(scale), len(qpos), dtype=torch.float64)
    path = []
    for u in ctrl:
        qpos, qvel = sim.step(qpos, qvel, u)
        path.append(torch.cat((qpos, qvel), dim=1))
    return torch.stack(path)


def starts(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random states near the ground, which slide and turn, and random commands."""
    low, high = torch.tensor([[0, -0.3, -0.3, -1, -1, -0.5], [0, 0.0, 0.3, 0, 0, 0.5]], dtype=torch.float64)
    qpos = low + (high - low) * torch.rand(count, 6, dtype=torch.float64)
    qvel = torch.randn(count, 6, dtype=torch.float64)
    return qpos, qvel, 0.3 * torch.randn(STEPS, count, 3, dtype=torch.float64)


def identify(count: int = 64, noise: float = 1e-2, iterations: int = 5, seed: int = 0) -> Tensor:
    """The constants (3,), relative to the file's, that explain the measurements best."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    data = starts(count)
    measured = simulate(TRUTH, *data)
    measured += noise * torch.randn_like(measured)
    log_scale, step = torch.zeros(3, dtype=torch.float64), 1e-4  # as logarithms they stay positive
    for iteration in range(iterations):
        error = (simulate(log_scale.exp(), *data) - measured).flatten()
        columns = [
            (simulate((log_scale + d).exp(), *data) - simulate((log_scale - d).exp(), *data)).flatten() / (2 * step)
            for d in step * torch.eye(3, dtype=torch.float64)
        ]
        print(f"iteration {iteration}: rms error {error.square().mean().sqrt():.2e}, {describe(log_scale.exp())}")
        log_scale = log_scale - torch.linalg.lstsq(torch.stack(columns, 1), error).solution
    print(f"found {describe(log_scale.exp())}; true {describe(TRUTH)}")
    return log_scale.exp()


def describe(scale: Tensor) -> str:
    return ", ".join(f"{name} x {value:.3f}" for name, value in zip(NAMES, scale.tolist(), strict=True))


if __name__ == "__main__":
    tyro.cli(identify)
