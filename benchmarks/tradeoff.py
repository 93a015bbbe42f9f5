"""What speed costs in accuracy: integrators, substeps and precisions against a float64 reference.

    python benchmarks/tradeoff.py --env ant --checkpoint runs/<run>/checkpoint.pt
    python benchmarks/tradeoff.py                     every task, with the policies that benchmarks/learning.py trained
    python benchmarks/tradeoff.py --quick --env hopper
    python benchmarks/tradeoff.py --env hopper --penalty k_n=1e5 k_d=1e4     on another ground, as a task of its own
    python benchmarks/tradeoff.py --timings-only                             on a quieter machine, or --device cuda

The reference is explicit with 16 times the most substeps measured. Start states are those that the policy visits,
actions those that it takes in the reference; they are replayed open-loop. Writes benchmarks/results/tradeoff.csv,
tradeoff.md, tradeoff_{env}.png, and the tables of docs/accuracy.md. Errors are medians over the start states:

- state 0.1 / 0.5 / 2 s: root mean square of the difference to the reference over all degrees of freedom (m and rad);
- penetration: deepest within 0.5 s, of any geom, minus the reference's (mm);
- energy, momentum: drift of free flight (no ground, limits, dampers, springs, motors) in 0.5 s, as parts of the kinetic
  energy and of the linear and angular momentum; momentum of floating robots only;
- gradient of the summed reward of h control steps with respect to all actions: cosine to the reference's, ratio of the
  norms (of 8 and 32 control steps) and its 95th percentile over the states, which shows chatter;
- policy: median return of 64 episodes of the same policy in that simulator, over that of the explicit one with four
  times the default's substeps.
- flight 0.5 s: state error without ground and limits, motors off (cartpole: with its motor), against MuJoCo's RK4 at
  128 steps per control step; the one motion for which MuJoCo's C simulator solves the same equations.
"""

from __future__ import annotations

import copy
import dataclasses
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import mujoco
import numpy as np
import torch
import tyro
from common import DOCS, RESULTS, RUNS, Policy, idle, load_policy, visited_states
from speed import time_diffsim
from tables import fill, markdown, merge_csv, read_csv
from torch import Tensor

import diffsim
from diffsim import Integration
from diffsim.evaluation import evaluate
from diffsim.integration import INTEGRATORS
from diffsim.run import constants, fail
from diffsim.scene import Scene
from diffsim.tasks import SHAC_TASKS

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

mujoco.set_mju_user_warning(lambda _: None)  # that a simulation is unstable: some are meant to be, and are seen below

DTYPES = {"float32": torch.float32, "float64": torch.float64}
CONTROL_DT = 1 / 60
SECONDS = {"0.1 s": 6, "0.5 s": 30, "2 s": 120}  # control steps
CHUNK = 8  # environments whose gradients are held at once
KEY = ("task", "simulator", "substeps", "precision", "device")
PANELS = ("state 0.5 s", "gradient 8", "gradient 32", "flight 0.5 s")
ERRORS = ("state 0.1 s", "state 0.5 s", "gradient 8", "gradient 32", "cosine 32", "norm 32, 95 %", "policy")
COLOURS = {
    "semi_implicit": "tab:blue",
    "implicit 0": "tab:orange",
    "implicit 0.5": "tab:green",
    "extrapolated": "tab:cyan",
}
MUJOCO = {"Euler": "tab:red", "RK4": "tab:purple", "implicitfast": "tab:brown"}


@dataclass
class Args:
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = SHAC_TASKS
    """tasks"""
    checkpoint: Path | None = None
    """checkpoint of shac.py whose policy decides states and actions; None: each task's in --runs, else untrained"""
    runs: Path = RUNS
    """directory of the runs of benchmarks/learning.py"""
    device: str = "cpu"
    """torch device of the timings, cpu (one thread) or cuda; errors are measured on the CPU"""
    num_envs: int = 64
    """environments of the timings"""
    states: int = 32
    """start states of the error measures, a multiple of 8"""
    dtype: tuple[str, ...] = ("float32", "float64")
    """precisions"""
    integrators: tuple[str, ...] = INTEGRATORS
    """integrators to measure"""
    theta: tuple[float, ...] = (0.0, 0.5)
    """of the implicit integrator"""
    factors: tuple[float, ...] = (0.125, 0.25, 0.5, 1, 2, 4)
    """substeps in multiples of the default's, at least 1"""
    penalty: tuple[str, ...] = ()
    """constants of contact and limits in place of the robot file's, e.g. k_n=1e5 k_d=1e4"""
    quick: bool = False
    """8 states, float32, factors 0.25 1 4"""
    timings_only: bool = False
    """only time, e.g. on another device or a quieter machine"""
    draw_only: bool = False
    """only tabulate and draw what there is"""
    output: Path = RESULTS
    """directory of the csv, the table and the pictures"""


# Motions --------------------------------------------------------------------------------------------------------------


def simulator(scene: Scene, setting: Integration, dtype: torch.dtype, num_envs: int, **options: Any) -> Any:
    return diffsim.Simulator(scene, num_envs, setting, CONTROL_DT, dtype=dtype, **options)


@torch.no_grad()
def replay(sim: Any, qpos: Tensor, qvel: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, int]:
    """Open-loop: qpos (T + 1, N, nq), qvel (T + 1, N, nv) in float64, and how many environments did not stay finite."""
    states = [(qpos, qvel)]
    q, v, actions = (x.to(sim.dtype) for x in (qpos, qvel, actions))
    bad = torch.zeros(sim.num_envs, dtype=torch.bool)
    for action in actions:
        q, v = sim.step(q, v, action)
        bad |= sim.nonfinite
        states.append((q.double(), v.double()))
    return *(torch.stack(x) for x in zip(*states, strict=True)), int(bad.sum())


@torch.no_grad()
def closed_loop(sim: Any, task: Any, policy: Policy, qpos: Tensor, qvel: Tensor, steps: int) -> Tensor:
    """The policy's actions (T, N, nu), rounded to float32 so that every precision replays the same."""
    actions, action = [], torch.zeros(sim.num_envs, sim.nu, dtype=torch.float64)
    for _ in range(steps):
        action = policy(task.observe(qpos, qvel, action)).clamp(-1, 1).float().double()
        actions.append(action)
        qpos, qvel = sim.step(qpos, qvel, action)
    return torch.stack(actions)


def gradients(
    scene: Scene, name: str, setting: Integration, dtype: torch.dtype, qpos: Tensor, qvel: Tensor, actions: Tensor
) -> dict[int, np.ndarray]:
    """horizon: (N, horizon * nu) gradient of each environment's summed reward with respect to its actions."""
    task = diffsim.TASKS[name](dtype=dtype)
    sim = simulator(scene, setting, dtype, CHUNK, horizon=32)
    result: dict[int, list[np.ndarray]] = {8: [], 32: []}
    for first in range(0, len(qpos), CHUNK):
        rows = slice(first, first + CHUNK)
        for horizon, found in result.items():
            sim.rewind()
            leaves = [a.to(dtype).requires_grad_() for a in actions[:horizon, rows]]
            q, v, total = qpos[rows].to(dtype), qvel[rows].to(dtype), 0.0
            for action in leaves:
                q, v = sim.step(q, v, action)
                total = total + task.reward(task.observe(q, v, action), action).sum()
            found.append(torch.stack(torch.autograd.grad(total, leaves), 1).flatten(1).double().numpy())
    return {horizon: np.concatenate(found) for horizon, found in result.items()}


def state_errors(model: mujoco.MjModel, qpos: Tensor, expected: Tensor) -> np.ndarray:
    """(N,) root mean square over degrees of freedom."""
    errors, difference = [], np.zeros(model.nv)
    for a, b in zip(qpos.numpy(), expected.numpy(), strict=True):
        mujoco.mj_differentiatePos(model, difference, 1.0, b, a)
        errors.append(np.sqrt(np.mean(difference**2)))
    return np.array(errors)


def state_error(model: mujoco.MjModel, qpos: Tensor, expected: Tensor) -> float:
    """Median over environments."""
    return float(np.median(state_errors(model, qpos, expected)))


def deepest(model: mujoco.MjModel, qpos: Tensor) -> np.ndarray:
    """(N,) how far each environment's geoms reach below z = 0 in qpos (T, N, nq), m."""
    data, kind = mujoco.MjData(model), mujoco.mjtGeom
    geoms = np.flatnonzero(((model.geom_contype | model.geom_conaffinity) != 0) & (model.geom_bodyid != 0))
    radius = model.geom_size[geoms, 0]
    length = np.where(model.geom_type[geoms] == kind.mjGEOM_CAPSULE, model.geom_size[geoms, 1], 0.0)
    depth = np.zeros(qpos.shape[:2])
    for index in np.ndindex(*depth.shape):
        data.qpos[:] = qpos[index]
        mujoco.mj_kinematics(model, data)
        low = data.geom_xpos[geoms, 2] - length * abs(data.geom_xmat[geoms, 8]) - radius
        depth[index] = -low.min()
    return np.maximum(depth, 0.0).max(0)


def mechanics(model: mujoco.MjModel, qpos: Tensor, qvel: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kinetic energy (N,), energy (N,), and linear and angular momentum about the centre of mass (N, 6)."""
    data, rows = mujoco.MjData(model), []
    for q, v in zip(qpos.numpy(), qvel.numpy(), strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        linear = model.body_subtreemass[0] * data.subtree_linvel[0]
        rows.append([data.energy[1], data.energy.sum(), *linear, *data.subtree_angmom[0]])
    table = np.array(rows)
    return table[:, 0], table[:, 1], table[:, 2:]


# Flight ---------------------------------------------------------------------------------------------------------------


class Flight:
    """Motion without ground and limits, for which MuJoCo solves the same equations. The kernels stay the task's."""

    def __init__(self, scene: Scene, qpos: Tensor, qvel: Tensor, actions: Tensor) -> None:
        far = {"ground_height": -1e3} if scene.ncontact else {}
        limited = np.isfinite(scene.lower)
        bounds = dict(lower=np.where(limited, -1e6, -np.inf), upper=np.where(limited, 1e6, np.inf))
        self.scene = dataclasses.replace(scene, **far, **bounds)
        # Neither dampers nor springs, though the kernels have their code.
        self.lossless = dataclasses.replace(
            self.scene, damping=1e-30 * scene.damping, stiffness=1e-30 * scene.stiffness
        )
        self.qpos, self.qvel = qpos, qvel
        self.actions = actions[:30] if scene.ncontact == 0 else idle(scene).expand_as(actions[:30])
        self.model = mujoco.MjModel.from_xml_path(scene.path)
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        if scene.ncontact:  # motors off: MuJoCo's own muscles pull at rest, too
            self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.free = mujoco.MjModel.from_xml_path(scene.path)
        self.free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self.free.dof_damping[:], self.free.jnt_stiffness[:] = 0.0, 0.0
        self.expected, _ = self.mujoco("RK4", 128)

    def mujoco(self, integrator: str, substeps: int) -> tuple[Tensor, float]:
        """qpos (N, nq) after 0.5 s, and microseconds per control step."""
        kind = {"Euler": "EULER", "RK4": "RK4", "implicitfast": "IMPLICITFAST"}[integrator]
        self.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{kind}")
        self.model.opt.timestep = CONTROL_DT / substeps
        data, ends, seconds = mujoco.MjData(self.model), [], []
        low, high = torch.tensor(self.model.actuator_ctrlrange).T
        for e in range(len(self.qpos)):
            mujoco.mj_resetData(self.model, data)
            data.qpos[:], data.qvel[:] = self.qpos[e], self.qvel[e]
            for action in self.actions[:, e]:
                data.ctrl[:] = low + (action + 1) / 2 * (high - low)
                start = time.perf_counter()
                mujoco.mj_step(self.model, data, substeps)
                seconds.append(time.perf_counter() - start)
            # An unstable simulation is reset by MuJoCo, with a warning.
            ends.append(data.qpos.copy() if not data.warning.number.any() else np.full(self.model.nq, np.nan))
        return torch.tensor(np.array(ends)), 1e6 * float(np.median(seconds))

    def measure(self, setting: Integration, dtype: torch.dtype) -> dict[str, float]:
        n = len(self.qpos)
        end = replay(simulator(self.scene, setting, dtype, n), self.qpos, self.qvel, self.actions)[0][-1]
        result = {"flight 0.5 s": state_error(self.model, end, self.expected)}
        q, v, _ = replay(
            simulator(self.lossless, setting, dtype, n), self.qpos, self.qvel, idle(self.scene).expand_as(self.actions)
        )
        (kinetic, energy0, momentum0), (_, energy1, momentum1) = (mechanics(self.free, q[k], v[k]) for k in (0, -1))
        result["energy"] = float(np.median(abs(energy1 - energy0) / kinetic))
        if "floating" in self.scene.features:
            momentum1[:, :3] -= self.scene.mass.sum() * self.scene.gravity * 30 * CONTROL_DT
            parts = [
                np.linalg.norm(momentum1[:, k] - momentum0[:, k], axis=1) / np.linalg.norm(momentum0[:, k], axis=1)
                for k in (slice(0, 3), slice(3, 6))
            ]
            result["momentum"] = float(np.median(np.maximum(*parts)))
        return result


# Measuring ------------------------------------------------------------------------------------------------------------


def timings(args: Args, scene: Scene, setting: Integration, dtype: str, state: Any) -> dict[str, float]:
    """Microseconds of a control step of one environment, kernels only on the CPU: forward, and backward.

    The fastest of thirty counts: the others were disturbed.
    """
    options = {"threads": 1} if args.device == "cpu" else {"device": args.device}
    sim = simulator(scene, setting, DTYPES[dtype], args.num_envs, **options)
    runs = [time_diffsim(sim, state) for _ in range(31)][1:]
    kinds = ("forward", "backward")
    return {f"{kind} (us)": min(run[f"kernel {kind}"] for run in runs) / args.num_envs for kind in kinds}


def policy_return(
    name: str, policy: Policy, setting: Integration, dtype: torch.dtype, penalty: dict[str, float]
) -> float:
    env = diffsim.make(name, num_envs=64, horizon=1, dtype=dtype, penalty=penalty, **setting._asdict())
    policy = copy.deepcopy(policy).to(dtype)
    return evaluate(env, policy).returns.median().item()


def label(setting: Integration) -> str:
    return setting.integrator if setting.integrator != "implicit" else f"implicit {setting.theta:g}"


def measure(args: Args, name: str) -> list[dict[str, Any]]:
    task_type, penalty = diffsim.TASKS[name], constants(args.penalty)
    called_task = " ".join((name, *args.penalty))
    policy, called = load_policy(name, args.checkpoint, args.runs)
    counts = sorted({max(1, round(task_type.substeps * factor)) for factor in args.factors})
    thetas = {"implicit": args.theta}
    kinds = [(name, theta) for name in args.integrators for theta in thetas.get(name, (0.0,))]
    settings = [Integration(i, n, theta) for i, theta in kinds for n in counts if i != "extrapolated" or n % 2 == 0]
    scene = diffsim.make(name, num_envs=1, penalty=penalty).scene
    finest = Integration("semi_implicit", 16 * max(counts))
    print(f"{called_task}: states and actions of {called}; reference {finest.substeps} substeps", flush=True)

    task = task_type(dtype=torch.float64)
    qpos, qvel = visited_states(name, policy, args.num_envs, penalty)
    with torch.no_grad():
        timed = qpos, qvel, policy(task.observe(qpos, qvel, torch.zeros(args.num_envs, scene.nu, dtype=qpos.dtype)))
    rows: list[dict[str, Any]] = []
    if not args.timings_only:
        qpos, qvel = visited_states(name, policy, args.states, penalty)
        sim = simulator(scene, finest, torch.float64, args.states)
        actions = closed_loop(sim, task, policy, qpos, qvel, 120)
        reference = replay(sim, qpos, qvel, actions)[0]
        model = scene.mj_model
        depth = deepest(model, reference[:31]) if scene.ncontact else np.zeros(args.states)
        expected = gradients(scene, name, finest, torch.float64, qpos, qvel, actions)
        flight = Flight(scene, qpos, qvel, actions)
        for integrator in MUJOCO:
            for substeps in (1, 2, 4, 8, 16, 32):
                end, microseconds = flight.mujoco(integrator, substeps)
                row = dict(task=called_task, simulator=f"MuJoCo {integrator}", substeps=substeps, precision="float64")
                error = state_error(model, end, flight.expected)
                rows.append(row | {"device": "cpu", "forward (us)": microseconds, "flight 0.5 s": error})
        finer = Integration("semi_implicit", 4 * task_type.substeps)
        standard = policy_return(name, policy, finer, torch.float32, penalty)
    for setting in settings:
        for dtype in args.dtype:
            row = dict(task=called_task, simulator=label(setting), substeps=setting.substeps, precision=dtype)
            row |= {"device": args.device} | timings(args, scene, setting, dtype, timed)
            if not args.timings_only:
                real = DTYPES[dtype]
                q, _, bad = replay(simulator(scene, setting, real, args.states), qpos, qvel, actions)
                row |= {f"state {t}": state_error(model, q[k], reference[k]) for t, k in SECONDS.items()}
                if scene.ncontact:
                    row["penetration (mm)"] = 1e3 * float(np.median(deepest(model, q[:31]) - depth))
                found = gradients(scene, name, setting, real, qpos, qvel, actions)
                for horizon, gradient in found.items():
                    wanted = expected[horizon]
                    norms = [np.linalg.norm(x, axis=1) for x in (gradient, wanted)]
                    cosines = (gradient * wanted).sum(1) / np.maximum(norms[0] * norms[1], 1e-300)
                    row[f"cosine {horizon}"] = float(np.median(cosines))
                    row[f"norm {horizon}"] = float(np.median(norms[0] / norms[1]))
                    row[f"norm {horizon}, 95 %"] = float(np.quantile(norms[0] / norms[1], 0.95))
                    error = np.linalg.norm(gradient - wanted, axis=1) / norms[1]
                    row[f"gradient {horizon}"] = float(np.median(error))
                row |= flight.measure(setting, real) | {"not finite": bad}
                if dtype == "float32":
                    value = policy_return(name, policy, setting, real, penalty)
                    row["policy"] = value / standard if standard > 0 else standard / value
            rows.append(row)
            print(
                "  " + ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else str(v) for k, v in row.items()), flush=True
            )
    return rows


# Tables and pictures --------------------------------------------------------------------------------------------------


def cost(row: dict[str, str]) -> float:
    """Microseconds of a control step, forward and backward."""
    return number(row, "forward (us)") + number(row, "backward (us)")


def number(row: dict[str, str], column: str) -> float:
    return float(row[column]) if row.get(column) else float("nan")


def front(points: list[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other point beats in both."""
    return [i for i, p in enumerate(points) if not any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in points)]


def draw(rows: list[dict[str, str]], name: str, path: Path) -> None:
    ours = [r for r in rows if not r["simulator"].startswith("MuJoCo") and r["state 0.5 s"]]
    theirs = [r for r in rows if r["simulator"].startswith("MuJoCo")]
    figure, axes = plt.subplots(1, 4, figsize=(17, 4.2), layout="constrained")
    for axis, column in zip(axes, PANELS, strict=True):
        flight = column.startswith("flight")
        points = []
        for row in ours:
            point = (number(row, "forward (us)") if flight else cost(row), number(row, column))
            points.append(point)
            single = row["precision"] == "float32"
            colour = COLOURS.get(row["simulator"], "0.5")
            axis.plot(
                *point, "o" if single else "s", color=colour, markersize=6, fillstyle="full" if single else "none"
            )
            if single:
                axis.annotate(row["substeps"], point, xytext=(3, 3), textcoords="offset points", fontsize=6)
        if flight:
            for row in theirs:
                point = (number(row, "forward (us)"), number(row, column))
                points.append(point)
                axis.plot(*point, "^", color=MUJOCO[row["simulator"].split()[1]], markersize=5)
                axis.annotate(row["substeps"], point, xytext=(3, 3), textcoords="offset points", fontsize=6)
        best = sorted(points[i] for i in front(points))
        axis.plot(*zip(*best, strict=True), color="black", linewidth=0.8, zorder=0)
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel(f"us per control step, forward{'' if flight else ' + backward'}")
        axis.set_title(
            {
                "s": "state after 0.5 s",
                "g": f"gradient, {column.split()[1]} control steps, relative error",
                "f": "flight: no contact, 0.5 s",
            }[column[0]],
            fontsize=10,
        )
        axis.grid(alpha=0.3)
    for kind, colour in COLOURS.items():
        axes[0].plot([], [], "o", color=colour, label=kind)
    axes[0].plot([], [], "s", color="0.3", fillstyle="none", label="float64")
    axes[0].plot([], [], color="black", linewidth=0.8, label="Pareto front")
    for kind, colour in MUJOCO.items():
        axes[3].plot([], [], "^", color=colour, label=f"MuJoCo {kind}")
    axes[0].legend(fontsize=7)
    axes[3].legend(fontsize=7)
    figure.suptitle(f"{name}: error against time, numbers are substeps per control step", fontsize=10)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def presets(rows: list[dict[str, str]]) -> list[dict[str, Any]]:
    """What each preset costs and errs, in float32."""
    lines: list[dict[str, Any]] = []
    for name in SHAC_TASKS:
        found = {}
        for accuracy in ("fast", "default", "accurate"):
            setting = diffsim.TASKS[name].integration(accuracy)
            key = (name, label(setting), str(setting.substeps), "float32")
            found[accuracy] = next((r for r in rows if tuple(r[c] for c in KEY[:4]) == key and r["state 0.5 s"]), None)
        for accuracy, row in found.items():
            if row and found["default"]:
                line = {"task": name, "--accuracy": accuracy, "integrator": row["simulator"]}
                line |= {
                    "substeps": row["substeps"],
                    "us": cost(row),
                    "speed": f"{cost(found['default']) / cost(row):.2f}",
                }
                lines.append(line | {c: row[c] for c in ERRORS})
    return lines


def fronts(rows: list[dict[str, str]], name: str) -> list[dict[str, Any]]:
    """The float32 settings that no other beats both in time and in the error named under "best in"."""
    found = [r for r in rows if r["task"] == name and r["precision"] == "float32" and r["state 0.5 s"]]
    lines = []
    for row in sorted(found, key=cost):
        best = [c for c in PANELS[:3] if found.index(row) in front([(cost(r), number(r, c)) for r in found])]
        if best:
            line = {"integrator": row["simulator"], "substeps": row["substeps"], "us": cost(row)}
            lines.append(line | {c: row[c] for c in ERRORS} | {"best in": ", ".join(best)})
    return lines


def report(output: Path) -> None:
    """Tables and pictures of all that was measured; those of benchmarks/results go into docs/accuracy.md, too."""
    rows = read_csv(output / "tradeoff.csv")
    cpu = [row for row in rows if row["device"] == "cpu"]
    names = sorted({row["task"] for row in rows}, key=lambda task: list(diffsim.TASKS).index(task.split()[0]))
    sections, found_fronts = [], []
    for name in names:
        if lines := fronts(cpu, name):
            picture = f"tradeoff_{re.sub('[^a-z0-9_]+', '_', name)}.png"
            draw([row for row in cpu if row["task"] == name], name, output / picture)
            found_fronts.append(f"### {name}\n\n![{name}](../benchmarks/results/{picture})\n\n{markdown(lines)}")
        found = [row for row in rows if row["task"] == name]
        columns = [c for c in found[0] if c != "task" and any(row[c] for row in found)]
        sections.append(f"## {name}\n\n{markdown(found, columns)}")
    (output / "tradeoff.md").write_text("\n".join(sections))
    if output == RESULTS:
        fill(DOCS / "accuracy.md", "presets", markdown(presets(cpu)))
        fill(DOCS / "accuracy.md", "fronts", "\n".join(found_fronts))


def main(args: Args) -> None:
    if unknown := [name for name in args.env if name not in diffsim.TASKS]:
        fail(f"unknown task {unknown[0]!r}: choose from {', '.join(diffsim.TASKS)}")
    if args.quick:
        args.states, args.dtype, args.factors = 8, ("float32",), (0.25, 1, 4)
    if args.states % CHUNK or args.states < CHUNK:
        fail(f"--states must be a multiple of {CHUNK}, not {args.states}")
    if unknown := [name for name in args.integrators if name not in INTEGRATORS]:
        fail(f"unknown integrator {unknown[0]!r}: choose from {', '.join(INTEGRATORS)}")
    if unknown := [name for name in args.dtype if name not in DTYPES]:
        fail(f"unknown --dtype {unknown[0]!r}: choose from {', '.join(DTYPES)}")
    if args.checkpoint and len(args.env) != 1:
        fail("--checkpoint is of one task: name it with --env")
    torch.set_num_threads(1)
    path = args.output / "tradeoff.csv"
    if not args.draw_only:
        for name in args.env:
            merge_csv(path, measure(args, name), KEY)
    report(args.output)
    print(f"written to {path}, {path.with_suffix('.md')} and pictures beside them")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
