"""What is installed and what is missing, without a command: tasks, devices, versions, hints about usual troubles."""

from __future__ import annotations

import os
import platform
import runpy
import shutil
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path

import torch
import tyro
import warp as wp
from tyro.conf import Positional

from diffsim import TASKS, SceneError, load_scene, startup
from diffsim.robot.report import report as report_robot
from diffsim.sim.launcher import available_cores
from diffsim.tasks import find_task
from diffsim.training import command, evaluate, export_onnx, export_policy, fail, load_policy, make_policy_env
from diffsim.view import render

POLICIES = files("diffsim") / "policies"
PACKAGE = Path(str(files("diffsim")))
LEARNERS = ("shac", "sapo", "bptt", "pods", "ppo_baseline", "sac_baseline", "mbpo", "pfpn", "pfpn_sac", "gps")
DEMO_EPISODES = 8  # the one of median return is filmed
DEMO_SECONDS = 4.0  # of it


@command
def main(argv: Sequence[str] | None = None) -> None:
    sys.argv[0] = "diffsim"  # in messages
    argv = sys.argv[1:] if argv is None else argv
    commands: dict[str, Callable[..., object]] = {
        each.__name__: each for each in (demo, drive, train, new, view, check, export)
    }
    match [*argv]:  # a script heeds its own flags and errors
        case ["view", *flags]:
            return run_script("view", flags)
        case ["train", learner, *flags] if not learner.startswith("-"):
            return run_script(known(learner), flags)
    try:
        if argv:
            tyro.extras.subcommand_cli_from_dict(commands, args=argv, prog="diffsim", description=__doc__)
        else:
            print(report())
    except BrokenPipeError:
        raise
    except (OSError, RuntimeError, ValueError) as error:
        fail(error)


def demo(task: Positional[str] = "ant", output: Path = Path("demo.mp4")) -> None:
    """Film a policy that comes with the package, as .mp4 or .gif; needs no display."""
    policy = shipped(find_task(task).name)
    render.check_video(output)
    render.check_opengl()
    torch.set_num_threads(1)
    saved = load_policy(policy)
    with startup.quick_kernels():
        env = make_policy_env(saved, DEMO_EPISODES)
        env.episode_length = min(env.episode_length, round(DEMO_SECONDS / env.control_dt))
        evaluation = evaluate(env, saved.network)
    which = f"{saved.script}.py, iteration {saved.iteration}"
    print(f"{task}, {which}, the first {DEMO_SECONDS:g} s of {DEMO_EPISODES} episodes: {evaluation}")
    print(f"video: {evaluation.save_video(output)}")


def shipped(task: str) -> Path:
    """The policy of a task that comes with the package."""
    there = [name for name in TASKS if (POLICIES / f"{name}.pt").is_file()]
    if task not in there:
        fail(f"no policy of {task} comes with this version; there are: {', '.join(there) or 'none'}")
    return Path(str(POLICIES / f"{task}.pt"))


def drive(
    robot: Positional[str] = "go2", checkpoint: Path | None = None, host: str = "127.0.0.1", port: int = 8080
) -> None:
    """Drive a robot from a page of your browser, with keys, a gamepad and the mouse; needs no display.

    Args:
        robot: a task whose policy comes with the package, or that of the checkpoint.
        checkpoint: of any script.
        host: where the page is served: 0.0.0.0 lets other machines drive, too.
        port: of the page; 0 takes a free one.
    """
    from diffsim.view.drive import KEYS, serve

    task = find_task(robot)
    if not issubclass(task, kinds := tuple(KEYS)):
        able = [name for name, each in TASKS.items() if issubclass(each, kinds)]
        fail(f"{robot} cannot be driven: choose from {', '.join(able)}")
    saved = load_policy(checkpoint or shipped(task.name))
    if (trained := find_task(saved.args["env"])) is not task:
        fail(f"{checkpoint} is a checkpoint of {trained.name}, not of {robot}")
    torch.set_num_threads(1)
    caption = f"{saved.script}.py, iteration {saved.iteration}"
    with startup.quick_kernels():
        serve(make_policy_env(saved, 1, forces=True), saved.network, caption, host, port)


def train(learner: Positional[str]) -> None:
    """Train with a learner of the package: diffsim train shac --env ant, and --help for its flags."""
    run_script(known(learner), [])


def view() -> None:
    """Show a run as video, page, window or plot: diffsim view runs/<run> --web ant.html, and --help for its flags."""


def new(learner: Positional[str], script: Positional[Path]) -> None:
    """Copy the one file of a learner, to edit: diffsim new shac my_shac.py; then python my_shac.py --env ant."""
    source = find_script(known(learner))
    if script.exists() or script.suffix != ".py":
        fail(f"{script} exists already" if script.exists() else f"{script}: a script ends in .py")
    with render.whole_file(script) as part:
        shutil.copyfile(source, part)
    print(f"{script}: a copy of {source.name}; python {script} --env ant trains with it")


def check(robot: Positional[Path]) -> None:
    """Say what of an MJCF file is used, approximated and refused; exit code 1 if it is refused."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the report has them all
            print(report_robot(load_scene(robot)))
    except SceneError as error:
        print(f"Cannot be simulated.\n\n{error}")
        sys.exit(1)


def export(checkpoint: Positional[Path], output: Positional[Path]) -> None:
    """Write the policy of a checkpoint alone: OUTPUT.pt for this package, or OUTPUT.onnx for other programs."""
    saved = load_policy(checkpoint)
    with render.whole_file(output) as part:
        if output.suffix == ".pt":
            export_policy(checkpoint, part)
        elif output.suffix == ".onnx":
            export_onnx(saved, make_policy_env(saved, 1), part)
        else:
            fail(f"cannot write {output}: its name must end in .pt or .onnx")
    size = output.stat().st_size / 1e3
    print(f"{output}: {saved.args['env']}, {saved.script}.py, iteration {saved.iteration}, {size:.0f} kB")


def known(learner: str) -> str:
    return learner if learner in LEARNERS else fail(f"unknown learner {learner!r}: choose from {', '.join(LEARNERS)}")


def find_script(name: str) -> Path:
    """A script of the repository: the wheel has them in the package, a clone beside it."""
    inside = PACKAGE / "learners"
    return (inside if inside.is_dir() else PACKAGE.parent) / f"{name}.py"


def run_script(name: str, flags: Sequence[str]) -> None:
    sys.argv[1:] = flags
    runpy.run_path(str(find_script(name)), run_name="__main__")


# The report -----------------------------------------------------------------------------------------------------------


def report() -> str:
    """All that a question about an installation needs, in some twenty lines."""
    machine = [f"{name:<10} {text}" for name, text in describe_machine().items()]
    blocks = describe_tasks(), machine, [f"! {hint}" for hint in find_troubles()]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def describe_tasks() -> list[str]:
    lines = [f"{'task':<18} {'obs':>4} {'act':>4}  {'episode':<18} {'substeps':>8}  demo"]
    for name, task in TASKS.items():
        scene = task.load_robot()
        episode = f"{task.episode_length} steps, {task.episode_length * task.control_dt:.1f} s"
        shipped = "yes" if (POLICIES / f"{name}.pt").is_file() else "-"
        lines.append(f"{name:<18} {task.obs_dim:>4} {scene.nu:>4}  {episode:<18} {task.substeps:>8}  {shipped}")
    return lines


def describe_machine() -> dict[str, str]:
    gpus = [torch.cuda.get_device_properties(k) for k in range(torch.cuda.device_count())]
    devices = [f"cuda:{k}, {gpu.name}, {gpu.total_memory / 2**30:.0f} GiB" for k, gpu in enumerate(gpus)]
    packages = ("torch", "warp-lang", "mujoco", "gymnasium", "numpy")
    try:
        drawing = render.check_opengl()
    except RuntimeError:
        drawing = "none"
    return {
        "diffsim": f"{_version('diffsim-rl')}, {files('diffsim')}",
        "versions": ", ".join([f"python {platform.python_version()}", *(f"{p} {_version(p)}" for p in packages)]),
        "devices": "; ".join([f"cpu, {available_cores()} cores", *devices]),
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
        return str(startup.check_kernel_cache())
    except ValueError:
        return "none"


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
