"""How fast the simulator and a whole SHAC iteration are, against MuJoCo's C step on the same model in the same run.

    python benchmarks/speed.py                                every task, 64 and 256 environments
    python benchmarks/speed.py --device cuda                  on a GPU: as CUDA graphs and operation by operation
    python benchmarks/speed.py --parts scaling --env ant      cost against environments (64 to 65,536) and horizon
    python benchmarks/speed.py --parts time --env cartpole ant humanoid    the SHAC paper's Table 12
    python benchmarks/speed.py --parts contact                an iteration of SHAC on soft and on firm ground
    python benchmarks/speed.py --parts policies --env ant     an iteration of pfpn.py with each policy
    python benchmarks/speed.py --parts scene                  links, spheres, limits, dampers, springs, balls, muscles

Prints markdown tables and writes their rows to speed_*.csv, in place of older rows of the same setting, and speed.png.
A machine that does something else meanwhile gives wrong numbers.
"""

from __future__ import annotations

import dataclasses
import gc
import importlib.util
import json
import math
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
from typing import Literal, TypeVar, get_args

import mujoco
import numpy as np
import torch
from common import CommonFlags, Line, Panel, TaskName, measured, parse, plot
from motions import CONTROL_DT, idle, integration, shac, simulator
from tables import ROOT, Row, markdown, read_csv

import diffsim
from diffsim import Scene, Simulator
from diffsim.kernels.lanes import divide
from diffsim.sim.launcher import available_cores
from diffsim.tasks import Contact
from diffsim.training import Count, fail, graph
from diffsim.training import parse as parse_script
from diffsim.training.assess import make_env

sys.path.append(str(ROOT))
import pfpn  # noqa: E402

SETTING = integration("semi_implicit", 16)
LINKS = 16  # of the chain to which everything but links is added
PARTS = {  # counts, the feature that is code of its own, and what gives it to a joint, without a force
    "link": ((4, 8, 16, 32), "", ""),
    "sphere in the air": ((1, 4, 8, 16, 32), "contact", ""),
    "sphere in the ground": ((1, 4, 8, 16, 32), "", ""),
    "limit": ((1, 4, 8, 16), "limit", 'range="-2 2" limited="true"'),
    "damper": ((1, 4, 8, 16), "damping", 'damping="1e-300"'),
    "spring": ((1, 4, 8, 16), "stiffness", 'stiffness="1e-300"'),
    "ball joint": ((1, 4, 8, 15), "", 'type="ball"'),
    "muscle": ((1, 4, 8, 15), "muscle", ""),
}
MUSCLE = (  # from a link to the next
    '<spatial name="t{0}"> <site site="s{0}"/> <site site="s{1}"/> </spatial>',
    '<general tendon="t{0}" gainprm="-10" ctrllimited="true" ctrlrange="0 1"/>',
)
Precision = Literal["float32", "float64"]
DTYPES: dict[Precision, torch.dtype] = {"float32": torch.float32, "float64": torch.float64}
Part = Literal["physics", "scaling", "training", "time", "contact", "policies", "scene"]
MAX_MEMORY = 40 * 2**30  # of a setting's checkpoints; larger settings of the scaling table are left out
TABLE_12 = {"cartpole": (0.15, 0.23, 0.34), "ant": (0.25, 0.37, 0.32), "humanoid": (0.91, 1.97, 0.32)}  # on a TITAN X


@dataclass
class Args(CommonFlags):
    parts: tuple[Part, ...] = ("physics", "training")  # tables to measure
    num_envs: tuple[Count, ...] = (64, 256)  # batch sizes of the physics table (training uses the task's own)
    scaling: tuple[Count, ...] = (64, 256, 1024, 4096, 16384, 65536)  # those of the scaling table, at a horizon of 32
    horizons: tuple[Count, ...] = (1, 4, 8, 16, 32, 64, 128)  # horizons of the scaling table, at 64 environments
    dtype: tuple[Precision, ...] = ("float32", "float64")  # precisions of the physics table
    states: Count = 9  # states of random motion in which a control step is timed; the median over them counts
    repeats: Count = 5  # turns of all competitors in each state; the fastest counts, the others were disturbed
    iterations: Count = 27  # SHAC iterations of the training table, after three that are not counted


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
    """With all models of its muscles if a task has any, and without; beside MuJoCo, and mujoco_warp if installed."""
    threads = {"cpu, 1 thread": 1, "cpu, all cores": available_cores()} if args.device == "cpu" else {args.device: 1}
    default, whole = diffsim.TASKS[name].integration("default"), diffsim.make(name, num_envs=1).scene
    scenes = {"": whole}
    if "muscle" in whole.features:
        scenes = {model: dataclasses.replace(whole, muscle_model=model) for model in ("linear", "hill")}
        scenes["none"] = whole.without("muscle")
    for num_envs in args.num_envs:
        key, shape = ("", "", ""), (whole, num_envs, default.substeps)
        competitors = {key: mujoco_timer(*shape)}
        if beside := args.device != "cpu" and importlib.util.find_spec("mujoco_warp") is not None:
            competitors["", "", "warp"] = mujoco_warp_timer(args.device, *shape)
        for (muscles, scene), dtype, (place, count) in product(scenes.items(), args.dtype, threads.items()):
            sim = simulator(scene, default, num_envs, DTYPES[dtype], device=args.device, threads=count)
            competitors[muscles, dtype, place] = timer(sim)
        states, per_substep = random_states(name, num_envs, args.states + 1), num_envs * default.substeps
        race(competitors, states[:1], 1)  # compiles and fills caches
        times = race(competitors, states[1:], args.repeats)
        mj = times.pop(key)["mj_step"] / per_substep
        warp = times.pop(("", "", "warp"))["mj_step"] / per_substep if beside else ""
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
    row: dict[str, object] = {"task": name, "environments": settings.num_envs, "forward, ms": first}
    row |= {"backward, ms": both - first, "critic, ms": critic}
    published = dict(zip(("forward", "backward", "critic"), TABLE_12.get(name, ()), strict=False))
    yield row | {f"published {part}, s (TITAN X)": value for part, value in published.items()}


def measure_contact(args: Args, name: TaskName) -> Iterator[Row]:
    """An iteration of SHAC on soft and on firm ground, each half captured and timed alone."""
    if not hasattr(diffsim.TASKS[name], "firm"):
        return
    times = dict[str, float]()
    for contact in get_args(Contact):
        settings = parse_script(shac.Args, ["--env", name, "--device", args.device, "--contact", contact])
        env = make_env(settings, settings.num_envs, settings.horizon, factors=contact == "firm")
        learner = shac.SHAC(settings, env)
        halves = (learner.update_actor, env), (learner.update_critic, None)
        calls = [graph.capture(half, env.device, stepped) for half, stepped in halves]
        times[contact] = sum(1e3 * median(timed(call, env.device, warmup=4, calls=20)) for call in calls)
    row: dict[str, object] = {"task": name, "environments": settings.num_envs}
    row |= {f"{contact}, ms": ms for contact, ms in times.items()}
    yield row | {"firm / soft": times["firm"] / times["soft"]}


def measure_policies(args: Args, name: TaskName) -> Iterator[Row]:
    """An iteration of pfpn.py with each policy, each half captured and timed alone, beside a Gaussian's."""
    for algorithm, learner_class in pfpn.ALGORITHMS.items():
        policies = ("gaussian", "pfpn", "gmm", *(["discrete"] if algorithm == "ppo" else []))
        gaussian = math.nan
        for policy in policies:
            flags = ["--env", name, "--device", args.device, "--algorithm", algorithm, "--policy", policy]
            settings = parse_script(pfpn.Args, flags)
            gc.collect()  # the policy before
            if args.device != "cpu":
                torch.cuda.reset_peak_memory_stats()
            env = make_env(settings, settings.num_envs, settings.horizon)
            learner = learner_class(settings, env)
            calls = [graph.capture(learner.interact, env.device, env), graph.capture(learner.learn, env.device)]
            ms = sum(1e3 * median(timed(call, env.device, warmup=4, calls=20)) for call in calls)
            gaussian = ms if policy == "gaussian" else gaussian
            row: dict[str, object] = {"task": name, "algorithm": algorithm, "policy": policy}
            row |= {"environments": settings.num_envs, "iteration, ms": ms, "of the Gaussian's": ms / gaussian}
            memory = torch.cuda.max_memory_allocated() / 2**20 if args.device != "cpu" else ""
            yield row | {"torch's peak memory, MiB": memory}


def run_shac(cache: str, directory: Path, arguments: list[str]) -> tuple[float, float]:
    """Seconds from the start of shac.py to the end of its first iteration, and its peak memory in MiB."""
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
        flags += ["--env", name, "--device", args.device, "--iterations", str(args.iterations + 4)]  # never evaluated
        flags += ["--eval-every", "0", "--save-every", "0", "--stop-after"]
        with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as runs:
            cold, _ = run_shac(cache, Path(runs) / "cold", [*flags, "1"])
            warm, memory = run_shac(cache, run := Path(runs) / "warm", [*flags, str(args.iterations + 3)])
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


def chain(links: int, what: str, count: int) -> Scene:
    """A floating chain with `count` of `what`."""
    text = ""
    for k in range(links):
        first = 1 if what == "ball joint" else 0
        extra = PARTS[what][2] if first <= k < count + first else ""
        joint = f'<joint axis="0 {k % 2} {1 - k % 2}" {extra}/>' if k else "<freejoint/>"
        spheres = range(len(range(k, count, links)) if what.startswith("sphere") else 0)
        geoms = '<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.04" contype="0" conaffinity="0"/>'
        geoms += "".join(f'<geom type="sphere" size="0.05" pos="{0.03 * s} 0 0"/>' for s in spheres)
        text += f'<body pos="{0.2 if k else 0} 0 0">{joint}{geoms}<site name="s{k}" pos="0.1 0 0.04"/>'
    text = f'<worldbody><geom type="plane" size="1 1 1"/>{text}{"</body>" * links}</worldbody>'
    if what == "muscle":
        tendons, motors = ("".join(part.format(k, k + 1) for k in range(count)) for part in MUSCLE)
        text += f"<tendon>{tendons}</tendon><actuator>{motors}</actuator>"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.xml"
        path.write_text(f'<mujoco><compiler angle="radian"/>{text}</mujoco>')
        return diffsim.load_scene(path)


def chain_states(scene: Scene, num_envs: int, height: float) -> State:
    generator = torch.Generator().manual_seed(0)
    shapes = ((num_envs, width) for width in (scene.nq, scene.nv))
    qpos, qvel = (0.1 * torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes)
    qpos[:, 2], qpos[:, 3] = height, 1.0
    qpos[:, scene.qpos_adr[scene.ball == 0]] = 1.0
    return qpos, qvel, idle(scene).repeat(num_envs, 1)


def difference(scene: Scene, feature: str) -> float:
    """Largest over the state after a control step and its gradient, relative to each one's largest entry."""
    results = []
    for one in (scene, scene.without(feature)):
        leaves = [x.clone().requires_grad_() for x in chain_states(one, 4, 5.0)]
        q, v = simulator(one, SETTING, 4, torch.float64).step(*leaves)
        results.append([q, v, *torch.autograd.grad(q.square().sum() + v.square().sum(), leaves[:2])])
    return max(((a - b).abs().max() / a.abs().max()).item() for a, b in zip(*results, strict=True))


def measure_scene(args: Args) -> Iterator[Row]:
    """What each part of a scene costs, added to a floating chain of hinges; a ball joint stands in a hinge's place."""
    for what, (counts, feature, _) in PARTS.items():
        for count in counts:
            scene, num_envs = chain(count if what == "link" else LINKS, what, count), args.num_envs[-1]
            threads = 1 if args.device == "cpu" else None
            sim = simulator(scene, SETTING, num_envs, device=args.device, threads=threads)
            state = chain_states(scene, num_envs, 0.0 if what == "sphere in the ground" else 5.0)
            t = race({0: timer(sim)}, [state], 6 * args.repeats)[0]
            row: dict[str, object] = {"of": what, "count": count, "environments": num_envs}
            row |= {f"{kind} (us/substep)": t[kind] / num_envs / SETTING.substeps for kind in ("forward", "backward")}
            yield row | {"left out": difference(scene, feature) if feature and count == counts[-1] else ""}


def report_scene(args: Args) -> None:
    """The cost of each part as a line in its count: the slope is the cost of one, R^2 says how straight it is."""
    new = [] if args.draw_only else list(measure_scene(args))
    rows = args.merge("scene_cost", new, ("of", "count", "environments"))
    lines, panels = list[Row](), list[Panel]()
    rows = [row for row in rows if row["environments"] == str(args.num_envs[-1])]
    for what in PARTS if rows else ():
        found = [row for row in rows if row["of"] == what]
        line: dict[str, object] = {"of": what, "counts": " ".join(row["count"] for row in found)}
        curves = list[Line]()
        for k, kind in enumerate(("forward", "backward")):
            x, y = (np.array([float(row[c]) for row in found]) for c in ("count", f"{kind} (us/substep)"))
            slope, start = np.polyfit(x, y, 1)
            line[f"{kind}: one (ns/substep)"] = f"{1e3 * slope:.3g}"
            line[f"{kind}: none (ns/substep)"] = f"{1e3 * start:.3g}"
            line[f"{kind}: R^2"] = f"{1 - ((y - slope * x - start) ** 2).sum() / ((y - y.mean()) ** 2).sum():.3f}"
            curves.append(Line(x, y, f"C{k}o-", kind))
        lines.append(line | {"left out": found[-1]["left out"]})
        panels.append(Panel(curves, what, "", "" if panels else "us per environment-substep", zero=True))
    args.publish("scene_cost", markdown(lines), "accuracy.md")
    plot(args.picture("scene_cost"), [panels], (2.6, 2.8))


MEASURES: dict[str, tuple[Callable[[Args, TaskName], Iterator[Row]], tuple[str, ...]]] = {
    "physics": (measure_physics, ("task", "environments", "precision", "device", "muscles")),
    "scaling": (measure_scaling, ("task", "environments", "horizon", "technique")),
    "training": (measure_training, ("task", "environments", "device")),
    "time": (measure_time, ("task",)),
    "contact": (measure_contact, ("task",)),
    "policies": (measure_policies, ("task", "algorithm", "policy")),
}
PAGES: dict[Part, str] = {"contact": "transfer.md", "policies": "pfpn.md"}


def main(args: Args) -> None:
    if "scene" in args.parts:
        report_scene(args)
    for part in (part for part in args.parts if part != "scene"):
        rows = measured(args, "time" if part == "time" else f"speed_{part}", *MEASURES[part])
        args.publish(part, markdown(rows), PAGES.get(part, "experiments.md"))
        if part == "scaling" and rows:
            draw(args, rows)


if __name__ == "__main__":
    main(parse(Args, __doc__))
