"""Fit masses, inertias, friction, damping or gains of a robot to a log of its motion, by gradients of the simulation.

    python examples/identify.py robot.xml log.csv --fit mass friction
    python examples/identify.py arm.xml log.csv --fit mass com --only hand

Columns of the log: time, qpos0 ..., qvel0 ..., ctrl0 ... as MuJoCo's; a row's ctrl acts until the next row. A log
determines only combinations of masses, centres of mass and inertias (base parameters), and friction only where contacts
slide. A weak prior around the file's values decides the rest: a deviation near 1, the prior's, means unknown.

The friction of a geom is that of its contacts with the ground and other fixed geoms. Theirs is no unknown unless only
they are named by --only, because a contact has the larger of two. Fitting mass leaves inertias as they are; a payload
changes mass, com and inertia.
"""

import csv
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import tyro
from torch import Tensor

from diffsim import Scene, load_scene
from diffsim.parameters import ParametricSimulator
from diffsim.robot.constants import LEAST_FRICTION
from diffsim.robot.contacts import declared_pairs, ground_pairs
from diffsim.robot.elements import control_range
from diffsim.sim.integration import Integration

OF_CENTRE, OF_FACTOR = 0.05, 0.7  # standard deviations of the prior: of a centre's change [m], of the log of a factor
WINDOWS, STEPS = 512, 4  # rows from which the motion is predicted, and over how many rows
ITERATIONS, HALVINGS = 20, 6  # at most, of the fit and of a step of it
STOP, STEADY = 1e-3, 0.01  # expected fall of the cost, as a part of it, at which the fit ends, and has converged
KNOWN = 0.1  # deviation below which a combination of numbers counts as determined by the log
Names = tuple[str, ...]
File = tyro.conf.Positional[Path]


class Unknowns:
    """What is fitted: elements of parameters, all or those named `only`, as changes x in units of the prior."""

    def __init__(self, sim: ParametricSimulator, names: Names, only: Names = ()) -> None:
        self.file, self.masks, self.labels = sim.parameters, dict[str, Tensor](), list[tuple[str, str]]()
        for name in names:
            mask = sim.adjustable(name)
            if name == "friction":
                named = torch.tensor([element in only for element in sim.elements(name)])
                self.file[name], held = friction_of_contacts(sim.scene, named)
                mask &= ~held
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


def friction_of_contacts(scene: Scene, named: Tensor) -> tuple[Tensor, Tensor]:
    """Return the friction of geoms (ngeom,), and mark those that leave it to the geoms that they touch.

    A contact has the larger friction of its geoms. As unknowns the two would take turns at being the larger, so only
    one is: the moving geom, or the fixed one if `named` (ngeom,) marks it alone.
    """
    m = scene.mj_model
    file, held, fixed = m.geom_friction[:, 0], np.zeros(m.ngeom, bool), m.body_weldid[m.geom_bodyid] == 0
    friction = file.copy()
    for pair in (*ground_pairs(m), *scene.geom_pairs):
        ground, geom = sorted(pair, key=lambda each: not fixed[each])
        alike = m.geom_priority[ground] == m.geom_priority[geom]
        if not fixed[ground] or fixed[geom] or not alike or (min(pair), max(pair)) in declared_pairs(m):
            continue
        if not named[ground] or named[geom]:
            friction[geom], held[ground] = max(friction[geom], file[ground]), True
        elif file[geom] <= file[ground]:
            held[geom] = True
    friction[held] = LEAST_FRICTION
    return torch.tensor(friction), torch.tensor(held)


def read_log(path: Path, scene: Scene) -> list[Tensor]:
    """Return time (T,), qpos (T, nq), qvel (T, nv), and actions (T, nu) in [-1, 1]."""
    table, sizes = np.genfromtxt(path, delimiter=",", skip_header=1), (1, scene.nq, scene.nv, scene.nu)
    if table.ndim != 2 or table.shape[1] != sum(sizes) or not np.isfinite(table).all():
        raise ValueError(f"{path}: must have columns of numbers: time and {sizes[1:]} of qpos, qvel and ctrl")
    time, qpos, qvel, ctrl = np.split(table, np.cumsum(sizes)[:-1], axis=1)
    low, high = control_range(scene.mj_model)
    return [torch.tensor(x) for x in (time[:, 0], qpos, qvel, (2 * ctrl - low - high) / (high - low))]


class Prediction(NamedTuple):
    """What numbers x say about the log."""

    velocity: Tensor  # (N, nv) after STEPS rows
    error: Tensor  # (N, nv) against the log's

    def scale(self) -> Tensor:
        """Return the errors' scale (nv,): the standard deviation of a normal variable with their median."""
        return self.error.abs().median(0).values.clamp(min=1e-9) / 0.67

    def cost(self, x: Tensor, scale: Tensor) -> float:
        """Return what x minimizes: large errors, as of early contacts, count linearly."""
        return float(((1 + (self.error / scale).square()).sqrt() - 1).sum() + x.detach().square().sum() / 2)


def estimate(scene: Scene, log: list[Tensor], names: Names, only: Names = ()) -> tuple[Unknowns, Tensor, Tensor, bool]:
    """Return the unknowns, the most probable x, its covariance, and whether it converged, by Gauss-Newton steps.

    A step is halved until the cost falls.
    """
    (time, qpos, qvel, action), dt = log, float(log[0].diff().median())
    first = torch.nonzero((time[STEPS:] - time[:-STEPS] - STEPS * dt).abs() < 0.1 * dt)[:, 0]
    first = first[torch.randperm(len(first), generator=torch.Generator().manual_seed(0))[:WINDOWS]]
    integration = Integration("mujoco", max(1, round(dt / scene.mj_model.opt.timestep)), tolerance=1e-8)
    sim = ParametricSimulator(scene, len(first), integration, dt, STEPS, dtype=torch.float64)
    unknowns = Unknowns(sim, names, only)

    def predict(x: Tensor) -> Prediction:
        sim.rewind()
        sim.parameters = unknowns.values(x)
        q, v = qpos[first], qvel[first]
        for k in range(STEPS):
            q, v = sim.step(q, v, action[first + k])
        return Prediction(v, (v - qvel[first + STEPS]).detach())

    x, converged = torch.zeros(len(unknowns.labels), dtype=torch.float64), False
    for _ in range(ITERATIONS):
        now = predict(x.requires_grad_())
        scale = now.scale()
        print(f"median error of velocities {float(now.error.abs().median()):.3g}")
        error, J = (now.error / scale).flatten(), (sim.jacobian(now.velocity, x) / scale[:, None]).flatten(0, 1)
        J_weighted = J * (1 + error.square()).rsqrt()[:, None]
        covariance, x = torch.linalg.inv(J_weighted.mT @ J + torch.eye(len(x))), x.detach()
        slope, cost = J_weighted.mT @ error + x, now.cost(x, scale)
        step = covariance @ slope
        expected = float(slope @ step) / cost
        if (converged := expected < STEADY) and expected < STOP:
            break
        with torch.no_grad():  # a log with contacts that begin early has a rough cost
            step = step.clamp(-1, 1)
            falls = (s for k in range(HALVINGS) if predict(x - (s := step / 2**k)).cost(x - s, scale) < cost)
            if (shorter := next(falls, None)) is None:
                break
        x = x - shorter
    return unknowns, x.detach(), covariance, converged


def main(robot: File, log: File, fit: Names = ("mass", "damping"), only: Names = ()) -> None:
    """Fit the parameters of a robot to a log.

    Args:
        robot: MJCF file.
        log: csv file.
        fit: of mass (inertias stay), com, inertia, friction, damping, armature, frictionloss, gain and kv.
        only: names of bodies, geoms, joints or actuators to fit; default all.
    """
    scene = load_scene(robot)
    unknowns, x, covariance, converged = estimate(scene, read_log(log, scene), fit, only)
    columns = unknowns.numbers(0 * x), unknowns.numbers(x), covariance.diag().sqrt().tolist()
    rows = [(*names, *numbers) for names, *numbers in zip(unknowns.labels, *columns, strict=True)]
    with log.with_suffix(".fit.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("parameter", "element", "file", "fitted", "deviation"), *rows])
    for row in rows:
        print("{:12} {:24} {:10.4g} {:10.4g} {:6.2f}".format(*row))
    if not converged:
        print("Not converged: the error does not fall any further, so do not trust these numbers or their deviations.")
    known = int((torch.linalg.eigvalsh(covariance) < KNOWN**2).sum())
    print(f"The log determines {known} of {len(x)} combinations of these numbers to {KNOWN} of the prior's deviation.")


if __name__ == "__main__":
    try:
        tyro.cli(main, description=__doc__)
    except (OSError, ValueError) as error:
        sys.exit(f"identify.py: {error}")
