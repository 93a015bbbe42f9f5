"""What each part of a scene costs: links, contact spheres, limits, dampers, springs, balls, muscles.

    python benchmarks/scene_cost.py
    python benchmarks/scene_cost.py --device cuda --num-envs 4096

A scene is a floating chain of hinges; a ball joint stands in a hinge's place. One thing is added at a time; the cost of
a substep, forward and backward, is fitted by a line in the count, whose slope is the cost of one and whose R^2 says how
straight it is. "left out" is the largest difference in the state and its gradient between a scene that has the feature
where it does nothing and one that lacks it, float64. Writes benchmarks/results/scene_cost.csv (every measurement),
scene_cost.png and the table of docs/accuracy.md (the lines).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib
import numpy as np
import torch
import tyro
from common import DOCS, RESULTS, idle
from speed import time_diffsim
from tables import fill, markdown, merge_csv

import diffsim
from diffsim.run import fail
from diffsim.scene import Scene

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

SUBSTEPS = 16
LINKS = 16  # of the chain to which everything but links is added
COUNTS: dict[str, tuple[int, ...]] = {
    "link": (4, 8, 16, 32),
    "sphere in the air": (1, 4, 8, 16, 32),
    "sphere in the ground": (1, 4, 8, 16, 32),
    "limit": (1, 4, 8, 16),
    "damper": (1, 4, 8, 16),
    "spring": (1, 4, 8, 16),
    "ball joint": (1, 4, 8, 15),
    "muscle": (1, 4, 8, 15),
}
LEFT_OUT = {
    "sphere in the air": "contact",
    "limit": "limit",
    "damper": "damping",
    "spring": "stiffness",
    "muscle": "muscle",
}


@dataclass
class Args:
    device: str = "cpu"
    """torch device, cpu (one thread) or cuda"""
    num_envs: int = 256
    """environments"""
    repeats: int = 30
    """timings of each scene; the fastest counts"""
    output: Path = RESULTS
    """directory of the tables and the picture"""


def chain(links: int, what: str = "", count: int = 0) -> Scene:
    """A floating chain with `count` of `what`."""
    body = '<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.04" contype="0" conaffinity="0"/>'
    text, end = "", ""
    for k in range(links):
        joint = {
            "limit": 'range="-2 2" limited="true"',
            "damper": 'damping="1e-300"',  # the code, without the force
            "spring": 'stiffness="1e-300"',
        }.get(what, "")
        joint = f'<joint axis="0 {k % 2} {1 - k % 2}" {joint if k < count else ""}/>' if k else "<freejoint/>"
        if what == "ball joint" and 1 <= k <= count:
            joint = '<joint type="ball"/>'
        spheres = len(range(k, count, links)) if what.startswith("sphere") else 0
        geoms = "".join(f'<geom type="sphere" size="0.05" pos="{0.03 * s} 0 0"/>' for s in range(spheres))
        text, end = (
            f'{text}<body pos="{0.2 if k else 0} 0 0">{joint}{body}{geoms}<site name="s{k}" pos="0.1 0 0.04"/>',
            f"{end}</body>",
        )
    mjcf = f'<compiler angle="radian"/><worldbody><geom type="plane" size="1 1 1"/>{text}{end}</worldbody>'
    if what == "muscle":  # each from a link to the next
        path = '<spatial name="t{0}"> <site site="s{0}"/> <site site="s{1}"/> </spatial>'
        muscle = '<general tendon="t{0}" gainprm="-10" ctrllimited="true" ctrlrange="0 1"/>'
        mjcf += f"<tendon>{''.join(path.format(k, k + 1) for k in range(count))}</tendon>"
        mjcf += f"<actuator>{''.join(map(muscle.format, range(count)))}</actuator>"
    with TemporaryDirectory() as folder:
        path = Path(folder) / "chain.xml"
        path.write_text(f"<mujoco>{mjcf}</mujoco>")
        return diffsim.load_scene(path)


def states(scene: Scene, num_envs: int, height: float) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(0)

    def noise(width: int) -> torch.Tensor:
        return 0.1 * torch.randn(num_envs, width, generator=generator, dtype=torch.float64)

    qpos = noise(scene.nq)
    qpos[:, 2], qpos[:, 3] = height, 1.0
    qpos[:, scene.qpos_adr[scene.ball == 0]] = 1.0
    return qpos, noise(scene.nv), idle(scene).repeat(num_envs, 1)


def difference(scene: Scene, feature: str) -> float:
    """Largest over the state after a control step and its gradient, relative to each one's largest entry."""
    results = []
    for one in (scene, scene.without(feature)):
        sim = diffsim.Simulator(one, 4, diffsim.Integration(substeps=SUBSTEPS), dtype=torch.float64)
        leaves = [x.clone().requires_grad_() for x in states(one, 4, 5.0)]
        q, v = sim.step(*leaves)
        total = q.square().sum() + v.square().sum()
        results.append([q.detach(), v.detach(), *torch.autograd.grad(total, leaves[:2])])
    return max(((a - b).abs().max() / a.abs().max()).item() for a, b in zip(*results, strict=True))


def measure(args: Args) -> list[dict[str, Any]]:
    rows = []
    options: dict[str, Any] = {"threads": 1} if args.device == "cpu" else {"device": args.device}
    for what, counts in COUNTS.items():
        for count in counts:
            scene = chain(count) if what == "link" else chain(LINKS, what, count)
            sim = diffsim.Simulator(scene, args.num_envs, diffsim.Integration(substeps=SUBSTEPS), **options)
            state = states(scene, args.num_envs, 0.0 if what == "sphere in the ground" else 5.0)
            runs = [time_diffsim(sim, state) for _ in range(args.repeats + 1)][1:]
            row: dict[str, Any] = {"of": what, "count": count, "device": args.device, "environments": args.num_envs}
            for kind in ("forward", "backward"):
                row[f"{kind} (us/substep)"] = min(r[f"kernel {kind}"] for r in runs) / args.num_envs / SUBSTEPS
            rows.append(row)
            print("  " + ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    return rows


def fits(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    lines = []
    for what in COUNTS:
        found = [row for row in rows if row["of"] == what]
        line: dict[str, Any] = {"of": what, "counts": " ".join(str(row["count"]) for row in found)}
        for kind in ("forward", "backward"):
            x = np.array([float(row["count"]) for row in found])
            y = np.array([float(row[f"{kind} (us/substep)"]) for row in found])
            slope, start = np.polyfit(x, y, 1)
            spread = ((y - y.mean()) ** 2).sum()
            line[f"{kind}: one (ns/substep)"] = f"{1e3 * slope:.3g}"
            line[f"{kind}: none (ns/substep)"] = f"{1e3 * start:.3g}"
            line[f"{kind}: R^2"] = f"{1 - ((y - slope * x - start) ** 2).sum() / spread:.3f}"
        feature = LEFT_OUT.get(what)
        line["left out"] = f"{difference(chain(LINKS, what, max(COUNTS[what])), feature):.1g}" if feature else ""
        lines.append(line)
    return lines


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    figure, axes = plt.subplots(1, len(COUNTS), figsize=(2.6 * len(COUNTS), 2.8), layout="constrained")
    for axis, what in zip(axes, COUNTS, strict=True):
        found = [row for row in rows if row["of"] == what]
        for kind in ("forward", "backward"):
            axis.plot([r["count"] for r in found], [r[f"{kind} (us/substep)"] for r in found], "o-", label=kind)
        axis.set_ylim(bottom=0)
        axis.set_xlim(left=0)
        axis.set_title(what, fontsize=9)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("us per environment-substep")
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=100)


def main(args: Args) -> None:
    if min(args.num_envs, args.repeats) < 1:
        fail("--num-envs and --repeats must be at least 1")
    torch.set_num_threads(1)
    rows = measure(args)
    merge_csv(args.output / "scene_cost.csv", rows, ("of", "count", "device", "environments"))
    text = markdown(fits(rows))
    if args.device == "cpu":
        if args.output == RESULTS:
            fill(DOCS / "accuracy.md", "scene_cost", text)
        draw(rows, args.output / "scene_cost.png")
    print(text, end="")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
