"""What speed costs in accuracy: integrators, substeps and precisions against a float64 reference.

    python benchmarks/tradeoff.py                     every task, with the policies that come with the package
    python benchmarks/tradeoff.py --env hopper --states 8 --dtype float32 --factors 0.25 1 4         a short look

The reference is explicit with 16 times the most substeps measured. The policy's actions in it are replayed open-loop
from states that the policy visits. docs/accuracy.md explains the errors. Writes tradeoff.csv and a picture for each
task.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import motions
import mujoco
import numpy as np
import torch
from common import TASKS, Line, Panel, Part, TaskName, measured, plot, run
from motions import INTEGRATORS, Array, Integration, PolicyFlags, integration, replay
from speed import race, timer
from tables import Row, digits, markdown

import diffsim
from diffsim import Simulator
from diffsim.training import Count, Positive, evaluate, fail

CHUNK = 8  # environments whose gradients are held at once
PANELS = {
    "state 0.5 s": "state after 0.5 s",
    "gradient 8": "gradient, 8 control steps, relative error",
    "gradient 32": "gradient, 32 control steps, relative error",
}
ERRORS = ("state 0.5 s", "gradient 8", "gradient 32", "cosine 32", "policy")
COLOURS = {kind: f"C{k}" for k, kind in enumerate(INTEGRATORS)}
Precision = Literal["float32", "float64"]


@dataclass
class Args(PolicyFlags):
    num_envs: Count = 64  # environments of the timings, which are of --device; errors are measured on the CPU
    dtype: tuple[Precision, ...] = ("float32", "float64")  # precisions
    factors: tuple[Positive, ...] = (0.125, 0.25, 0.5, 1, 2, 4)  # substeps in multiples of the default's, at least 1


class Reference(motions.Case):
    """The policy's motion in a simulator so fine that it is taken for the truth."""

    def __init__(self, args: Args, name: TaskName, finest: Integration) -> None:
        super().__init__(args, name)
        sim = Simulator(self.scene, self.n, finest, dtype=torch.float64)
        self.actions = self.actions_in(sim)
        self.state = replay(sim, self.qpos, self.qvel, self.actions[:30])[0][-1]  # after 0.5 s
        self.gradients = self.reward_gradients(finest, torch.float64)
        self.best = self.policy_return(integration("semi_implicit", 4 * self.task.substeps))

    def reward_gradients(self, setting: Integration, dtype: torch.dtype) -> dict[int, Array]:
        """horizon: (N, horizon * nu) gradient of each environment's summed reward with respect to its actions."""
        task, sim = type(self.task)(dtype=dtype), Simulator(self.scene, CHUNK, setting, horizon=32, dtype=dtype)
        result: dict[int, list[Array]] = {8: [], 32: []}
        for rows in (slice(first, first + CHUNK) for first in range(0, self.n, CHUNK)):
            for horizon, found in result.items():
                sim.rewind()
                leaves = [a.to(dtype).requires_grad_() for a in self.actions[:horizon, rows]]
                q, v, total = self.qpos[rows].to(dtype), self.qvel[rows].to(dtype), torch.zeros((), dtype=dtype)
                for action in leaves:
                    q, v = sim.step(q, v, action)
                    total = total + task.reward(task.observe(q, v, action), action).sum()
                found.append(torch.stack(torch.autograd.grad(total, leaves), 1).flatten(1).double().numpy())
        return {horizon: np.concatenate(found) for horizon, found in result.items()}

    def policy_return(self, setting: Integration) -> float:
        how = setting.substeps, setting.integrator, setting.theta
        env = diffsim.make(self.task.name, 64, "cpu", None, 1, *how)
        return evaluate(env, copy.deepcopy(self.policy).float()).returns.median().item()

    def errors(self, setting: Integration, dtype: torch.dtype) -> Iterator[tuple[str, object]]:
        """What a setting of the simulator makes of the same motion."""
        sim = Simulator(self.scene, self.n, setting, dtype=dtype)
        path, _, bad = replay(sim, self.qpos, self.qvel, self.actions)
        away, errors = np.zeros(self.scene.nv), list[float]()
        for found, expected in zip(path[30].numpy(), self.state.numpy(), strict=True):
            mujoco.mj_differentiatePos(self.scene.mj_model, away, 1.0, expected, found)
            errors.append(np.sqrt(np.mean(away**2)))
        yield "state 0.5 s", float(np.median(errors))
        for h, gradient in self.reward_gradients(setting, dtype).items():
            wanted = self.gradients[h]
            size, norm = (np.linalg.norm(x, axis=1) for x in (gradient, wanted))
            yield f"cosine {h}", float(np.median((gradient * wanted).sum(1) / np.maximum(size * norm, 1e-300)))
            yield f"gradient {h}", float(np.median(np.linalg.norm(gradient - wanted, axis=1) / norm))
        yield "not finite", bad
        if dtype == torch.float32:
            value = self.policy_return(setting)
            yield "policy", value / self.best if self.best > 0 else self.best / value


def measure(args: Args, name: TaskName) -> Iterator[Row]:
    default = diffsim.TASKS[name].substeps
    counts = sorted({max(1, round(default * factor)) for factor in args.factors})
    reference = Reference(args, name, integration("semi_implicit", 16 * max(counts)))
    with torch.no_grad():
        qpos, qvel = motions.visited_states(name, reference.policy, args.num_envs)
        nothing = torch.zeros(args.num_envs, reference.scene.nu, dtype=torch.float64)
        state = qpos, qvel, reference.policy(reference.task.observe(qpos, qvel, nothing))
    kinds = [(kind, n) for kind in INTEGRATORS for n in counts if kind != "extrapolated" or n % 2 == 0]
    for (kind, n), precision in product(kinds, args.dtype):
        setting, dtype = integration(kind, n), getattr(torch, precision)
        options = dict[str, Any](dtype=dtype, device=args.device, threads=1 if args.device == "cpu" else None)
        sim = Simulator(reference.scene, args.num_envs, setting, **options)
        t = race({0: timer(sim)}, [state, state], repeats=31)[0]
        row: dict[str, object] = {"task": name, "simulator": kind, "substeps": n, "precision": precision}
        row |= {"device": args.device} | {f"{way} (us)": t[way] / args.num_envs for way in ("forward", "backward")}
        yield row | dict(reference.errors(setting, dtype))


def number(row: dict[str, str], column: str) -> float:
    return float(row[column]) if row.get(column) else math.nan


def cost(row: dict[str, str]) -> float:
    """Microseconds of a control step, forward and backward."""
    return number(row, "forward (us)") + number(row, "backward (us)")


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that no other point beats in both, by their first numbers."""
    return sorted(p for p in points if not any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in points))


def draw(args: Args, rows: list[dict[str, str]], name: str) -> None:
    panels = []
    for column, text in PANELS.items():
        points, lines = list[tuple[float, float]](), list[Line]()
        for row in rows:
            x, y, kind = cost(row), number(row, column), row["simulator"]
            if math.isfinite(x * y) and kind in COLOURS:
                double = row["precision"] == "float64"
                style, notes = COLOURS[kind] + ("x" if double else "o"), [] if double else [row["substeps"]]
                lines.append(Line([x], [y], style, f"{kind}, float64" if double else kind, notes=notes))
                points.append((x, y))
        best = np.array(front(points)).reshape(-1, 2)
        lines.append(Line(best[:, 0], best[:, 1], "k-", "Pareto front", 0.8))
        what = "us per control step, forward + backward; numbers: substeps"
        panels.append(Panel(lines, f"{name}: {text}", what, log="xy"))
    plot(args.picture(f"tradeoff_{name}"), [panels], (4.2, 4.6))


def presets(rows: list[dict[str, str]]) -> Iterator[Row]:
    """What each preset costs and errs, in float32."""
    found = {(r["task"], r["simulator"], r["substeps"]): r for r in rows if r["precision"] == "float32"}
    for name in TASKS:
        settings = {accuracy: diffsim.TASKS[name].integration(accuracy) for accuracy in ("fast", "default", "accurate")}
        own = {a: found.get((name, motions.label(s), str(s.substeps)), {}) for a, s in settings.items()}
        for accuracy, row in own.items():
            if row.get("state 0.5 s") and own["default"].get("state 0.5 s"):
                line = {"task": name, "--accuracy": accuracy, "integrator": row["simulator"]}
                line |= {"substeps": row["substeps"], "us": digits(cost(row))}
                yield line | {"speed": f"{cost(own['default']) / cost(row):.2f}"} | {c: row[c] for c in ERRORS}


def main(args: Args) -> None:
    if args.states % CHUNK:
        fail(f"--states must be a multiple of {CHUNK}, not {args.states}")
    rows = measured(args, Part("tradeoff", measure, ("task", "simulator", "substeps", "precision", "device")))
    pictures = ""
    for name in (name for name in TASKS if any(row["task"] == name for row in rows)):
        draw(args, [row for row in rows if row["task"] == name], name)
        pictures += f"![{name}]({args.link(f'tradeoff_{name}')})\n"
    args.publish("presets", markdown(list(presets(rows))), "accuracy.md")
    args.publish("fronts", pictures, "accuracy.md")


if __name__ == "__main__":
    run(main, Args, __doc__)
