"""How fast the simulator and a whole SHAC iteration are, against MuJoCo's C step on the same model in the same run.

    python benchmarks/speed.py --env ant --num-envs 64
    python benchmarks/speed.py                                every task, 64 and 256 environments
    python benchmarks/speed.py --device cuda                  on a GPU: as CUDA graphs and operation by operation
    python benchmarks/speed.py --parts scaling --env ant      cost against environments (64 to 65,536) and horizon
    python benchmarks/speed.py --parts time --env cartpole ant humanoid    the SHAC paper's Table 12
    python benchmarks/speed.py --parts kernels --device cuda --env hopper  where a GPU's time of an iteration goes

Prints markdown tables and writes their rows to speed_*.csv, in place of older rows of the same setting, and speed.png.
A machine that does something else meanwhile gives wrong numbers.
"""

from __future__ import annotations

import dataclasses
import gc
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Annotated, Literal, TypeVar

import mujoco
import numpy as np
import torch
from common import Line, Panel, TaskFlags, TaskName, measured, parse, plot
from motions import CONTROL_DT, shac, simulator
from tables import ROOT, Row, markdown, read_csv
from torch.profiler import ProfilerActivity, profile

import diffsim
from diffsim import DiffEnv, Scene, Simulator
from diffsim.kernels.lanes import divide
from diffsim.launcher import available_cores
from diffsim.training import Count, fail, graph
from diffsim.training import parse as parse_script
from diffsim.training.flags import Range
from diffsim.training.run import make_env

Precision = Literal["float32", "float64"]
DTYPES: dict[Precision, torch.dtype] = {"float32": torch.float32, "float64": torch.float64}
Part = Literal["physics", "scaling", "training", "time", "kernels"]
MAX_MEMORY = 40 * 2**30  # of a setting's checkpoints; larger settings of the scaling table are left out
TABLE_12 = {"cartpole": (0.15, 0.23, 0.34), "ant": (0.25, 0.37, 0.32), "humanoid": (0.91, 1.97, 0.32)}  # on a TITAN X


@dataclass
class Args(TaskFlags):
    parts: tuple[Part, ...] = ("physics", "training")  # tables to measure
    num_envs: tuple[Count, ...] = (64, 256)  # batch sizes of the physics table (training uses the task's own)
    scaling: tuple[Count, ...] = (64, 256, 1024, 4096, 16384, 65536)
    """batch sizes of the scaling table, at a horizon of 32"""
    horizons: tuple[Count, ...] = (1, 4, 8, 16, 32, 64, 128)  # horizons of the scaling table, at 64 environments
    compare: tuple[Literal["mujoco", "mujoco_warp"], ...] = ("mujoco",)
    """simulators in the physics table beside ours; mujoco_warp must be installed, and wants --device cuda"""
    dtype: tuple[Precision, ...] = ("float32", "float64")  # precisions of the physics table
    states: Count = 9
    """states, visited by random actions, in which a control step is timed; the median over them counts"""
    repeats: Count = 5
    """times that all competitors take their turn in each state; the fastest counts, the others were disturbed"""
    iterations: Annotated[int, Range(4)] = 30  # SHAC iterations of the training table; the first three are not counted


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


def timer(sim: Simulator) -> Callable[[State], Times]:
    """Times one differentiated control step: forward and backward, the whole ("step") and the kernels alone."""
    synchronize = torch.cuda.synchronize if sim.device.type == "cuda" else lambda: None

    def time_step(state: State) -> Times:
        inputs = [x.to(sim.device, sim.dtype, copy=True).requires_grad_() for x in state]
        gradients, kernels = [torch.ones_like(x) for x in inputs[:2]], dict(sim.seconds)
        synchronize()
        start = time.perf_counter()
        outputs = sim.step(*inputs)
        synchronize()
        middle = time.perf_counter()
        torch.autograd.grad(outputs, inputs, gradients)
        synchronize()
        wall = {"forward": middle - start, "backward": time.perf_counter() - middle}
        alone = {k: sim.seconds[k] - kernels[k] for k in wall} if sim.device.type == "cpu" else wall
        return {f"step {k}": 1e6 * v for k, v in wall.items()} | {k: 1e6 * v for k, v in alone.items()}

    return time_step


def race(competitors: Mapping[K, Callable[[State], Times]], states: Sequence[State], repeats: int) -> dict[K, Times]:
    """In each state all take their turn, many times, and each one's fastest counts; medians over the states."""
    found: dict[K, list[Times]] = {key: [] for key in competitors}
    for state in states:
        turns = [{key: call(state) for key, call in competitors.items()} for _ in range(repeats)]
        for key in competitors:
            found[key].append({what: min(turn[key][what] for turn in turns) for what in turns[0][key]})
    return {key: {what: median(t[what] for t in times) for what in times[0]} for key, times in found.items()}


def euler(scene: Scene, substeps: int) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_path(scene.path)
    model.opt.timestep, model.opt.integrator = CONTROL_DT / substeps, mujoco.mjtIntegrator.mjINT_EULER
    return model


def mujoco_timer(scene: Scene, num_envs: int, substeps: int) -> Callable[[State], Times]:
    """mj_step of each environment in turn on one core: Euler, the substep's length, MuJoCo's own contact solver."""
    model = euler(scene, substeps)
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


def mujoco_warp_timer(device: str, scene: Scene, num_envs: int, substeps: int) -> Callable[[State], Times]:
    """mujoco_warp's step of all environments of a GPU as one CUDA graph: its own contact solver, no gradients."""
    import mujoco_warp
    import warp as wp

    model = euler(scene, substeps)
    low, high = model.actuator_ctrlrange.T
    with wp.ScopedDevice(device):
        warp_model = mujoco_warp.put_model(model)
        data = mujoco_warp.make_data(model, nworld=num_envs, nconmax=64, njmax=256)

        def steps() -> None:
            for _ in range(substeps):
                mujoco_warp.step(warp_model, data)

        steps()
        with wp.ScopedCapture() as capture:
            steps()

    def time_step(state: State) -> Times:
        ctrl = low + (state[2].numpy() + 1) / 2 * (high - low)
        for array, value in zip((data.qpos, data.qvel, data.ctrl), (*state[:2], ctrl), strict=True):
            array.assign(np.asarray(value, dtype=np.float32))
        wp.synchronize()
        start = time.perf_counter()
        wp.capture_launch(capture.graph)
        wp.synchronize()
        return {"mj_step": 1e6 * (time.perf_counter() - start)}

    return time_step


def measure_physics(args: Args, name: TaskName) -> Iterator[Row]:
    """With all models of its muscles if a task has any, and without them."""
    threads = {"cpu, 1 thread": 1, "cpu, all cores": available_cores()} if args.device == "cpu" else {args.device: 1}
    default, whole = diffsim.TASKS[name].integration("default"), diffsim.make(name, num_envs=1).scene
    scenes = {"": whole}
    if "muscle" in whole.features:
        scenes = {model: dataclasses.replace(whole, muscle_model=model) for model in ("linear", "hill")}
        scenes["none"] = whole.without("muscle")
    for num_envs in args.num_envs:
        key, shape = ("", "", ""), (whole, num_envs, default.substeps)
        competitors = {key: mujoco_timer(*shape)}
        if "mujoco_warp" in args.compare:
            competitors["", "", "warp"] = mujoco_warp_timer(args.device, *shape)
        for (muscles, scene), dtype, (place, count) in product(scenes.items(), args.dtype, threads.items()):
            sim = simulator(scene, default, num_envs, DTYPES[dtype], device=args.device, threads=count)
            competitors[muscles, dtype, place] = timer(sim)
        states, per_substep = random_states(name, num_envs, args.states + 1), num_envs * default.substeps
        race(competitors, states[:1], 1)  # compiles and fills caches
        times = race(competitors, states[1:], args.repeats)
        mj = times.pop(key)["mj_step"] / per_substep
        warp = times.pop(("", "", "warp"))["mj_step"] / per_substep if "mujoco_warp" in args.compare else ""
        for (muscles, precision, place), t in times.items():
            forward, backward = t["forward"] / per_substep, t["backward"] / per_substep
            alone, bare = times[muscles, precision, next(iter(threads))], times.get(("none", precision, place), t)
            share = {kind: 1 - bare[kind] / t[kind] for kind in ("forward", "backward")}
            row: dict[str, object] = {"task": name, "environments": num_envs, "precision": precision, "device": place}
            row |= {"muscles": muscles, "forward (us/substep)": forward, "backward (us/substep)": backward}
            row |= {"backward/forward": backward / forward, "control step forward (us)": t["step forward"]}
            row |= {"control step backward (us)": t["step backward"], "mj_step, one core (us/substep)": mj}
            row |= {"mj_step/forward": mj / forward, "mujoco_warp (us/substep)": warp}
            row["one thread/this"] = (alone["forward"] + alone["backward"]) / (t["forward"] + t["backward"])
            yield row | {f"muscles' share, {kind}": value if muscles else "" for kind, value in share.items()}


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


def measure_scaling(args: Args, name: TaskName) -> Iterator[Row]:
    techniques = ["cuda graph", "cuda graph, one thread per environment", "cuda, eager"]
    if args.device == "cpu":
        techniques = ["cpu, 1 thread", "cpu, all cores"]
    substeps, scene = diffsim.TASKS[name].substeps, diffsim.make(name, num_envs=1).scene
    numbers = scene.nq + 2 * scene.nv + 7 * (scene.nlink - 1) + 21  # of a checkpoint, see kernels/model.py
    settings = dict.fromkeys([(n, 32) for n in args.scaling] + [(64, h) for h in args.horizons])
    for (num_envs, horizon), technique in product(settings, techniques):
        if 4 * numbers * num_envs * horizon * substeps <= MAX_MEMORY:
            yield time_window(name, num_envs, horizon, technique)


def time_window(name: TaskName, num_envs: int, horizon: int, technique: str) -> Row:
    """A window of control steps without gradients, differentiably, and with its backward pass."""
    device = torch.device("cuda" if "cuda" in technique else "cpu")
    if device.type == "cuda":
        gc.collect()  # the graphs of the setting before
        torch.cuda.empty_cache()
        torch.cuda.synchronize()
        free = torch.cuda.mem_get_info()[0]
    env = diffsim.make(name, num_envs=num_envs, seed=0, device=device)
    threads = {"cpu, 1 thread": 1, "cpu, all cores": available_cores()}.get(technique)
    division, default = divide(env.scene) if "one thread" in technique else None, env.task.integration("default")
    sim = simulator(
        env.scene, default, num_envs, horizon=horizon, device=device.type, threads=threads, division=division
    )
    start_qpos, start_qvel = env.qpos.clone(), env.qvel.clone()
    actions = (torch.rand(horizon, num_envs, sim.nu, device=device) * 2 - 1).requires_grad_()

    def forward() -> torch.Tensor:
        sim.rewind()
        qpos, qvel = start_qpos, start_qvel
        for action in actions.unbind():
            qpos, qvel = sim.step(qpos, qvel, action)
        return qpos.sum() + qvel.sum()

    calls = (torch.no_grad()(forward), forward, lambda: torch.autograd.grad(forward(), actions)[0])
    captured = [graph.capture(call, device) if "graph" in technique else call for call in calls]
    no_grad, one_way, both = (min(timed(call, device, warmup=3, calls=4)) for call in captured)
    row: dict[str, object] = {"task": name, "environments": num_envs, "horizon": horizon, "technique": technique}
    row["forward (us/substep of all)"] = 1e6 * one_way / horizon / default.substeps
    row["backward (us/substep of all)"] = 1e6 * (both - one_way) / horizon / default.substeps
    row["differentiated control steps/s"] = num_envs * horizon / both
    row["substeps/s without gradient"] = num_envs * horizon * default.substeps / no_grad
    return row | {"memory (GiB)": (free - torch.cuda.mem_get_info()[0]) / 2**30 if device.type == "cuda" else ""}


def draw(args: Args, rows: Sequence[Mapping[str, str]]) -> None:
    """Microseconds of one differentiated control step of one environment, against environments and horizon."""
    panels = []
    for of, fixed, value in (("environments", "horizon", "32"), ("horizon", "environments", "64")):
        curves = defaultdict[str, dict[int, float]](dict)
        for row in rows:
            if row[fixed] == value:
                microseconds = 1e6 / float(row["differentiated control steps/s"])
                curves[f"{row['task']}, {row['technique']}"][int(row[of])] = microseconds
        lines = [Line(sorted(c), [c[k] for k in sorted(c)], "o-", label) for label, c in curves.items()]
        panels.append(Panel(lines, "", f"{of} ({fixed} {value})", "us per control step, forward + backward", "xy"))
    plot(args.picture("speed"), [panels], (4.5, 3.6))


def make_learner(args: Args, name: TaskName) -> tuple[shac.Args, DiffEnv, shac.SHAC]:
    settings = parse_script(shac.Args, ["--env", name, "--device", args.device])
    env = make_env(settings, settings.num_envs, settings.horizon)
    return settings, env, shac.SHAC(settings, env)


def measure_time(args: Args, name: TaskName) -> Iterator[Row]:
    """Table 12: the parts of one iteration of SHAC, each captured and timed alone."""
    settings, env, learner = make_learner(args, name)

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
    row: dict[str, object] = {"task": name, "environments": settings.num_envs, "forward, ms": first}
    row |= {"backward, ms": both - first, "critic, ms": critic}
    published = zip(("forward", "backward", "critic"), TABLE_12.get(name, ("",) * 3), strict=True)
    yield row | {f"published {part}, s (TITAN X)": value for part, value in published}


def measure_kernels(args: Args, name: TaskName) -> Iterator[Row]:
    """What a GPU does in the two graphs of an iteration, by torch.profiler; prints the ten longest of each, too."""
    _, env, learner = make_learner(args, name)
    row: dict[str, object] = {"task": name}
    for part, half, of in (("window", learner.update_actor, env), ("critic", learner.update_critic, None)):
        call = graph.capture(half, env.device, of)
        timed(call, env.device, warmup=0, calls=4)
        with profile(activities=[ProfilerActivity.CUDA]) as record:
            call()
            torch.cuda.synchronize()
        kernels = defaultdict[str, list[float]](list)
        for event in record.events() or ():
            if event.device_type == torch.autograd.DeviceType.CUDA:
                kernels[event.name].append(event.device_time / 1e3)
        for kernel, times in sorted(kernels.items(), key=lambda item: -sum(item[1]))[:10]:
            print(f"{part}: {len(times):6d} x {1e3 * median(times):8.2f} us = {sum(times):8.3f} ms  {kernel[:80]}")
        ours = {k: sum(sum(t) for n, t in kernels.items() if n.startswith(k)) for k in ("forward_", "backward_")}
        if part == "window":
            row |= {f"simulator {k[:-1]} (ms)": ms for k, ms in ours.items()}
        row[f"torch, {part} (ms)"] = sum(map(sum, kernels.values())) - sum(ours.values())
        row[f"kernels, {part}"] = sum(map(len, kernels.values()))
    yield row


def run_shac(cache: str, directory: Path, arguments: list[str]) -> tuple[float, float]:
    """Seconds from the start of shac.py to its first iteration's end, and its peak memory in MiB."""
    command = [sys.executable, str(ROOT / "shac.py"), "--run-dir", str(directory), "--quiet", *arguments]
    start, first, ended = time.perf_counter(), None, 0
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"WARP_CACHE_PATH": cache})
    while not ended:
        ended, status, usage = os.wait4(process.pid, os.WNOHANG)
        if first is None and read_csv(directory / "progress.csv"):
            first = time.perf_counter() - start
        time.sleep(0.01)
    process.returncode = os.waitstatus_to_exitcode(status)
    if first is None or process.returncode:
        fail(f"{' '.join(command)} failed")
    return first, usage.ru_maxrss / (1024 if sys.platform == "linux" else 1024**2)


def measure_training(args: Args, name: TaskName) -> Iterator[Row]:
    techniques = {"cpu, 1 thread": ["--threads", "1"], "cpu, all cores": ["--threads", str(available_cores())]}
    if args.device != "cpu":
        techniques = {"cuda graph": [], "cuda, eager": ["--no-cuda-graph"]}
    for technique, flags in techniques.items():
        flags += ["--env", name, "--device", args.device, "--iterations", str(args.iterations + 1)]  # never evaluated
        flags += ["--eval-every", "0", "--save-every", "0", "--stop-after"]
        with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as runs:
            cold, _ = run_shac(cache, Path(runs) / "cold", [*flags, "1"])
            warm, memory = run_shac(cache, run := Path(runs) / "warm", [*flags, str(args.iterations)])
            progress = read_csv(run / "progress.csv")[3:]
            num_envs = json.loads((run / "args.json").read_text())["num_envs"]
        names = ("total", "update_critic", "sim_forward", "sim_backward")
        t = {n: 1e3 * median(float(row[f"time_{n}"]) for row in progress) for n in names if f"time_{n}" in progress[0]}
        whole, critic = t.pop("total"), t.pop("update_critic")
        row: dict[str, object] = {"task": name, "environments": num_envs, "device": technique, "iteration (ms)": whole}
        row |= {f"physics {kind}": t.get(f"sim_{kind}", "") for kind in ("forward", "backward")} | {"critic": critic}
        row["policy, task, loss"] = whole - critic - sum(t.values())  # and the physics on a GPU
        row |= {"start to first iteration (s)": warm, "peak memory (MiB)": memory}
        yield row | {"start with nothing compiled (s)": cold}


MEASURES: dict[Part, tuple[Callable[[Args, TaskName], Iterator[Row]], tuple[str, ...]]] = {
    "physics": (measure_physics, ("task", "environments", "precision", "device", "muscles")),
    "scaling": (measure_scaling, ("task", "environments", "horizon", "technique")),
    "training": (measure_training, ("task", "environments", "device")),
    "time": (measure_time, ("task",)),
    "kernels": (measure_kernels, ("task",)),
}


def main(args: Args) -> None:
    if args.device == "cpu" and not args.draw_only and ("kernels" in args.parts or "mujoco_warp" in args.compare):
        fail("--parts kernels and --compare mujoco_warp are of a GPU's graphs: give --device cuda")
    if "mujoco_warp" in args.compare and importlib.util.find_spec("mujoco_warp") is None:
        fail("--compare mujoco_warp needs it installed: pip install mujoco-warp")
    for part in args.parts:
        rows = measured(args, f"speed_{part}", *MEASURES[part])
        pages = {"cpu": "experiments.md", "h100": "experiments_gpu.md"} if part == "time" else {}
        args.publish(part, markdown(rows), pages)
        if part == "scaling" and rows:
            draw(args, rows)


if __name__ == "__main__":
    main(parse(Args, __doc__))
