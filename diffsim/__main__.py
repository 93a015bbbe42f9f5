"""What is installed and what is missing; a demonstration; small copies of policies.

python -m diffsim                                  tasks, devices, versions, and hints about usual troubles
python -m diffsim demo [TASK] [--output FILE]      film a policy that comes with the package; needs no display
python -m diffsim check ROBOT.xml                  what of an MJCF file is used, approximated and refused
python -m diffsim export CHECKPOINT OUTPUT         the policy of a checkpoint alone, in a small file
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path

import torch
import warp as wp

from diffsim import TASKS, SceneError, load_scene, startup
from diffsim.robot.report import report as report_robot
from diffsim.sim.launcher import available_cores
from diffsim.training import command, evaluate, export_policy, fail, load_policy, make_policy_env
from diffsim.view import render

POLICIES = files("diffsim") / "policies"
DEMO_EPISODES = 8  # the one of median return is filmed
DEMO_SECONDS = 4.0  # of it


@command
def main(argv: Sequence[str] | None = None) -> None:
    sys.argv[0] = "diffsim"  # in messages
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m diffsim", description=__doc__, formatter_class=raw)
    commands = parser.add_subparsers(dest="command", metavar="{demo,check,export}")
    film = commands.add_parser("demo", help="film a policy that comes with the package")
    film.add_argument("task", nargs="?", default="ant", help="which task (default: ant)")
    film.add_argument("--output", type=Path, default=Path("demo.mp4"), help=".mp4 or .gif (default: demo.mp4)")
    robot = commands.add_parser("check", help="say what of an MJCF file is used, approximated and refused")
    robot.add_argument("robot", type=Path)
    copy = commands.add_parser("export", help="write the policy of a checkpoint alone")
    copy.add_argument("checkpoint", type=Path)
    copy.add_argument("output", type=Path)
    args = parser.parse_args(argv)
    try:
        if args.command == "demo":
            demo(args.task, args.output)
        elif args.command == "check":
            check(args.robot)
        elif args.command == "export":
            export(args.checkpoint, args.output)
        else:
            print(report())
        sys.stdout.flush()
    except BrokenPipeError:  # head, for one, has read enough; Python would complain once more when it ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, RuntimeError, ValueError) as error:
        fail(error)


def demo(task: str, output: Path) -> None:
    """Film the task's policy; the kernel of the gradient is not compiled, for nothing is differentiated."""
    if task not in TASKS:
        fail(f"unknown task {task!r}: choose from {', '.join(TASKS)}")
    policy = POLICIES / f"{task}.pt"
    if not policy.is_file():
        there = [name for name in TASKS if (POLICIES / f"{name}.pt").is_file()]
        fail(f"no policy of {task} comes with this version; there are: {', '.join(there) or 'none'}")
    render.check_video(output)
    render.check_opengl()
    torch.set_num_threads(1)
    saved = load_policy(Path(str(policy)))
    evaluation = evaluate(make_policy_env(saved, DEMO_EPISODES), saved.network)
    print(f"{task}, {saved.script}.py, iteration {saved.iteration}, {DEMO_EPISODES} episodes: {evaluation}")
    print(f"video: {evaluation.save_video(output, DEMO_SECONDS)}")


def check(robot: Path) -> None:
    """Print what the simulator makes of an MJCF file; exit code 1 if it refuses the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the report has them all
            print(report_robot(load_scene(robot)))
    except SceneError as error:
        print(f"Cannot be simulated.\n\n{error}")
        sys.exit(1)


def export(checkpoint: Path, output: Path) -> None:
    """Write the policy of a checkpoint alone; an existing file is replaced, anything else is refused."""
    with render.whole_file(output) as part:
        export_policy(checkpoint, part)
    saved = load_policy(output)
    size = output.stat().st_size / 1e3
    print(f"{output}: {saved.args['env']}, {saved.script}.py, iteration {saved.iteration}, {size:.0f} kB")


# The report -----------------------------------------------------------------------------------------------------------


def report() -> str:
    """All that a question about an installation needs, in some twenty lines."""
    machine = [f"{name:<10} {text}" for name, text in describe_machine().items()]
    blocks = describe_tasks(), machine, [f"! {hint}" for hint in find_troubles()]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def describe_tasks() -> list[str]:
    lines = [f"{'task':<18} {'obs':>4} {'act':>4}  {'episode':<18} {'substeps':>8}  demo"]
    for name, task in TASKS.items():
        scene = load_scene(str(files("diffsim") / "assets" / task.asset))
        episode = f"{task.episode_length} steps, {task.episode_length * task.control_dt:.1f} s"
        shipped = "yes" if (POLICIES / f"{name}.pt").is_file() else "-"
        lines.append(f"{name:<18} {task.obs_dim:>4} {scene.nu:>4}  {episode:<18} {task.substeps:>8}  {shipped}")
    return lines


def describe_machine() -> dict[str, str]:
    devices = [f"cpu, {available_cores()} cores"]
    for k in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(k)
        devices.append(f"cuda:{k}, {properties.name}, {properties.total_memory / 2**30:.0f} GiB")
    packages = ("torch", "warp-lang", "mujoco", "gymnasium", "numpy")
    try:
        drawing = render.check_opengl()
    except RuntimeError:
        drawing = "none"
    return {
        "diffsim": f"{_version('diffsim')}, {files('diffsim')}",
        "versions": ", ".join([f"python {platform.python_version()}", *(f"{p} {_version(p)}" for p in packages)]),
        "devices": "; ".join(devices),
        "kernels": _kernel_cache(),
        "OpenGL": drawing,
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "(not installed)"


def _kernel_cache() -> str:
    try:
        folder = startup.check_kernel_cache()
    except ValueError:
        return "none"
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    kernels = sum(1 for path in folder.iterdir() if path.is_dir())
    return f"{folder}, {kernels} kernels, {sum(sizes) / 1e6:.0f} MB"


def find_troubles() -> list[str]:
    """What is likely to disappoint on this machine, each with its remedy."""
    hints = []
    driver = startup.nvidia_driver() or shutil.which("nvidia-smi") is not None
    if driver and not torch.cuda.is_available():
        if torch.version.cuda is None:
            hints.append("this torch is a build for the CPU: see https://pytorch.org/get-started for one with CUDA")
        elif "CUDA_VISIBLE_DEVICES" in os.environ:
            shown = os.environ["CUDA_VISIBLE_DEVICES"]
            hints.append(f"torch sees no GPU with CUDA_VISIBLE_DEVICES={shown!r}: unset it")
        else:
            hints.append(f"torch sees no GPU: the driver may be older than CUDA {torch.version.cuda}, see nvidia-smi")
    elif torch.cuda.is_available() and not wp.is_cuda_available():
        hints.append("torch sees a GPU and Warp does not: the driver is too old for Warp, see nvidia-smi")
    for works in (startup.check_kernel_cache, render.check_opengl, lambda: render.check_video("demo.mp4")):
        try:
            works()
        except (RuntimeError, ValueError) as error:
            hints.append(str(error))
    return hints


if __name__ == "__main__":
    main()
