"""Without a command: tasks, devices and versions, what is missing, and hints."""

from __future__ import annotations

import functools
import os
import platform
import runpy
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import distributions, version
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import torch
import tyro
import warp as wp
from tyro.conf import Positional

from diffsim import TASKS, SceneError, load_scene, startup
from diffsim.robot.constants import check_soft, constrained
from diffsim.sim.launcher import available_cores
from diffsim.tasks import Contact, base_name, find_task
from diffsim.training import command, evaluate, fail, load_policy
from diffsim.training.checkpoint import POLICIES
from diffsim.training.errors import in_one_line
from diffsim_cli import render
from diffsim_cli.export import export_onnx, export_policy
from diffsim_cli.report import report as report_robot
from diffsim_cli.report import steps_beside_mujoco
from diffsim_cli.tune import tune
from diffsim_cli.view import main as film
from diffsim_cli.watch import film_median, make_policy_env

PACKAGE = Path(str(files("diffsim_cli")))
LEARNER = "\nmain = script("  # a script that has this line is one
DEMO_EPISODES = 8  # the one of median return is filmed
DEMO_SECONDS = 4.0  # of it


def find_scripts(folder: Path) -> dict[str, Path]:
    """Find the learners in a folder."""
    paths = sorted(folder.glob("*.py"))
    return {path.stem: path for path in paths if LEARNER in path.read_text(errors="ignore")}


def find_learners() -> dict[str, Path]:
    """Find the learners that diffsim brings: a wheel has them in this package, a clone next to it."""
    home = inside if (inside := PACKAGE / "learners").is_dir() else PACKAGE.parent
    return dict(sorted((find_scripts(home) | find_scripts(home / "baselines")).items()))


@command
def main(argv: Sequence[str] | None = None) -> None:
    sys.argv[0] = "diffsim"  # in messages
    argv = sys.argv[1:] if argv is None else argv
    commands = {each.__name__: _later(each) for each in (demo, drive, train, view, check, tune, export)}
    match [*argv]:  # these heed their own flags and errors
        case ["view", *flags]:
            return film(flags)
        case ["train", learner, *flags] if not learner.startswith("-"):
            return run_learner(learner, flags)
    try:
        if argv:
            with in_one_line(argv):
                call = tyro.extras.subcommand_cli_from_dict(commands, args=argv, prog="diffsim", description=__doc__)
            call()
        else:
            print(report())
    except BrokenPipeError:
        raise
    except (OSError, RuntimeError, ValueError) as error:
        fail(error)


def _later(function: Callable[..., object]) -> Callable[..., Callable[[], object]]:
    """Return a function of the same signature that returns the call, to be made."""
    return functools.wraps(function)(lambda *args, **kwargs: functools.partial(function, *args, **kwargs))


def demo(task: Positional[str] = "ant", output: Path = Path("demo.mp4")) -> None:
    """Film a shipped policy; needs no display.

    Args:
        task: one whose policy is shipped: `diffsim` lists them.
        output: video to write, .mp4 or .gif.
    """
    policy = shipped(find_task(task).name)
    render.check_video(output)
    render.check_opengl()
    torch.set_num_threads(1)
    saved = load_policy(policy)
    with quick_kernels():
        env = make_policy_env(saved, DEMO_EPISODES)
        env.episode_length = min(env.episode_length, round(DEMO_SECONDS / env.control_dt))
        evaluation = evaluate(env, saved.network)
    print(f"{task}, {saved}, the first {DEMO_SECONDS:g} s of {DEMO_EPISODES} episodes: {evaluation}")
    print(f"video: {film_median(evaluation, output)}")


@contextmanager
def quick_kernels() -> Iterator[None]:
    """Compile in half the time kernels that run at a fifth of the speed."""
    config = wp.config
    before = config.optimization_level, config.use_precompiled_headers
    config.optimization_level, config.use_precompiled_headers = 0, False  # headers are compiled for several modules
    try:
        yield
    finally:
        config.optimization_level, config.use_precompiled_headers = before


def shipped_tasks() -> list[str]:
    return [name for name in TASKS if (POLICIES / f"{name}.pt").is_file()]


def shipped(task: str) -> Path:
    """The shipped policy of a task."""
    if task not in (there := shipped_tasks()):
        fail(f"no policy for {task} is shipped; there are: {', '.join(there) or 'none'}")
    return POLICIES / f"{task}.pt"


def drive(
    robot: Positional[str] = "go2", checkpoint: Path | None = None, host: str = "127.0.0.1", port: int = 8080
) -> None:
    """Watch or drive a robot in your browser with keys, a gamepad and the mouse; needs no display.

    Args:
        robot: a task, or a file with your own, my_task.py.
        checkpoint: policy of any script. Default: the one that is shipped.
        host: address of the page; 0.0.0.0 lets other machines drive, too.
        port: port of the page; 0 takes a free one.
    """
    from diffsim_cli.drive.serve import serve

    task = find_task(robot)
    saved = load_policy(checkpoint or shipped(task.name))
    own = None if robot == task.name else robot  # a file, or a task with options
    if own is None and (trained := base_name(saved.task())) != task.name:
        fail(f"{checkpoint} is a checkpoint of {trained}, not of {robot}")
    torch.set_num_threads(1)
    with quick_kernels():
        serve(make_policy_env(saved, 1, forces=True, env=own), saved.network, str(saved), host, port)


def train(learner: Annotated[Positional[str], tyro.conf.arg(metavar=f"{{{','.join(find_learners())}}}")]) -> None:
    """Train a policy, e.g. diffsim train shac --env ant; `diffsim train shac --help` lists the learner's flags.

    Args:
        learner: the algorithm, or a script of your own in the current folder.
    """


def view() -> None:
    """Film a run, e.g. diffsim view runs/<run> --video ant.mp4."""


def check(robot: Positional[Path], contact: Contact = "mujoco") -> None:
    """List what of an MJCF file is simulated, approximated and refused; the exit code is 1 if it is refused.

    Args:
        robot: MJCF file.
        contact: contact model of your task; soft needs constants in the file.
    """
    if robot.suffix == ".py":
        fail(f"{robot} is code: check reads the MJCF file of the task's robot, its asset")
    try:
        scene = load_scene(robot)
        check_soft(scene) if contact == "soft" else constrained(scene, 1e-3)
        print(report_robot(scene))
        if contact == "mujoco" and 0 < scene.mj_model.opt.timestep < float("inf"):
            print(f"\n{steps_beside_mujoco(scene)}")
    except SceneError as error:
        print(f"Cannot be simulated.\n\n{error}")
        sys.exit(1)


def export(checkpoint: Positional[Path], output: Positional[Path], env: str | None = None, half: bool = False) -> None:
    """Write only the policy of a checkpoint, for diffsim (.pt) or for other programs (.onnx).

    Args:
        checkpoint: checkpoint of any script.
        output: file to write, which ends in .pt or .onnx.
        env: file of your own task, for .onnx; its code runs.
        half: round the weights of a .pt file to 16 bits, which halves its size.
    """
    saved = load_policy(checkpoint)
    with render.whole_file(output) as part:
        if output.suffix == ".pt":
            export_policy(checkpoint, part, half)
        elif output.suffix == ".onnx":
            export_onnx(saved, make_policy_env(saved, 1, env=env), part)
        else:
            fail(f"cannot write {output}: its name must end in .pt or .onnx")
    size = output.stat().st_size / 1e3
    print(f"{output}: {saved.args['env']}, {saved}, {size:.0f} kB")


def run_learner(name: str, flags: Sequence[str]) -> None:
    """Run a learner's script: one in the current folder comes before those that diffsim brings."""
    own, brought = find_scripts(Path.cwd()), find_learners()
    path = (brought | own).get(name.removesuffix(".py"))
    if path is None:
        here = f", or a script of the current folder ({', '.join(own)})" if own.keys() - brought.keys() else ""
        fail(f"unknown learner {name!r}: choose from {', '.join(brought)}{here}")
    sys.argv[1:] = flags
    runpy.run_path(str(path), run_name="__main__")


# The report -----------------------------------------------------------------------------------------------------------


def report() -> str:
    """All that a question about an installation needs, in some twenty lines."""
    hints, machine = find_gpu_troubles(), describe_machine()
    needed: dict[str, Callable[[], object]] = {"kernels": startup.check_kernel_cache, "OpenGL": render.check_opengl}
    for name, works in (needed | {"videos": lambda: render.check_video("demo.mp4").suffix}).items():
        try:
            machine[name] = str(works())
        except (RuntimeError, ValueError) as error:
            machine[name] = "none"
            hints.append(str(error))
    return "\n".join([*(f"{name:<10} {text}" for name, text in machine.items()), *(f"! {hint}" for hint in hints)])


def describe_machine() -> dict[str, str]:
    gpus = [torch.cuda.get_device_properties(k) for k in range(torch.cuda.device_count())]
    devices = [f"cuda:{k}, {gpu.name}, {gpu.total_memory / 2**30:.0f} GiB" for k, gpu in enumerate(gpus)]
    packages = [f"{name} {version(name)}" for name in ("torch", "warp-lang", "mujoco", "gymnasium", "numpy")]
    own = [each.version for each in distributions(name="diffsim-rl")] or ["(not installed)"]
    return {
        "diffsim": f"{own[0]}, {PACKAGE.parent}",
        "versions": ", ".join([f"python {platform.python_version()}", *packages]),
        "devices": "; ".join([f"cpu, {available_cores()} cores", *devices]),
        "tasks": ", ".join(TASKS),
        "policies": ", ".join(shipped_tasks()),
    }


def find_gpu_troubles() -> list[str]:
    """Say what to look at on a machine that has a driver where torch or Warp sees no GPU."""
    sees = {"torch": torch.cuda.is_available(), "Warp": wp.is_cuda_available()}
    if all(sees.values()) or not (startup.nvidia_driver() or shutil.which("nvidia-smi")):
        return []
    blind = " and ".join(name for name, there in sees.items() if not there)
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    about = f"torch is built for CUDA {torch.version.cuda}, CUDA_VISIBLE_DEVICES is {shown}"
    return [f"a driver, but no GPU for {blind}: {about}; see nvidia-smi and https://pytorch.org/get-started"]


if __name__ == "__main__":
    main()
