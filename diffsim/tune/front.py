"""The front of cost and error: settings of a robot on this machine, against a reference far finer than any of them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from tqdm import tqdm

from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks import Task
from diffsim.tune.motion import HORIZONS, SPANS, Motion, Setting, without

FINER = 8  # the reference's substeps, in multiples of the most measured
TIMED, ROUNDS = 64, 15  # environments and turns of a timing; the fastest turn counts, the others were disturbed
FACTORS = (0.125, 0.25, 0.5, 0.75, 1.0, 2.0, 4.0)  # substeps, in multiples of the default's
ENDS = ((4, 1e-4), (8, 1e-4), (30, 1e-2), (30, 1e-3))  # of Newton's method on MuJoCo's contact: passes, tolerance


class Row(NamedTuple):
    """What a setting costs and errs. Errors are medians over the start states."""

    setting: Setting
    # us of a control step of one environment, forward and with its gradient; root mean square over dofs [m, rad] after
    # SPANS; relative error and cosine of gradients over HORIZONS; the largest residual of MuJoCo's constraints; drift
    # of the energy in a fall, relative to the largest kinetic energy; share of environments that were contained
    numbers: dict[str, float]

    @property
    def cost(self) -> float:
        return self.numbers["us with gradient"]

    @property
    def error(self) -> float:
        return self.numbers[f"state {SPANS[-1]:g} s"]

    def columns(self) -> dict[str, str]:
        return {"setting": self.setting.flags} | {name: f"{value:.3g}" for name, value in self.numbers.items()}


def settings(task: type[Task], contact: str) -> list[Setting]:
    """What is measured on a contact model: the task's presets, and others around its default."""
    presets = task.presets(contact)
    default = presets["default"]
    factors = (*FACTORS, 8.0) if default.constrained else FACTORS  # whose default has fewer substeps
    counts = sorted({max(1, round(factor * default.substeps)) for factor in factors})
    if default.constrained:
        ends = *ENDS, (default.passes, default.tolerance)
        found = [default._replace(substeps=n, passes=passes, tolerance=end) for n in counts for passes, end in ends]
    else:
        found = [Integration("semi_implicit", n) for n in counts]
        found += [Integration("implicit", n, theta) for theta in (0.0, 0.5) for n in counts]
        found += [Integration("extrapolated", n) for n in counts if n % 2 == 0]
    double = [Setting(default._replace(substeps=n), torch.float64) for n in counts[-2:]]
    return [Setting(each) for each in dict.fromkeys((*found, *presets.values()))] + double


class Reference:
    """What a setting makes of a motion, to be compared with what others make of it."""

    def __init__(self, motion: Motion, setting: Setting) -> None:
        falling = motion.falling()
        self.motion, self.trail, self.gradients = motion, motion.replay(setting), motion.gradients(setting)
        self.energies = falling.energies(falling.replay(setting))

    def errors(self, truth: Reference) -> dict[str, float]:
        motion, pairs = self.motion, [(h, a, truth.gradients[h]) for h, a in self.gradients.items()]
        drift = abs(self.energies - truth.energies)[..., 1].max(0) / truth.energies[..., 0].max(0)
        return (
            {f"state {t:g} s": motion.error(self.trail, truth.trail, t) for t in SPANS}
            | {f"gradient {h}": ((a - b).norm(dim=1) / b.norm(dim=1)).median().item() for h, a, b in pairs}
            | {f"cosine {h}": F.cosine_similarity(a, b, dim=1).median().item() for h, a, b in pairs}
            | {"residual": self.trail.residual, "energy drift": float(np.median(drift))}
            | {"contained": self.trail.contained}
        )


def timed(sims: Sequence[Simulator], motion: Motion, rounds: int = ROUNDS) -> list[list[float]]:
    """Microseconds of a control step of one environment, forward and with its gradient: the least of `rounds` turns of
    all simulators, in windows of 8 steps from the start states."""
    best = np.full((len(sims), 2), np.inf)
    for turn in range(rounds + 1):  # the first one compiles and warms up
        order = [*zip(best, sims, strict=True)]
        for row, sim in order if turn % 2 else reversed(order):  # so that no one always follows the slowest
            copies = torch.arange(sim.num_envs) % len(motion.qpos)
            states = motion.qpos[copies], motion.qvel[copies], *motion.actions[:8, copies]
            for k, grad in enumerate((False, True)):
                sim.rewind()
                q, v, *leaves = (x.to(sim.device, sim.dtype) for x in states)
                leaves = [leaf.requires_grad_(grad) for leaf in leaves]
                start = clock(sim.device)
                for leaf in leaves:
                    q, v = sim.step(q, v, leaf)
                if grad:
                    v.sum().backward()
                if turn:
                    row[k] = min(row[k], (clock(sim.device) - start) / len(leaves) / sim.num_envs * 1e6)
    return best.tolist()


def finest(found: Iterable[Setting]) -> Setting:
    """The reference of settings of one contact model."""
    how = max((setting.integration for setting in found), key=lambda how: how.substeps)
    if how.constrained:
        fine = how._replace(substeps=FINER * how.substeps, passes=100, tolerance=1e-9)
    else:
        fine = Integration("extrapolated", FINER * how.substeps)
    return Setting(fine, torch.float64)


def measure(motion: Motion, found: list[Setting], rows: list[Row], **options: Any) -> None:
    """Append a row of each setting of one contact model; timings are of all of them side by side.

    Args:
        options: of Simulator, where timings are: device, threads.
    """
    truth = Reference(motion, finest(found))
    times = timed([motion.simulator(setting, TIMED, **options) for setting in found], motion)
    for setting, (forward, both) in zip(tqdm(found, "errors", leave=False, ncols=80), times, strict=True):
        numbers = {"us forward": forward, "us with gradient": both}
        rows.append(Row(setting, numbers | Reference(motion, setting).errors(truth)))


def clock(device: torch.device) -> float:
    """Seconds, once the device has done what it was told."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def front(rows: Iterable[Row]) -> list[Row]:
    """The rows that no other one beats in cost, and in the error of the state or of the gradient; the fastest first."""

    def beaten(row: Row, other: Row) -> bool:
        mine, its = ((r.cost, r.error, r.numbers[f"gradient {HORIZONS[0]}"]) for r in (row, other))
        return all(a <= b for a, b in zip(its, mine, strict=True)) and its != mine

    rows = [*rows]
    return sorted((row for row in rows if not any(beaten(row, other) for other in rows)), key=lambda row: row.cost)


def choice(rows: Iterable[Row], error: float) -> Row | None:
    """The fastest of those with at most that error of the state after 0.5 s, and no environment contained."""
    enough = (row for row in rows if row.error <= error and not row.numbers["contained"])
    return min(enough, key=lambda row: row.cost, default=None)


COSTS = ("contact", "limit", "frictionloss", "muscle", "terrain", "drag")  # parts that a scene may be without
BATCHES = (1, 16, 64, 256, 1024)  # environments per call


def costs(motion: Motion, setting: Setting, device: str) -> dict[str, float]:
    """Microseconds of a control step with its gradient: of the whole scene, and saved by leaving out each part."""
    sim, features = motion.simulator(setting, TIMED, device=device), set(motion.scene.features)
    if setting.integration.constrained and motion.scene.mj_model.dof_frictionloss.any():
        features.add("frictionloss")
    parts = [part for part in COSTS if part in features]
    scenes = {part: without(motion.scene, part) for part in parts}
    sims = [sim, *(motion.simulator(setting, TIMED, scene, device=device) for scene in scenes.values())]
    whole, *others = (both for _, both in timed(sims, motion))
    return {"all": whole} | {part: whole - other for part, other in zip(parts, others, strict=True)}


def batches(motion: Motion, setting: Setting, device: str) -> dict[int, float]:
    """Microseconds of a control step of one environment with its gradient, for numbers of environments per call."""
    sims = [motion.simulator(setting, n, device=device) for n in BATCHES]
    return {n: both for n, (_, both) in zip(BATCHES, timed(sims, motion, rounds=3), strict=True)}
