"""Rows between two bodies: the solver's statistics beside MuJoCo's, and the time that pairs of geoms take.

    python benchmarks/pairs.py path/to/mujoco_menagerie
    python benchmarks/pairs.py path/to/mujoco_menagerie --parts time --device cuda --num-envs 4096

Solver: MuJoCo moves a scene. From states on the way with rows between bodies, a substep in float64 ends after 1, 2, ...
passes of Newton's method. At each iterate conjugate gradients run once more, by the rule of kernels/pairs/solver.py on
dense matrices of MuJoCo's rows. States in which a step of theirs is not the kernel's are `left out`. All shapes are
those of `as_primitives`, and MuJoCo has no islands. Gradients are those of mjData.solver. MuJoCo starts from its last
acceleration and goes on to its own tolerance; `cold` counts its passes from qacc_smooth until its gradient is ours.

Time: substeps of the G1 with pairs relative to those without, in states where nothing touches, and where the legs do.
On a GPU pairs have one thread per environment, and what is without pairs may have more. `one thread` has not.
Writes pairs_solver.csv and pairs_time.csv. Needs Menagerie's folders agility_cassie and unitree_g1, of which the time
needs the latter.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np
import torch
import tyro
from common import CommonFlags, Part, Tasks, measured, run
from speed import race, timer
from tables import Row

from diffsim import Integration, Scene, Simulator, load_scene
from diffsim.kernels.pairs.adjoint import ACCURACY_ADJOINT
from diffsim.kernels.pairs.rows import ACCURACY, LOOSE
from diffsim.kernels.pairs.solver import ROUND_OFF
from diffsim.robot.elements import control_range
from diffsim.robot.pairs import with_pairs
from diffsim.robot.shapes import as_primitives
from diffsim.robot.types import Array
from diffsim.sim import simulator
from diffsim.training import Count, fail

PartName = Literal["solver", "time"]
FILES = {"g1": "unitree_g1/scene.xml", "cassie": "agility_cassie/scene.xml"}
ROLLOUTS, SECONDS, EVERY = 8, 1.2, 0.02  # of MuJoCo's motion, and s between states
AGREE = 1e-6  # largest difference of the steps, in multiples of 1 + |qacc|
BENT, CROSSED, DEEPEST = 0.05, 0.3, 0.005  # rad, of all joints and of those that cross the legs; m
HIP = ("hip", "knee", "ankle")
DISABLE, ROW, ZONE = mujoco.mjtDisableBit, mujoco.mjtConstraint, mujoco.mjtConstraintState


@dataclass
class Args(CommonFlags):
    folder: tyro.conf.Positional[Path] = Path("mujoco_menagerie")  # a clone of MuJoCo Menagerie
    scenes: tuple[Literal["g1", "cassie", "stack"], ...] = ("g1", "cassie", "stack")  # of the solver's table
    parts: tuple[PartName, ...] = ("solver", "time")  # tables to measure
    num_envs: tuple[Count, ...] = (256,)  # batch sizes of the table of times
    states: Count = 5  # batches of states in which a substep is timed; the median over them counts
    repeats: Count = 9  # turns in each of them; the fastest counts
    substeps: Count = 4  # in a control step
    env: tyro.conf.Suppress[Tasks] = ()

    def model(self, name: str) -> mujoco.MjModel:
        if name == "stack":  # three spheres and three lying capsules
            shapes = 'type="sphere" size=".1"', 'type="capsule" size=".06 .1" euler="90 0 {}"'
            places = [f'<body pos="{0.02 * (k % 2)} 0 {0.1 + 0.17 * k}">' for k in range(6)]
            balls = (f"{place}<freejoint/><geom {shapes[k % 2]}/></body>" for k, place in enumerate(places))
            text = "".join(ball.format(40 * k) for k, ball in enumerate(balls))
            ground = '<geom type="plane" size="5 5 .1"/>'
            return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{ground}{text}</worldbody></mujoco>")
        if not (file := self.folder / FILES[name]).is_file():
            fail(f"no such file: {file}; MuJoCo Menagerie is at github.com/google-deepmind/mujoco_menagerie")
        return load_scene(file).mj_model


# The solver -----------------------------------------------------------------------------------------------------------


def between_bodies(m: mujoco.MjModel, data: mujoco.MjData) -> Any:
    """Mark the rows (nefc,) of equality and of contacts between moving bodies."""
    marks = data.efc_type == int(ROW.mjCNSTR_EQUALITY)
    touch = data.efc_type >= int(ROW.mjCNSTR_CONTACT_FRICTIONLESS)
    if touch.any():
        marks[touch] = (m.body_weldid[m.geom_bodyid[data.contact.geom[data.efc_id[touch]]]] > 0).all(1)
    return marks


def gradients_of(data: mujoco.MjData) -> list[float]:
    """Return the gradient after each pass of MuJoCo's last step."""
    return [data.solver[k].gradient for k in range(data.solver_niter[0])]


def motion(m: mujoco.MjModel) -> Iterator[tuple[tuple[Array, Array, Array], list[float]]]:
    """Yield (qpos, qvel, ctrl) with rows between bodies, and the gradients of MuJoCo's step from there."""
    rng, data, (low, high) = np.random.default_rng(0), mujoco.MjData(m), control_range(m)
    for _ in range(ROLLOUTS):
        mujoco.mj_resetData(m, data)
        data.qpos = m.key_qpos[0] if m.nkey else m.qpos0
        data.qvel, ctrl = 0.3 * rng.normal(size=m.nv), rng.uniform(-1, 1, m.nu)
        data.ctrl = low + (ctrl + 1) / 2 * (high - low)
        for step in range(round(SECONDS / m.opt.timestep)):
            state = data.qpos.copy(), data.qvel.copy(), ctrl
            mujoco.mj_step(m, data)
            if step % round(EVERY / m.opt.timestep) == 0 and between_bodies(m, data).any():
                yield state, gradients_of(data)


def iterates(scene: Scene, states: Sequence[Array]) -> tuple[Array, Array]:
    """Return qacc (passes, N, nv) and the residual (passes, N) after each pass of one substep."""
    seconds, found, most = scene.mj_model.opt.timestep, list[tuple[Array, Array]](), simulator.PASSES
    try:
        for simulator.PASSES in range(1, most + 1):
            sim = Simulator(scene, len(states[0]), Integration("mujoco", 1), seconds, dtype=torch.float64)
            with torch.no_grad():
                qvel = sim.step(*map(torch.tensor, states))[1].numpy()
            found.append(((qvel - states[1]) / seconds, sim.residual.numpy().copy()))
    finally:
        simulator.PASSES = most
    accelerations, residuals = zip(*found, strict=True)
    return np.array(accelerations), np.array(residuals)


class System(NamedTuple):
    """Newton's method at an iterate: (T + U' C U) step = rest; weight has the inverse weights of U's rows."""

    T: Array
    U: Array
    C: Array
    rest: Array
    weight: Array


def linearize(m: mujoco.MjModel, data: mujoco.MjData, qacc: Array, first: bool = False) -> System:
    """Linearize MuJoCo's forces at qacc; before the first pass all rows act."""
    M, J = np.zeros((m.nv, m.nv)), data.efc_J.reshape(-1, m.nv)
    mujoco.mj_fullM(m, data, M)
    jar = J @ qacc - data.efc_aref
    mujoco.mj_constraintUpdate(m, data, jar, None, 1)
    act = data.efc_state == int(ZONE.mjCNSTRSTATE_QUADRATIC)
    act |= first & (data.efc_type != int(ROW.mjCNSTR_FRICTION_DOF))
    C, force = np.diag(data.efc_D * act), np.where(act, -data.efc_D * jar, data.efc_force)
    for contact in () if first else data.contact:
        k, n = contact.efc_address, contact.dim
        if k >= 0 and data.efc_state[k] == int(ZONE.mjCNSTRSTATE_CONE):
            C[k : k + n, k : k + n] = np.reshape(contact.H[: n * n], (n, n))
    rows = between_bodies(m, data)
    T, d = M + J[~rows].T @ C[np.ix_(~rows, ~rows)] @ J[~rows], data.efc_KBIP[rows, 2]
    rest = data.qfrc_smooth + J.T @ force - M @ qacc
    return System(T, J[rows], C[np.ix_(rows, rows)], rest, data.efc_R[rows] * d / (1 - d))


def conjugate_gradients(system: System, accuracy: float) -> tuple[Array, int]:
    """Solve like kernels/pairs/solver.py, whose names it has; returns Newton's step, and the number of steps to it."""
    T, U, C, rest, weight = system
    inverse = np.linalg.inv(T)
    A, start = U @ inverse @ U.T, inverse @ rest
    p = -C @ (U @ start)
    y, q, v = np.zeros((3, len(p)))
    goal, enough, last, steps = ROUND_OFF * accuracy**2 * float(weight @ p**2), 0.0, 0.0, 0
    while weight @ p**2 > goal:
        z, steps = A @ p, steps + 1
        if (pz := float(p @ z)) <= enough:
            break
        beta, last = pz / last if last else 0.0, pz
        q, v = p + beta * q, z + beta * v
        alpha = pz / float(v @ (q + C @ v))
        enough = enough or (accuracy * alpha) ** 2 * pz
        y, p = y + alpha * q, p - alpha * (q + C @ v)
    return start + inverse @ U.T @ y, steps


def statistics(m: mujoco.MjModel, data: mujoco.MjData, qacc: Array) -> dict[str, float]:
    """Repeat the steps between iterates (passes, nv) after mj_forward without a warm start; nothing if they differ."""
    last, steps = np.zeros(m.nv), list[int]()
    for k, following in enumerate(qacc):
        step, count = conjugate_gradients(linearize(m, data, last, k == 0), ACCURACY * 0.1 ** max(k + 1 - LOOSE, 0))
        length = (following - last) @ step / (step @ step)  # by the line search
        if np.linalg.norm(following - last - length * step) > AGREE * (1 + np.linalg.norm(following)):
            return {}
        last = following
        steps.append(count)
    end = linearize(m, data, last)
    right = np.random.default_rng(0).normal(size=m.nv)  # as any gradient may be
    adjoint = conjugate_gradients(end._replace(rest=right), ACCURACY_ADJOINT[1])[1]
    gradient, found = np.linalg.norm(end.rest) / (m.stat.meaninertia * m.nv), np.array(gradients_of(data))
    cold = min(1 + int((found > gradient).sum()), len(found))
    row: dict[str, float] = {"rows": len(end.U), "passes": len(qacc), "steps per pass": float(np.mean(steps))}
    return row | {"adjoint's steps": adjoint, "gradient": float(gradient), "cold": cold}


def measure_solver(args: Args, name: str) -> Iterator[Row]:
    m, table = as_primitives(args.model(name)), list[dict[str, float]]()
    m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    m.opt.disableflags |= DISABLE.mjDSBL_ISLAND
    visited, theirs = zip(*motion(m), strict=True)
    states, cold, (low, high) = [np.array(x) for x in zip(*visited, strict=True)], copy.copy(m), control_range(m)
    cold.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # without damping at the end, qacc is the solver's
    cold.opt.disableflags |= DISABLE.mjDSBL_EULERDAMP | DISABLE.mjDSBL_WARMSTART
    qacc, residual = iterates(with_pairs(load_scene(cold)), states)
    data, passes = mujoco.MjData(cold), np.minimum((residual > Integration().tolerance).sum(0) + 1, len(qacc))
    for n, (qpos, qvel, ctrl) in enumerate(zip(*states, strict=True)):
        data.qpos, data.qvel, data.ctrl = qpos, qvel, low + (ctrl + 1) / 2 * (high - low)
        mujoco.mj_forward(cold, data)
        if row := statistics(cold, data, qacc[: passes[n], n]):
            table.append(row | {"MuJoCo's passes": len(theirs[n]), "MuJoCo's gradient": [0.0, *theirs[n]][-1]})
    counts = {"states": len(table), "left out": len(theirs) - len(table), "residual": float(residual.min(0).max())}
    average = {key: np.median if "gradient" in key else np.mean for key in table[0]}
    yield {"scene": name} | counts | {key: float(f([row[key] for row in table])) for key, f in average.items()}


# The time -------------------------------------------------------------------------------------------------------------


def poses(m: mujoco.MjModel, legs: set[tuple[int, int]], cross: bool, count: int) -> Array:
    """Draw qpos (count, nq) of a standing robot of which nothing touches, or only pairs of its legs, not deeply."""
    rng, data, found = np.random.default_rng(0), mujoco.MjData(m), list[Array]()
    spread = np.array(
        [CROSSED if cross and any(part in m.joint(k).name for part in HIP) else BENT for k in range(m.njnt)]
    )
    while len(found) < count:
        data.qpos = m.key_qpos[0]
        data.qpos[7:] += spread[1:] * rng.normal(size=m.nq - 7)
        mujoco.mj_fwdPosition(m, data)
        touching = [contact for contact in data.contact if m.geom_bodyid[contact.geom].all()]
        right = all(tuple(sorted(each.geom.tolist())) in legs and each.dist > -DEEPEST for each in touching)
        if right and cross == bool(touching):
            found.append(data.qpos.copy())
    return np.array(found)


def measure_time(args: Args, name: str) -> Iterator[Row]:
    scene = with_pairs(load_scene(args.model(name)))
    m, device = scene.mj_model, "cpu, 1 thread" if args.device == "cpu" else args.device
    bodies = [m.body(body).name for body in m.geom_bodyid.tolist()]
    legs = [any(part in body for part in HIP) and body.partition("_")[0] for body in bodies]
    crossing = tuple((a, b) for a, b in scene.geom_pairs if {legs[a], legs[b]} == {"left", "right"})
    kinds = {"none": (), "legs": crossing, "all": scene.geom_pairs}
    kinds |= {"one thread": ()} if args.device == "cuda" else {}
    for num_envs, cross in [(n, cross) for n in args.num_envs for cross in (False, True)]:
        drawn = torch.tensor(poses(as_primitives(m), set(crossing), cross, 64)).repeat(-(-num_envs // 64), 1)[:num_envs]
        rest = [torch.zeros(num_envs, n, dtype=torch.float64) for n in (m.nv, m.nu)]
        states = [(drawn.roll(k, 0), rest[0], rest[1]) for k in range(args.states + 1)]
        timers = {}
        for kind, pairs in kinds.items():
            own, division = dataclasses.replace(scene, geom_pairs=pairs), (1, 1) if kind == "one thread" else None
            how, seconds = Integration("mujoco", args.substeps), args.substeps * m.opt.timestep
            sim = Simulator(own, num_envs, how, seconds, device=args.device, threads=1, division=division)
            timers[kind] = timer(sim)
        times = race(timers, states, args.repeats)
        for kind, pairs in kinds.items():
            row: dict[str, object] = {"scene": name, "touching": "legs" if cross else "nothing", "pairs": kind}
            row |= {"number": len(pairs), "environments": num_envs, "device": device}
            row |= {f"{way} (us/substep)": t / num_envs / args.substeps for way, t in times[kind].items()}
            yield row | {f"{way}, relative": t / times["none"][way] for way, t in times[kind].items()}


SHOWN = ("scene", "rows", "passes", "steps per pass", "adjoint's steps", "MuJoCo's passes", "cold")
TIMED = ("touching", "number", "forward, relative", "backward, relative")
PARTS = {
    "solver": Part("pairs_solver", measure_solver, ("scene",), "pairs_solver", "physics.md", list, SHOWN),
    "time": Part(
        "pairs_time",
        measure_time,
        ("scene", "touching", "pairs", "environments", "device"),
        "pairs_time",
        "physics.md",
        lambda rows: [row for row in rows if row["pairs"] == "all"],
        TIMED,
    ),
}


def main(args: Args) -> None:
    for part in args.parts:
        names: Any = args.scenes if part == "solver" else ("g1",)
        measured(dataclasses.replace(args, env=names), PARTS[part])


if __name__ == "__main__":
    run(main, Args, __doc__)
