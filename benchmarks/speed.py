"""How fast the simulator is, against MuJoCo's C step on the same model in the same run.

    python benchmarks/speed.py                                every task on a core, 64 and 256 environments
    python benchmarks/speed.py --device cuda --parts scaling --env ant    64 to 65,536 environments, as CUDA graphs
    python benchmarks/speed.py --parts iteration --env ant humanoid       learners' iterations, and what they launch

Prints markdown tables and writes their rows to speed_*.csv, in place of older rows of the same setting, and speed.png.
A machine that does something else meanwhile gives wrong numbers.
"""

from __future__ import annotations

import csv
import dataclasses
import gc
import importlib
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal

import mujoco
import torch
import tyro
from common import TASKS, CommonFlags, Panel, Part, TaskName, lines, measured, plot, run
from tables import ROOT, Row

import diffsim
from diffsim import Scene, Simulator
from diffsim.sim.launcher import TooLargeError
from diffsim.training import Count, Run, fail, graph
from diffsim_cli.tune.front import clock
from diffsim_robots.terrain import rough

Robot = Literal["go1", "go2", "g1"]  # of the physics table alone
TECHNIQUES = "cuda graph", "cuda graph, one thread per environment", "cuda, eager"
PartName = Literal["physics", "scaling", "iteration"]
SCALING = (64, 256, 1024, 4096, 16384, 65536)  # environments of the scaling table, at a horizon of 32
HORIZONS = (1, 4, 8, 16, 32, 64, 128)  # its horizons, at 64 environments
ITERATIONS = {  # what the iteration's table measures on a GPU: learner, environments, horizon
    "ant": (("shac", 64, 32), ("shac", 4096, 32), ("ppo_baseline", 4096, 32)),
    "humanoid": (("sapo", 1024, 32),),
    "g1": (("sapo", 1024, 16),),
    "go2": (("shac", 1024, 8), ("ppo_baseline", 4096, 32)),
}
ON_CPU = dict.fromkeys(("ant", "humanoid"), (("shac", 64, 32),))


@dataclass
class Args(CommonFlags):
    env: Annotated[tuple[TaskName | Robot, ...], tyro.conf.arg(aliases=["--env-id"], help="tasks")] = TASKS  # type: ignore[assignment]
    parts: tuple[PartName, ...] = ("physics",)  # tables to measure
    num_envs: tuple[Count, ...] = (64, 256)  # batch sizes of the physics table
    states: Count = 9  # states of random motion in which a control step is timed; the median over them counts
    repeats: Count = 5  # turns of all competitors in each state; the fastest counts, the others were disturbed


# A control step ------------------------------------------------------------------------------------------------------

State = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
Times = dict[str, float]  # microseconds


@torch.no_grad()
def random_states(name: str, num_envs: int, count: int) -> list[State]:
    """(qpos, qvel, ctrl) in float64, every 8 control steps of a run under uniform random actions, resets included."""
    env, generator = diffsim.make(name, num_envs=num_envs, seed=0), torch.Generator().manual_seed(0)
    env.reset(seed=0)
    states = []
    for step in range(8 * count):
        action = torch.rand(num_envs, env.scene.nu, generator=generator) * 2 - 1
        if step % 8 == 7:
            states.append((env.qpos.double(), env.qvel.double(), action.double()))
        env.step(action)
    return states


def timer(sim: Simulator) -> Callable[[State], Times]:
    """Times one differentiated control step, forward and backward, as a learner sees it."""

    def time_step(state: State) -> Times:
        inputs = [x.to(sim.device, sim.dtype, copy=True).requires_grad_() for x in state]
        gradients = [torch.ones_like(x) for x in inputs[:2]]
        sim.rewind()
        start = clock(sim.device)
        outputs = sim.step(*inputs)
        middle = clock(sim.device)
        torch.autograd.grad(outputs, inputs, gradients)
        return {"forward": 1e6 * (middle - start), "backward": 1e6 * (clock(sim.device) - middle)}

    return time_step


def mujoco_timer(scene: Scene, num_envs: int, timestep: float, substeps: int) -> Callable[[State], Times]:
    """mj_step of each environment in turn on one core: Euler, the substep's length, MuJoCo's own contact solver."""
    model = mujoco.MjModel.from_xml_path(scene.path)
    model.opt.timestep, model.opt.integrator = timestep, mujoco.mjtIntegrator.mjINT_EULER
    low, high = model.actuator_ctrlrange.T
    environments = [mujoco.MjData(model) for _ in range(num_envs)]

    def time_step(state: State) -> Times:
        for data, qpos, qvel, ctrl in zip(environments, *(x.numpy() for x in state), strict=True):
            data.qpos, data.qvel, data.ctrl = qpos, qvel, low + (ctrl + 1) / 2 * (high - low)
            mujoco.mj_forward(model, data)  # gives the solver the warm start that a running simulation has
        start = time.perf_counter()
        for data in environments:
            mujoco.mj_step(model, data, substeps)
        return {"mj_step": 1e6 * (time.perf_counter() - start)}

    return time_step


def race(
    competitors: Mapping[str, Callable[[State], Times]], states: Sequence[State], repeats: int
) -> dict[str, Times]:
    """In each state all take their turn, many times, and each one's fastest counts; medians over the states.

    The first state compiles and fills caches, and does not count.
    """
    found: dict[str, list[Times]] = {key: [] for key in competitors}
    for call in competitors.values():
        call(states[0])
    for state in states[1:]:
        turns = [{key: call(state) for key, call in competitors.items()} for _ in range(repeats)]
        for key in competitors:
            found[key].append({what: min(turn[key][what] for turn in turns) for what in turns[0][key]})
    return {key: {what: median(t[what] for t in times) for what in times[0]} for key, times in found.items()}


def without_muscles(scene: Scene) -> Scene:
    names = "segment_link segment_position segment_muscle".split()
    return dataclasses.replace(scene, **{name: getattr(scene, name)[:0] for name in names})


def measure_physics(args: Args, name: TaskName | Robot) -> Iterator[Row]:
    """On one thread beside MuJoCo: without its muscles, if a task has any; the hopper also on rough ground."""
    task, whole = diffsim.TASKS[name], diffsim.make(name, num_envs=1).scene
    default, options = task.integration("default"), dict[str, Any](device=args.device, control_dt=task.control_dt)
    scenes = {"": whole}
    if "muscle" in whole.features:
        scenes = {"muscles": whole, "no muscles": without_muscles(whole)}
    if name == "hopper":
        scenes["rough ground"] = whole.with_terrain(rough(0))
    for num_envs in args.num_envs:
        substeps = num_envs * default.substeps  # of all
        mujoco_step = mujoco_timer(whole, num_envs, task.control_dt / default.substeps, default.substeps)
        sims = {kind: Simulator(scene, num_envs, default, threads=1, **options) for kind, scene in scenes.items()}
        competitors = {"mj_step": mujoco_step} | {kind: timer(sim) for kind, sim in sims.items()}
        times = race(competitors, random_states(name, num_envs, args.states + 1), args.repeats)
        mj = times.pop("mj_step")["mj_step"]
        for kind, t in times.items():
            row: dict[str, object] = {"task": name, "environments": num_envs, "scene": kind, "kernel": "blocks"}
            row |= {"device": "cpu, 1 thread" if args.device == "cpu" else args.device}
            row |= {f"{way} (us/substep)": microseconds / substeps for way, microseconds in t.items()}
            yield row | {"mj_step, one core (us/substep)": mj / substeps, "mj_step/forward": mj / t["forward"]}


# Rollouts of control steps --------------------------------------------------------------------------------------------


def timed(call: Callable[[], object], device: torch.device, warmup: int, calls: int) -> float:
    """Seconds of the fastest call, once compiled, captured and warm."""
    for _ in range(warmup):
        call()
    seconds = []
    for _ in range(calls):
        start = clock(device)
        call()
        seconds.append(clock(device) - start)
    return min(seconds)


def rollouts(
    sim: Simulator, qpos: torch.Tensor, qvel: torch.Tensor, actions: torch.Tensor
) -> tuple[Callable[[], torch.Tensor], ...]:
    """Control steps with actions (H, N, nu) from a state: without gradients, differentiably, with the backward pass."""

    def forward() -> torch.Tensor:
        sim.rewind()
        q, v = qpos, qvel
        for action in actions.unbind():
            q, v = sim.step(q, v, action)
        return q.sum() + v.sum()

    return torch.no_grad()(forward), forward, lambda: torch.autograd.grad(forward(), actions)[0]


def measure_scaling(args: Args, name: TaskName) -> Iterator[Row]:
    """A rollout of control steps differentiably, and with its backward pass; without what needs too much memory."""
    settings = dict.fromkeys([(n, 32) for n in SCALING] + [(64, h) for h in HORIZONS])
    if args.device == "cpu":
        fail("--parts scaling needs a GPU: --device cuda")
    for (num_envs, horizon), technique in product(settings, TECHNIQUES):
        try:
            yield scaling_row(args.device, name, num_envs, horizon, technique)
        except (TooLargeError, torch.OutOfMemoryError) as error:
            print(f"{name}, {num_envs} environments, horizon {horizon}: {error}", flush=True)


def scaling_row(device: str, name: TaskName, num_envs: int, horizon: int, technique: str) -> Row:
    """Its locals end with it, so that the next row's memory is without this one's."""
    gc.collect()  # the graphs of the row before
    torch.cuda.empty_cache()
    torch.cuda.synchronize()
    free = torch.cuda.mem_get_info()[0]
    default, env = diffsim.TASKS[name].integration("default"), diffsim.make(name, num_envs, device, seed=0)
    division = (1, 1) if "one thread" in technique else None
    sim = Simulator(env.scene, num_envs, default, horizon=horizon, device=device, division=division)
    actions = (torch.rand(horizon, num_envs, sim.nu, device=env.device) * 2 - 1).requires_grad_()
    calls = rollouts(sim, env.qpos.clone(), env.qvel.clone(), actions)[1:]
    captured = [graph.capture(call, env.device) if "graph" in technique else call for call in calls]
    one_way, both = (timed(call, env.device, warmup=3, calls=4) for call in captured)
    row: dict[str, object] = {"task": name, "environments": num_envs, "horizon": horizon, "technique": technique}
    for way, seconds in {"forward": one_way, "backward": both - one_way}.items():
        row[f"{way} (us/substep of all)"] = 1e6 * seconds / horizon / default.substeps
    row["differentiated control steps/s"] = num_envs * horizon / both
    return row | {"memory (GiB)": (free - torch.cuda.mem_get_info()[0]) / 2**30}


# Iterations ----------------------------------------------------------------------------------------------------------


class Measured(Run):
    """A run that stops after some iterations, and counts what the second one launches on a GPU."""

    stop_after = 40
    launches = 0

    def capture(self, function: Any, env: Any = None, eager: bool = False) -> Any:
        calls = 0

        def counted() -> Any:
            nonlocal calls
            calls += 1
            if calls != 2 or self.device.type == "cpu":
                return function()
            with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
                result = function()
                torch.cuda.synchronize(self.device)
            kinds = [event.device_type for event in profile.events() or ()]
            Measured.launches += kinds.count(torch.autograd.DeviceType.CUDA)
            return result

        counted.__name__ = function.__name__
        return super().capture(counted, env, eager)


def measure_iteration(args: Args, name: TaskName | Robot) -> Iterator[Row]:
    """Whole iterations of learners, from rollout to critic: eager, as one CUDA graph, and with --compile."""
    cuda = args.device != "cpu"
    for learner, num_envs, horizon in (ITERATIONS if cuda else ON_CPU).get(name, ()):
        for technique in ("eager", "graph", "compiled") if cuda else ("eager",):
            row: Row = {"task": name, "learner": learner, "environments": num_envs, "horizon": horizon}
            yield {**row, "technique": technique, **iteration(args.device, name, learner, num_envs, horizon, technique)}


def iteration(device: str, name: str, learner: str, num_envs: int, horizon: int, technique: str) -> Row:
    """Milliseconds of the median iteration, what it launches, and seconds until the first one has ended."""
    script: Any = importlib.import_module(learner)
    Measured.graphs, Measured.launches, script.Run = technique != "eager", 0, Measured
    with tempfile.TemporaryDirectory() as folder:
        flags = (
            f"--env {name} --num-envs {num_envs} --horizon {horizon} --device {device} --run-dir {folder}/run --quiet"
        )
        start = time.perf_counter()
        script.main([*flags.split(), "--eval-every", "0", *(["--compile"] if technique == "compiled" else [])])
        seconds = time.perf_counter() - start
        with (Path(folder) / "run" / "progress.csv").open() as file:
            times = [float(row["time_total"]) for row in csv.DictReader(file)]
    graph.release()
    gc.collect()
    usual = median(times[len(times) // 4 :])
    return {"ms": 1e3 * usual, "launches": Measured.launches or "", "start (s)": seconds - sum(times[1:])}


def shown_iterations(rows: Sequence[Mapping[str, str]]) -> list[Row]:
    """A learner's techniques side by side: milliseconds of each."""
    cases: dict[tuple[str, ...], dict[str, Mapping[str, str]]] = {}
    for row in rows:
        cases.setdefault((row["learner"], row["task"], row["environments"]), {})[row["technique"]] = row
    table = list[Row]()
    for (learner, task, environments), by in cases.items():
        line: dict[str, object] = {"case": f"{learner}, {task}", "environments": environments}
        line |= {f"{name} (ms)": by[name]["ms"] for name in ("eager", "graph", "compiled") if name in by}
        if "compiled" in by:
            line["start, compiled (s)"] = by["compiled"]["start (s)"]
        table.append(line)
    return table


def draw(args: Args, rows: Sequence[Mapping[str, str]]) -> None:
    """Microseconds of one differentiated control step of one environment, against environments and horizon."""
    panels, unit, speed = list[Panel](), "us per control step, both ways", "differentiated control steps/s"
    for x, fixed, value in (("environments", "horizon", "32"), ("horizon", "environments", "64")):
        own = [row for row in rows if row[fixed] == value]
        points = [{x: r[x], unit: str(1e6 / float(r[speed])), "curve": f"{r['task']}, {r['technique']}"} for r in own]
        panels.append(Panel(lines(points, x, unit, "curve"), "", f"{x} ({fixed} {value})", unit, "xy"))
    plot(args.picture("speed"), [panels], (4.5, 3.6))


PARTS: dict[PartName, Part] = {
    "physics": Part("speed_physics", measure_physics, ("task", "environments", "scene", "kernel", "device")),
    "scaling": Part("speed_scaling", measure_scaling, ("task", "environments", "horizon", "technique")),
    "iteration": Part(
        "speed_iteration",
        measure_iteration,
        ("task", "learner", "environments", "technique"),
        "speed_iteration",
        "performance.md",
        shown_iterations,
    ),
}


def main(args: Args) -> None:
    robots = [name for name in args.env if name not in TASKS]
    if robots and "scaling" in args.parts:
        fail(f"--env {' '.join(robots)}: not measured by --parts scaling")
    sys.path.insert(0, str(ROOT))  # of the learners
    for part in args.parts:
        rows = measured(args, PARTS[part])
        if part == "scaling" and rows:
            draw(args, rows)


if __name__ == "__main__":
    run(main, Args, __doc__)
