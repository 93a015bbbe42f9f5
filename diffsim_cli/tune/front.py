"""The front of cost and error: integrations of a robot on this machine, against a reference far finer than them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from diffsim.sim.integration import TOLERANCE, Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks import Task
from diffsim_cli.tune.motion import HORIZONS, SPANS, Motion

FINER = 16  # the reference's substeps, in multiples of the most measured
TIMED, ROUNDS = 64, 15  # environments and turns of a timing; the fastest turn counts, the others were disturbed
FACTORS = (0.125, 0.25, 0.5, 0.75, 1.0, 2.0, 4.0)  # substeps, in multiples of the default's


class Row(NamedTuple):
    """The cost and the errors of an integration. Errors are medians over the start states."""

    how: Integration
    # us of a control step of one environment, forward and with its gradient; root mean square over dofs [m, rad] after
    # SPANS; relative error of gradients over HORIZONS; the largest residual of MuJoCo's constraints; share of
    # environments that were contained
    numbers: dict[str, float]

    @property
    def cost(self) -> float:
        return self.numbers["us with gradient"]

    @property
    def error(self) -> float:
        return self.numbers[f"state {SPANS[-1]:g} s"]

    def columns(self) -> dict[str, str]:
        return {"setting": flags(self.how)} | {name: f"{value:.3g}" for name, value in self.numbers.items()}


def flags(how: Integration) -> str:
    """Write the flags that make a script integrate so."""
    words = ["--contact", how.contact, "--substeps", str(how.substeps)]
    if how.contact == "soft":
        words.append("--implicit" if how.implicit else "--no-implicit")
    elif how.tolerance < TOLERANCE:
        words += ["--accuracy", "accurate"]
    return " ".join(words)


def integrator(how: Integration) -> str:
    """The integrator's name."""
    return "mujoco" if how.contact == "mujoco" else "implicit" if how.implicit else "semi_implicit"


def settings(task: type[Task], contact: str) -> list[Integration]:
    """List what is measured on a contact model: the task's presets, and others around its default."""
    presets = task.presets(contact)
    default = presets["default"]
    factors = (*FACTORS, 8.0) if contact == "mujoco" else FACTORS  # whose default has fewer substeps
    counts = sorted({max(1, round(factor * default.substeps)) for factor in factors})
    found = [default._replace(substeps=n) for n in counts]
    if contact == "soft":
        found += [default._replace(substeps=n, implicit=True) for n in counts]
    return [*dict.fromkeys((*found, *presets.values()))]


def finest(found: Sequence[Integration]) -> Integration:
    """The reference of integrations on one contact model, to be computed in float64."""
    most = max(how.substeps for how in found)
    return found[0]._replace(substeps=FINER * most, implicit=False, tolerance=1e-9)


class Reference:
    """Integrate a motion, to be compared with what others make of it."""

    def __init__(self, motion: Motion, how: Integration, dtype: torch.dtype = torch.float32) -> None:
        self.motion, self.trail, self.gradients = motion, motion.replay(how, dtype), motion.gradients(how, dtype)

    def errors(self, truth: Reference) -> dict[str, float]:
        pairs = [(h, a, truth.gradients[h]) for h, a in self.gradients.items()]
        return (
            {f"state {t:g} s": self.motion.error(self.trail, truth.trail, t) for t in SPANS}
            | {f"gradient {h}": ((a - b).norm(dim=1) / b.norm(dim=1)).median().item() for h, a, b in pairs}
            | {"residual": self.trail.residual, "contained": self.trail.contained}
        )


def measure(motion: Motion, found: list[Integration], rows: list[Row], **options: Any) -> None:
    """Append a row of each integration on one contact model; timings are of all of them side by side.

    Args:
        options: of Simulator, where timings are: device, threads.
    """
    truth = Reference(motion, finest(found), torch.float64)
    times = timed([motion.simulator(how, TIMED, **options) for how in found], motion)
    for how, (forward, both) in zip(tqdm(found, "errors", leave=False, ncols=80), times, strict=True):
        numbers = {"us forward": forward, "us with gradient": both}
        rows.append(Row(how, numbers | Reference(motion, how).errors(truth)))


def timed(sims: Sequence[Simulator], motion: Motion) -> list[list[float]]:
    """Microseconds of a control step of one environment, forward and with its gradient: the least of ROUNDS turns of
    all simulators, in rollouts of 8 steps from the start states."""
    best = np.full((len(sims), 2), np.inf)
    for turn in range(ROUNDS + 1):  # the first one compiles and warms up
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
