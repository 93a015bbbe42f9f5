"""What speed costs in accuracy: integrators and substeps in float32 against a float64 reference.

    python benchmarks/tradeoff.py --env hopper        a task (default: all) with its shipped policy

The reference is explicit with 16 times the most substeps measured. The policy's actions in it are replayed open-loop
from states that the policy visits. docs/accuracy.md explains the errors. Writes tradeoff.csv and a picture for each
task.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import motions
import mujoco
import numpy as np
import torch
from common import TASKS, CommonFlags, Line, Panel, Part, TaskName, measured, plot, run
from motions import INTEGRATORS, Integration, integration, replay
from speed import race, timer
from tables import Row, digits, markdown
from worlds import Array

import diffsim
from diffsim import Simulator
from diffsim.training import evaluate

STATES, CHUNK = 32, 8  # start states; environments whose gradients are held at once
TIMED = 64  # environments of the timings
FACTORS = 0.25, 0.5, 1, 2  # substeps in multiples of the default's
PANELS = {
    "state 0.5 s": "state after 0.5 s",
    "gradient 8": "gradient, 8 control steps, relative error",
    "gradient 32": "gradient, 32 control steps, relative error",
}
ERRORS = ("state 0.5 s", "gradient 8", "gradient 32", "cosine 32", "policy")


class Reference(motions.Case):
    """The policy's motion in a simulator so fine that it is taken for the truth."""

    def __init__(self, name: TaskName, finest: Integration) -> None:
        super().__init__(name, STATES)
        self.actions = self.actions_in(fine := Simulator(self.scene, STATES, finest, dtype=torch.float64))
        self.state = replay(fine, self.qpos, self.qvel, self.actions[:30])[0][-1]  # after 0.5 s
        self.gradients = self.reward_gradients(finest, torch.float64)
        self.best = self.policy_return(integration("semi_implicit", 4 * self.task.substeps))

    def reward_gradients(self, setting: Integration, dtype: torch.dtype) -> dict[int, Array]:
        """horizon: (N, horizon * nu) gradient of each environment's summed reward with respect to its actions."""
        task, sim = type(self.task)(dtype=dtype), Simulator(self.scene, CHUNK, setting, horizon=32, dtype=dtype)
        result: dict[int, list[Array]] = {8: [], 32: []}
        for rows in (slice(first, first + CHUNK) for first in range(0, STATES, CHUNK)):
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
        return evaluate(diffsim.make(self.task.name, 64, "cpu", None, 1, *how), self.policy).returns.median().item()

    def errors(self, setting: Integration) -> Iterator[tuple[str, object]]:
        """What a setting of the simulator makes of the same motion."""
        path, _, bad = replay(Simulator(self.scene, STATES, setting), self.qpos, self.qvel, self.actions)
        away, errors = np.zeros(self.scene.nv), list[float]()
        for found, expected in zip(path[30].numpy(), self.state.numpy(), strict=True):
            mujoco.mj_differentiatePos(self.scene.mj_model, away, 1.0, expected, found)
            errors.append(np.sqrt(np.mean(away**2)))
        yield "state 0.5 s", float(np.median(errors))
        for h, gradient in self.reward_gradients(setting, torch.float32).items():
            wanted = self.gradients[h]
            size, norm = (np.linalg.norm(x, axis=1) for x in (gradient, wanted))
            yield f"cosine {h}", float(np.median((gradient * wanted).sum(1) / np.maximum(size * norm, 1e-300)))
            yield f"gradient {h}", float(np.median(np.linalg.norm(gradient - wanted, axis=1) / norm))
        yield "not finite", bad
        value = self.policy_return(setting)
        yield "policy", value / self.best if self.best > 0 else self.best / value


def measure(args: CommonFlags, name: TaskName) -> Iterator[Row]:
    counts = sorted({max(1, round(diffsim.TASKS[name].substeps * factor)) for factor in FACTORS})
    reference = Reference(name, integration("semi_implicit", 16 * max(counts)))
    states = motions.visited_states(diffsim.make(name, TIMED, seed=0), reference.policy)
    state = *states, torch.zeros(TIMED, reference.scene.nu).double()
    for kind, n in ((kind, n) for kind in INTEGRATORS for n in counts if kind != "extrapolated" or n % 2 == 0):
        setting = integration(kind, n)
        t = race({0: timer(Simulator(reference.scene, TIMED, setting, threads=1))}, [state] * 2, repeats=31)[0]
        row = {"task": name, "simulator": kind, "substeps": n} | {f"{way} (us)": t[way] / TIMED for way in t}
        yield row | dict(reference.errors(setting))


def cost(row: dict[str, str]) -> float:
    """Microseconds of a control step, forward and backward."""
    return float(row["forward (us)"]) + float(row["backward (us)"])


def front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that no other point beats in both, by their first numbers."""
    return sorted(p for p in points if not any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in points))


def draw(args: CommonFlags, rows: list[dict[str, str]], name: str) -> None:
    panels = []
    for column, text in PANELS.items():
        points, lines = [(cost(row), float(row[column])) for row in rows], list[Line]()
        for row, (x, y) in zip(rows, points, strict=True):
            style, kind = f"C{INTEGRATORS.index(row['simulator'])}o", row["simulator"]
            lines.append(Line([x], [y], style, kind, notes=[row["substeps"]]))
        best = np.array(front([point for point in points if np.isfinite(point).all()])).reshape(-1, 2)
        lines.append(Line(best[:, 0], best[:, 1], "k-", "Pareto front", 0.8))
        what = "us per control step, forward + backward; numbers: substeps"
        panels.append(Panel(lines, f"{name}: {text}", what, log="xy"))
    plot(args.picture(f"tradeoff_{name}"), [panels], (4.2, 4.6))


def presets(rows: list[dict[str, str]]) -> list[Row]:
    """What each preset costs and errs."""
    found = {(row["task"], integration(row["simulator"], int(row["substeps"]))): row for row in rows}
    lines = list[Row]()
    for name in dict.fromkeys(row["task"] for row in rows):
        settings = {accuracy: diffsim.TASKS[name].integration(accuracy) for accuracy in ("fast", "default", "accurate")}
        for accuracy, row in ((accuracy, found[name, setting]) for accuracy, setting in settings.items()):
            line = {"task": name, "--accuracy": accuracy, "integrator": row["simulator"], "substeps": row["substeps"]}
            line |= {"us": digits(cost(row)), "speed": f"{cost(found[name, settings['default']]) / cost(row):.2f}"}
            lines.append(line | {column: row[column] for column in ERRORS})
    return lines


def main(args: CommonFlags) -> None:
    rows = measured(args, Part("tradeoff", measure, ("task", "simulator", "substeps")))
    pictures = ""
    for name in (name for name in TASKS if any(row["task"] == name for row in rows)):
        draw(args, [row for row in rows if row["task"] == name], name)
        pictures += f"![{name}]({args.link(f'tradeoff_{name}')})\n"
    args.publish("presets", markdown(presets(rows)), "accuracy.md")
    args.publish("fronts", pictures, "accuracy.md")


if __name__ == "__main__":
    run(main, CommonFlags, __doc__)
