"""What speed costs in accuracy: integrators, substeps and precisions against a float64 reference.

    python benchmarks/tradeoff.py                     every task, with the policies that benchmarks/learning.py trained
    python benchmarks/tradeoff.py --env hopper --states 8 --dtype float32 --factors 0.25 1 4         a short look
    python benchmarks/tradeoff.py --env hopper --penalty k_n=1e5 k_d=1e4     on another ground, as a task of its own
    python benchmarks/tradeoff.py --timings-only                             on a quieter machine, or --device cuda
    python benchmarks/tradeoff.py --adaptive                                 what substeps that adapt could win

The reference is explicit with 16 times the most substeps measured. The policy's actions in it are replayed open-loop
from states that the policy visits. docs/accuracy.md explains the errors. tradeoff.csv also has: how much deeper than
the reference a robot sinks within 0.5 s; flight, 0.5 s without ground, limits and motors (cartpole keeps its), against
MuJoCo's RK4 at 128 steps per control step; and what energy and momentum lose there without dampers and springs.
"""

from __future__ import annotations

import copy
import dataclasses
import math
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import motions
import mujoco
import numpy as np
import torch
from common import TASKS, Line, Panel, TaskName, measured, parse, plot
from motions import CONTROL_DT, INTEGRATORS, Array, Integration, PolicyFlags, integration, replay, simulator
from speed import DTYPES, Precision, race, timer
from tables import Row, markdown
from torch import Tensor

import diffsim
from diffsim import Scene
from diffsim.training import Count, Positive, evaluate, fail, parse_penalty

mujoco.set_mju_user_warning(lambda _: None)  # that a simulation is unstable: some are meant to be, and are seen below

SECONDS = {"0.1 s": 6, "0.5 s": 30, "2 s": 120}  # control steps
STEPS, INSTANTS = 60, 16  # of an episode; of a control step, at which contact is looked for
CHUNK = 8  # environments whose gradients are held at once
PANELS = {
    "state 0.5 s": "state after 0.5 s",
    "gradient 8": "gradient, 8 control steps, relative error",
    "gradient 32": "gradient, 32 control steps, relative error",
    "flight 0.5 s": "flight: no contact, 0.5 s",
}
ERRORS = ("state 0.1 s", "state 0.5 s", "gradient 8", "gradient 32", "cosine 32", "norm 32, 95 %", "policy")
MUJOCO = {"MuJoCo Euler": "mjINT_EULER", "MuJoCo RK4": "mjINT_RK4", "MuJoCo implicitfast": "mjINT_IMPLICITFAST"}
COLOURS = {kind: f"C{k}" for k, kind in enumerate((*INTEGRATORS, *MUJOCO))}


@dataclass
class Args(PolicyFlags):
    num_envs: Count = 64  # environments of the timings, which are of --device; errors are measured on the CPU
    dtype: tuple[Precision, ...] = ("float32", "float64")  # precisions
    factors: tuple[Positive, ...] = (0.125, 0.25, 0.5, 1, 2, 4)  # substeps in multiples of the default's, at least 1
    penalty: tuple[str, ...] = ()  # constants of contact and limits in place of the robot file's, e.g. k_n=1e5 k_d=1e4
    timings_only: bool = False  # only time, e.g. on another device or a quieter machine
    adaptive: bool = False  # instead: what substeps that adapt to contact could win at most


def state_error(scene: Scene, qpos: Tensor, expected: Tensor) -> float:
    return float(np.median(motions.state_errors(scene.mj_model, qpos, expected)))


class Flight:
    """Motion without ground and limits, for which MuJoCo solves the same equations. The kernels stay the task's."""

    def __init__(self, scene: Scene, qpos: Tensor, qvel: Tensor, actions: Tensor) -> None:
        limited = np.isfinite(scene.lower)
        lower, upper = np.where(limited, -1e6, -np.inf), np.where(limited, 1e6, np.inf)
        self.scene = dataclasses.replace(scene, lower=lower, upper=upper)
        if scene.ncontact:
            self.scene = dataclasses.replace(self.scene, ground_height=-1e3)
        # Neither dampers nor springs, though the kernels have their code.
        damping, stiffness = 1e-30 * scene.damping, 1e-30 * scene.stiffness
        self.lossless = dataclasses.replace(self.scene, damping=damping, stiffness=stiffness)
        self.qpos, self.qvel, self.idle = qpos, qvel, motions.idle(scene).expand_as(actions[:30])
        self.actions = self.idle if scene.ncontact else actions[:30]
        self.model, self.free = (mujoco.MjModel.from_xml_path(scene.path) for _ in range(2))
        for model in (self.model, self.free):
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        if scene.ncontact:  # motors off: MuJoCo's own muscles pull at rest, too
            self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        self.free.dof_damping[:], self.free.jnt_stiffness[:] = 0.0, 0.0
        self.expected, _ = self.mujoco("MuJoCo RK4", 128)

    def mujoco(self, integrator: str, substeps: int) -> tuple[Tensor, float]:
        """qpos (N, nq) after 0.5 s, and microseconds per control step."""
        self.model.opt.integrator = getattr(mujoco.mjtIntegrator, MUJOCO[integrator])
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

    def errors(self, setting: Integration, dtype: torch.dtype) -> Iterator[tuple[str, float]]:
        sims = [simulator(scene, setting, len(self.qpos), dtype) for scene in (self.scene, self.lossless)]
        end = replay(sims[0], self.qpos, self.qvel, self.actions)[0][-1]
        yield "flight 0.5 s", state_error(self.scene, end, self.expected)
        q, v, _ = replay(sims[1], self.qpos, self.qvel, self.idle)
        (kinetic, energy, momentum), (_, late_energy, late) = (
            motions.mechanics(self.free, q[k], v[k]) for k in (0, -1)
        )
        yield "energy", float(np.median(abs(late_energy - energy) / kinetic))
        if "floating" in self.scene.features:
            late[:, :3] -= self.scene.mass.sum() * self.scene.gravity * 30 * CONTROL_DT
            drift = (late - momentum).reshape(-1, 2, 3), momentum.reshape(-1, 2, 3)  # linear and angular
            norms = [np.linalg.norm(x, axis=2) for x in drift]
            yield "momentum", float(np.median((norms[0] / norms[1]).max(1)))


class Reference(motions.Case):
    """The policy's motion in a simulator so fine that it is taken for the truth."""

    def __init__(self, args: Args, name: TaskName, finest: Integration) -> None:
        self.name, self.penalty = name, parse_penalty(args.penalty)
        super().__init__(args, name, self.penalty)
        sim = simulator(self.scene, finest, self.n, torch.float64)
        self.actions = motions.closed_loop(sim, self.task, self.policy, self.qpos, self.qvel, 120)
        self.path = replay(sim, self.qpos, self.qvel, self.actions)[0]
        self.depth = self.deepest(self.path)
        self.gradients = self.reward_gradients(finest, torch.float64)
        self.flight = Flight(self.scene, self.qpos, self.qvel, self.actions)
        self.best = self.policy_return(integration("semi_implicit", 4 * self.task.substeps))

    def deepest(self, path: Tensor) -> Array:
        return motions.deepest(self.scene.mj_model, path[:31]) if self.scene.ncontact else np.zeros(self.n)

    def reward_gradients(self, setting: Integration, dtype: torch.dtype) -> dict[int, Array]:
        """horizon: (N, horizon * nu) gradient of each environment's summed reward with respect to its actions."""
        task, sim = type(self.task)(dtype=dtype), simulator(self.scene, setting, CHUNK, dtype, horizon=32)
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
        env = diffsim.make(self.name, 64, "cpu", None, 1, *how, penalty=self.penalty)
        return evaluate(env, copy.deepcopy(self.policy).float()).returns.median().item()

    def errors(self, setting: Integration, dtype: Precision) -> Iterator[tuple[str, object]]:
        """What a setting of the simulator makes of the same motion."""
        sim = simulator(self.scene, setting, self.n, DTYPES[dtype])
        path, _, bad = replay(sim, self.qpos, self.qvel, self.actions)
        for text, k in SECONDS.items():
            yield f"state {text}", state_error(self.scene, path[k], self.path[k])
        if self.scene.ncontact:
            yield "penetration (mm)", 1e3 * float(np.median(self.deepest(path) - self.depth))
        for h, found in self.reward_gradients(setting, DTYPES[dtype]).items():
            expected = self.gradients[h]
            norm, wanted = (np.linalg.norm(x, axis=1) for x in (found, expected))
            yield f"cosine {h}", float(np.median((found * expected).sum(1) / np.maximum(norm * wanted, 1e-300)))
            yield f"norm {h}", float(np.median(norm / wanted))
            yield f"norm {h}, 95 %", float(np.quantile(norm / wanted, 0.95))
            yield f"gradient {h}", float(np.median(np.linalg.norm(found - expected, axis=1) / wanted))
        yield from self.flight.errors(setting, DTYPES[dtype])
        yield "not finite", bad
        if dtype == "float32":
            value = self.policy_return(setting)
            yield "policy", value / self.best if self.best > 0 else self.best / value


def measure(args: Args, name: TaskName) -> Iterator[Row]:
    default, penalty = diffsim.TASKS[name].substeps, parse_penalty(args.penalty)
    counts = sorted({max(1, round(default * factor)) for factor in args.factors})
    wanted = [integration(kind, n) for kind in INTEGRATORS for n in counts if kind != "extrapolated" or n % 2 == 0]
    own: dict[str, object] = {"task": " ".join((name, *args.penalty))}
    timing = motions.Case(dataclasses.replace(args, states=args.num_envs), name, penalty)
    with torch.no_grad():
        nothing = torch.zeros(timing.n, timing.scene.nu, dtype=torch.float64)
        state = timing.qpos, timing.qvel, timing.policy(timing.task.observe(timing.qpos, timing.qvel, nothing))
    reference = None if args.timings_only else Reference(args, name, integration("semi_implicit", 16 * max(counts)))
    if reference:
        for kind in MUJOCO:
            for substeps in (1, 2, 4, 8, 16, 32):
                end, microseconds = reference.flight.mujoco(kind, substeps)
                row = own | {"simulator": kind, "substeps": substeps, "precision": "float64", "device": "cpu"}
                error = state_error(reference.scene, end, reference.flight.expected)
                yield row | {"forward (us)": microseconds, "flight 0.5 s": error}
    for setting in wanted:
        for dtype in args.dtype:
            threads = 1 if args.device == "cpu" else None
            sim = simulator(timing.scene, setting, timing.n, DTYPES[dtype], device=args.device, threads=threads)
            t = race({0: timer(sim)}, [state], repeats=31)[0]
            row = own | {"simulator": motions.label(setting), "substeps": setting.substeps, "precision": dtype}
            row |= {"device": args.device} | {f"{kind} (us)": t[kind] / timing.n for kind in ("forward", "backward")}
            yield row | (dict(reference.errors(setting, dtype)) if reference else {})


@torch.no_grad()
def measure_adaptive(args: Args, name: TaskName) -> Iterator[Row]:
    """What substeps that adapt to contact could win at most: how coarse may a control step without contact be?

    The policy's control steps in a fine float64 simulation are sorted into those that touch the ground at one of 16
    instants and those that do not, and each is taken again, by itself, with fewer substeps. Those in flight may have as
    few as keep the 95th percentile of their error at or below that of those in contact at the default's substeps. The
    gain is the default's substeps over the average that is left, if it is known beforehand when a foot will touch.
    """
    case = motions.Case(args, name)
    default, scene, model = case.task.substeps, case.scene, case.scene.mj_model
    coarse = {n: integration("semi_implicit", n) for n in (1, 2, 3, 4, 6, 8, 12, 16, 24, 48) if n <= default}
    sim = simulator(scene, coarse[default], case.n, torch.float64, control_dt=CONTROL_DT / INSTANTS)
    qpos, qvel, ctrl = case.qpos, case.qvel, torch.zeros(case.n, scene.nu, dtype=torch.float64)
    starts, ends, contacts = [], [], []
    for _ in range(STEPS):
        ctrl = case.policy(case.task.observe(qpos, qvel, ctrl)).clamp(-1, 1)
        starts.append((qpos, qvel, ctrl))
        instants = [qpos]
        for _ in range(INSTANTS):
            qpos, qvel = sim.step(qpos, qvel, ctrl)
            instants.append(qpos)
        ends.append(qpos)
        contacts.append(motions.deepest(model, torch.stack(instants)) > 0)
    qpos, qvel, ctrl = (torch.cat(states) for states in zip(*starts, strict=True))
    touching = np.concatenate(contacts)
    row: dict[str, object] = {"task": name, "steps in flight": f"{1 - touching.mean():.3f}"}
    if not touching.all() and touching.any():  # there is something to compare
        contact, flight = dict[int, float](), dict[int, float]()
        for n, setting in coarse.items():
            end = simulator(scene, setting, len(qpos), torch.float64).step(qpos, qvel, ctrl)[0]
            errors = motions.state_errors(model, end, torch.cat(ends))
            contact[n], flight[n] = (float(np.quantile(errors[kind], 0.95)) for kind in (touching, ~touching))
        enough = [n for n in coarse if all(flight[m] <= contact[default] for m in coarse if m >= n)]
        least = min([*enough, default])
        gain = default / (touching.mean() * default + (1 - touching.mean()) * least)
        row |= {"error in contact, default": contact[default], "error in flight, default": flight[default]}
        row |= {"default substeps": default, "in flight": least, "error in flight": flight[least]}
        row["gain"] = f"{gain:.2f}"
    yield row


def number(row: dict[str, str], column: str) -> float:
    return float(row[column]) if row.get(column) else math.nan


def cost(row: dict[str, str]) -> float:
    """Microseconds of a control step, forward and backward."""
    return number(row, "forward (us)") + number(row, "backward (us)")


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other point beats in both."""
    return [i for i, p in enumerate(points) if not any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in points)]


def draw(args: Args, rows: list[dict[str, str]], name: str, picture: str) -> None:
    panels = []
    for column, text in PANELS.items():
        flight, points, lines = column.startswith("flight"), list[tuple[float, float]](), list[Line]()
        for row in rows:
            x, y = number(row, "forward (us)") if flight else cost(row), number(row, column)
            if math.isfinite(x * y):
                kind, double = row["simulator"], row["simulator"] not in MUJOCO and row["precision"] == "float64"
                style = COLOURS[kind] + ("^" if kind in MUJOCO else "x" if double else "o")
                notes = [] if double else [row["substeps"]]
                lines.append(Line([x], [y], style, f"{kind}, float64" if double else kind, notes=notes))
                points.append((x, y))
        best = sorted(points[i] for i in front(points))
        lines.append(Line([x for x, _ in best], [y for _, y in best], "k-", "Pareto front", 0.8))
        what = f"us per control step, forward{'' if flight else ' + backward'}; numbers: substeps"
        panels.append(Panel(lines, f"{name}: {text}", what, log="xy"))
    plot(args.picture(picture), [panels], (4.2, 4.6))


def presets(rows: list[dict[str, str]]) -> Iterator[Row]:
    """What each preset costs and errs, in float32."""
    found = {(r["task"], r["simulator"], r["substeps"]): r for r in rows if r["precision"] == "float32"}
    for name in TASKS:
        settings = {accuracy: diffsim.TASKS[name].integration(accuracy) for accuracy in ("fast", "default", "accurate")}
        own = {
            a: found.get((name, motions.label(setting), str(setting.substeps)), {}) for a, setting in settings.items()
        }
        for accuracy, row in own.items():
            if row.get("state 0.5 s") and own["default"].get("state 0.5 s"):
                line = {"task": name, "--accuracy": accuracy, "integrator": row["simulator"]}
                line |= {"substeps": row["substeps"], "us": f"{cost(row):.3g}"}
                yield line | {"speed": f"{cost(own['default']) / cost(row):.2f}"} | {c: row[c] for c in ERRORS}


def main(args: Args) -> None:
    if args.states % CHUNK:
        fail(f"--states must be a multiple of {CHUNK}, not {args.states}")
    if args.adaptive:
        args.env = tuple(name for name in args.env if name != "cartpole")  # which has no ground
        rows = measured(args, "adaptive", measure_adaptive, ("task",))
        return args.publish("adaptive", markdown(rows), "accuracy.md")
    rows = measured(args, "tradeoff", measure, ("task", "simulator", "substeps", "precision", "device"))
    pictures = ""
    for name in dict.fromkeys(row["task"] for row in rows):
        picture = f"tradeoff_{re.sub('[^a-z0-9_]+', '_', name)}"
        draw(args, [row for row in rows if row["task"] == name], name, picture)
        pictures += f"![{name}]({args.link(picture)})\n"
    args.publish("presets", markdown(list(presets(rows))), "accuracy.md")
    args.publish("fronts", pictures, "accuracy.md")


if __name__ == "__main__":
    main(parse(Args, __doc__))
