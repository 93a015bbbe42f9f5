"""Where the simulator breaks: the largest stable step, and what it does at extremes of constants, states and actions.

    python benchmarks/stability.py                         every task and integrator, a quarter of an hour
    python benchmarks/stability.py --parts long

Writes stability_*.csv, stability.png and, with --update-results, the tables of docs/stability.md, which explains them.
All is float32, from states that a trained policy visits. "step" seeks the fewest substeps that stay finite and below
twice the largest kinetic energy of a reference, 64 times as fine. "sweeps" drives one thing to an extreme: without
motors the energy must never exceed that of the start, springs included, by 10 %; under actions, the kinetic one not
twice the reference's. "energy", of no task and only if it is named, swings chains without damping for 10 s.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import motions
import mujoco
import numpy as np
import torch
from common import CommonFlags, Line, Panel, Part, TaskName, lines, measured, plot, run
from motions import INTEGRATORS, integration, mechanics, replay
from tables import Row, grouped, numbers, pivot
from torch import Tensor
from worlds import Array

import diffsim
from diffsim import Scene, Simulator
from diffsim.training import Count, gait

PartName = Literal["step", "sweeps", "horizon", "long", "energy"]
STATES, CHAINS = 8, 16
CONTROL_DT = 1 / 60
COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
HORIZONS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1000)
SHOWN = (1, 32, 128, 1000)  # of them in the page
SWEEPS: dict[str, tuple[float, ...]] = {
    "contact stiffness x": (0.01, 0.1, 1, 10, 100, 1000),
    "contact damping x": (0, 1, 10, 100),
    "friction": (0, 0.1, 1, 3, 10),
    "drop (m)": (1, 10, 100),
    "start below ground (m)": (0.01, 0.1, 1),
    "last link's mass x": (1e-4, 1e-2, 1, 1e2, 1e4),
    "rate at limit (rad/s)": (1, 10, 100, 1000),
    "speed (m/s)": (1, 10, 100, 1000),
    "position (m)": (1, 1e3, 1e6),
    "action": (1, 1e3, 1e6),
    "alternating action": (1,),
}
NEEDS_GROUND = list(SWEEPS)[:5]
CONSTANTS = {"contact stiffness x": ("k_n", None), "contact damping x": ("k_d", None), "friction": ("mu", 1.0)}
LINKS, CHAIN_SUBSTEPS = (1, 5, 20), (16, 32, 64)


@dataclass
class Args(CommonFlags):
    parts: tuple[PartName, ...] = ("step", "sweeps", "horizon", "long")  # tables to measure
    steps: Count = 1_000_000  # control steps of the table "long", over all of its 64 environments


class Case(motions.Case):
    """A motion with MuJoCo's model for its energies, and a reference so fine that it is stable."""

    def __init__(self, name: TaskName) -> None:
        super().__init__(name, STATES)
        self.model = mujoco.MjModel.from_xml_path(self.scene.path)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        finest = integration("semi_implicit", 64 * self.task.substeps)
        self.reference = Simulator(self.scene, self.n, finest, dtype=torch.float64)

    @cached_property
    def actions(self) -> Tensor:
        return self.actions_in(self.reference)

    def kinetic(self, sim: Simulator, actions: Tensor) -> tuple[float, int]:
        """The largest kinetic energy under these actions, and how many environments did not stay finite."""
        qpos, qvel, bad = replay(sim, self.qpos, self.qvel, actions)
        return max(mechanics(self.model, q, v)[0].max() for q, v in zip(qpos, qvel, strict=True)), bad


def measure_step(args: Args, name: TaskName) -> Iterator[Row]:
    case, default = Case(name), diffsim.TASKS[name].substeps
    limit = case.kinetic(case.reference, case.actions)[0]
    for integrator in INTEGRATORS:
        stable: dict[int, bool] = {}
        for count in (c for c in COUNTS if c <= 4 * default and (integrator != "extrapolated" or c % 2 == 0)):
            energy, bad = case.kinetic(Simulator(case.scene, case.n, integration(integrator, count)), case.actions)
            stable[count] = bad == 0 and energy < 2 * limit
        counts = list(stable)
        fewest = next((c for k, c in enumerate(counts) if all(stable[d] for d in counts[k:])), f"over {counts[-1]}")
        yield {"task": name, "integrator": integrator, "fewest substeps": fewest, "default": default}


def fewest_substeps(rows: list[dict[str, str]]) -> Sequence[Row]:
    return pivot(rows, ("task", "default"), "integrator", "fewest substeps")


def stored(scene: Scene, qpos: Tensor) -> Array:
    """A lower bound (N,) of the energy in the springs of ground and limits."""
    links = np.flatnonzero(np.isfinite(scene.upper))
    joints = qpos[:, scene.qpos_adr[links]].numpy()
    beyond = np.maximum(scene.lower[links] - joints, 0) + np.maximum(joints - scene.upper[links], 0)
    limits = 0.5 * (scene.k_limit[links] * beyond**2).sum(1)
    if not scene.ncontact:
        return limits
    return limits + 0.5 * scene.k_n * (np.maximum(gait.trace(scene, qpos.numpy())[0], 0) ** 2).sum(1)


def bounded(scene: Scene, model: mujoco.MjModel, qpos: Tensor, qvel: Tensor) -> bool:
    """Whether the energy along qpos (T, N, nq), qvel (T, N, nv) stays that of the start, springs included, to 10 %."""
    start = mechanics(model, qpos[0], qvel[0])[1] + stored(scene, qpos[0])
    path = np.array([mechanics(model, q, v) for q, v in zip(qpos, qvel, strict=True)])
    floor = (path[:, 1] - path[:, 0]).min(0)  # potential energy has no zero: its least value is taken off
    return bool((path[:, 1] - floor <= 1.1 * (start - floor) + 1e-3).all())


def setup(case: Case, sweep: str, value: float) -> tuple[Scene, mujoco.MjModel, Tensor, Tensor, Tensor]:
    """Scene, MuJoCo's model, qpos, qvel and actions of one extreme."""
    scene, model, qpos, qvel = case.scene, case.model, case.qpos.clone(), case.qvel.clone()
    idle = torch.where(torch.tensor(scene.motor_link) > 0, 0.0, -1.0).double()  # without force: of a motor, of a muscle
    actions = idle.expand(60, case.n, scene.nu)
    height = 2 if scene.floating else 1  # in qpos; the planar robots' second slide
    lowest = torch.tensor(-gait.trace(scene, qpos.numpy())[0].max(1)) if scene.ncontact else 0.0
    if sweep in CONSTANTS:
        name, start = CONSTANTS[sweep]
        changes: dict[str, Any] = {name: value * (getattr(scene, name) if start is None else start)}
        scene = dataclasses.replace(scene, **changes)
    elif sweep == "last link's mass x":
        mass, inertia, model = scene.mass.copy(), scene.inertia.copy(), copy.deepcopy(model)
        mass[-1], inertia[-1] = value * mass[-1], value * inertia[-1]
        scene = dataclasses.replace(scene, mass=mass, inertia=inertia)
        bodies = model.body_weldid == model.jnt_bodyid[-1]
        model.body_mass[bodies] *= value
        model.body_inertia[bodies] *= value
        mujoco.mj_setConst(model, mujoco.MjData(model))
    elif sweep == "rate at limit (rad/s)":
        limited = np.flatnonzero(np.isfinite(scene.upper))
        qpos[:, scene.qpos_adr[limited]] = torch.tensor(scene.upper[limited])
        qvel[:, scene.nv - scene.nlink + limited] = value
    elif sweep == "speed (m/s)":
        qvel[:, 0] = value
    elif sweep == "drop (m)":
        qpos[:, height] += value - lowest
        actions = actions[:1].expand(60 + int(np.sqrt(2 * value / 9.81) / CONTROL_DT), -1, -1)
    elif sweep == "start below ground (m)":
        qpos[:, height] -= value + lowest
    elif sweep == "position (m)":
        qpos[:, 0] = value
    elif sweep == "action":
        actions = (value * case.actions.sign()[:60]).clamp(-1, 1)  # DiffEnv clips
    elif sweep == "alternating action":
        actions = torch.ones_like(actions)
        actions[1::2] = -1
    return scene, model, qpos, qvel, actions


def measure_sweeps(args: Args, name: TaskName) -> Iterator[Row]:
    case = Case(name)
    for sweep, value in ((sweep, value) for sweep, values in SWEEPS.items() for value in values):
        if sweep in NEEDS_GROUND and not case.scene.ncontact:
            continue
        scene, model, qpos, qvel, actions = setup(case, sweep, value)
        limit = case.kinetic(case.reference, actions)[0] if "action" in sweep else 0.0
        for integrator in INTEGRATORS:
            sim = Simulator(scene, case.n, integration(integrator, case.task.substeps))
            if "action" in sweep:
                energy, bad = case.kinetic(sim, actions)
                within = energy < 2 * limit
            else:
                *path, bad = replay(sim, qpos, qvel, actions)
                within = bounded(scene, model, *path)
            row: Row = {"task": name, "integrator": integrator, "sweep": sweep, "value": float(value)}
            yield {**row, "finite": bad == 0, "contained": bad, "energy bounded": within}


def summary(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each task and sweep in which an integrator failed: of each the first value not finite or bounded."""
    lines = list[Row]()
    for (task, sweep), group in grouped(rows, "task", "sweep").items():
        failed: dict[str, str] = dict.fromkeys(INTEGRATORS, "-")
        for row in reversed(group):
            if "False" in (row["finite"], row["energy bounded"]):
                how = "energy" if row["finite"] == "True" else "not finite"
                failed[row["integrator"]] = f"{row['value']} ({how})"
        if {*failed.values()} != {"-"}:
            lines.append({"task": task, "sweep": sweep, **failed})
    return lines


def measure_horizon(args: Args, name: TaskName) -> Iterator[Row]:
    """The norm of the gradient of the mean reward with respect to the policy's weights."""
    case, task = Case(name), diffsim.TASKS[name]()
    weights = list(case.policy.parameters())  # of which the noise's standard deviation plays no part
    for integrator in INTEGRATORS:
        sim = Simulator(case.scene, case.n, integration(integrator, task.substeps), horizon=HORIZONS[-1])
        for horizon in HORIZONS:
            q, v, total = case.qpos.float(), case.qvel.float(), torch.zeros(())
            action = torch.zeros(case.n, case.scene.nu)
            sim.rewind()
            for _ in range(horizon):
                action = case.policy(task.observe(q, v, action)).clamp(-1, 1)
                q, v = sim.step(q, v, action)
                total = total + task.reward(task.observe(q, v, action), action).mean() / horizon
            found = [g.flatten() for g in torch.autograd.grad(total, weights, allow_unused=True) if g is not None]
            norm = torch.cat(found).norm().item()
            yield {"task": name, "integrator": integrator, "horizon": horizon, "gradient": norm}


def growth(rows: list[dict[str, str]]) -> Sequence[Row]:
    """Explicitly integrated: the gradient's norm over some horizons."""
    explicit = (row for row in rows if row["integrator"] == "semi_implicit" and int(row["horizon"]) in SHOWN)
    return pivot(explicit, ("task", "integrator"), "horizon", "gradient")


@torch.no_grad()
def measure_long(args: Args, name: TaskName) -> Iterator[Row]:
    env, steps = diffsim.make(name, num_envs=64, seed=0), math.ceil(args.steps / 64)
    policy, (obs, _) = motions.shipped(name), env.reset(seed=0)
    bad, fastest, episodes = (torch.zeros(()) for _ in range(3))
    for _ in range(steps):
        obs, _, _, _, info = env.step(policy(obs))
        bad += info["nonfinite"].sum()
        episodes += info["_episode"].sum()
        fastest = torch.maximum(fastest, env.qvel.abs().max())
    row = {"task": name, "control steps": 64 * steps, "contained": int(bad), "largest velocity": fastest.item()}
    yield row | {"episodes": int(episodes)}


def chain(links: int) -> Scene:
    """A fixed chain of capsules of 0.2 m on parallel hinges, without damping and contact."""
    link = '<joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.04" contype="0" conaffinity="0"/>'
    bodies = "".join(f'<body pos="{0.2 * (k > 0)} 0 0">{link}' for k in range(links)) + links * "</body>"
    return diffsim.load_scene(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"))


def measure_energy(args: Args, links: int) -> Iterator[Row]:
    """Chains fall from about horizontal at rest: how far the energy leaves that of the start, relative to the fall."""
    scene, generator = chain(links), torch.Generator().manual_seed(0)
    qpos = 0.1 * torch.randn((CHAINS, links), generator=generator, dtype=torch.float64)
    down = torch.eye(links).double()[:1] * math.pi / 2
    least = mechanics(scene.mj_model, down, torch.zeros_like(down))[1]
    for substeps in CHAIN_SUBSTEPS:
        for integrator in ("semi_implicit", "extrapolated"):
            sim = Simulator(scene, CHAINS, integration(integrator, substeps))
            q, v, bad = replay(sim, qpos, torch.zeros_like(qpos), torch.zeros(600, CHAINS, 0))
            energy = np.array([mechanics(scene.mj_model, a, b)[1] for a, b in zip(q, v, strict=True)]) - least
            drift = float(np.median(abs(energy / energy[0] - 1).max(0)))
            row = {"links": links, "substeps": substeps, "integrator": integrator, "energy drift": drift}
            yield row | {"chains": CHAINS, "not finite": bad}


def energies(rows: list[dict[str, str]]) -> Sequence[Row]:
    for row in rows:
        lost = f" ({row['not finite']} of {row['chains']} not finite)" if int(row["not finite"]) else ""
        row["energy drift"] += lost
    return pivot(rows, ("links", "substeps"), "integrator", "energy drift")


def draw(args: Args, rows: list[dict[str, str]]) -> None:
    panels = list[Panel]()
    for (name,), own in grouped(rows, "task").items():
        ends = numbers(own, "gradient")
        window = Line((32, 32), (min(ends), max(ends)), "k--", "SHAC's window", 0.8)
        curves = [*lines(own, "horizon", "gradient", "integrator"), window]
        panels.append(Panel(curves, name, "control steps", "" if panels else "|gradient of the mean reward|", log="xy"))
    plot(args.picture("stability"), [panels], (3.4, 3.2))


PAGE = "stability.md"
PARTS: dict[PartName, Part] = {
    "step": Part("stability_step", measure_step, ("task", "integrator"), "step", PAGE, fewest_substeps),
    "sweeps": Part(
        "stability_sweeps", measure_sweeps, ("task", "integrator", "sweep", "value"), "sweeps", PAGE, summary
    ),
    "horizon": Part("stability_horizon", measure_horizon, ("task", "integrator", "horizon"), "horizon", PAGE, growth),
    "long": Part("stability_long", measure_long, ("task",)),
    "energy": Part("stability_energy", measure_energy, ("links", "substeps", "integrator"), "energy", PAGE, energies),
}


def main(args: Args) -> None:
    for part in args.parts:
        changes: dict[str, Any] = {"env": LINKS} if part == "energy" else {}
        rows = measured(dataclasses.replace(args, **changes), PARTS[part])
        if part == "horizon" and rows:
            draw(args, rows)


if __name__ == "__main__":
    run(main, Args, __doc__)
