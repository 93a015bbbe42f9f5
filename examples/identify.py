"""Fit masses, inertias, friction, damping or gains of a robot to a log of its motion, by gradients of the simulation.

    python examples/identify.py robot.xml log.csv --fit mass friction
    python examples/identify.py arm.xml log.csv --fit mass com --only hand

Columns of the log: time, qpos0 ..., qvel0 ..., ctrl0 ... as MuJoCo's; a row's ctrl acts until the next row. A log
determines only combinations of masses, centres of mass and inertias (base parameters), and friction only where contacts
slide. A weak prior around the file's values decides the rest: a deviation near 1, the prior's, means unknown.
"""

import csv
import sys
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from diffsim import Scene, load_scene
from diffsim.parameters import ParametricSimulator
from diffsim.robot.elements import control_range
from diffsim.sim.integration import Integration

OF_CENTRE, OF_FACTOR = 0.05, 0.7  # standard deviations of the prior: of a centre's change [m], of the log of a factor
WINDOWS, STEPS, ITERATIONS = 512, 4, 10  # rows from which the motion is predicted, and over how many rows
KNOWN = 0.1  # deviation below which a combination of numbers counts as determined by the log
Names = tuple[str, ...]
File = tyro.conf.Positional[Path]


class Unknowns:
    """What is fitted: elements of parameters, all or those named `only`, as changes x in units of the prior."""

    def __init__(self, sim: ParametricSimulator, names: Names, only: Names = ()) -> None:
        self.file, self.masks, self.labels = sim.parameters, dict[str, Tensor](), list[tuple[str, str]]()
        for name in names:
            mask = sim.adjustable(name)
            for k, element in enumerate(sim.elements(name)):
                mask[k] &= (not only or element in only) & ((self.file[name][k] != 0) | (name == "com"))
                self.labels += [(name, element)] * int(mask[k].sum())
            self.masks[name] = mask
        if not self.labels:
            raise ValueError(f"there is no {', '.join(names)} that moves the robot and is not zero in the file")

    def values(self, x: Tensor) -> dict[str, Tensor]:
        result, parts = {}, x.split([int(mask.sum()) for mask in self.masks.values()])
        for (name, mask), part in zip(self.masks.items(), parts, strict=True):
            file, change = self.file[name], torch.zeros(mask.shape).to(x).masked_scatter(mask, part)
            result[name] = file + OF_CENTRE * change if name == "com" else file * (OF_FACTOR * change).exp()
            if name == "inertia":  # by its second moments, so that no moment exceeds the sum of the two others
                second = (file.sum(1, keepdim=True) / 2 - file).clamp(min=0) * (OF_FACTOR * change).exp()
                result[name] = (second.sum(1, keepdim=True) - second).where(mask, file)
        return result

    def numbers(self, x: Tensor) -> list[float]:
        values = self.values(x)
        return torch.cat([values[name][mask] for name, mask in self.masks.items()]).tolist()


def read_log(path: Path, scene: Scene) -> list[Tensor]:
    """Return time (T,), qpos (T, nq), qvel (T, nv), and actions (T, nu) in [-1, 1]."""
    table, sizes = np.genfromtxt(path, delimiter=",", skip_header=1), (1, scene.nq, scene.nv, scene.nu)
    if table.ndim != 2 or table.shape[1] != sum(sizes) or not np.isfinite(table).all():
        raise ValueError(f"{path}: must have columns of numbers: time and {sizes[1:]} of qpos, qvel and ctrl")
    time, qpos, qvel, ctrl = np.split(table, np.cumsum(sizes)[:-1], axis=1)
    low, high = control_range(scene.mj_model)
    return [torch.tensor(x) for x in (time[:, 0], qpos, qvel, (2 * ctrl - low - high) / (high - low))]


def estimate(scene: Scene, log: list[Tensor], names: Names, only: Names = ()) -> tuple[Unknowns, Tensor, Tensor]:
    """Return the unknowns, the most probable x, and its covariance, by the Gauss-Newton method."""
    (time, qpos, qvel, action), dt = log, float(log[0].diff().median())
    first = torch.nonzero((time[STEPS:] - time[:-STEPS] - STEPS * dt).abs() < 0.1 * dt)[:, 0]
    first = first[torch.randperm(len(first), generator=torch.Generator().manual_seed(0))[:WINDOWS]]
    integration = Integration("mujoco", max(1, round(dt / scene.mj_model.opt.timestep)), tolerance=1e-8)
    sim = ParametricSimulator(scene, len(first), integration, dt, STEPS, dtype=torch.float64)
    unknowns = Unknowns(sim, names, only)
    x = torch.zeros(len(unknowns.labels), dtype=torch.float64)
    for _ in range(ITERATIONS):
        sim.rewind()
        sim.parameters = unknowns.values(x.requires_grad_())
        q, v = qpos[first], qvel[first]
        for k in range(STEPS):
            q, v = sim.step(q, v, action[first + k])
        error = (v - qvel[first + STEPS]).detach()
        scale = error.abs().median(0).values.clamp(min=1e-9) / 0.67  # the standard deviation of a normal variable
        error, J = (error / scale).flatten(), (sim.jacobian(v, x) / scale[:, None]).flatten(0, 1)
        J_weighted = J * (1 + error.square()).rsqrt()[:, None]  # large errors, as of early contacts, count linearly
        covariance = torch.linalg.inv(J_weighted.mT @ J + torch.eye(len(x)))
        x = x.detach() - (covariance @ (J_weighted.mT @ error + x.detach())).clamp(-1, 1)
        print(f"median error of velocities {float((error.abs().view(v.shape) * scale).median()):.3g}")
    return unknowns, x, covariance


def main(robot: File, log: File, fit: Names = ("mass", "damping"), only: Names = ()) -> None:
    scene = load_scene(robot)
    unknowns, x, covariance = estimate(scene, read_log(log, scene), fit, only)
    columns = unknowns.numbers(0 * x), unknowns.numbers(x), covariance.diag().sqrt().tolist()
    rows = [(*names, *numbers) for names, *numbers in zip(unknowns.labels, *columns, strict=True)]
    with log.with_suffix(".fit.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("parameter", "element", "file", "fitted", "deviation"), *rows])
    for row in rows:
        print("{:12} {:24} {:10.4g} {:10.4g} {:6.2f}".format(*row))
    known = int((torch.linalg.eigvalsh(covariance) < KNOWN**2).sum())
    print(f"The log determines {known} of {len(x)} combinations of these numbers to {KNOWN} of the prior's deviation.")


if __name__ == "__main__":
    try:
        tyro.cli(main, description=__doc__)
    except (OSError, ValueError) as error:
        sys.exit(f"identify.py: {error}")
