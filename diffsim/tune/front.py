"""The front of cost and error: settings of a robot on this machine, against a reference far finer than any of them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
import torch.nn.functional as F
from tqdm import tqdm

from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks import Task
from diffsim.training.monitor import apart
from diffsim.tune.motion import HORIZONS, SPANS, Motion, Setting, without

FINER = 8  # the reference's substeps, in multiples of the most measured
TIMED, ROUNDS = 64, 7  # environments and turns of a timing; the fastest turn counts, the others were disturbed
FACTORS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)  # substeps, in multiples of the default's
PASSES = (2, 4, 8)  # of Newton's method on MuJoCo's contact


@dataclass
class Row:
    """What a setting costs and errs. Errors are medians over the start states."""

    setting: Setting
    forward: float = math.nan  # us of a control step of one environment, without gradient
    backward: float = math.nan  # us of its gradient: what a window of 8 steps takes beyond forward
    state: dict[float, float] = field(default_factory=dict)  # root mean square over dofs [m, rad] after SPANS
    gradient: dict[int, float] = field(default_factory=dict)  # relative error over HORIZONS
    cosine: dict[int, float] = field(default_factory=dict)  # with the reference's
    residual: float = 0.0  # of MuJoCo's constraints, see Simulator
    drift: float = math.nan  # of the energy in a fall of 0.5 s, relative to the largest kinetic energy
    contained: float = math.nan  # share of environments that did not stay finite

    @property
    def kind(self) -> str:
        """What it shares with the settings of other substeps."""
        (how, dtype), theta = self.setting, self.setting.integration.theta
        words = (
            f"{how.passes} passes" if how.constrained else f"theta {theta:g}" if how.integrator == "implicit" else ""
        )
        return " ".join((how.integrator, words, "float64" * (dtype == torch.float64))).strip()

    @property
    def cost(self) -> float:
        return self.forward + self.backward

    @property
    def error(self) -> float:
        return self.state.get(SPANS[-1], math.inf)

    def columns(self) -> dict[str, str]:
        numbers = {"us forward": self.forward, "us with gradient": self.cost}
        numbers |= {f"state {span:g} s": value for span, value in self.state.items()}
        numbers |= {f"gradient {h}": value for h, value in self.gradient.items()}
        numbers |= {f"cosine {h}": value for h, value in self.cosine.items()}
        numbers |= {"residual": self.residual, "energy drift": self.drift, "contained": self.contained}
        return {"setting": self.setting.flags} | {name: f"{value:.3g}" for name, value in numbers.items()}


def settings(task: type[Task], contact: str) -> list[Setting]:
    """What is measured on a contact model, around the task's default."""
    default = task.integration("default", contact)
    counts = sorted({max(1, round(factor * default.substeps)) for factor in FACTORS})
    if default.constrained:
        found = [default._replace(substeps=n, passes=p) for n in counts for p in sorted({*PASSES, default.passes})]
    else:
        found = [Integration("semi_implicit", n) for n in counts]
        found += [Integration("implicit", n, theta) for theta in (0.0, 0.5) for n in counts]
        found += [Integration("extrapolated", n) for n in counts if n % 2 == 0]
    double = [Setting(default._replace(substeps=n), torch.float64) for n in counts[-2:]]
    return [Setting(each) for each in found] + double


class Reference:
    """What a setting makes of a motion, to be compared with what others make of it."""

    def __init__(self, motion: Motion, setting: Setting) -> None:
        self.motion, self.setting = motion, setting
        self.states, self.residual, self.contained = motion.replay(setting)
        self.gradients = motion.gradients(setting)
        self.energies = motion.fall(setting)[0]

    def row(self, truth: Reference) -> Row:
        row = Row(self.setting, residual=self.residual, contained=self.contained)
        for span, qpos in self.states.items():
            row.state[span] = float(np.median(apart(self.motion.scene.mj_model, qpos, truth.states[span])))
        for horizon, found in self.gradients.items():
            expected = truth.gradients[horizon]
            row.gradient[horizon] = ((found - expected).norm(dim=1) / expected.norm(dim=1)).median().item()
            row.cosine[horizon] = F.cosine_similarity(found, expected, dim=1).median().item()
        gained = truth.energies[..., 0].max(0)
        row.drift = float(np.median(abs(self.energies - truth.energies)[..., 1].max(0) / gained))
        return row


def timed(sims: Sequence[Simulator], motion: Motion, rounds: int = ROUNDS) -> list[tuple[float, float]]:
    """Microseconds of a control step of one environment, without gradient and of the gradient: the least of `rounds`
    turns of all simulators, in windows of 8 steps from the start states."""
    best = np.full((len(sims), 2), np.inf)
    for turn in range(rounds + 1):  # the first one compiles and warms up
        for row, sim in zip(best, sims, strict=True):
            copies = torch.arange(sim.num_envs) % len(motion.qpos)
            q0, v0, actions = (
                x.to(sim.device, sim.dtype)
                for x in (motion.qpos[copies], motion.qvel[copies], motion.actions[:8, copies])
            )
            spent = []
            for grad in (False, True):
                sim.rewind()
                q, v, leaves = q0, v0, [a.clone().requires_grad_(grad) for a in actions]
                start = clock(sim)
                for leaf in leaves:
                    q, v = sim.step(q, v, leaf)
                if grad:
                    v.sum().backward()
                spent.append((clock(sim) - start) / len(leaves) / sim.num_envs * 1e6)
            if turn:
                row[:] = np.minimum(row, spent)
    return [(forward, both - forward) for forward, both in best.tolist()]


def measure(motion: Motion, found: list[Setting], device: str, rows: list[Row]) -> None:
    """Append a row of each setting of one contact model; timings are of all of them side by side."""
    most = max(setting.integration.substeps for setting in found)
    finest = found[0].integration._replace(substeps=FINER * most, passes=12)
    truth = Reference(motion, Setting(finest, torch.float64))
    times = timed([motion.simulator(setting, TIMED, device=device) for setting in found], motion)
    for setting, (forward, backward) in zip(tqdm(found, "errors", leave=False, ncols=80), times, strict=True):
        row = Reference(motion, setting).row(truth)
        row.forward, row.backward = forward, backward
        rows.append(row)


def clock(sim: Simulator) -> float:
    if sim.device.type == "cuda":
        torch.cuda.synchronize(sim.device)
    return time.perf_counter()


def front(rows: Iterable[Row]) -> list[Row]:
    """The rows that no other one beats in cost, and in the error of the state or of the gradient; the fastest first."""

    def beaten(row: Row, other: Row) -> bool:
        errors = [(r.cost, r.error, r.gradient.get(HORIZONS[0], math.inf)) for r in (other, row)]
        return all(a <= b for a, b in zip(*errors, strict=True)) and errors[0] != errors[1]

    rows = [row for row in rows if math.isfinite(row.cost)]
    return sorted((row for row in rows if not any(beaten(row, other) for other in rows)), key=lambda row: row.cost)


def choice(rows: Iterable[Row], error: float) -> Row | None:
    """The fastest of those with at most that error of the state after 0.5 s, and no environment contained."""
    enough = (row for row in rows if row.error <= error and not row.contained)
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
    whole, *others = (sum(times) for times in timed(sims, motion))
    return {"all": whole} | {part: whole - other for part, other in zip(parts, others, strict=True)}


def batches(motion: Motion, setting: Setting, device: str) -> dict[int, float]:
    """Microseconds of a control step of one environment with its gradient, for numbers of environments per call."""
    sims = [motion.simulator(setting, n, device=device) for n in BATCHES]
    return {n: sum(times) for n, times in zip(BATCHES, timed(sims, motion, rounds=3), strict=True)}
