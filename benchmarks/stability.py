"""Where the simulator breaks: the largest stable step, and what it does at extremes of constants, states and actions.

    python benchmarks/stability.py                         every task and integrator, a quarter of an hour
    python benchmarks/stability.py --env hopper --parts step sweeps horizon
    python benchmarks/stability.py --parts long --steps 100_000

Writes benchmarks/results/stability_{step,sweeps,horizon,long}.csv, stability.png, and the tables of docs/stability.md.
float32, the task's own substeps, states that a trained policy visits.

- step: the fewest substeps per control step with which 2 s under the policy's actions stay finite and below twice
  the largest kinetic energy of the reference (64 times the default's substeps), and so with all larger counts measured.
- sweeps: one thing is driven to an extreme. With the motors off nothing supplies energy, so kinetic and potential
  energy must never exceed what was there at the start, springs of ground and limits included (10 % allowed); under
  actions, twice the largest kinetic energy of the reference. "gradient" is the largest norm, over environments, of
  the derivative of the summed qpos after 8 control steps with respect to qvel.
- horizon: gradient of the mean reward with respect to the policy's weights, through 1 to 1,000 control steps.
- long: control steps of the policy in a row, resets included.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import matplotlib
import mujoco
import numpy as np
import torch
import tyro
from common import DOCS, RESULTS, RUNS, Policy, idle, load_policy, visited_states
from tables import fill, markdown, merge_csv, read_csv
from torch import Tensor
from tradeoff import CONTROL_DT, closed_loop, label, mechanics, simulator

import diffsim
from diffsim import Integration
from diffsim.run import fail
from diffsim.scene import Scene
from diffsim.tasks import SHAC_TASKS

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

Part = Literal["step", "sweeps", "horizon", "long"]
INTEGRATORS = (("semi_implicit", 0.0), ("implicit", 0.0), ("implicit", 0.5), ("extrapolated", 0.0))
COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
HORIZONS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1000)
SWEEPS: dict[str, tuple[float, ...]] = {
    "contact stiffness x": (0.01, 0.1, 1, 10, 100, 1000),
    "contact damping x": (0, 1, 10, 100),
    "friction": (0, 0.1, 1, 3, 10),
    "last link's mass x": (1e-4, 1e-2, 1, 1e2, 1e4),
    "rate at limit (rad/s)": (1, 10, 100, 1000),
    "speed (m/s)": (1, 10, 100, 1000),
    "drop (m)": (1, 10, 100),
    "start below ground (m)": (0.01, 0.1, 1),
    "position (m)": (1, 1e3, 1e6),
    "action": (1, 1e3, 1e6),
    "alternating action": (1,),
}
NEEDS_GROUND = ("contact stiffness x", "contact damping x", "friction", "drop (m)", "start below ground (m)")


@dataclass
class Args:
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = SHAC_TASKS
    """tasks"""
    parts: tuple[Part, ...] = ("step", "sweeps", "horizon", "long")
    """tables to measure"""
    checkpoint: Path | None = None
    """checkpoint of shac.py; None: each task's in --runs, else an untrained policy"""
    runs: Path = RUNS
    """directory of the runs of benchmarks/learning.py"""
    states: int = 8
    """start states"""
    steps: int = 1_000_000
    """control steps of the table "long", over all of its 64 environments"""
    draw_only: bool = False
    """only tabulate and draw what there is"""
    output: Path = RESULTS
    """directory of the tables and the picture"""


class Case:
    """A task with its policy, the states that it visits, and MuJoCo's model of it for the energies."""

    def __init__(self, name: str, args: Args) -> None:
        self.name, self.n = name, args.states
        self.policy, self.called = load_policy(name, args.checkpoint, args.runs)
        self.scene = diffsim.make(name, num_envs=1).scene
        self.substeps = diffsim.TASKS[name].substeps
        self.qpos, self.qvel = visited_states(name, self.policy, args.states)
        self.model = mujoco.MjModel.from_xml_path(self.scene.path)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        fine = Integration("semi_implicit", 64 * self.substeps)
        self.reference = simulator(self.scene, fine, torch.float64, self.n)
        task = diffsim.TASKS[name](dtype=torch.float64)
        with torch.no_grad():
            self.actions = closed_loop(self.reference, task, self.policy, self.qpos, self.qvel, 120)

    def kinetic(self, qpos: Tensor, qvel: Tensor) -> float:
        return max(mechanics(self.model, q, v)[0].max() for q, v in zip(qpos, qvel, strict=True))

    def limit(self, actions: Tensor) -> float:
        """Twice the largest kinetic energy of the reference under these actions."""
        return 2 * self.kinetic(*run(self.reference, self.qpos, self.qvel, actions)[:2])


def alternate(actions: Tensor) -> Tensor:
    """+1, -1, +1, ... for every motor."""
    signs = torch.ones_like(actions)
    signs[1::2] = -1
    return signs


@torch.no_grad()
def run(sim: Any, qpos: Tensor, qvel: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, int]:
    """qpos, qvel (T + 1, N, ...) in float64 and the number of environments that were contained."""
    q, v = qpos.to(sim.dtype), qvel.to(sim.dtype)
    path, bad = [(q.double(), v.double())], torch.zeros(len(qpos), dtype=torch.bool)
    for action in actions.to(sim.dtype):
        q, v = sim.step(q, v, action)
        bad |= sim.nonfinite
        path.append((q.double(), v.double()))
    return *(torch.stack(x) for x in zip(*path, strict=True)), int(bad.sum())


def gradient_norm(sim: Any, qpos: Tensor, qvel: Tensor, actions: Tensor) -> tuple[float, int]:
    """Largest over environments of |d sum(qpos after 8 control steps) / d qvel|, and number of adjoints not finite."""
    before = int(sim.nonfinite_gradients.sum())
    leaf = qvel.to(sim.dtype).requires_grad_()
    q, v = qpos.to(sim.dtype), leaf
    sim.rewind()
    for action in actions[:8].to(sim.dtype):
        q, v = sim.step(q, v, action)
    (gradient,) = torch.autograd.grad(q.sum(), leaf)
    assert gradient.isfinite().all()
    return gradient.norm(dim=1).max().item(), int(sim.nonfinite_gradients.sum()) - before


# Step -----------------------------------------------------------------------------------------------------------------


def measure_step(case: Case) -> list[dict[str, Any]]:
    rows, limit = [], case.limit(case.actions)
    for integrator, theta in INTEGRATORS:
        stable: dict[int, bool] = {}
        for count in (c for c in COUNTS if c <= 4 * case.substeps):
            if integrator == "extrapolated" and count % 2:
                continue
            sim = simulator(case.scene, Integration(integrator, count, theta), torch.float32, case.n)
            q, v, bad = run(sim, case.qpos, case.qvel, case.actions)
            stable[count] = bad == 0 and case.kinetic(q, v) < limit
        counts = list(stable)
        fewest = next((c for k, c in enumerate(counts) if all(stable[d] for d in counts[k:])), None)
        kind = label(Integration(integrator, 1, theta))
        row = {"task": case.name, "integrator": kind, "fewest substeps": fewest or f"over {counts[-1]}"}
        row["largest stable step (ms)"] = 1e3 * CONTROL_DT / fewest if fewest else ""
        rows.append(row | {"default": case.substeps})
    return rows


# Sweeps ---------------------------------------------------------------------------------------------------------------


def heights(case: Case, qpos: Tensor) -> np.ndarray:
    """Heights over the ground of spheres and capsules' ends (N, spheres), those that the scene leaves out included."""
    data, model, kind = mujoco.MjData(case.model), case.model, mujoco.mjtGeom.mjGEOM_CAPSULE
    geoms = np.flatnonzero(((model.geom_contype | model.geom_conaffinity) != 0) & (model.geom_bodyid != 0))
    length = np.where(model.geom_type[geoms] == kind, model.geom_size[geoms, 1], 0.0)
    rows = []
    for q in qpos.numpy():
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        centre, half = data.geom_xpos[geoms, 2] - model.geom_size[geoms, 0], length * data.geom_xmat[geoms, 8]
        rows.append(np.concatenate([centre - half, (centre + half)[length > 0]]))
    return np.array(rows)


def stored(scene: Scene, case: Case, qpos: Tensor) -> np.ndarray:
    """At least the energy (N,) in the springs of ground and limits."""
    links = np.flatnonzero(np.isfinite(scene.upper))
    joints = qpos[:, scene.qpos_adr[links]].numpy()
    beyond = np.maximum(scene.lower[links] - joints, 0) + np.maximum(joints - scene.upper[links], 0)
    energy = 0.5 * scene.k_limit * (beyond**2).sum(1)
    if scene.ncontact:
        energy = energy + 0.5 * scene.k_n * (np.minimum(heights(case, qpos), 0) ** 2).sum(1)
    return energy


def setup(case: Case, sweep: str, value: float) -> tuple[Scene, mujoco.MjModel, Tensor, Tensor, Tensor]:
    """Scene, MuJoCo's model, qpos, qvel and actions of one extreme."""
    scene, model, qpos, qvel = case.scene, case.model, case.qpos.clone(), case.qvel.clone()
    actions = idle(scene).expand(60, case.n, scene.nu)
    height = 2 if scene.floating else 1  # in qpos; the planar robots' second slide
    lowest = torch.tensor(heights(case, qpos).min(1)) if scene.ncontact else 0.0
    if sweep == "contact stiffness x":
        scene = dataclasses.replace(scene, k_n=value * scene.k_n)
    elif sweep == "contact damping x":
        scene = dataclasses.replace(scene, k_d=value * scene.k_d)
    elif sweep == "friction":
        scene = dataclasses.replace(scene, mu=value)
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
        actions = alternate(actions)
    return scene, model, qpos, qvel, actions


def measure_sweeps(case: Case) -> list[dict[str, Any]]:
    rows = []
    for sweep, values in SWEEPS.items():
        if sweep in NEEDS_GROUND and not case.scene.ncontact:
            continue
        for value in values:
            scene, model, qpos, qvel, actions = setup(case, sweep, value)
            limit = case.limit(actions) if "action" in sweep else 0.0
            for integrator, theta in INTEGRATORS:
                sim = simulator(scene, Integration(integrator, case.substeps, theta), torch.float32, case.n, horizon=8)
                q, v, bad = run(sim, qpos, qvel, actions)
                if "action" in sweep:
                    within = case.kinetic(q, v) < limit
                else:
                    before = mechanics(model, qpos, qvel)[1] + stored(scene, case, qpos)
                    # Potential energy has no zero; with its least value along the path taken off, all of it is motion.
                    path = np.array([mechanics(model, a, b)[:2] for a, b in zip(q, v, strict=True)])
                    floor = (path[:, 1] - path[:, 0]).min(0)
                    within = bool((path[:, 1] - floor <= 1.1 * (before - floor) + 1e-3).all())
                norm, lost = gradient_norm(sim, qpos, qvel, actions)
                row = {"task": case.name, "integrator": label(Integration(integrator, 1, theta)), "sweep": sweep}
                row |= {"value": float(value), "finite": bad == 0, "contained": bad, "energy bounded": within}
                rows.append(row | {"gradient": norm, "gradients not finite": lost})
    return rows


def summary(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """One line for each task and sweep: of each integrator the first value that is not finite or not bounded."""
    kinds = list(dict.fromkeys(row["integrator"] for row in rows))
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        line = lines.setdefault(
            (row["task"], row["sweep"]),
            {"task": row["task"], "sweep": row["sweep"]} | dict.fromkeys(kinds, "not measured"),
        )
        line["range"] = row["value"] if "range" not in line else f"{line['range'].split(' .. ')[0]} .. {row['value']}"
        line["largest gradient"] = str(max(float(line.get("largest gradient", 0)), float(row["gradient"])))
        failed = "not finite" if row["finite"] != "True" else "energy" if row["energy bounded"] != "True" else ""
        if line[row["integrator"]] in ("-", "not measured"):
            line[row["integrator"]] = f"{row['value']} ({failed})" if failed else "-"
    columns = ("task", "sweep", "range", *kinds, "largest gradient")
    return [{c: line[c] for c in columns} for line in lines.values()]


# Horizon and long -----------------------------------------------------------------------------------------------------


def measure_horizon(case: Case) -> list[dict[str, Any]]:
    rows, task = [], diffsim.TASKS[case.name]()
    policy: Policy = copy.deepcopy(case.policy).float()
    weights = list(policy.actor.mean.parameters())
    for integrator, theta in INTEGRATORS:
        sim = simulator(
            case.scene, Integration(integrator, case.substeps, theta), torch.float32, case.n, horizon=HORIZONS[-1]
        )
        for horizon in HORIZONS:
            before, bad = int(sim.nonfinite_gradients.sum()), 0
            q, v, total = case.qpos.float(), case.qvel.float(), torch.zeros(())
            action = torch.zeros(case.n, case.scene.nu)
            sim.rewind()
            for _ in range(horizon):
                action = policy(task.observe(q, v, action)).clamp(-1, 1)
                q, v = sim.step(q, v, action)
                bad += int(sim.nonfinite.sum())
                total = total + task.reward(task.observe(q, v, action), action).mean() / horizon
            gradient = torch.cat([g.flatten() for g in torch.autograd.grad(total, weights)])
            kind = label(Integration(integrator, 1, theta))
            row = {"task": case.name, "integrator": kind, "horizon": horizon, "gradient": gradient.norm().item()}
            row["gradients not finite"] = int(sim.nonfinite_gradients.sum()) - before
            rows.append(row | {"contained": bad})
    return rows


@torch.no_grad()
def measure_long(case: Case, steps: int) -> list[dict[str, Any]]:
    env = diffsim.make(case.name, num_envs=64, seed=0, horizon=32)
    policy, returns = copy.deepcopy(case.policy).float(), []
    obs, _ = env.reset(seed=0)
    bad, fastest = torch.zeros((), dtype=torch.long), torch.zeros(())
    for _ in range(steps // 64):
        obs, _, _, _, info = env.step(policy(obs))
        bad += info["nonfinite"].sum()
        fastest = torch.maximum(fastest, env.qvel.abs().max())
        if info["_episode"].any():
            returns += info["episode"]["r"][info["_episode"]].tolist()
    row = {"task": case.name, "control steps": steps // 64 * 64, "contained": int(bad)}
    median = float(np.median(returns)) if returns else float("nan")
    return [row | {"largest velocity": fastest.item(), "episodes": len(returns), "median return": median}]


# Tables and picture ---------------------------------------------------------------------------------------------------


def draw(rows: list[dict[str, str]], path: Path) -> None:
    tasks = [name for name in diffsim.TASKS if any(row["task"] == name for row in rows)]
    figure, axes = plt.subplots(1, len(tasks), figsize=(3.4 * len(tasks), 3.2), squeeze=False, layout="constrained")
    for axis, name in zip(axes[0], tasks, strict=True):
        for kind in dict.fromkeys(row["integrator"] for row in rows):
            found = [row for row in rows if row["task"] == name and row["integrator"] == kind]
            axis.plot(
                [int(r["horizon"]) for r in found],
                [float(r["gradient"]) for r in found],
                "o-",
                markersize=3,
                label=kind,
            )
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.axvline(32, color="0.6", linewidth=0.8, linestyle="--")
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("control steps")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("|gradient of the mean reward|")
    axes[0, 0].legend(fontsize=7)
    figure.suptitle("gradient of a trained policy's weights against the horizon (dashed: SHAC's window)", fontsize=10)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def report(output: Path) -> None:
    """The picture of all that was measured, and the tables of docs/stability.md."""
    for part in ("step", "sweeps", "horizon", "long"):
        path = output / f"stability_{part}.csv"
        if not path.is_file():
            continue
        rows = sorted(read_csv(path), key=lambda row: list(diffsim.TASKS).index(row["task"]))
        if part == "horizon":
            draw(rows, output / "stability.png")
        elif output == RESULTS:
            fill(DOCS / "stability.md", part, markdown(summary(rows) if part == "sweeps" else rows))


def main(args: Args) -> None:
    if unknown := [name for name in args.env if name not in diffsim.TASKS]:
        fail(f"unknown task {unknown[0]!r}: choose from {', '.join(diffsim.TASKS)}")
    if args.checkpoint and len(args.env) != 1:
        fail("--checkpoint is of one task: name it with --env")
    if min(args.states, args.steps // 64) < 1:
        fail("--states must be at least 1 and --steps at least 64")
    torch.set_num_threads(1)
    keys = {"step": ("task", "integrator"), "sweeps": ("task", "integrator", "sweep", "value")}
    keys |= {"horizon": ("task", "integrator", "horizon"), "long": ("task",)}
    if args.draw_only:
        report(args.output)
        return
    for name in args.env:
        case = Case(name, args)
        print(f"{name}: states and actions of {case.called}", flush=True)
        for part in args.parts:
            measure = {"step": measure_step, "sweeps": measure_sweeps, "horizon": measure_horizon}.get(part)
            rows = measure(case) if measure else measure_long(case, args.steps)
            merge_csv(args.output / f"stability_{part}.csv", rows, keys[part])
            print(f"  {part}", flush=True)
        report(args.output)
    print(f"written to {args.output}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
