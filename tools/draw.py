"""Pictures of policies at work, written to docs/figures: a film of each task, a strip of frames.

    python tools/draw.py films                                # of all policies in diffsim/policies
    python tools/draw.py films diffsim/policies/go2.pt
    python tools/draw.py gait runs/<run>/checkpoint.pt --start 2 --every 0.1 --frames 8
    python tools/draw.py batch diffsim/policies/go2.pt
    python tools/draw.py commands diffsim/policies/go2.pt
    python tools/draw.py learning ant --marks 5 15 60
    python tools/draw.py searched runs/gps/humanoid__full__1

A film, an animated WebP, shows the policy here and in MuJoCo, with MuJoCo's own contact on the file of the robot, from
the same start: of several episodes the one of median return here. It ends where it resembles its first frame most, so
that it plays in a loop; a robot that falls or does not travel is shown from its start. Robots that follow commands go
forward, along an arrow, above a diagram of the time in which each foot is on the ground (Hildebrand 1965). Muscles,
which are not simulated in MuJoCo, are coloured by activation, as in the SHAC paper's Figure 5. What a robot tracks is
drawn as a ghost. The gait is that of the first of a few random episodes that lasts long enough.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from tyro.conf import Positional

from diffsim import Scene
from diffsim.training import command, evaluate, fail, load_policy
from diffsim_cli.commands import DEMO_EPISODES, POLICIES
from diffsim_cli.gait import TOUCHING, contact_bodies, trace
from diffsim_cli.render import BLUE, RED, Arrow, Frame, Renderer, drawable, whole_file
from diffsim_cli.watch import make_policy_env
from diffsim_robots.imitation.tracking import Tracking
from diffsim_robots.joystick import Joystick

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from cells import Cell, Runner, ScriptFlags  # noqa: E402
from common import RESULTS, Case, load_case  # noqa: E402
from tables import ROOT, read_csv  # noqa: E402
from worlds import Here, MuJoCo, State, World, in_double, rollout, starts  # noqa: E402

FIGURES = ROOT / "docs" / "figures"
# How many times closer than the robot's camera, and at which share of that one's height the picture's middle is.
CLOSER = {
    "cartpole": (1.6, 0.38),
    "hopper": (1.6, 0.62),
    "half_cheetah": (1.4, 0.5),
    "ant": (1.4, 0.53),
    "humanoid": (1.6, 0.56),
    "humanoid_mtu": (1.2, 0.52),
    "go2": (1.3, 0.55),
    "g1": (1.3, 0.49),
    "g1_track": (1.25, 0.49),
}
FLOOR, AROUND = 4.0, 4.8  # m after which the floor repeats; s that a robot with a clock takes for it, in whole cycles
DANCE = 12.6, 5.0  # s of the clip that a film of tracking begins with, and how many it shows
LEAST_FPS, QUALITY = 25.0, 40  # of a film; WebP's, of 100
SPACING = 1.5  # m between the robots of a batch
NEAR = 0.9  # m, between the roots of two robots of a batch, at least
# Seconds from which a film of commands has each one, as shares of the robot's largest, and what it is called
COMMANDS = (
    (0.0, (0.0, 0.0, 0.0), "stand"),
    (0.6, (1.0, 0.0, 0.0), "forward"),
    (2.6, (0.5, 0.0, 1.0), "turn left"),
    (3.5, (0.0, -1.0, 0.0), "to the right"),
    (5.1, (-0.7, 0.0, 0.0), "backward"),
    (6.5, (0.5, 0.0, -1.0), "turn right"),
    (7.4, (0.0, 0.0, 0.0), "stand"),
)
# Seconds before which the root's velocity changes [m/s], how long this is shown, and when the film ends
PUSHES, SHOWN, END = ((1.6, (-0.7, 0.7)), (4.2, (0.7, 0.7)), (5.8, (-0.7, -0.7))), 0.4, 8.2
ROW, LABELS = 16, 56  # pixels of a foot's line in the diagram, and of its name
INK, PAPER, PALE = (40, 46, 58), (255, 255, 255), (226, 230, 236)


class Motion(NamedTuple):
    """What a robot does in one world, as frames."""

    qpos: NDArray[np.float64]  # (F, nq)
    action: NDArray[np.float64]  # (F, nu)
    fallen: bool  # by the end
    ghost: NDArray[np.float64] | None = None  # (F, nq) what it tracks

    def part(self, begin: int, length: int | None = None) -> Motion:
        ghost = None if self.ghost is None else self.ghost[begin:][:length]
        return self._replace(qpos=self.qpos[begin:][:length], action=self.action[begin:][:length], ghost=ghost)


def films(
    checkpoints: Positional[tuple[Path, ...]] = (),
    size: tuple[int, int] = (480, 320),
    start: float = 2.0,
    seconds: tuple[float, float] = (4.0, 5.0),
) -> None:
    """A film of each policy, called as its task, and as its contact if that is not the task's.

    Args:
        checkpoints: files of any script. Default: the shipped policies.
        size: width and height of a world's picture in pixels.
        start: seconds into the episode before which no loop begins.
        seconds: shortest and longest loop, unless the robot has a clock; what is shown from its start takes 4 s.
    """
    for checkpoint in checkpoints or [POLICIES / f"{task}.pt" for task in CLOSER]:
        case = load_case(checkpoint, DEMO_EPISODES, "cpu")
        task, dt = case.env.task, case.env.control_dt
        every, tracks = max(1, int(1 / (LEAST_FPS * dt) + 1e-6)), isinstance(task, Tracking)
        fps, clock = 1 / (every * dt), isinstance(task, Joystick)
        shortest, longest = (stride(task), stride(task)) if isinstance(task, Joystick) else seconds
        if tracks:  # of the clip, from its beginning on
            case.env.stochastic_init = False
            start, longest = DANCE
        sides = motions(case, round((start + longest + 2.0) / dt), every)
        if tracks:
            sides = {name: motion.part(round(start * fps), round(longest * fps)) for name, motion in sides.items()}
            pictures = {name: drawn(case, motion, size) for name, motion in sides.items()}
        elif any(motion.fallen for motion in sides.values()) or not (clock or task.forward_column is not None):
            sides = {name: motion.part(0, round(4.0 * fps)) for name, motion in sides.items()}
            pictures = {name: drawn(case, motion, size) for name, motion in sides.items()}
        else:
            sides = {name: motion.part(round(start * fps)) for name, motion in sides.items()}
            pictures = {name: drawn(case, motion, size) for name, motion in sides.items()}
            lengths = round(shortest * fps), round(longest * fps)  # a clock keeps both worlds in step
            begins, length = find_loop([*pictures.values()], *lengths, together=clock)
            for name, begin in zip(sides, begins, strict=True):
                sides[name] = sides[name].part(begin, length)
                pictures[name] = pictures[name][begin:][:length]
        shown = {name: [titled(frame, name) for frame in frames] for name, frames in pictures.items()}
        if clock:
            for name, frames in shown.items():
                below = diagrams(case.env.scene, sides[name].qpos, size[0])
                shown[name] = [np.concatenate(both) for both in zip(frames, below, strict=True)]
        frames = [np.concatenate(row, axis=1) for row in zip(*shown.values(), strict=True)]
        contact = case.env.sim.integration.contact
        name = task.name if contact == task.contact else f"{task.name}_{contact}"
        path = save_webp(FIGURES / f"{name}.webp", frames, fps)
        print(f"{path}, {len(frames) / fps:.2f} s, {fps:.0f} frames/s, {path.stat().st_size / 1000:.0f} kB")


def drawn(
    case: Case, motion: Motion, size: tuple[int, int], arrows: Sequence[Sequence[Arrow]] | None = None
) -> list[Frame]:
    """Pictures as near as CLOSER says, drawn with twice as many pixels a side: smooth edges."""
    zoom, middle = CLOSER.get(case.env.task.name, (1.0, 0.5))
    width, height, wide, high = *size, *(round(2 * zoom * side) for side in size)
    left, top = wide // 2 - width, round(middle * high) - height
    with Renderer(case.env.scene, wide, high) as renderer:
        ghosts = [None] * len(motion.qpos) if motion.ghost is None else motion.ghost
        rows = zip(motion.qpos, motion.action, ghosts, strict=True)
        if arrows is None:  # the command of a film, forward
            speed = FLOOR / stride(case.env.task) if isinstance(case.env.task, Joystick) else 0.0
            arrows = [[((speed, 0.0), RED)]] * len(motion.qpos)
        whole = (
            renderer.draw(qpos, action, ghost=ghost, arrows=own)
            for (qpos, action, ghost), own in zip(rows, arrows, strict=True)
        )
        return [halve(frame[top : top + 2 * height, left : left + 2 * width]) for frame in whole]


def stride(task: Joystick) -> float:
    """Seconds of the cycles in which a commanded robot crosses what of the floor repeats."""
    return round(AROUND * task.robot.cycle) / task.robot.cycle


def motions(case: Case, steps: int, every: int, beside: bool = True) -> dict[str, Motion]:
    """A frame for `every` of so many control steps, of the episode of median return here, by the name of the world:
    this one, and MuJoCo beside it."""
    env, task, start, found, episode = case.env, in_double(case.env), starts(case.env, torch.float64), {}, -1
    worlds: dict[str, World] = {"diffsim": Here(env.sim)}
    if beside and "muscle" not in env.scene.features:
        exact = env.sim.integration.contact == "mujoco"
        worlds["MuJoCo"] = MuJoCo(env.scene, env.num_envs, env.control_dt, own_friction=exact)
    if isinstance(task, Joystick):
        start.memory[:, :3] = torch.tensor((FLOOR / stride(task), 0.0, 0.0))
    for name, world in worlds.items():
        taken = [*rollout(world, task, case.saved.network, start, steps)]
        states = [step.state for step in taken[::every]]
        fallen = torch.stack([step.fallen for step in taken])
        if episode < 0:
            returns = torch.stack([step.reward for step in taken]).masked_fill(fallen, 0.0).sum(0)
            episode = int(returns.median(0).indices)
        qpos, action = (torch.stack([getattr(x, part)[episode] for x in states]).numpy() for part in ("qpos", "action"))
        tracked = task.ghost(torch.stack([x.memory[episode] for x in states]))
        ghost = None if tracked is None else tracked.numpy()
        found[name] = Motion(qpos, action, bool(fallen[-1, episode]), ghost)
    return found


def find_loop(sides: Sequence[Sequence[Frame]], shortest: int, longest: int, together: bool) -> tuple[list[int], int]:
    """First frames, and the length after which these are resembled most: gait and floor, compared by 8 x 8 pixels.

    Args:
        together: all sides begin at the same time.
    """
    best, begins, taken = float(np.inf), [0], shortest
    small = [np.array([frame[::8, ::8] for frame in frames], dtype=np.float32) for frames in sides]
    for length in range(shortest, longest + 1):
        gaps = [np.abs(side[length:] - side[:-length]).mean((1, 2, 3)) for side in small]
        gaps = [sum(gaps, np.zeros(len(gaps[0])))] * len(gaps) if together else gaps
        if (gap := sum(float(each.min()) for each in gaps)) < best:
            best, begins, taken = gap, [int(each.argmin()) for each in gaps], length
    return begins, taken


def titled(frame: Frame, text: str) -> Frame:
    picture = Image.fromarray(frame)
    ImageDraw.Draw(picture).text((10, 6), text, INK, ImageFont.load_default(18))
    return np.asarray(picture)


def diagrams(scene: Scene, qpos: NDArray[np.float64], width: int) -> list[Frame]:
    """Of each row qpos (T, nq) one: bars for the time in which a foot is on the ground, and a line at the row's."""
    (depth, _), bodies, right = trace(scene, qpos), contact_bodies(scene), width - 8
    touching = {scene.mj_model.body(b).name: (depth[:, bodies == b] > 0).any(1) for b in np.unique(bodies)}
    feet = {name: down for name, down in touching.items() if down.mean() >= TOUCHING}
    sheet = Image.new("RGB", (width, ROW * len(feet) + 12), PAPER)
    draw, at = ImageDraw.Draw(sheet), np.linspace(LABELS, right, len(qpos) + 1)
    for line, (name, down) in enumerate(feet.items()):
        top = 6 + ROW * line
        draw.text((10, top), name.split("_")[0], INK, ImageFont.load_default(12))
        draw.rectangle((LABELS, top + 3, right, top + ROW - 3), PALE)
        for k in np.flatnonzero(down).tolist():
            draw.rectangle((at[k], top + 3, at[k + 1], top + ROW - 3), INK)
    pictures = [sheet.copy() for _ in qpos]
    for k, picture in enumerate(pictures):
        ImageDraw.Draw(picture).line((at[k], 2, at[k], sheet.height - 3), (214, 60, 40), 2)
    return [np.asarray(picture) for picture in pictures]


def save_webp(path: Path, frames: Sequence[Frame], fps: float) -> Path:
    """Written as an animation that repeats for ever; its delays are milliseconds."""
    first, *others = map(Image.fromarray, frames)
    delays = np.diff(np.round(np.arange(len(frames) + 1) * 1000 / fps)).astype(int).tolist()
    with whole_file(path) as part:
        how = dict(format="WEBP", duration=delays, loop=0, quality=QUALITY, method=4)
        first.save(part, save_all=True, append_images=others, **how)
    return path


def gait(
    checkpoint: Positional[Path], start: float = 2.0, every: float = 0.1, frames: int = 8, size: int = 240
) -> None:
    """Frames of a policy at work, side by side.

    Args:
        checkpoint: file of any script.
        start: seconds into the episode of the first frame.
        every: seconds between frames.
        frames: number of frames.
        size: width and height of a frame in pixels.
    """
    saved = load_policy(checkpoint)
    episodes = evaluate(make_policy_env(saved, 16), saved.network)
    wanted = [round((start + k * every) / episodes.control_dt) for k in range(frames)]
    lasting = episodes.lengths > wanted[-1]
    if not lasting.any():
        fail(f"none of {len(lasting)} episodes lasts {start + (frames - 1) * every:.2f} s")
    qpos, action = (rows[wanted] for rows in episodes.episode(int(lasting.int().argmax())))
    path = FIGURES / f"{saved.args['env']}_gait.png"
    with Renderer(episodes.scene, 2 * size, 2 * size) as renderer:
        Image.fromarray(halve(np.concatenate([*map(renderer.draw, qpos, action)], axis=1))).save(path)
    print(path)


def batch(
    checkpoint: Positional[Path], count: int = 9, seconds: float = 3.0, size: tuple[int, int] = (640, 360)
) -> None:
    """A film of many environments of one batch, each at its place of a grid, called <task>_batch.webp.

    Args:
        checkpoint: file of any script.
        count: robots, a square number.
        seconds: length, from one second into the episode on.
        size: width and height in pixels.
    """
    saved = load_policy(checkpoint)
    episodes = evaluate(make_policy_env(saved, count), saved.network)
    dt, side = episodes.control_dt, round(count**0.5)
    every = max(1, int(1 / (LEAST_FPS * dt) + 1e-6))
    rows = np.stack(
        [episodes.episode(k)[0][round(1 / dt) :: every][: round(seconds / dt / every)] for k in range(count)]
    )
    spacing = SPACING
    while nearest(placed := apart(rows, side, spacing)) < NEAR:  # worlds are independent
        spacing += 0.25
    rows = placed
    model, _ = drawable(episodes.scene)
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    model.vis.map.shadowclip *= side  # the light sees all of them
    data, option, pert, camera = mujoco.MjData(model), mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.MjvCamera()
    camera.lookat, camera.azimuth, camera.elevation, camera.distance = (0, 0, 0.2), 60, -24, 0.8 * side * spacing
    frames = []
    with mujoco.Renderer(model, size[1], size[0], max_geom=model.ngeom * count + 100) as renderer:
        for moment in rows.swapaxes(0, 1):
            for k, data.qpos[:] in enumerate(moment):
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                if k == 0:
                    renderer.update_scene(data, camera)
                else:
                    kind = mujoco.mjtCatBit.mjCAT_DYNAMIC.value
                    mujoco.mjv_addGeoms(model, data, option, pert, kind, renderer.scene)
            frames.append(renderer.render())
    path = save_webp(FIGURES / f"{saved.args['env'].partition(':')[0]}_batch.webp", frames, 1 / (every * dt))
    print(f"{path}, {len(frames)} frames, {path.stat().st_size / 1000:.0f} kB")


def apart(rows: NDArray[Any], side: int, spacing: float) -> NDArray[Any]:
    """Episodes qpos (n, T, nq), moved so that each starts at its place of a grid."""
    spread = spacing * (np.arange(side) - (side - 1) / 2)
    places = np.stack(np.meshgrid(spread, spread), -1).reshape(-1, 2)
    moved = rows.copy()
    moved[:, :, :2] += places[:, None] - rows[:, :1, :2]
    return moved


def nearest(rows: NDArray[Any]) -> float:
    """The least distance [m] between the roots of two robots at the same time."""
    x = rows[:, :, :2].swapaxes(0, 1)
    gaps = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)
    return float((gaps + 1e9 * np.eye(len(rows))).min())


def commands(checkpoint: Positional[Path], size: tuple[int, int] = (480, 320)) -> None:
    """A film of a robot in MuJoCo that follows one command after another (red) and is pushed (blue), called
    <task>_commands.webp.

    Args:
        checkpoint: file of any script, trained on a joystick task.
        size: width and height in pixels.
    """
    case = load_case(checkpoint, 1, "cpu")
    if not isinstance(case.env.task, Joystick):
        fail(f"{checkpoint} was trained on {case.env.task.name}, which follows no command")
    task, dt, start = in_double(case.env), case.env.control_dt, starts(case.env, torch.float64)
    most = torch.tensor(case.env.task.robot.command).double()

    def command_of(step: int) -> tuple[NDArray[np.float64], str]:
        share, text = next(entry[1:] for entry in reversed(COMMANDS) if entry[0] <= step * dt)
        return (torch.tensor(share) * most).numpy(), text

    def disturb(step: int, state: State) -> State:
        command, _ = command_of(step)
        state.memory[:, :3] = torch.from_numpy(command)
        for at, change in PUSHES:
            if step == round(at / dt):
                state.qvel[:, :2] += torch.tensor(change)
        return state

    world = MuJoCo(case.env.scene, 1, dt, own_friction=True)
    taken = [*rollout(world, task, case.saved.network, start, round(END / dt), disturb)]
    every = max(1, int(1 / (LEAST_FPS * dt) + 1e-6))
    qpos, action = (torch.stack([getattr(step.state, name)[0] for step in taken]) for name in ("qpos", "action"))
    motion = Motion(qpos.numpy()[::every], action.numpy()[::every], bool(taken[-1].fallen))
    arrows, texts = list[list[Arrow]](), list[str]()
    for step, row in zip(range(0, len(taken), every), motion.qpos, strict=True):
        command, text = command_of(step)
        w, x, y, z = row[3:7]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        ahead, aside = command[:2]
        along = ahead * np.cos(yaw) - aside * np.sin(yaw), ahead * np.sin(yaw) + aside * np.cos(yaw)
        pushed = [change for at, change in PUSHES if 0 <= step * dt - at < SHOWN]
        arrows.append([(along, RED), *((change, BLUE) for change in pushed)])
        texts.append(text + ", pushed by 1 m/s" * bool(pushed))
    frames = [titled(frame, text) for frame, text in zip(drawn(case, motion, size, arrows), texts, strict=True)]
    path = save_webp(FIGURES / f"{case.env.task.name}_commands.webp", frames, 1 / (every * dt))
    print(
        f"{path}, {len(frames)} frames, {path.stat().st_size / 1000:.0f} kB, {'fallen' if motion.fallen else 'whole'}"
    )


def learning(
    env: Positional[str] = "ant",
    learner: str = "rpo",
    marks: tuple[float, ...] = (5.0, 15.0, 60.0),
    seconds: float = 4.0,
    size: tuple[int, int] = (280, 240),
) -> None:
    """A film of what a learner's seed 1 on two CPU cores has learned after some seconds, called <task>_learning.webp.

    It trains on this machine's CPU as many iterations as the training of results/cpu/cells.csv had in this time.

    Args:
        env: task to train.
        learner: one of cells.csv.
        marks: seconds of training.
        seconds: length of the film, from the start of an episode on.
        size: width and height of a policy's picture in pixels.
    """
    known = read_csv(RESULTS / "cpu" / "cells.csv")
    row = next((row for row in known if (row["learner"], row["task"], row["seed"]) == (learner, env, "1")), None)
    if row is None:
        fail(f"{learner} on {env} is not in results/cpu/cells.csv")
    pace, columns = float(row["training (s)"]) / int(row["iterations"]), list[list[Frame]]()
    with TemporaryDirectory() as folder:
        cell = Cell("cpu", learner, env, 1).case(Path(folder))
        for mark in marks:
            if not Runner(ScriptFlags(device="cpu")).train(cell, round(mark / pace)):
                fail((cell.folder / "output.txt").read_text())
            case = load_case(cell.folder, DEMO_EPISODES, "cpu")
            dt, title = case.env.control_dt, f"after {mark:g} s"
            every = max(1, int(1 / (LEAST_FPS * dt) + 1e-6))
            (motion,) = motions(case, round(seconds / dt), every, beside=False).values()
            if (x := case.env.task.forward_column) is not None:
                title += f": {(motion.qpos[-1, x] - motion.qpos[0, x]) / seconds:.1f} m/s"
            columns.append([titled(frame, title) for frame in drawn(case, motion, size)])
    frames = [np.concatenate(row, axis=1) for row in zip(*columns, strict=True)]
    path = save_webp(FIGURES / f"{env}_learning.webp", frames, 1 / (every * dt))
    print(f"{path}, {len(frames)} frames, {path.stat().st_size / 1000:.0f} kB")


def searched(checkpoint: Positional[Path], horizons: int = 3, size: tuple[int, int] = (360, 240)) -> None:
    """A film of what gps.py has learned, with the noise of its policy, called gps_<task>.webp.

    Args:
        checkpoint: file or run of gps.py or benchmarks/guided_policy_search.py.
        horizons: how long it is, in horizons of the search.
        size: width and height in pixels.
    """
    from guided_policy_search import load_search

    search = load_search(checkpoint)
    rollouts, task, dt = search.rollouts, search.args.task, search.system.control_dt
    noise = torch.cat([rollouts.noise(1, torch.Generator().manual_seed(k)) for k in range(horizons)], 1)
    x = rollouts.roll_out(search.network.theta, noise, rollouts.start[:1]).x[0, :, : search.system.nq].numpy()
    every, zoom = max(1, int(1 / (LEAST_FPS * dt) + 1e-6)), 2
    with Renderer(search.system.scene, zoom * size[0], zoom * size[1]) as renderer:
        frames = [
            titled(halve(renderer.draw(qpos)), f"{k * every * dt:.0f} s, {qpos[0] - x[0, 0]:.0f} m")
            for k, qpos in enumerate(x[::every])
        ]
    path = save_webp(FIGURES / f"gps_{task}.webp", frames, 1 / (every * dt))
    print(f"{path}, {len(frames)} frames, {path.stat().st_size / 1000:.0f} kB")


def halve(frame: Frame) -> Frame:
    """2 x 2 pixels into one: smooth edges."""
    height, width = frame.shape[0] // 2, frame.shape[1] // 2
    return frame.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)).round().astype(np.uint8)


FILMS: dict[str, Callable[..., None]] = {
    "films": films,
    "gait": gait,
    "batch": batch,
    "commands": commands,
    "learning": learning,
    "searched": searched,
}


@command
def main() -> None:
    torch.set_num_threads(1)
    tyro.extras.subcommand_cli_from_dict(FILMS, description=__doc__)


if __name__ == "__main__":
    main()
