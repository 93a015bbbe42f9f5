"""Figure 7 of the PFPN paper: where the feet go, seen from the trunk, over ten cycles of an imitated motion.

    python benchmarks/feet.py runs/learning/pfpn_ppo/humanoid_imitation__1 runs/learning/pfpn_shac/humanoid_imitation__1

Each policy tracks its clip from the first frame, without noise, for ten cycles or until the episode ends. The plane is
that of the first two principal components of the reference's feet (6 coordinates). Writes feet.csv, a row for each
frame, feet.png, and with --update-results the table of docs/pfpn.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import common
import mujoco
import numpy as np
import torch
from common import Case, Line, Panel, load_case, parse, plot
from robustness import State, Walkers
from tables import markdown

from diffsim import Scene
from diffsim.tasks import HumanoidImitation
from diffsim.training import Count, fail

FEET = ("right_foot_inner", "left_foot_inner")
REFERENCE = "reference"
KEY = ("policy", "seed", "cycle", "frame")


@dataclass
class Args(common.CheckpointFlags):
    cycles: Count = 10  # of the motion


def feet(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Both feet in the trunk's frame (frames, 6), m, of qpos (frames, nq)."""
    model, found = scene.mj_model, list[np.ndarray]()
    data, geoms = mujoco.MjData(model), [model.geom(name).id for name in FEET]
    for row in qpos:
        data.qpos = row
        mujoco.mj_kinematics(model, data)
        found.append(((data.geom_xpos[geoms] - data.xpos[1]) @ data.xmat[1].reshape(3, 3)).ravel())
    return np.array(found)


def measure(case: Case, args: Args) -> None:
    env, task = case.env, case.env.task
    if not isinstance(task, HumanoidImitation):
        fail(f"{case.path} was trained on {task.name}; this needs humanoid_imitation")
    start = task.reset(torch.full((1, task.num_random), 0.5, device=env.device, dtype=env.dtype))  # the first frame
    action, step = start[1].new_zeros(1, env.scene.nu), torch.zeros(1, dtype=torch.int64, device=env.device)
    walkers = Walkers(env, case.saved.network.to(env.device), 1, State(*start, action, step))
    seconds, states = args.cycles * task.period * env.control_dt, list[torch.Tensor]()
    for state, fallen in walkers.walk(seconds):
        if fallen.any():
            break
        states.append(state.qpos[0])
    clip = task.clip.qpos[: task.period].double().numpy()
    reference = feet(env.scene, clip)
    own = feet(env.scene, torch.stack(states).double().numpy(force=True)) if states else reference[:0]
    middle = reference.mean(0)
    plane = np.linalg.svd(reference - middle)[2][:2].T
    policy = " ".join(str(case.saved.args[name]) for name in ("algorithm", "policy") if name in case.saved.args)
    for name, points, first in ((REFERENCE, reference, 0), (policy or case.saved.script, own, 1)):
        about = {"policy": name, "seed": case.saved.args["seed"] if first else ""}
        rows = list[dict[str, object]]()
        for k, (point, flat) in enumerate(zip(points, (points - middle) @ plane, strict=True), first):
            cycle, frame = divmod(k, task.period)
            error = np.linalg.norm((point - reference[frame]).reshape(2, 3), axis=1).mean()
            row = about | {"cycle": cycle, "frame": frame, "first": f"{flat[0]:.4f}", "second": f"{flat[1]:.4f}"}
            rows.append(row | {"error": f"{error:.4f}"})
        args.merge("feet", rows, KEY)


def runs(rows: list[dict[str, str]]) -> dict[str, dict[str, list[dict[str, str]]]]:
    """Of each policy the rows of each seed."""
    found: dict[str, dict[str, list[dict[str, str]]]] = {}
    for row in rows:
        found.setdefault(row["policy"], {}).setdefault(row["seed"], []).append(row)
    return found


def table(rows: list[dict[str, str]]) -> str:
    """How far the feet are from the reference's, at the same phase, and how long the policy tracks it."""
    lines = list[dict[str, object]]()
    for policy, seeds in runs(rows).items():
        if policy != REFERENCE:
            errors = [100 * np.mean([float(row["error"]) for row in own]) for own in seeds.values()]
            line: dict[str, object] = {
                "policy": policy,
                "frames until the end": " ".join(str(len(own)) for own in seeds.values()),
            }
            lines.append(line | {"feet from the reference's, cm": " ".join(f"{error:.1f}" for error in errors)})
    return markdown(lines)


def draw(args: Args, rows: list[dict[str, str]]) -> None:
    """The first seed of each policy, with the reference in black."""
    found, panels = runs(rows), list[Panel]()

    def line(own: list[dict[str, str]], style: str, label: str, width: float) -> Line:
        points = np.array([(float(row["first"]), float(row["second"])) for row in own])
        return Line(points[:, 0], points[:, 1], style, label, width)

    for k, (policy, seeds) in enumerate((name, own) for name, own in found.items() if name != REFERENCE):
        first = next(iter(seeds.values()))
        both = [line(first, f"C{k}-", "", 0.6), *(line(own, "k-", REFERENCE, 1.2) for own in found[REFERENCE].values())]
        panels.append(Panel(both, policy, "first component (m)", "" if panels else "second component (m)"))
    plot(args.picture("feet"), [panels])


def main(args: Args) -> None:
    for path in args.measured:
        measure(load_case(path, 1, args.device), args)
    rows = args.read("feet")
    draw(args, rows)
    args.publish("feet", table(rows), "pfpn.md")


if __name__ == "__main__":
    main(parse(Args, __doc__))
