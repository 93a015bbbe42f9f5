"""Whether what goes wrong in one environment stays there, and whether extreme contacts are solved as by MuJoCo.

    python benchmarks/extremes.py                        hopper: 1,260 tries, and 512 states
    python benchmarks/extremes.py --parts containment --env ant

Containment: one environment of a batch gets a number of DISTURBANCES, as the first, the middle or the last one, in
batches of several sizes and kinds of kernels, and all take four steps. It holds if all states, gradients, flags and
counts of the others are bit for bit those of the batch without it, and its own states (unless they began so) and
gradients are finite.

States: a robot of two links whose masses differ by up to 1e9, thrown into the ground at up to 1000 m/s and rad/s, takes
one step of MuJoCo's contact. It holds if nothing is contained, and velocities are
MuJoCo's, of the largest velocity and its change within 1e-9 in float64, solved to the end, and 1e-2 in float32, to the
default tolerance.

Newton (--parts newton --env ant humanoid): a control step of each state of some MOTIONS, to several tolerances, against
one to 1e-11 in float64: passes of Newton's method on average and the most in a block of 16, time of one core, and the
errors of velocity (of the largest change) and gradient of float32.

Writes containment.csv, newton.csv and extreme_states.csv and, with --update-results, a table of docs/numerics.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np
import torch
from common import CommonFlags, Part, TaskName, Tasks, measured, run
from tables import Row, grouped, markdown, numbers
from torch import Tensor
from worlds import Array

import diffsim
from diffsim import Integration, Scene, Simulator, load_scene
from diffsim.training import load_policy
from diffsim.training.checkpoint import POLICIES

PartName = Literal["containment", "states", "newton"]
INTEGRATIONS = {
    "semi_implicit": Integration("semi_implicit", 8),
    "implicit": Integration("implicit", 8),
    "implicit, theta 1": Integration("implicit", 8, 1.0),
    "extrapolated": Integration("extrapolated", 8),
    "mujoco": Integration("mujoco", 4),
}
BATCHES: list[tuple[int, int | None, torch.dtype]] = [  # environments, and how wide a kernel's blocks are
    *((16, 16, torch.float32), (17, 16, torch.float32), (8, 8, torch.float32)),
    *((5, None, torch.float32), (3, None, torch.float64), (33, None, torch.float32)),
]
ALL, NAN, INF = slice(None), float("nan"), float("inf")
DISTURBANCES: list[tuple[str, Any, float]] = [  # what of an environment gets which value
    *(("qvel", 0, NAN), ("qvel", -1, INF), ("qvel", ALL, 9e4), ("qvel", ALL, 1e30), ("qpos", -1, NAN)),
    *(("forces", 1, 1e30), ("forces", 1, 1e8), ("ctrl", ALL, NAN), ("ctrl", ALL, 1e30), ("factors", [0, 4], 1e30)),
    *(("factors", 6, 0.0), ("factors", 6, 1e30), ("factors", 7, 1e30)),
]
MASSES = (1.0, 1.0), (1e2, 1e-2), (1e4, 1e-4), (1e5, 1e-4), (1e-4, 1e-4), (3e5, 3e5)  # kg, of root and of links
ROBOTS = [*((*masses, 1.0) for masses in MASSES), (1.0, 1.0, 0.0), (1.0, 1.0, 100.0)]  # with the friction
SPEEDS = {1.0: 0.01, 10.0: 0.05, 100.0: 0.1, 1000.0: 0.3}  # m/s and rad/s: how deep it may be in the ground [m]
ROBOT_KEY = ("root (kg)", "links (kg)", "friction")
STATES, STEP = 16, 0.002  # of each robot and speed; s
EXACT = {  # how far velocities may be off: of the solution, and as it is by default
    torch.float64: (Integration("mujoco", 1, passes=300, tolerance=1e-13), 1e-9),
    torch.float32: (Integration("mujoco", 1), 1e-2),
}
ROBOT = """<mujoco><option timestep="{step}" cone="elliptic" iterations="2000" tolerance="0" ls_iterations="500"
ls_tolerance="1e-14"/><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 .5"><freejoint/>
<geom type="sphere" size=".2" mass="{root}"/><body pos="0 0 -.25"><joint axis="0 1 0" range="-60 60"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".03" mass="{link}" friction="{friction}"/><body pos="0 0 -.2">
<joint axis="1 0 0" range="-30 30"/><geom type="sphere" size=".05" mass="{link}" friction="{friction}"/>
</body></body></body></worldbody></mujoco>"""

MOTIONS: dict[str, tuple[float, float, float]] = {  # friction (0: the file's), speed along and into the ground [m/s]
    **{"gait": (0, 0, 0), "random actions": (0, 0, 0), "impact": (0, 0, 10)},
    **{f"slip, friction {friction:g}": (friction, 2, 0) for friction in (0.05, 0.3, 1.0)},
}
TOLERANCES = 1e-3, 1e-4, 1e-5
NEWTON_KEY = "task", "motion", "tolerance"
SHOWN = "motion", "passes", "velocity 99 %", "gradient 99 %"


@dataclass
class Args(CommonFlags):
    env: Tasks = ("hopper",)  # tasks whose environments are disturbed
    parts: tuple[PartName, ...] = ("containment", "states")  # what to measure


class Inputs(NamedTuple):
    qpos: Tensor
    qvel: Tensor
    ctrl: Tensor
    factors: Tensor
    forces: Tensor


def four_steps(sim: Simulator, given: Inputs) -> list[Tensor]:
    """States, gradients and what was contained of four steps and their backward pass, a row for each environment."""
    leaves = Inputs(*(x.clone().requires_grad_() for x in given))
    sim.factors, sim.forces = leaves.factors, leaves.forces
    state, states, lost = (leaves.qpos, leaves.qvel), list[Tensor](), list[Tensor]()
    sim.nonfinite_gradients.zero_()
    for _ in range(4):
        state = sim.step(*state, leaves.ctrl)
        states += state
        lost.append(sim.nonfinite.clone())
    weights = torch.arange(1.0, sim.num_envs + 1, dtype=sim.dtype).unsqueeze(1)  # each environment has its own
    gradients = torch.autograd.grad((torch.cat(states, 1) * weights).sum(), leaves)
    parts = [x.detach() for x in states], [x.flatten(1) for x in gradients], [torch.stack(lost, 1).int()]
    return [*(torch.cat(each, 1) for each in parts), sim.nonfinite_gradients.clone()]


def contain(args: Args, task: TaskName) -> Iterator[Row]:
    """A row for each integrator."""
    env = diffsim.make(task, max(n for n, *_ in BATCHES), seed=3)
    scene, drawn = env.scene, torch.Generator().manual_seed(0)
    tries = [*DISTURBANCES, ("qpos", 2 if scene.floating else 1, -100.0)]
    tries += [("qpos", slice(3, 7), 0.0)] if scene.floating else []  # a quaternion of zeros
    for name, integration in INTEGRATIONS.items():
        tried = held = 0
        for n, block, dtype in BATCHES:
            options: dict[str, Any] = dict(dtype=dtype, block=block, factors=True, forces=True)
            sim = Simulator(scene, n, integration, 1 / 60, 4, **options)
            ctrl = 2 * torch.rand(n, scene.nu, generator=drawn) - 1
            parts = env.qpos[:n], env.qvel[:n], ctrl, sim.factors, sim.forces
            given = Inputs(*(part.to(dtype) for part in parts))
            expected = four_steps(sim, given)
            for (what, where, value), k in product(tries, (0, n // 2, n - 1)):
                (tensor := getattr(given, what).clone())[k][where] = value
                found, others = four_steps(sim, given._replace(**{what: tensor})), torch.arange(n) != k
                good = all(torch.equal(x[others], y[others]) for x, y in zip(found, expected, strict=True))
                begun = what in ("qpos", "qvel") and not np.isfinite(value)
                good &= bool(found[1][k].isfinite().all() and (begun or found[0][k].isfinite().all()))
                if not good:
                    print(f"{task}, {name}, {n} environments in blocks of {block}: {what} {where} = {value} of {k}")
                tried, held = tried + 1, held + good
        yield {"task": task, "integrator": name, "tried": tried, "held": held}


def robot(root: float, link: float, friction: float) -> Scene:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        path.write_text(ROBOT.format(step=STEP, root=root, link=link, friction=friction))
        return load_scene(path)


def thrown(model: mujoco.MjModel, speed: float, depth: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Start positions and velocities (STATES, ...), a sphere in the ground, and velocities a step later."""
    states, data = list[tuple[Array, Array, Array]](), mujoco.MjData(model)
    for _ in range(STATES):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv) * ([0] * 3 + [0.1] * 5), 1.0)
        data.qpos[7:] = rng.uniform(-0.7, 0.7, 2)
        mujoco.mj_kinematics(model, data)
        lowest = min(data.geom_xpos[1, 2] - 0.2, data.geom_xpos[3, 2] - 0.05)
        data.qpos[2] -= lowest + rng.uniform(0, depth)
        data.qvel[:] = rng.normal(size=model.nv) * speed
        start = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_step(model, data)
        states.append((*start, data.qvel.copy()))
    qpos, qvel, after = (np.stack(parts) for parts in zip(*states, strict=True))
    return qpos, qvel, after


def throw() -> Iterator[Row]:
    """A row for each robot and speed."""
    rng = np.random.default_rng(1)
    for root, link, friction in ROBOTS:
        scene = robot(root, link, friction)
        for speed, depth in SPEEDS.items():
            qpos, qvel, expected = thrown(scene.mj_model, speed, depth, rng)
            row = dict(zip((*ROBOT_KEY, "speed", "tried"), (root, link, friction, speed, STATES), strict=True))
            held, scale = np.full(STATES, True), np.abs(expected).max(1) + np.abs(expected - qvel).max(1)
            for dtype, (integration, exact) in EXACT.items():
                sim = Simulator(scene, STATES, integration, STEP, dtype=dtype)
                start = torch.tensor(qpos).to(dtype), torch.tensor(qvel).to(dtype)
                _, after = sim.step(*start, torch.zeros(STATES, 0, dtype=dtype))
                error = np.abs(after.double().numpy() - expected).max(1) / scale
                held &= (error < exact) & ~sim.nonfinite.numpy()
                row[f"error, {str(dtype).removeprefix('torch.')}"] = float(error.max())
            yield row | {"held": int(held.sum())}


class Moving(NamedTuple):
    """A scene, how it is simulated, the length of a control step, and states with their actions."""

    scene: Scene
    how: Integration
    dt: float
    states: list[Tensor]

    def advance(self, dtype: torch.dtype, passes: int, tolerance: float) -> tuple[Simulator, Tensor, Tensor, float]:
        """The simulator after a control step, velocities and gradients in float64, microseconds without gradients."""
        how = self.how._replace(passes=passes, tolerance=tolerance, touchdown=False)
        sim = Simulator(self.scene, len(self.states[0]), how, self.dt, dtype=dtype, threads=1)
        start, times = [x.to(dtype, copy=True).requires_grad_() for x in self.states], []
        end = torch.cat(sim.step(*start), 1)
        weights = torch.linspace(-1, 1, end.shape[1], dtype=dtype)
        slopes = torch.autograd.grad((end * weights).sum(), start)
        with torch.no_grad():
            for _ in range(9):
                begin = time.thread_time()
                sim.step(*start)
                times.append(time.thread_time() - begin)
        sim.unconverged //= 10
        velocities = end[:, sim.nq :].detach().double()
        return sim, velocities, torch.cat(slopes, 1).double(), 1e6 * min(times) / sim.num_envs


def moving(task: TaskName, name: str) -> Moving:
    """1,280 states of a motion."""
    friction, along, down = MOTIONS[name]
    env, act = (
        diffsim.make(task, 32, seed=0, contact="mujoco", early_termination=False),
        load_policy(POLICIES / f"{task}.pt").network,
    )
    model = mujoco.MjModel.from_xml_path(env.scene.path)
    model.geom_friction[:, 0] = friction or model.geom_friction[:, 0]
    obs, drawn, found = env.reset(seed=0)[0], torch.Generator().manual_seed(0), []
    with torch.no_grad():
        for _ in range(60):
            action = act(obs).clamp(-1, 1)
            if name != "gait":
                action = torch.rand(action.shape, generator=drawn) * 2 - 1
            found.append([x.double() for x in (env.qpos, env.qvel, action)])
            obs = env.step(action)[0]
    qpos, qvel, actions = map(torch.cat, zip(*found[20:], strict=True))
    qvel[:, :2] += along * torch.randn(len(qvel), 2, generator=drawn)
    qvel[:, 2] -= down
    return Moving(load_scene(model), env.sim.integration, env.control_dt, [qpos, qvel, actions])


def converge(args: Args, task: TaskName) -> Iterator[Row]:
    """A row for each motion and tolerance."""
    for name in MOTIONS:
        of = moving(task, name)
        _, expected, right, _ = of.advance(torch.float64, 300, 1e-11)
        change = (expected - of.states[1]).abs().amax(1)
        for tolerance in TOLERANCES:
            sim, found, slope, each = of.advance(torch.float32, Integration().passes, tolerance)
            row: dict[str, object] = {"task": task, "motion": name, "tolerance": tolerance}
            row |= {"passes": float(sim.passes.mean()), "most of 16": float(sim.passes.view(-1, 16).amax(1).mean())}
            row |= {"us": each, "not converged": float(sim.unconverged.double().mean())}
            velocity = (found - expected).abs().amax(1) / change
            gradient = (slope - right).norm(dim=1) / right.norm(dim=1)
            row |= {"residual": float(sim.residual.max()), "velocity 99 %": float(velocity.quantile(0.99))}
            row |= {"gradient 99 %": float(gradient.quantile(0.99)), "velocity most": float(velocity.max())}
            yield row | {"gradient most": float(gradient.max())}


def worst(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each robot: all its speeds."""
    lines = list[Row]()
    for key, own in grouped(rows, *ROBOT_KEY).items():
        line: dict[str, object] = dict(zip(ROBOT_KEY, key, strict=True))
        line |= {title: f"{sum(numbers(own, name)):.0f}" for title, name in (("states", "tried"), ("solved", "held"))}
        errors = [name for name in own[0] if name.startswith("error")]
        lines.append(line | {f"largest {name}": f"{max(numbers(own, name)):.0e}" for name in errors})
    return lines


def at_default(rows: list[dict[str, str]]) -> list[Row]:
    """The humanoid's rows of the default tolerance, in the columns of the page."""
    rows = [row for row in rows if float(row["tolerance"]) == Integration().tolerance and row["task"] == "humanoid"]
    return [{name: row[name] for name in SHOWN} for row in rows]


def main(args: Args) -> None:
    if "containment" in args.parts:
        key = "task", "integrator"
        measured(args, Part("containment", contain, key))
    if "newton" in args.parts:
        measured(args, Part("newton", converge, NEWTON_KEY, "newton", "numerics.md", at_default))
    if "states" in args.parts:
        for row in () if args.draw_only else throw():
            args.keep("extreme_states", row, (*ROBOT_KEY, "speed"))
        print(markdown(worst(args.read("extreme_states"))))


if __name__ == "__main__":
    run(main, Args, __doc__)
