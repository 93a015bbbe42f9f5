"""How well policies track their clips in MuJoCo, on any file of their robot.

    python benchmarks/tracking.py runs/g1_track__sapo__1 --file path/to/unitree_g1/scene.xml
    python benchmarks/tracking.py runs/h100/* --push 0.5
    python benchmarks/tracking.py runs/h100/many --clip folder/of/unseen/clips
    python benchmarks/tracking.py runs/race/sapo__1/at_*.pt --race --friction 1

Each motion is tracked several times from its first frame to its end, from joints that are up to 0.05 rad off. An
episode succeeds if the root is never 0.5 m or 1 rad away from the clip's: mjlab's and BeyondMimic's criterion, of which
a fall is one case. Errors are means over the time until then. Servos get the policy's targets within the range of its
training, and a motor the torque that the task's servo would have. Nothing else of the file is changed.

Writes tracking.csv, a row for each policy and world, or with --race tracking_race.csv, of checkpoints that were copied
beside their run's progress.csv while it trained; with --update-results also the tables of docs/tracking.md. Trainings
that shared a GPU have a folder whose name ends with _shared: their seconds do not count.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import common
import numpy as np
import torch
from common import ABOUT, Part, load_case, measured, run
from joystick import alone, training
from tables import Row, grouped, markdown, middle, numbers, ranged
from worlds import Array, OtherFile, State, pushes, rollout

from diffsim.training import Count, SavedPolicy, fail
from diffsim_robots.imitation.clip import read_clip
from diffsim_robots.imitation.tracking import Tracking

OFF = 0.05  # rad, of the joints at the start
ENOUGH = 0.95  # share of episodes that succeed, to which learners race
PAGE = "tracking.md"


@dataclass
class Args(common.ServoFlags):
    clip: Path | None = None  # motions in place of those of the training: a file or a folder
    episodes: Count = 16  # of each motion


def track(saved: SavedPolicy, task: Tracking, world: OtherFile, args: Args) -> tuple[Array, Array]:
    """Success (n,) of each motion's episodes, and (3, n) mean errors of root [m], rotation and joints [rad]."""
    first, length = (each.repeat_interleave(args.episodes) for each in task.motions)
    n, drawn = len(first), np.random.default_rng(1)
    memory = torch.zeros(n, task.num_memory).double()
    memory[:, 0] = first
    qpos, qvel = task.reference(memory)
    qpos[:, 7:] += torch.from_numpy(drawn.uniform(-OFF, OFF, (n, task.joints)))

    push = pushes(args.push, task.control_dt, drawn)
    start = State(qpos, qvel, torch.zeros(n, task.joints).double(), memory)
    sums, counted, alive = torch.zeros(3, n).double(), torch.zeros(n), torch.ones(n, dtype=torch.bool)
    for step, seen in enumerate(rollout(world, task, saved.network, start, int(length.max()), push)):
        playing = step < length
        alive &= ~seen.fallen | ~playing
        if not (alive & playing).any():
            break
        obs = task.named(seen.obs)
        off = *(obs[name].norm(dim=-1) for name in ("root_off", "root_turned")), obs["joints_off"].abs().mean(-1)
        sums += torch.where(alive & playing, torch.stack(off), 0.0)
        counted += alive & playing
    return alive.numpy(), (sums / counted.clamp(min=1)).numpy()


def measure(args: Args, path: Path) -> Iterator[Row]:
    """A row for each friction."""
    case = load_case(path, 1, "cpu")
    if not isinstance(own := case.env.task, Tracking):
        fail(f"{path} was trained on {own.name}, which is not judged by its clip's root")
    clip = own.clip if args.clip is None else read_clip(args.clip)
    task = type(own).with_clip(clip)(dtype=torch.float64)
    assert isinstance(task, Tracking)
    task.bind(case.env.scene)
    task.low, task.high = own.low.double(), own.high.double()  # other clips do not move the servos' range
    count = len(task.motions[0])
    for friction in args.friction:
        world = OtherFile(case.env, count * args.episodes, args.file, friction)
        success, (root, turn, joints) = track(case.saved, task, world, args)
        each = success.reshape(count, -1).mean(1)
        if count > 1:
            print("  " + " ".join(f"{share:.0%}" for share in each))
        row = {"clip": str(clip), "motions": count, "clip s": float(task.motions[1].sum()) * task.control_dt}
        row |= {"file": args.file.parent.name if args.file else "", "friction": friction, "push": args.push}
        row |= {"success": success.mean(), "whole motions": np.sum(each >= ENOUGH)}
        row |= {"joint error": joints.mean(), "root error": root.mean(), "root turn": turn.mean()}
        row |= {"episodes": args.episodes}
        if args.race:
            given = case.saved.args
            row["control steps"] = case.saved.iteration * given["num_envs"] * given["horizon"]
        yield training(case) | row


def least(rows: list[dict[str, str]]) -> str:
    return f"{min(found):.0%}" if (found := numbers(rows, "success")) else ""


def groups(rows: list[dict[str, str]]) -> Iterator[tuple[dict[str, str], list[dict[str, str]], list[dict[str, str]]]]:
    """A policy's clip, learner and, of one core, the machine, over seeds; its rows, and those with the file's friction
    and no push."""
    for (clip, learner, device), group in sorted(grouped(rows, "clip", "learner", "device").items()):
        name, drawn, _ = learner.partition(" randomised")
        by = name.upper() + (", one core" if device == "cpu" else "") + ("" if drawn else ", not randomised")
        plain = [row for row in group if float(row["friction"]) == 1 and float(row["push"]) == 0]
        yield {"clip": clip, "learner": by}, group, plain


def seeds(group: list[dict[str, str]]) -> int:
    return len({row["checkpoint"] for row in group})


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each policy of one motion: how many episodes succeed. Pushes and other frictions are told one by one,
    so that all policies are compared in the same worlds."""
    lines = list[Row]()
    for policy, group, plain in groups([row for row in rows if row["motions"] == "1"]):
        calm = [row for row in group if float(row["push"]) == 0 and float(row["friction"]) != 1]
        pushed = [row for row in group if float(row["push"]) > 0 and float(row["friction"]) == 1]
        lines.append(
            {**policy, "seeds": seeds(group)}
            | {"training (s)": timed(alone(plain))}
            | {"success (worst seed)": f"{middle(plain, 'success', '.0%')} ({least(plain)})"}
            | {"friction x 0.7, 1.3 (worst)": least(calm), "pushed (worst seed)": least(pushed)}
        )
    return lines


def errors(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each policy of one motion: medians over seeds on the file's friction."""
    return [
        {**policy, "joints (rad)": middle(plain, "joint error", ".3f"), "root (m)": middle(plain, "root error", ".3f")}
        for policy, _, plain in groups([row for row in rows if row["motions"] == "1"])
    ]


def timed(rows: list[dict[str, str]]) -> str:
    """Seconds of the seeds that had a machine for themselves, and which one."""
    machines = sorted({row["checkpoint"].partition("/")[0].upper() for row in rows})
    return f"{ranged(numbers(rows, 'training s'), '.0f')}, {' and '.join(machines)}" if rows else ""


def many(rows: list[dict[str, str]]) -> list[Row]:
    """A line for each policy of several motions and what it was judged by, on the file's friction without pushes."""
    return [
        {**policy, "motions": row["motions"], "success": f"{float(row['success']):.0%}"}
        | {
            f"motions with {ENOUGH:.0%}": row["whole motions"],
            "training (s)": timed(alone([row])),
        }
        | {"joints (rad)": f"{float(row['joint error']):.3f}"}
        for policy, _, plain in groups([row for row in rows if row["motions"] != "1"])
        for row in plain
    ]


def race(rows: list[dict[str, str]]) -> list[Row]:
    """Control steps and seconds of training until enough episodes succeed, for the first time and for two checkpoints
    in a row, of a GPU's only trainings."""
    lines = list[Row]()
    rows = [row | {"run": row["checkpoint"].partition("/")[0]} for row in alone(rows)]
    for (name,), group in grouped(rows, "run").items():
        group.sort(key=lambda row: int(row["iteration"]))
        enough = [row for row in group if float(row["success"]) >= ENOUGH]
        twice = [row for row, after in pairwise(group) if row in enough and after in enough]
        line = {"learner": name.partition("__")[0].upper(), "joints (rad)": group[-1]["joint error"]}
        line[f"M steps to {ENOUGH:.0%}"] = f"{float(enough[0]['control steps']) / 1e6:.3g}" if enough else "never"
        for column, found in ((f"s to {ENOUGH:.0%}", enough), ("twice in a row (s)", twice)):
            line[column] = found[0]["training s"] if found else "never"
        lines.append(line | {"last success": f"{float(group[-1]['success']):.0%}"})
    return lines


def main(args: Args) -> None:
    key = (*ABOUT[:-1], "clip", "file", "friction", "push")
    if args.race:
        measured(args, Part("tracking_race", measure, key, "track_race", PAGE, race))
        return
    rows = measured(args, Part("tracking", measure, key, "tracking", PAGE, table))
    args.publish("track_errors", markdown(errors(rows)), PAGE)
    args.publish("many", markdown(many(rows)), PAGE)


if __name__ == "__main__":
    run(main, Args, __doc__)
