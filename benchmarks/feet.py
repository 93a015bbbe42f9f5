"""Figure 7 of the PFPN paper: where the feet go, seen from the trunk, over ten cycles of an imitated motion.

    python benchmarks/feet.py runs/learning/pfpn_ppo/humanoid_imitation__1 runs/learning/pfpn_shac/humanoid_imitation__1

Each policy tracks its clip from the first frame, without noise, for ten cycles or until the episode ends. The plane is
that of the first two principal components of the reference's feet (6 coordinates). Writes feet.csv, a row for each
frame, and feet.png; prints how far each policy's feet are from the reference's at the same phase.
"""

from __future__ import annotations

from dataclasses import dataclass

import common
import mujoco
import numpy as np
import torch
from common import Case, Line, Panel, load_case, parse, plot
from robustness import State, Walkers
from tables import Row, markdown

from diffsim import Scene
from diffsim.tasks import HumanoidImitation
from diffsim.training import Count, command, fail

FEET = ("right_foot_inner", "left_foot_inner")
REFERENCE = "reference"


@dataclass
class Args(common.CheckpointFlags):
    cycles: Count = 10  # of the motion


def feet(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Both feet in the trunk's frame (frames, 6), m, of qpos (frames, nq)."""
    model, found = scene.mj_model, np.zeros((len(qpos), 6))
    data, geoms = mujoco.MjData(model), [model.geom(name).id for name in FEET]
    for row, place in zip(qpos, found, strict=True):
        data.qpos = row
        mujoco.mj_kinematics(model, data)
        place[:] = ((data.geom_xpos[geoms] - data.xpos[1]) @ data.xmat[1].reshape(3, 3)).ravel()
    return found


def measure(case: Case, args: Args) -> None:
    env, task = case.env, case.env.task
    if not isinstance(task, HumanoidImitation):
        fail(f"{case.path} was trained on {task.name}; this needs humanoid_imitation")
    start = task.reset(torch.full((1, task.num_random), 0.5, device=env.device, dtype=env.dtype))  # the first frame
    action, step = start[1].new_zeros(1, env.scene.nu), torch.zeros(1, dtype=torch.int64, device=env.device)
    walkers = Walkers(env, case.saved.network.to(env.device), 1, State(*start, action, step))
    path = list[np.ndarray]()
    for state, fallen in walkers.walk(args.cycles * task.period * env.control_dt):
        if fallen.any():
            break
        path.append(state.qpos[0].double().numpy(force=True))
    reference = feet(env.scene, task.clip.qpos[: task.period].double().numpy())
    middle = reference.mean(0)
    plane = np.linalg.svd(reference - middle)[2][:2].T
    own = feet(env.scene, np.array(path).reshape(-1, env.scene.nq))
    about = case.about
    for name, seed, points, first in ((REFERENCE, "", reference, 0), (about["learner"], about["seed"], own, 1)):
        rows = list[Row]()
        for k, (point, flat) in enumerate(zip(points, (points - middle) @ plane, strict=True), first):
            cycle, frame = divmod(k, task.period)
            error = np.linalg.norm((point - reference[frame]).reshape(2, 3), axis=1).mean()
            row = {"policy": name, "seed": seed, "cycle": cycle, "frame": frame, "error": f"{error:.4f}"}
            rows.append({**row, "first": f"{flat[0]:.4f}", "second": f"{flat[1]:.4f}"})
        args.merge("feet", rows, ("policy", "seed", "cycle", "frame"))


def line(rows: list[dict[str, str]], style: str, label: str, width: float) -> Line:
    first, second = ([float(row[name]) for row in rows] for name in ("first", "second"))
    return Line(first, second, style, label, width)


def report(args: Args) -> str:
    """Draw the plane of each policy's feet, its first seed with the reference in black; returns the table."""
    runs: dict[str, dict[str, list[dict[str, str]]]] = {}
    for row in args.read("feet"):
        runs.setdefault(row["policy"], {}).setdefault(row["seed"], []).append(row)
    table, panels = list[Row](), list[Panel]()
    reference = runs.pop(REFERENCE, {}).get("", [])
    for k, (policy, seeds) in enumerate(runs.items()):
        frames = " ".join(str(len(own)) for own in seeds.values())
        errors = " ".join(f"{100 * np.mean([float(row['error']) for row in own]):.1f}" for own in seeds.values())
        table.append({"policy": policy, "frames until the end": frames, "feet from the reference's, cm": errors})
        lines = [line(next(iter(seeds.values())), f"C{k}-", "", 0.6), line(reference, "k-", REFERENCE, 1.2)]
        panels.append(Panel(lines, policy, "first component (m)", "" if panels else "second component (m)"))
    plot(args.picture("feet"), [panels])
    return markdown(table)


@command
def main(args: Args) -> None:
    for path in args.measured:
        measure(load_case(path, 1, args.device), args)
    print(report(args))


if __name__ == "__main__":
    main(parse(Args, __doc__))
