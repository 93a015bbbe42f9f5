"""How fast the simulator and a whole SHAC iteration are, against MuJoCo's C step on the same model in the same run.

    python benchmarks/speed.py --env ant --num-envs 64
    python benchmarks/speed.py                                every task, 64 and 256 environments
    python benchmarks/speed.py --device cuda                  on a GPU: as CUDA graphs and operation by operation
    python benchmarks/speed.py --parts scaling --env ant      cost against environments (64 to 65,536) and horizon
    python benchmarks/speed.py --parts muscles --env humanoid_mtu    what muscles cost in a substep
    python benchmarks/speed.py --parts picture                only draws benchmarks/results/speed.png from the csv files

Prints markdown tables and writes their rows to benchmarks/results/speed_*.csv, in place of older rows of the same
setting. A machine that does something else meanwhile gives wrong numbers.
"""

from __future__ import annotations

import dataclasses
import gc
import importlib.util
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal

import matplotlib
import mujoco
import numpy as np
import torch
import tyro
from tables import digits, markdown, merge_csv, read_csv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import diffsim
from diffsim import graph
from diffsim.kernels.lanes import divide
from diffsim.launcher import available_cores
from diffsim.run import fail
from diffsim.tasks import SHAC_TASKS

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
DTYPES = {"float32": torch.float32, "float64": torch.float64}
Part = Literal["physics", "muscles", "scaling", "training", "compile", "picture"]


@dataclass
class Args:
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = SHAC_TASKS
    """tasks"""
    num_envs: tuple[int, ...] = (64, 256)
    """batch sizes of the physics table (training uses the task's own)"""
    scaling: tuple[int, ...] = (64, 256, 1024, 4096, 16384, 65536)
    """batch sizes of the scaling table, at a horizon of 32"""
    horizons: tuple[int, ...] = (1, 4, 8, 16, 32, 64, 128)
    """horizons of the scaling table, at 64 environments"""
    max_memory: float = 40.0
    """GiB; settings of the scaling table whose checkpoints would need more are left out"""
    compare: tuple[Literal["mujoco", "mujoco_warp"], ...] = ("mujoco",)
    """simulators in the physics table beside ours; mujoco_warp must be installed"""
    dtype: tuple[Literal["float32", "float64"], ...] = ("float32", "float64")
    """precisions of the physics table"""
    device: str = "cpu"
    """torch device, cpu or cuda"""
    parts: tuple[Part, ...] = ("physics", "training", "compile")
    """tables to measure"""
    states: int = 9
    """states, visited by random actions, in which a control step is timed; the median over them counts"""
    repeats: int = 5
    """times that all competitors take their turn in each state; the fastest counts, the others were disturbed"""
    iterations: int = 30
    """SHAC iterations of the training table; the first three are not counted"""
    output: Path = ROOT / "benchmarks" / "results"
    """directory of the csv files"""


# Tables ---------------------------------------------------------------------------------------------------------------


@dataclass
class Table:
    """Rows of one csv file. The `key` columns say what was measured: a new row replaces the old one of its key."""

    name: str
    key: tuple[str, ...]
    directory: Path
    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, **row: Any) -> None:
        """A row, which the file has at once: a measurement cut short keeps what it has."""
        self.rows.append({k: digits(v) for k, v in row.items()})
        print(" ", ", ".join(f"{k} {v}" for k, v in self.rows[-1].items()), flush=True)
        merge_csv(self.directory / f"speed_{self.name}.csv", self.rows[-1:], self.key)


# Physics --------------------------------------------------------------------------------------------------------------

State = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


@torch.no_grad()
def visited_states(name: str, num_envs: int, count: int) -> list[State]:
    """(qpos, qvel, ctrl) in float64, every 8 control steps of a run under uniform random actions, resets included."""
    env = diffsim.make(name, num_envs=num_envs, seed=0)
    generator = torch.Generator().manual_seed(0)
    env.reset(seed=0)
    states = []
    for step in range(8 * count):
        action = torch.rand(num_envs, env.scene.nu, generator=generator) * 2 - 1
        if step % 8 == 7:
            states.append((env.qpos.double(), env.qvel.double(), action.double()))
        env.step(action)
    return states


def time_diffsim(sim: diffsim.Simulator, state: State) -> dict[str, float]:
    """Microseconds of one differentiated control step: forward and backward, with torch's part and of the kernels."""
    synchronize = torch.cuda.synchronize if sim.device.type == "cuda" else lambda: None
    inputs = [x.to(sim.device, sim.dtype, copy=True).requires_grad_() for x in state]
    gradients = [torch.ones_like(x) for x in inputs[:2]]
    kernels = dict(sim.seconds)
    synchronize()
    start = time.perf_counter()
    outputs = sim.step(*inputs)
    synchronize()
    middle = time.perf_counter()
    torch.autograd.grad(outputs, inputs, gradients)
    synchronize()
    wall = {"forward": middle - start, "backward": time.perf_counter() - middle}
    if sim.device.type == "cpu":
        kernels = {k: sim.seconds[k] - before for k, before in kernels.items()}
    else:
        kernels = wall
    return {f"step {k}": 1e6 * v for k, v in wall.items()} | {f"kernel {k}": 1e6 * v for k, v in kernels.items()}


class MuJoCo:
    """mj_step of each environment in turn on one core: Euler, the substep's length, MuJoCo's own contact solver."""

    def __init__(self, scene: diffsim.Scene, num_envs: int, substeps: int, control_dt: float) -> None:
        self.model = mujoco.MjModel.from_xml_path(scene.path)
        self.model.opt.timestep = control_dt / substeps
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        self.substeps = substeps
        self.data = [mujoco.MjData(self.model) for _ in range(num_envs)]

    def time(self, state: State) -> dict[str, float]:
        low, high = self.model.actuator_ctrlrange.T
        for data, qpos, qvel, ctrl in zip(self.data, *(x.numpy() for x in state), strict=True):
            data.qpos, data.qvel, data.ctrl = qpos, qvel, low + (ctrl + 1) / 2 * (high - low)
            mujoco.mj_forward(self.model, data)  # gives the solver the warm start that a running simulation has
        start = time.perf_counter()
        for data in self.data:
            mujoco.mj_step(self.model, data, self.substeps)
        return {"mj_step": 1e6 * (time.perf_counter() - start)}


class MuJoCoWarp:
    """mujoco_warp's step of all environments, on a GPU as one CUDA graph: its own contact solver, no gradients."""

    def __init__(self, args: Args, scene: diffsim.Scene, num_envs: int, substeps: int, control_dt: float) -> None:
        import mujoco_warp
        import warp as wp

        model = mujoco.MjModel.from_xml_path(scene.path)
        model.opt.timestep = control_dt / substeps
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        self.low, self.high = model.actuator_ctrlrange.T
        with wp.ScopedDevice(args.device):
            self.model = mujoco_warp.put_model(model)
            self.data = mujoco_warp.make_data(model, nworld=num_envs, nconmax=64, njmax=256)

            def steps() -> None:
                for _ in range(substeps):
                    mujoco_warp.step(self.model, self.data)

            steps()
            self.run = steps
            if args.device != "cpu":
                with wp.ScopedCapture() as capture:
                    steps()
                self.run = lambda: wp.capture_launch(capture.graph)
        self.synchronize = wp.synchronize

    def time(self, state: State) -> dict[str, float]:
        ctrl = self.low + (state[2].numpy() + 1) / 2 * (self.high - self.low)
        for array, value in zip((self.data.qpos, self.data.qvel, self.data.ctrl), (*state[:2], ctrl), strict=True):
            array.assign(np.asarray(value, dtype=np.float32))
        self.synchronize()
        start = time.perf_counter()
        self.run()
        self.synchronize()
        return {"mj_step": 1e6 * (time.perf_counter() - start)}


def measure_physics(args: Args, table: Table) -> None:
    threads = [1] if args.device != "cpu" else [1, available_cores()]
    for name in args.env:
        task = diffsim.TASKS[name]
        for num_envs in args.num_envs:
            states = visited_states(name, num_envs, args.states + 1)
            scene = diffsim.load_scene(Path(diffsim.__file__).parent / "assets" / task.asset)
            reference = MuJoCo(scene, num_envs, task.substeps, task.control_dt)
            competitors: dict[Any, Callable[[State], dict[str, float]]] = {"mujoco": reference.time}
            if "mujoco_warp" in args.compare:
                competitors["mujoco_warp"] = MuJoCoWarp(args, scene, num_envs, task.substeps, task.control_dt).time
            for dtype in args.dtype:
                for count in threads:
                    sim = diffsim.Simulator(
                        scene,
                        num_envs,
                        task.integration("default"),
                        task.control_dt,
                        device=args.device,
                        dtype=DTYPES[dtype],
                        threads=count,
                    )
                    competitors[dtype, count] = lambda state, sim=sim: time_diffsim(sim, state)
            times: dict[Any, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
            for k, state in enumerate(states):
                fastest: dict[Any, dict[str, float]] = defaultdict(dict)
                for _ in range(args.repeats):
                    for competitor, measure in competitors.items():
                        for what, value in measure(state).items():
                            fastest[competitor][what] = min(value, fastest[competitor].get(what, value))
                if k > 0:  # the first state compiles and fills caches
                    for competitor, values in fastest.items():
                        for what, value in values.items():
                            times[competitor][what].append(value)
            report_physics(args, table, name, num_envs, task.substeps, times)


def report_physics(args: Args, table: Table, name: str, num_envs: int, substeps: int, times: Any) -> None:
    per_substep = num_envs * substeps
    mj = median(times.pop("mujoco")["mj_step"]) / per_substep
    mj_warp = median(times.pop("mujoco_warp")["mj_step"]) / per_substep if "mujoco_warp" in times else None
    for (dtype, count), measured in times.items():
        t = {what: median(values) for what, values in measured.items()}
        alone = {what: median(values) for what, values in times[dtype, 1].items()}
        total, total_alone = (x["kernel forward"] + x["kernel backward"] for x in (t, alone))
        table.add(
            **{
                "task": name,
                "environments": num_envs,
                "precision": dtype,
                "device": args.device if args.device != "cpu" else "cpu, 1 thread" if count == 1 else "cpu, all cores",
                "forward (us/substep)": t["kernel forward"] / per_substep,
                "backward (us/substep)": t["kernel backward"] / per_substep,
                "backward/forward": t["kernel backward"] / t["kernel forward"],
                "control step forward (us)": t["step forward"],
                "control step backward (us)": t["step backward"],
                "mj_step, one core (us/substep)": mj,
                "mj_step/forward": mj * per_substep / t["kernel forward"],
                "mujoco_warp (us/substep)": mj_warp if mj_warp is not None else "",
                "one thread/this": total_alone / total,
            }
        )


# Muscles --------------------------------------------------------------------------------------------------------------


def measure_muscles(args: Args, table: Table) -> None:
    """A substep without muscles, with linear and with Hill-type ones; their share is what the first lacks."""
    for name in args.env:
        task = diffsim.TASKS[name]
        scene = diffsim.load_scene(Path(diffsim.__file__).parent / "assets" / task.asset)
        if "muscle" not in scene.features:
            continue
        scenes = {"none": scene.without("muscle")}
        scenes |= {model: dataclasses.replace(scene, muscle_model=model) for model in ("linear", "hill")}
        for num_envs, dtype in itertools.product(args.num_envs, args.dtype):
            options: dict[str, Any] = dict(device=args.device, dtype=DTYPES[dtype], threads=1)
            sims = {
                muscles: diffsim.Simulator(s, num_envs, task.integration("default"), task.control_dt, **options)
                for muscles, s in scenes.items()
            }
            times: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
            for k, state in enumerate(visited_states(name, num_envs, args.states + 1)):
                fastest: dict[str, dict[str, float]] = defaultdict(dict)
                for _ in range(args.repeats):
                    for muscles, sim in sims.items():
                        for what, value in time_diffsim(sim, state).items():
                            fastest[muscles][what] = min(value, fastest[muscles].get(what, value))
                if k > 0:  # the first state compiles and fills caches
                    for muscles, values in fastest.items():
                        for what in ("forward", "backward"):
                            times[muscles][what].append(values[f"kernel {what}"] / num_envs / task.substeps)
            t = {muscles: {what: median(values) for what, values in of.items()} for muscles, of in times.items()}
            for muscles, own in t.items():
                bare, both = t["none"], own["forward"] + own["backward"]
                table.add(
                    **{
                        "task": name,
                        "environments": num_envs,
                        "precision": dtype,
                        "device": args.device if args.device != "cpu" else "cpu, 1 thread",
                        "muscles": muscles,
                        "forward (us/substep)": own["forward"],
                        "backward (us/substep)": own["backward"],
                        "muscles' share, forward": 1 - bare["forward"] / own["forward"],
                        "backward": 1 - bare["backward"] / own["backward"],
                        "both": 1 - (bare["forward"] + bare["backward"]) / both,
                    }
                )


# Scaling --------------------------------------------------------------------------------------------------------------


def time_window(name: str, num_envs: int, horizon: int, technique: str) -> dict[str, Any]:
    """Seconds of a window of control steps, without gradients, differentiably, and with its backward; peak memory."""
    device = "cuda" if "cuda" in technique else "cpu"
    if device == "cuda":
        gc.collect()  # the graphs of the setting before
        torch.cuda.empty_cache()
        torch.cuda.synchronize()
        free = torch.cuda.mem_get_info()[0]
    env = diffsim.make(name, num_envs=num_envs, seed=0, device=device)
    sim = diffsim.Simulator(
        env.scene,
        num_envs,
        env.task.integration("default"),
        env.control_dt,
        horizon,
        device=device,
        threads={"cpu, 1 thread": 1, "cpu, all cores": available_cores()}.get(technique),
        division=divide(env.scene, 1) if "one thread" in technique else None,
    )
    start_qpos, start_qvel = env.qpos.clone(), env.qvel.clone()
    actions = (torch.rand(horizon, num_envs, sim.nu, device=device) * 2 - 1).requires_grad_()

    def forward() -> torch.Tensor:
        sim.rewind()
        qpos, qvel = start_qpos, start_qvel
        for action in actions.unbind():
            qpos, qvel = sim.step(qpos, qvel, action)
        return qpos.sum() + qvel.sum()

    def both() -> torch.Tensor:
        return torch.autograd.grad(forward(), actions)[0]

    seconds: dict[str, Any] = {}
    for what, function in (("no_grad", torch.no_grad()(forward)), ("forward", forward), ("both", both)):
        call = graph.capture(function, device) if "graph" in technique else function
        fastest = float("inf")
        for k in range(7):
            if device == "cuda":
                torch.cuda.synchronize()
            start = time.perf_counter()
            call()
            if device == "cuda":
                torch.cuda.synchronize()
            if k > 2:  # compilation, warm-up, capture
                fastest = min(fastest, time.perf_counter() - start)
        seconds[what] = fastest
    memory = (free - torch.cuda.mem_get_info()[0]) / 2**30 if device == "cuda" else ""
    return seconds | {"memory": memory}


def measure_scaling(args: Args, table: Table) -> None:
    techniques = ["cuda graph", "cuda graph, one thread per environment", "cuda, eager"]
    if args.device == "cpu":
        techniques = ["cpu, 1 thread", "cpu, all cores"]
    for name in args.env:
        task = diffsim.TASKS[name]
        settings = [(n, 32) for n in args.scaling] + [(64, h) for h in args.horizons]
        for num_envs, horizon in dict.fromkeys(settings):
            scene = diffsim.load_scene(Path(diffsim.__file__).parent / "assets" / task.asset)
            row = scene.nq + 2 * scene.nv + 7 * (scene.nlink - 1) + 21  # numbers of a checkpoint, see kernels/model.py
            if 4 * row * num_envs * horizon * task.substeps > args.max_memory * 2**30:
                continue
            for technique in techniques:
                t = time_window(name, num_envs, horizon, technique)
                steps = num_envs * horizon
                table.add(
                    **{
                        "task": name,
                        "environments": num_envs,
                        "horizon": horizon,
                        "technique": technique,
                        "forward (us/substep of all)": 1e6 * t["forward"] / horizon / task.substeps,
                        "backward (us/substep of all)": 1e6 * (t["both"] - t["forward"]) / horizon / task.substeps,
                        "differentiated control steps/s": steps / t["both"],
                        "substeps/s without gradient": steps * task.substeps / t["no_grad"],
                        "memory (GiB)": t["memory"],
                    }
                )


def draw(directory: Path) -> None:
    """Microseconds of one differentiated control step of one environment, against environments and horizon."""
    path = directory / "speed_scaling.csv"
    if not path.is_file():
        fail(f"{path} does not exist: measure with --parts scaling first")
    rows = read_csv(path)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    for axis, of, fixed, value in (
        (axes[0], "environments", "horizon", "32"),
        (axes[1], "horizon", "environments", "64"),
    ):
        curves: dict[str, list[tuple[int, float]]] = defaultdict(list)
        for row in rows:
            if row[fixed] == value:
                label = f"{row['task']}, {row['technique']}"
                curves[label].append((int(row[of]), 1e6 / float(row["differentiated control steps/s"])))
        for label, points in curves.items():
            axis.loglog(*zip(*sorted(points), strict=True), marker="o", markersize=3, label=label)
        axis.set_xlabel(f"{of} ({fixed} {value})")
        axis.grid(True, which="both", alpha=0.3)
    axes[0].set_ylabel("us per control step, forward + backward")
    axes[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(directory / "speed.png", dpi=110)


# Training and compilation ---------------------------------------------------------------------------------------------

COMPILE = """
import sys, time
import diffsim, torch
start = time.perf_counter()
env = diffsim.make(sys.argv[1], num_envs=1, horizon=1, device=sys.argv[2])
action = torch.zeros(1, env.scene.nu, device=env.device, requires_grad=True)
torch.autograd.grad(env.step(action)[1].sum(), action)
print(time.perf_counter() - start)
"""


def measure_compile(args: Args, table: Table) -> None:
    """Seconds until the first control step and its backward are done, with an empty and with a filled kernel cache."""
    for name in args.env:
        with tempfile.TemporaryDirectory() as cache:
            command = [sys.executable, "-c", COMPILE, name, args.device]
            environment = os.environ | {"WARP_CACHE_PATH": cache}
            cold, warm = (
                float(subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout)
                for _ in range(2)
            )
        table.add(task=name, device=args.device, **{"cold cache (s)": cold, "warm cache (s)": warm})


def run_shac(directory: Path, arguments: list[str]) -> tuple[float, float]:
    """Runs shac.py; returns the seconds from its start to its first iteration's end, and its peak memory in MiB."""
    command = [sys.executable, str(ROOT / "shac.py"), "--run-dir", str(directory), "--quiet", *arguments]
    progress = directory / "progress.csv"
    start, first = time.perf_counter(), float("nan")
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while True:
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
        if first != first and progress.is_file() and len(progress.read_text().splitlines()) > 1:
            first = time.perf_counter() - start
        if ended:
            break
        time.sleep(0.01)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        fail(f"{' '.join(command)} ended with {process.returncode}")
    return first, usage.ru_maxrss / (1024 if sys.platform == "linux" else 1024**2)


def logged(directory: Path, tag: str) -> list[float]:
    """The values of a tensorboard scalar."""
    events = EventAccumulator(str(directory), size_guidance={"scalars": 0})
    events.Reload()
    return [event.value for event in events.Scalars(tag)]


def measure_training(args: Args, table: Table) -> None:
    devices = ["cuda graph", "cuda, eager"] if args.device != "cpu" else ["cpu, 1 thread", "cpu, all cores"]
    for name in args.env:
        for device in devices:
            options = ["--env", name, "--device", args.device, "--eval-every", "0", "--save-every", "0"]
            options += ["--no-cuda-graph"] if "eager" in device else []
            options += [
                "--iterations",
                str(args.iterations),
                "--threads",
                "1" if "1 thread" in device else str(available_cores()),
            ]
            with tempfile.TemporaryDirectory() as temporary:
                run_shac(Path(temporary) / "compile", [*options, "--stop-after", "1"])
                directory = Path(temporary) / "run"
                first, memory = run_shac(directory, options)
                tags = (
                    "time/total",
                    "time/critic",
                    *(["time/sim_forward", "time/sim_backward"] * (args.device == "cpu")),
                )
                total, critic, *physics = (1e3 * median(logged(directory, tag)[3:]) for tag in tags)
                num_envs = json.loads((directory / "args.json").read_text())["num_envs"]
            table.add(
                **{
                    "task": name,
                    "environments": num_envs,
                    "device": device,
                    "iteration (ms)": total,
                    "physics forward": physics[0] if physics else "",
                    "physics backward": physics[1] if physics else "",
                    "critic": critic,
                    "policy, task, loss": total - critic - sum(physics),  # and the physics on a GPU
                    "start to first iteration (s)": first,
                    "peak memory (MiB)": memory,
                }
            )


def main(args: Args) -> None:
    if unknown := [name for name in args.env if name not in diffsim.TASKS]:
        fail(f"unknown task {unknown[0]!r}: choose from {', '.join(diffsim.TASKS)}")
    if min(args.states, args.repeats, *args.num_envs) < 1 or args.iterations < 4:
        fail("--states, --repeats and --num-envs must be at least 1, --iterations at least 4")
    torch.set_num_threads(1)
    if "mujoco_warp" in args.compare and importlib.util.find_spec("mujoco_warp") is None:
        fail("--compare mujoco_warp needs it installed: pip install mujoco-warp")
    measures = {
        "physics": (measure_physics, ("task", "environments", "precision", "device")),
        "muscles": (measure_muscles, ("task", "environments", "precision", "device", "muscles")),
        "scaling": (measure_scaling, ("task", "environments", "horizon", "technique")),
        "training": (measure_training, ("task", "environments", "device")),
        "compile": (measure_compile, ("task", "device")),
    }
    tables = []
    for part in args.parts:
        if part == "picture":
            continue
        measure, key = measures[part]
        print(f"{part}:", flush=True)
        tables.append(Table(part, key, args.output))
        measure(args, tables[-1])
        if not tables[-1].rows:
            fail(f"none of {', '.join(args.env)} has muscles")
    for table in tables:
        print(f"\n{markdown(table.rows)}", end="")
    if {"scaling", "picture"} & set(args.parts):
        draw(args.output)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
