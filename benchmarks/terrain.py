"""What a terrain costs, how accurate contact with it is, and what it withstands.

    python benchmarks/terrain.py                              hopper and ant, some minutes
    python benchmarks/terrain.py --env ant --parts cost

Writes terrain_*.csv and, with --update-results, the tables of docs/physics.md, which explains them. "cost" times a
differentiated control step on one thread. "accuracy" compares the states after half a second under random actions with
those of a step 32 times as fine. "extremes" throws robots without motors at walls and spikes: their energy must never
exceed that of the start, springs included, by 10 %.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from common import CommonFlags, Part, TaskName, Tasks, measured, parse
from motions import INTEGRATORS, Array, idle, integration, replay, simulator, state_errors
from speed import race, random_states, timer
from stability import energies, gradient_norm, unconstrained
from tables import Row

import diffsim
from diffsim import Scene
from diffsim.terrain import rough
from diffsim.training import Count

PartName = Literal["cost", "accuracy", "extremes"]
SUBSTEPS = (4, 8, 16, 32)
FINER = 512  # substeps of the reference
SPEEDS = (1.0, 10.0)  # m/s


def level(count: int, spacing: float) -> Array:
    """The plane z = 0 as a terrain of so many vertices."""
    return np.stack([spacing * (np.arange(count) - count // 2), np.zeros(count)], 1)


def walls(height: float, width: float) -> Array:
    """Blocks and gaps between them, each as wide."""
    x, z = np.repeat(np.arange(-20.0, 20.0, width), 2), np.array([0.0, height, height, 0.0])
    return np.concatenate([[[-30.0, 0.0]], np.stack([x, np.resize(z, len(x))], 1), [[30.0, np.resize(z, len(x))[-1]]]])


def needles(height: float, width: float) -> Array:
    x = np.arange(-20.0, 20.0, width / 2)
    return np.stack([x, np.resize([0.0, height], len(x))], 1)


PLANE = level(2, 1.0)
COSTS: dict[str, Array | None] = {
    "plane": None,
    "2 vertices": level(2, 1.0),
    "50 vertices, 1 m apart": level(50, 1.0),
    "500 vertices, 1 m apart": level(500, 1.0),
    "500 vertices, 1 cm apart": level(500, 0.01),
}
GROUNDS = {"plane": PLANE, "rough, 10 degrees": rough(0, start=-20.0), "walls of 0.1 m": walls(0.1, 1.0)}
EXTREMES = {
    "walls of 0.1 m": walls(0.1, 1.0),
    "walls of 0.3 m": walls(0.3, 1.0),
    "walls of 1 m": walls(1.0, 1.0),
    "slots, 0.3 m deep and 4 cm wide": walls(0.3, 0.04),
    "spikes of 0.3 m, 10 cm apart": needles(0.3, 0.1),
    "spikes of 0.3 m, 1 cm apart": needles(0.3, 0.01),
}


@dataclass
class Args(CommonFlags):
    env: Tasks = ("hopper", "ant")  # tasks
    parts: tuple[PartName, ...] = ("cost", "accuracy", "extremes")  # tables to measure
    num_envs: Count = 64  # environments
    repeats: Count = 5  # turns of all grounds in each of nine states; the fastest counts


def measure_cost(args: Args, name: TaskName) -> Iterator[Row]:
    task, flat = diffsim.TASKS[name], diffsim.make(name, num_envs=1).scene
    setting, competitors = task.integration("default"), {}
    for ground, profile in COSTS.items():
        scene = flat if profile is None else flat.with_terrain(profile)
        competitors[ground] = timer(simulator(scene, setting, args.num_envs, device=args.device, threads=1))
    states = random_states(name, args.num_envs, 10)
    race(competitors, states[:1], 1)
    times = race(competitors, states[1:], args.repeats)
    for ground, t in times.items():
        row: dict[str, object] = {"task": name, "ground": ground}
        row |= {f"{kind} (us/substep)": t[kind] / args.num_envs / setting.substeps for kind in ("forward", "backward")}
        whole, plane = (sum(x[kind] for kind in ("forward", "backward")) for x in (t, times["plane"]))
        yield row | {"times the plane": whole / plane}


def thrown(scene: Scene, qpos: torch.Tensor, room: float) -> torch.Tensor:
    """qpos of a level ground, spread over 10 m of the scene's, at least `room` above all of it within 0.7 m."""
    assert scene.terrain is not None
    profile, height, moved = scene.terrain[0], 2 if scene.floating else 1, qpos.clone()
    moved[:, 0] = torch.linspace(-5, 5, len(qpos), dtype=qpos.dtype)
    for row in moved:
        near = np.linspace(float(row[0]) - 0.7, float(row[0]) + 0.7, 141)
        row[height] += np.interp(near, *profile.T).max() + room
    return moved


def measure_accuracy(args: Args, name: TaskName) -> Iterator[Row]:
    flat, n = diffsim.make(name, num_envs=1).scene, args.num_envs
    qpos, qvel, _ = random_states(name, n, 3)[-1]
    generator = torch.Generator().manual_seed(1)
    actions = (2 * torch.rand(30, n, flat.nu, generator=generator) - 1).double()
    for ground, profile in GROUNDS.items():
        scene = flat.with_terrain(profile)
        start = thrown(scene, qpos, 0.0)
        fine = simulator(scene, integration("semi_implicit", FINER), n, torch.float64)
        expected = replay(fine, start, qvel, actions)[0][-1]
        for integrator in INTEGRATORS[:2]:
            row: dict[str, object] = {"task": name, "ground": ground, "integrator": integrator}
            for substeps in SUBSTEPS:
                end, _, bad = replay(simulator(scene, integration(integrator, substeps), n), start, qvel, actions)
                row[f"{substeps} substeps"] = float(np.median(state_errors(scene.mj_model, end[-1], expected)))
                assert not bad
            yield row


def measure_extremes(args: Args, name: TaskName) -> Iterator[Row]:
    task, flat, n = diffsim.TASKS[name], diffsim.make(name, num_envs=1).scene, args.num_envs
    model = unconstrained(flat)
    states, rest = random_states(name, n, 3)[-1], idle(flat).expand(90, n, flat.nu)
    for ground, profile in EXTREMES.items():
        scene = flat.with_terrain(profile)
        for speed in SPEEDS:
            qpos, qvel = thrown(scene, states[0], 0.2), states[1].clone()
            qvel[:, 0] = speed
            for integrator in INTEGRATORS[:3]:
                sim = simulator(scene, integration(integrator, task.substeps), n, horizon=8)
                q, v, bad = replay(sim, qpos, qvel, rest)
                start, largest = energies(scene, model, q, v)
                norms, lost = zip(*(gradient_norm(sim, q[k], v[k], rest) for k in range(10, 90, 10)), strict=True)
                yield {
                    "task": name,
                    "ground": ground,
                    "speed (m/s)": speed,
                    "integrator": integrator,
                    "contained": bad,
                    "gained energy": int((largest > 1.1 * start).sum()),
                    "largest energy": (largest / start).max(),
                    "gradient": max(norms),
                    "gradients not finite": sum(lost),
                }


def summary(rows: list[dict[str, str]]) -> list[Row]:
    """One line for each task and ground: of each integrator how many environments failed, at the worse speed."""
    lines = list[Row]()
    for task, ground in dict.fromkeys((row["task"], row["ground"]) for row in rows):
        own = [row for row in rows if (row["task"], row["ground"]) == (task, ground)]
        line: dict[str, object] = {"task": task, "ground": ground}
        for integrator in INTEGRATORS[:3]:
            here = [row for row in own if row["integrator"] == integrator]
            counts = {name: max(int(row[name]) for row in here) for name in ("contained", "gained energy")}
            line[integrator] = ", ".join(f"{count} {name}" for name, count in counts.items() if count) or "-"
        lines.append(line | {"largest gradient": max(float(row["gradient"]) for row in own)})
    return lines


PAGE = "physics.md"
PARTS: dict[PartName, Part] = {
    "cost": Part("terrain_cost", measure_cost, ("task", "ground"), "terrain_cost", PAGE),
    "accuracy": Part("terrain_accuracy", measure_accuracy, ("task", "ground", "integrator"), "terrain_accuracy", PAGE),
    "extremes": Part(
        *("terrain_extremes", measure_extremes, ("task", "ground", "speed (m/s)", "integrator")),
        *("terrain_extremes", PAGE, summary),
    ),
}


def main(args: Args) -> None:
    for part in args.parts:
        measured(args, PARTS[part])


if __name__ == "__main__":
    main(parse(Args, __doc__))
