"""How fast the simulator and a whole SHAC iteration are, against MuJoCo's C step on the same model in the same run.

    python benchmarks/speed.py                                every task, 64 and 256 environments
    python benchmarks/speed.py --device cuda                  on a GPU: as CUDA graphs and operation by operation
    python benchmarks/speed.py --parts scaling --env ant      cost against environments (64 to 65,536) and horizon
    python benchmarks/speed.py --parts time --env cartpole ant humanoid    the SHAC paper's Table 12
    python benchmarks/speed.py --parts training --env ant -- --contact mujoco    what follows "--" goes to the script
    python benchmarks/speed.py --parts training --script pfpn -- --policy gaussian
    python benchmarks/speed.py --parts memory --env ant humanoid_mtu    the most that a script takes

Prints markdown tables and writes their rows to speed_*.csv, in place of older rows of the same setting, and speed.png.
A machine that does something else meanwhile gives wrong numbers.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal, TypeVar

import mujoco
import torch
import tyro
import warp as wp
from cells import ScriptFlags
from common import TASKS, Panel, Part, TaskName, lines, measured, plot, run
from motions import shac
from tables import ROOT, Row, read_csv

import diffsim
from diffsim import Scene, Simulator
from diffsim.kernels.lanes import divide
from diffsim.sim.launcher import Launcher, available_cores
from diffsim.terrain import rough
from diffsim.training import Count, fail, graph
from diffsim.training import parse as parse_script
from diffsim.training.evaluation import make_env

Robot = Literal["go1", "go2", "g1"]  # of the physics table alone
KernelName = Literal["blocks", "scalar"]  # on a CPU in vectors of environments, or one environment at a time
THREADS = {"cpu, 1 thread": 1, "cpu, all cores": available_cores()}  # techniques of a CPU
PartName = Literal["physics", "scaling", "training", "time", "memory"]
MAX_MEMORY = 40 * 2**30  # of a setting's checkpoints; the scaling table leaves out larger settings
TABLE_12 = {"cartpole": (0.15, 0.23, 0.34), "ant": (0.25, 0.37, 0.32), "humanoid": (0.91, 1.97, 0.32)}  # on a TITAN X


@dataclass
class Args(ScriptFlags):
    env: Annotated[tuple[TaskName | Robot, ...], tyro.conf.arg(aliases=["--env-id"])] = TASKS  # type: ignore[assignment]
    device: str = "cpu"  # torch device of the measurements, cpu or cuda (auto: the GPU if there is one)
    parts: tuple[PartName, ...] = ("physics", "training")  # tables to measure
    num_envs: tuple[Count, ...] = (64, 256)  # batch sizes of the physics table (training uses the task's own)
    scaling: tuple[Count, ...] = (64, 256, 1024, 4096, 16384, 65536)  # those of the scaling table, at a horizon of 32
    horizons: tuple[Count, ...] = (1, 4, 8, 16, 32, 64, 128)  # horizons of the scaling table, at 64 environments
    kernels: tuple[KernelName, ...] = ("blocks", "scalar")  # of the physics table; scalar on a CPU
    states: Count = 9  # states of random motion in which a control step is timed; the median over them counts
    repeats: Count = 5  # turns of all competitors in each state; the fastest counts, the others were disturbed
    script: str = "shac"  # script of the training table, in the repository's root, without .py
    iterations: Count = 27  # iterations of the training table, after three that are not counted


State = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
Times = dict[str, float]  # microseconds
K = TypeVar("K", bound=Hashable)


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


@contextmanager
def kernel_time() -> Iterator[list[float]]:
    """Seconds of each launch of kernels meanwhile; on a GPU, which does not wait for them, meaningless."""
    seconds, launch = list[float](), Launcher.launch

    def timed_launch(self: Launcher, command: list[wp.Launch]) -> None:
        start = time.perf_counter()
        launch(self, command)
        seconds.append(time.perf_counter() - start)

    Launcher.launch = timed_launch  # type: ignore[method-assign]
    try:
        yield seconds
    finally:
        Launcher.launch = launch  # type: ignore[method-assign]


def timer(sim: Simulator) -> Callable[[State], Times]:
    """Times one differentiated control step, forward and backward, as a learner sees it, and of it the kernels."""
    synchronize = torch.cuda.synchronize if sim.device.type == "cuda" else lambda: None

    def time_step(state: State) -> Times:
        inputs = [x.to(sim.device, sim.dtype, copy=True).requires_grad_() for x in state]
        gradients = [torch.ones_like(x) for x in inputs[:2]]
        synchronize()
        start = time.perf_counter()
        with kernel_time() as forward:
            outputs = sim.step(*inputs)
        synchronize()
        middle = time.perf_counter()
        with kernel_time() as backward:
            torch.autograd.grad(outputs, inputs, gradients)
        synchronize()
        whole = {"forward": middle - start, "backward": time.perf_counter() - middle}
        kernels = {"forward kernel": sum(forward), "backward kernel": sum(backward)}
        return {what: 1e6 * seconds for what, seconds in (whole | kernels).items()}

    return time_step


def race(competitors: Mapping[K, Callable[[State], Times]], states: Sequence[State], repeats: int) -> dict[K, Times]:
    """In each state all take their turn, many times, and each one's fastest counts; medians over the states.

    The first state compiles and fills caches, and does not count.
    """
    found: dict[K, list[Times]] = {key: [] for key in competitors}
    for call in competitors.values():
        call(states[0])
    for state in states[1:]:
        turns = [{key: call(state) for key, call in competitors.items()} for _ in range(repeats)]
        for key in competitors:
            found[key].append({what: min(turn[key][what] for turn in turns) for what in turns[0][key]})
    return {key: {what: median(t[what] for t in times) for what in times[0]} for key, times in found.items()}


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


def measure_physics(args: Args, name: TaskName | Robot) -> Iterator[Row]:
    """Beside MuJoCo: without its muscles, if a task has any; the hopper also on rough ground."""
    threads = THREADS if args.device == "cpu" else {args.device: 1}
    task, whole = diffsim.TASKS[name], diffsim.make(name, num_envs=1).scene
    default, options = task.integration("default"), dict[str, Any](device=args.device, control_dt=task.control_dt)
    scenes = {"": whole}
    if "muscle" in whole.features:
        none = {name: getattr(whole, name)[:0] for name in ("segment_link", "segment_position", "segment_muscle")}
        scenes = {"muscles": whole, "no muscles": dataclasses.replace(whole, **none)}
    if name == "hopper":
        scenes["rough ground"] = whole.with_terrain(rough(0))
    kernels = [kernel for kernel in args.kernels if args.device == "cpu" or kernel != "scalar"]
    for num_envs in args.num_envs:
        reference = "", "", "mj_step"
        competitors = {reference: mujoco_timer(whole, num_envs, task.control_dt / default.substeps, default.substeps)}
        for (scene_name, scene), kernel, (place, count) in product(scenes.items(), kernels, threads.items()):
            block = {"block": 1} if kernel == "scalar" else {}
            sim = Simulator(scene, num_envs, default, threads=count, **options, **block)
            competitors[scene_name, kernel, place] = timer(sim)
        times = race(competitors, random_states(name, num_envs, args.states + 1), args.repeats)
        per_substep = num_envs * default.substeps
        mj = times.pop(reference)["mj_step"] / per_substep
        for (scene_name, kind, place), t in times.items():
            scalar = times.get((scene_name, "scalar", place), {})
            row: dict[str, object] = {"task": name, "environments": num_envs, "scene": scene_name}
            row |= {"kernel": kind, "device": place}
            row |= {f"{what} (us/substep)": microseconds / per_substep for what, microseconds in t.items()}
            ratios = {what: t[what] / scalar[what] for what in scalar if "kernel" in what}
            row |= {f"{what}/scalar": ratio for what, ratio in ratios.items()}
            yield row | {"mj_step, one core (us/substep)": mj, "mj_step/forward": mj * per_substep / t["forward"]}


def timed(call: Callable[[], object], device: torch.device, warmup: int, calls: int) -> list[float]:
    """Seconds of each call, once compiled, captured and warm."""
    synchronize = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    seconds = []
    for _ in range(warmup + calls):
        synchronize()
        start = time.perf_counter()
        call()
        synchronize()
        seconds.append(time.perf_counter() - start)
    return seconds[warmup:]


def windows(
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
    """A window of control steps differentiably, and with its backward pass."""
    graphs = "cuda graph", "cuda graph, one thread per environment", "cuda, eager"
    settings = dict.fromkeys([(n, 32) for n in args.scaling] + [(64, h) for h in args.horizons])
    for (num_envs, horizon), technique in product(settings, graphs if args.device != "cpu" else THREADS):
        row = scaling_row(args.device, name, num_envs, horizon, technique)
        if row is not None:
            yield row


def scaling_row(device: str, name: TaskName, num_envs: int, horizon: int, technique: str) -> Row | None:
    """None if it needs too much memory. Its locals end with it, so that the next row's memory is without this one's."""
    cuda = device != "cpu"
    if cuda:
        gc.collect()  # the graphs of the row before
        torch.cuda.empty_cache()
        torch.cuda.synchronize()
        free = torch.cuda.mem_get_info()[0]
    default, env = diffsim.TASKS[name].integration("default"), diffsim.make(name, num_envs, device, seed=0)
    scene, steps = env.scene, num_envs * horizon
    numbers = scene.nq + 2 * scene.nv + 7 * (scene.nlink - 1) + 21  # of a checkpoint, see kernels/model.py
    if 4 * numbers * steps * default.substeps > MAX_MEMORY:
        return None
    options = dict[str, Any](device=device, threads=THREADS.get(technique))
    options["division"] = divide(scene) if "one thread" in technique else None
    sim = Simulator(scene, num_envs, default, horizon=horizon, **options)
    actions = (torch.rand(horizon, num_envs, sim.nu, device=env.device) * 2 - 1).requires_grad_()
    calls = windows(sim, env.qpos.clone(), env.qvel.clone(), actions)[1:]
    captured = [graph.capture(call, env.device) if "graph" in technique else call for call in calls]
    one_way, both = (min(timed(call, env.device, warmup=3, calls=4)) for call in captured)
    passes = {"forward": one_way, "backward": both - one_way}
    row: dict[str, object] = {"task": name, "environments": num_envs, "horizon": horizon, "technique": technique}
    row |= {f"{way} (us/substep of all)": 1e6 * s / horizon / default.substeps for way, s in passes.items()}
    row["differentiated control steps/s"] = steps / both
    return row | {"memory (GiB)": (free - torch.cuda.mem_get_info()[0]) / 2**30 if cuda else ""}


def draw(args: Args, rows: Sequence[Mapping[str, str]]) -> None:
    """Microseconds of one differentiated control step of one environment, against environments and horizon."""
    panels, unit, speed = list[Panel](), "us per control step, forward + backward", "differentiated control steps/s"
    for x, fixed, value in (("environments", "horizon", "32"), ("horizon", "environments", "64")):
        own = [row for row in rows if row[fixed] == value]
        points = [{x: r[x], unit: str(1e6 / float(r[speed])), "curve": f"{r['task']}, {r['technique']}"} for r in own]
        panels.append(Panel(lines(points, x, unit, "curve"), "", f"{x} ({fixed} {value})", unit, "xy"))
    plot(args.picture("speed"), [panels], (4.5, 3.6))


def measure_time(args: Args, name: TaskName) -> Iterator[Row]:
    """Table 12: the parts of one iteration of SHAC, each captured and timed alone."""
    settings = parse_script(shac.Args, ["--env", name, "--device", args.device])
    env = make_env(settings, settings.num_envs, settings.horizon)
    learner = shac.SHAC(settings, env)

    def forward() -> torch.Tensor:
        noise = learner.actor.sample_noise(settings.horizon, settings.num_envs)
        rollout = shac.collect(env, learner.actor, noise)
        return shac.actor_loss(rollout.reward, learner.next_values(rollout), rollout.done, settings.gamma)

    calls: list[Callable[[], object]] = [
        graph.capture(lambda: forward().detach(), env.device, env),
        graph.capture(lambda: learner.actor_optimizer.step(forward()), env.device, env),
        graph.capture(learner.update_critic, env.device),
    ]
    first, both, critic = (1e3 * median(timed(call, env.device, warmup=4, calls=20)) for call in calls)
    row: Row = {"task": name, "environments": settings.num_envs, "forward, ms": first, "backward, ms": both - first}
    published = zip(("forward", "backward", "critic"), TABLE_12.get(name, ()), strict=False)
    yield {**row, "critic, ms": critic, **{f"published {part}, s (TITAN X)": seconds for part, seconds in published}}


def command(args: Args, name: str, *flags: str) -> list[str]:
    """A script on a task, without evaluations."""
    words = f"--env {name} --device {args.device} --quiet --eval-every 0"
    return [sys.executable, str(ROOT / f"{args.script}.py"), *words.split(), *flags, *args.arguments]


def watch(command: Sequence[str], look: Callable[[int], None], **environment: str) -> None:
    """Run a script; meanwhile look, by the process's number, again and again."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | environment)
    while process.poll() is None:
        look(process.pid)
        time.sleep(0.01)
    if process.returncode:
        fail(f"{' '.join(command)} failed")


def start(command: Sequence[str], directory: Path, cache: str) -> float:
    """Seconds from a script's start to the end of its first iteration; waits for its end."""
    began, first = time.perf_counter(), list[float]()

    def look(_: int) -> None:
        if not first and read_csv(directory / "progress.csv"):
            first.append(time.perf_counter() - began)

    watch(command, look, WARP_CACHE_PATH=cache)
    return first[0] if first else fail(f"{' '.join(command)} wrote no progress.csv")


def measure_memory(args: Args, name: TaskName) -> Iterator[Row]:
    """The most memory that a script takes in three iterations: its process on a CPU, on a GPU what others then lack."""
    cuda = args.device != "cpu"
    free, most = torch.cuda.mem_get_info()[0] if cuda else 0, 0

    def look(pid: int) -> None:
        nonlocal most
        status = Path(f"/proc/{pid}/status").read_text()  # a process that has ended has no such line
        resident = re.search(r"VmHWM:\s+(\d+) kB", status)
        most = max(most, free - torch.cuda.mem_get_info()[0] if cuda else 1024 * int(resident[1] if resident else 0))

    with tempfile.TemporaryDirectory() as run:
        watch(command(args, name, "--stop-after", "3", "--run-dir", run), look)
        num_envs = json.loads(Path(run, "args.json").read_text())["num_envs"]
    script = " ".join((args.script, *args.arguments))
    yield {"task": name, "script": script, "environments": num_envs, "memory (GiB)": most / 2**30}


def measure_training(args: Args, name: TaskName) -> Iterator[Row]:
    """Iterations of a script in a process of its own, which is never evaluated."""
    techniques = {technique: ["--threads", str(threads)] for technique, threads in THREADS.items()}
    if args.device != "cpu":
        techniques = {"cuda graph": [], "cuda, eager": ["--no-cuda-graph"]}
    common = "--iterations", str(args.iterations + 4), "--save-every", "0"
    for technique, flags in techniques.items():
        with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as runs:
            run = Path(runs)
            first = command(args, name, *common, *flags, "--stop-after", "1", "--run-dir", f"{run}/cold")
            cold = start(first, run / "cold", cache)
            last = "--stop-after", str(args.iterations + 3), "--run-dir", f"{run}/warm"
            warm = start(command(args, name, *common, *flags, *last), run / "warm", cache)
            progress = read_csv(run / "warm" / "progress.csv")[3:]
            num_envs = json.loads((run / "warm" / "args.json").read_text())["num_envs"]
        critic = [1e3 * float(row["time_update_critic"]) for row in progress if "time_update_critic" in row]
        row = {"task": name, "environments": num_envs, "device": technique}
        row["script"] = " ".join((args.script, *args.arguments))
        yield row | {
            "iteration (ms)": 1e3 * median(float(row["time_total"]) for row in progress),
            "critic": median(critic) if critic else "",
            "start to first iteration (s)": warm,
            "start with nothing compiled (s)": cold,
        }


PARTS: dict[PartName, Part] = {
    "physics": Part("speed_physics", measure_physics, ("task", "environments", "scene", "kernel", "device")),
    "scaling": Part("speed_scaling", measure_scaling, ("task", "environments", "horizon", "technique")),
    "training": Part("speed_training", measure_training, ("task", "environments", "device", "script")),
    "time": Part("time", measure_time, ("task",), "time", "experiments.md"),
    "memory": Part("speed_memory", measure_memory, ("task", "script"), "speed_memory", "performance.md"),
}


def main(args: Args) -> None:
    robots = [name for name in args.env if name not in TASKS]
    if robots and args.parts != ("physics",):
        fail(f"--env {' '.join(robots)}: measured by --parts physics alone")
    for part in args.parts:
        rows = measured(args, PARTS[part])
        if part == "scaling" and rows:
            draw(args, rows)


if __name__ == "__main__":
    run(main, Args, __doc__)
