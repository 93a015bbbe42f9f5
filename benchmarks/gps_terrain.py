"""Guided policy search on slopes, steps and rough ground that no training saw, beside its guides (Figures 3 and 4).

    python benchmarks/gps_terrain.py runs/gps/walker__feedback-short__1 runs/gps/hopper__feedback__1
    python benchmarks/gps_terrain.py --draw-only

Takes runs of gps_experiments.py. Each terrain has ten profiles: a slope or step begins at ten places 10 cm apart, so
that a robot meets it in ten phases of its gait; rough ground has ten seeds. All controllers get heights over the ground
(System.over_ground), as a task's observations do; velocities and angles are the world's. None sees the terrain. A robot
falls where its root sinks 0.45 m below its start's height over the ground. A trajectory is kept if the robot does not
fall and its return is within a quarter of the guides' mean.

Writes gps_terrain.csv, gps_terrain.png and, with --update-results, the table of docs/gps.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import mean

import common
from common import Line, Panel, parse, plot
from gps_experiments import CONTROLLERS, RUN, controllers, environment, grouped, load_search
from tables import Row, digits, markdown
from torch import Tensor

from diffsim.planning import System
from diffsim.terrain import named_terrains

PLACES = [0.5 + 0.1 * i for i in range(10)]  # m, where a slope or a step begins
SEEDS = range(1000, 1010)
FALL, WALKED = 0.45, 0.9  # m; of the guides' way
SIZES = {  # of each terrain
    "incline (degrees)": (-10.0, -5.0, -2.5, 0.0, 2.5, 5.0, 10.0),
    "step (cm)": (-5.0, -2.0, 2.0, 5.0),
    "rough, 1 m (degrees)": (5.0, 10.0),
    "rough, 2 m (degrees)": (5.0, 10.0),
}
KEY = (*RUN, "terrain", "size", "controller")


def names(terrain: str, size: float) -> list[str]:
    """As diffsim.terrain.named_terrains takes them."""
    kind, segment = terrain.split()[0], "1" if "1 m" in terrain else "2"
    if kind.startswith("rough"):
        return [f"rough:{size:g}:{segment}:{seed}:{PLACES[0]}" for seed in SEEDS]
    return [f"{kind}:{size:g}:{place:g}" for place in PLACES]


def until_fall(x: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """Whether robots stand to the end (...), and how far they come along x before they fall (...) [m].

    Of states x (..., T + 1, nx) over the ground, whose coordinate `height` is the root's.
    """
    up = (x[..., height] > x[..., :1, height] - FALL).cumprod(-1)
    last = up.sum(-1, keepdim=True) - 1
    return up[..., -1].bool(), (x[..., 0].gather(-1, last) - x[..., :1, 0]).squeeze(-1)


def measure(path: Path) -> Iterator[Row]:
    """One row for each terrain, size and controller."""
    run, search, env = dict(zip(RUN, path.parent.name.split("__"), strict=True)), load_search(path), environment(path)
    guides, height = search.guide_return[0], 2 if search.system.scene.floating else 1
    far = WALKED * mean((guide.x[-1, 0] - guide.x[0, 0]).item() for guide in search.guides)
    start = search.guides[0].x[:1].expand(len(PLACES), -1)
    for terrain, size in ((terrain, size) for terrain, sizes in SIZES.items() for size in sizes):
        system = System(env, 1, named_terrains(*names(terrain, size)))
        for name, act in controllers(search).items():
            x, u, finite = system.rollout(start, search.args.horizon, act)
            returns, (up, distance) = search.measure(x, u, finite).returns, until_fall(x, height)
            standing = up & finite.all(-1)
            kept = standing & (returns >= guides - 0.25 * abs(guides))
            shares = dict(kept=kept, walked=standing & (distance >= far), standing=standing, distance=distance)
            means = {key: value.double().mean().item() for key, value in shares.items()}
            row = run | dict(terrain=terrain, size=size, controller=name) | means
            yield row | dict(median_return=returns.median().item(), guides=guides)


def main(args: common.CheckpointFlags) -> None:
    for path in args.measured:
        for row in measure((path / "checkpoint.pt" if path.is_dir() else path).resolve()):
            print(", ".join(digits(value) for value in row.values()), flush=True)
            args.merge("gps_terrain", [row], KEY)
    table, grid = list[Row](), dict[tuple[str, str], list[Panel]]()
    for (env, variant, terrain), rows in grouped(args.read("gps_terrain"), *RUN[:2], "terrain").items():
        shares = dict[str, dict[float, float]]()  # kept, by controller and size
        for (size,), own in grouped(rows, "size").items():
            means: dict[str, list[float]] = {column: [] for column in ("kept", "walked", "standing", "distance")}
            for name in CONTROLLERS:
                for column, values in means.items():
                    values.append(mean(float(row[column]) for row in own if row["controller"] == name))
                shares.setdefault(name, {})[float(size)] = 100 * means["kept"][-1]
            cells = {
                column: " / ".join(f"{value:.0%}" for value in means[column])
                for column in ("kept", "walked", "standing")
            }
            cells["m until a fall"] = " / ".join(f"{value:.1f}" for value in means["distance"])
            table.append({"task": env, "case": variant, "terrain": terrain, "size": size} | cells)
        lines = [Line(list(s), list(s.values()), f"{CONTROLLERS[name]}o-", name) for name, s in shares.items()]
        sizes = list(shares["policy"])
        lines.append(Line(sizes, [100.0] * len(sizes), "k:", width=0.5))
        grid.setdefault((env, variant), []).append(Panel(lines, f"{env}, {variant}", terrain, "kept (%)", zero=True))
    plot(args.picture("gps_terrain"), list(grid.values()) or [[]])
    args.publish("gps terrain", markdown(table), "gps.md")


if __name__ == "__main__":
    main(parse(common.CheckpointFlags, __doc__))
