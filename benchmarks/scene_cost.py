"""What each part of a scene costs: links, contact spheres, limits, dampers, springs, balls, muscles.

    python benchmarks/scene_cost.py
    python benchmarks/scene_cost.py --device cuda --num-envs 4096

A scene is a floating chain of hinges; a ball joint stands in a hinge's place. One thing is added at a time; the cost of
a substep, forward and backward, is fitted by a line in the count, whose slope is the cost of one and whose R^2 says how
straight it is. "left out" is the largest difference in the state and its gradient between a scene that has the feature
where it does nothing and one that lacks it, float64. Writes scene_cost.csv (every measurement), scene_cost.png and the
table of docs/accuracy.md (the lines).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from common import Flags, Line, Panel, parse, plot
from motions import idle, integration, simulator
from speed import State, race, timer
from tables import Row, markdown

import diffsim
from diffsim import Scene
from diffsim.training import Count

SETTING = integration("semi_implicit", 16)
LINKS = 16  # of the chain to which everything but links is added
PARTS = {  # counts, and the feature that is code of its own
    "link": ((4, 8, 16, 32), ""),
    "sphere in the air": ((1, 4, 8, 16, 32), "contact"),
    "sphere in the ground": ((1, 4, 8, 16, 32), ""),
    "limit": ((1, 4, 8, 16), "limit"),
    "damper": ((1, 4, 8, 16), "damping"),
    "spring": ((1, 4, 8, 16), "stiffness"),
    "ball joint": ((1, 4, 8, 15), ""),
    "muscle": ((1, 4, 8, 15), "muscle"),
}
JOINTS = {  # the code, without the force
    "limit": 'range="-2 2" limited="true"',
    "damper": 'damping="1e-300"',
    "spring": 'stiffness="1e-300"',
    "ball joint": 'type="ball"',
}
MUSCLE = (  # from a link to the next
    '<spatial name="t{0}"> <site site="s{0}"/> <site site="s{1}"/> </spatial>',
    '<general tendon="t{0}" gainprm="-10" ctrllimited="true" ctrlrange="0 1"/>',
)


@dataclass
class Args(Flags):
    num_envs: Count = 256  # environments, on a CPU in one thread
    repeats: Count = 30  # timings of each scene; the fastest counts


def chain(links: int, what: str = "", count: int = 0) -> Scene:
    """A floating chain with `count` of `what`."""
    text = ""
    for k in range(links):
        first = 1 if what == "ball joint" else 0
        extra = JOINTS.get(what, "") if first <= k < count + first else ""
        joint = f'<joint axis="0 {k % 2} {1 - k % 2}" {extra}/>' if k else "<freejoint/>"
        spheres = range(len(range(k, count, links)) if what.startswith("sphere") else 0)
        geoms = '<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.04" contype="0" conaffinity="0"/>'
        geoms += "".join(f'<geom type="sphere" size="0.05" pos="{0.03 * s} 0 0"/>' for s in spheres)
        text += f'<body pos="{0.2 if k else 0} 0 0">{joint}{geoms}<site name="s{k}" pos="0.1 0 0.04"/>'
    text = f'<worldbody><geom type="plane" size="1 1 1"/>{text}{"</body>" * links}</worldbody>'
    if what == "muscle":
        tendons, motors = ("".join(part.format(k, k + 1) for k in range(count)) for part in MUSCLE)
        text += f"<tendon>{tendons}</tendon><actuator>{motors}</actuator>"
    with TemporaryDirectory() as folder:
        path = Path(folder) / "chain.xml"
        path.write_text(f'<mujoco><compiler angle="radian"/>{text}</mujoco>')
        return diffsim.load_scene(path)


def states(scene: Scene, num_envs: int, height: float) -> State:
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
        leaves = [x.clone().requires_grad_() for x in states(one, 4, 5.0)]
        q, v = simulator(one, SETTING, 4, torch.float64).step(*leaves)
        results.append([q, v, *torch.autograd.grad(q.square().sum() + v.square().sum(), leaves[:2])])
    return max(((a - b).abs().max() / a.abs().max()).item() for a, b in zip(*results, strict=True))


def measure(args: Args) -> Iterator[Row]:
    for what, (counts, feature) in PARTS.items():
        for count in counts:
            scene = chain(count) if what == "link" else chain(LINKS, what, count)
            threads = 1 if args.device == "cpu" else None
            sim = simulator(scene, SETTING, args.num_envs, device=args.device, threads=threads)
            state = states(scene, args.num_envs, 0.0 if what == "sphere in the ground" else 5.0)
            t = race({0: timer(sim)}, [state], args.repeats + 1)[0]
            row: dict[str, object] = {"of": what, "count": count, "environments": args.num_envs}
            row |= {
                f"{kind} (us/substep)": t[kind] / args.num_envs / SETTING.substeps for kind in ("forward", "backward")
            }
            yield row | {"left out": difference(scene, feature) if feature and count == counts[-1] else ""}


def main(args: Args) -> None:
    rows = args.merge("scene_cost", [] if args.draw_only else list(measure(args)), ("of", "count", "environments"))
    lines, panels = list[Row](), list[Panel]()
    for what in PARTS:
        found = [row for row in rows if row["of"] == what and row["environments"] == str(args.num_envs)]
        curves = list[Line]()
        line: dict[str, object] = {"of": what, "counts": " ".join(row["count"] for row in found)}
        for k, kind in enumerate(("forward", "backward")):
            x, y = (np.array([float(row[c]) for row in found]) for c in ("count", f"{kind} (us/substep)"))
            slope, start = np.polyfit(x, y, 1)
            line[f"{kind}: one (ns/substep)"] = f"{1e3 * slope:.3g}"
            line[f"{kind}: none (ns/substep)"] = f"{1e3 * start:.3g}"
            line[f"{kind}: R^2"] = f"{1 - ((y - slope * x - start) ** 2).sum() / ((y - y.mean()) ** 2).sum():.3f}"
            curves.append(Line(x, y, f"C{k}o-", kind))
        lines.append(line | {"left out": found[-1]["left out"]})
        panels.append(Panel(curves, what, "", "" if panels else "us per environment-substep", zero=True))
    args.publish("scene_cost", markdown(lines), {"cpu": "accuracy.md"})
    plot(args.picture("scene_cost"), [panels], (2.6, 2.8))


if __name__ == "__main__":
    main(parse(Args, __doc__))
