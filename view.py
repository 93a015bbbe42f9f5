"""Show the policy of any script's checkpoint: as a video, as a web page, or in a window, where it can be pushed.

    python view.py runs/<run>/checkpoint.pt --video ant.mp4     a file for a talk or a web site; .gif as well
    python view.py runs/<run> --web ant.html                    one page for any browser, without network access
    python view.py runs/<run> --viewer                          MuJoCo's window; this simulator moves the robot
    python view.py runs/* --plot curves.png                     return against control steps and seconds

Video and page show the beginning of the median one of several episodes.

In the window, double-click a body, then drag with ctrl and the right mouse button to pull it. Arrow keys push the robot
by 1 m/s; minus and equals change the speed; space pauses; enter starts a new episode.
"""

from __future__ import annotations

import copy
import csv
import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from diffsim import DiffEnv
from diffsim.training import SavedPolicy, command, describe, evaluate, fail, load_policy, make_policy_env
from diffsim.training.evaluation import SEED
from diffsim.view import render, web

ROBOT = 1  # MuJoCo's first body after the world
SPEEDS = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0)
PUSH = 1.0  # m/s, of the whole robot
MAX_PULL = 2.0  # of the mouse, in weights of the robot
PUSHES = {262: (1, 0, 0), 263: (-1, 0, 0), 264: (0, -1, 0), 265: (0, 1, 0)}  # keys of GLFW: right, left, down, up
SPACE, ENTER, MINUS, EQUALS = 32, 257, 45, 61


@dataclass
class Args:
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CHECKPOINT")]
    """checkpoint of any script, or the directory of its run; several with --plot"""
    video: Path | None = None
    """write a video: .mp4 or .gif"""
    web: Path | None = None
    """write a page that plays the motion in a browser: .html"""
    viewer: bool = False
    """open MuJoCo's window and simulate there in real time"""
    plot: Path | None = None
    """draw the progress.csv of the runs: .png, .svg or .pdf"""
    seconds: float = render.VIDEO_SECONDS
    """how much of an episode video and page show"""
    episodes: int = 8
    """of as many episodes they show the one of median return"""
    seed: int = SEED
    """of the start states"""
    substeps: int | None = None
    """simulation steps per control step instead of those of the training"""
    size: tuple[int, int] = (640, 480)
    """width and height of the video in pixels, multiples of 16"""

    def check(self) -> None:
        """End with one line where the machine or the arguments forbid what is asked for, before any work."""
        if not (self.video or self.web or self.viewer or self.plot):
            fail("nothing to show: give --video, --web, --viewer or --plot")
        if not self.paths:
            fail("of what? give a checkpoint or the directory of a run")
        if min(self.episodes, *self.size, self.substeps or 1) <= 0 or not 0 < self.seconds < math.inf:
            fail("--seconds, --episodes, --substeps and --size must be positive")
        if len(self.paths) > 1 and (self.video or self.web or self.viewer):
            fail("--video, --web and --viewer show one checkpoint; several are for --plot")
        if self.viewer and (self.video or self.web):
            fail("--viewer goes without --video and --web")
        try:
            if self.video:
                render.check_video(self.video, self.size)
                render.check_opengl()
        except (ValueError, RuntimeError) as error:
            fail(f"--video: {error}")
        if self.web and self.web.suffix != ".html":
            fail(f"--web: a page ends in .html, not {self.web.suffix!r}")
        if self.viewer:
            try:
                render.check_display()
            except RuntimeError as error:
                fail(f"--viewer: {error}; --web and --video need none")


@command
def main(argv: Sequence[str] | None = None) -> None:
    config = (tyro.conf.FlagCreatePairsOff,)
    args = tyro.cli(Args, args=argv, description=__doc__, config=config)
    args.check()
    try:
        if args.plot:
            plot([path if path.is_dir() else path.parent for path in args.paths], args.plot)
        if args.video or args.web or args.viewer:
            path = args.paths[0]
            show(load_policy(path / "checkpoint.pt" if path.is_dir() else path), args)
    except (OSError, RuntimeError, ValueError) as error:
        fail(error)


def show(saved: SavedPolicy, args: Args) -> None:
    torch.set_num_threads(1)  # operations this small gain nothing from more
    changes = {} if args.substeps is None else {"substeps": args.substeps}
    name = f"{saved.args['env']}, {saved.script}.py, iteration {saved.iteration}"
    if args.video or args.web:
        env = make_policy_env(saved, args.episodes, **changes)
        evaluation = evaluate(env, saved.network, args.seed)
        print(f"{name}, {args.episodes} episodes: {evaluation}")
        if gait := describe(evaluation):
            print(f"gait: {gait}")
        qpos, action = evaluation.median_episode(args.seconds)
        motion = env.scene, qpos, env.control_dt, action
        if args.video:
            print(f"video: {render.film(args.video, *motion, args.size)}")
        if args.web:
            caption = f"{saved.script}.py, iteration {saved.iteration}\nreturn {evaluation.returns.median():.1f}"
            print(f"page: {web.write_page(args.web, *motion, title=saved.args['env'], caption=caption)}")
    if args.viewer:
        print(name, (__doc__ or "").rstrip().rpartition("\n\n")[2], sep="\n")
        Window(make_policy_env(saved, 1, **changes), saved.network, args.seed).run()


# The window -----------------------------------------------------------------------------------------------------------


class Window:
    """MuJoCo's window on an environment of this simulator, which takes a control step for each picture."""

    def __init__(self, env: DiffEnv, policy: torch.nn.Module, seed: int) -> None:
        self.env, self.policy = env, policy
        self.model = copy.copy(env.scene.mj_model)
        if render.check_display():
            render.lower_quality(self.model)
        self.data = mujoco.MjData(self.model)
        self.obs, _ = env.reset(seed=seed)
        self.action = torch.zeros(1, env.scene.nu)
        self.speed, self.paused = 1.0, False
        self.keys: deque[int] = deque()  # pressed, not yet heeded

    @torch.no_grad()
    def run(self) -> None:
        """Until it is closed."""
        import mujoco.viewer

        self.copy_state()
        others = set(threading.enumerate())
        options = dict(key_callback=self.keys.append, show_left_ui=False, show_right_ui=False)
        with mujoco.viewer.launch_passive(self.model, self.data, **options) as window:
            camera, orbit = window.cam, web.orbit(self.model)
            camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, ROBOT
            camera.azimuth, camera.elevation = math.degrees(orbit["yaw"]) + 180, -math.degrees(orbit["pitch"])
            camera.distance = orbit["distance"]
            due = time.perf_counter()
            while window.is_running():
                with window.lock():
                    pushes = self.heed_keys()
                    if not self.paused:
                        self.push(pushes, window.perturb)
                        self.step()
                window.sync()
                due += self.env.control_dt / self.speed
                time.sleep(max(0.0, due - time.perf_counter()))
                due = max(due, time.perf_counter() - 0.1)  # late: go on from here
        for thread in set(threading.enumerate()) - others:
            thread.join(5)  # the viewer's own crashes if the process ends before it does

    def heed_keys(self) -> list[tuple[int, int, int]]:
        """Do what keys ask for; returns the directions in which they push."""
        pushes = []
        while self.keys:
            key = self.keys.popleft()
            if key in PUSHES:
                pushes.append(PUSHES[key])
            elif key == SPACE:
                self.paused = not self.paused
            elif key == ENTER:
                self.obs, _ = self.env.reset()
            elif key in (MINUS, EQUALS):
                place = SPEEDS.index(self.speed) + (1 if key == EQUALS else -1)
                self.speed = SPEEDS[min(max(place, 0), len(SPEEDS) - 1)]
                print(f"speed {self.speed:g}")
        return pushes

    def push(self, pushes: Sequence[tuple[int, int, int]], mouse: mujoco.MjvPerturb) -> None:
        """Change the velocity as the forces of keys and mouse would in one control step: by M^-1 J^T f dt.

        The simulator itself knows no external forces; Jacobian and mass matrix are MuJoCo's, of the same model.
        """
        env, model, data = self.env, self.model, self.data
        weight = model.body_subtreemass[ROBOT] * np.linalg.norm(model.opt.gravity)
        data.xfrc_applied[:] = 0
        if mouse.select > 0 and mouse.active:
            mujoco.mjv_applyPerturbForce(model, data, mouse)
            pull, most = np.linalg.norm(data.xfrc_applied[mouse.select, :3]), MAX_PULL * weight
            data.xfrc_applied *= min(1.0, most / max(pull, 1e-9))  # else a robot that runs away is torn back
        for direction in pushes:
            data.xfrc_applied[ROBOT, :3] += PUSH * model.body_subtreemass[ROBOT] / env.control_dt * np.array(direction)
        if not data.xfrc_applied.any():
            return
        force, acceleration = np.zeros(model.nv), np.zeros((1, model.nv))
        for body in np.flatnonzero(data.xfrc_applied.any(1)):
            push, turn = np.split(data.xfrc_applied[body], 2)
            mujoco.mj_applyFT(model, data, push, turn, data.xipos[body], body, force)
        mujoco.mj_solveM(model, data, acceleration, force[None])
        env.set_state(env.qpos, env.qvel + torch.as_tensor(acceleration * env.control_dt, dtype=env.dtype))
        self.obs = env.observe(env.qpos, env.qvel, self.action)

    def step(self) -> None:
        self.action = self.policy(self.obs)
        self.obs, *_ = self.env.step(self.action)
        self.data.time += self.env.control_dt
        self.copy_state()

    def copy_state(self) -> None:
        """Let MuJoCo draw the environment's state, and muscles in the colour of their activation."""
        self.data.qpos[:], self.data.qvel[:] = self.env.qpos[0], self.env.qvel[0]
        render.colour_muscles(self.model, self.action[0])
        mujoco.mj_forward(self.model, self.data)


# The curves -----------------------------------------------------------------------------------------------------------


def plot(directories: Sequence[Path], output: Path) -> None:
    """Return against control steps and seconds: of training a line, of evaluations of the policy alone dots.

    Raises:
        OSError, RuntimeError, ValueError: what is missing to draw or to write.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise RuntimeError("--plot needs matplotlib: pip install matplotlib") from error
    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(11, 4.2), sharey=True, layout="constrained")
    for number, directory in enumerate(directories):
        columns = read_progress(directory / "progress.csv")
        for axis, x in zip(axes, ("control_steps", "seconds"), strict=True):
            style = dict(color=f"C{number}", label=directory.resolve().name)
            axis.plot(columns[x], columns["return"], **style)
            axis.plot(columns[x], columns["eval_return"], "o", color=f"C{number}", markersize=4)
            axis.set_xlabel(x.replace("_", " "))
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("return (line: training, dots: evaluation)")
    axes[0].legend(frameon=False, fontsize="small")
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=150)
    print(f"curves: {output}")


def read_progress(path: Path) -> dict[str, NDArray[np.float64]]:
    """The columns that are drawn, NaN where a row has no value."""
    if not path.is_file():
        fail(f"no such file: {path}; --plot takes directories of runs")
    names = ("control_steps", "seconds", "return", "eval_return")
    with path.open(newline="") as file:
        rows = [[float(row.get(name) or "nan") for name in names] for row in csv.DictReader(file)]
    if not rows:
        fail(f"{path} holds no iteration yet")
    return dict(zip(names, np.array(rows).T, strict=True))


if __name__ == "__main__":
    main()
