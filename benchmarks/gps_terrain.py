"""Guided policy search on slopes, steps and rough ground, beside its guides (Figures 3 and 4).

    python benchmarks/gps_terrain.py runs/gps/walker__feedback-short__1 runs/gps/hopper__feedback__1
    python benchmarks/gps_terrain.py --steps 500 runs/gps/walker__feedback-terrain__1      longer than its guides
    python benchmarks/gps_terrain.py --draw-only

Takes runs of gps_experiments.py. Each terrain has ten profiles: a slope or step begins at ten places 10 cm apart, so
that a robot meets it in ten phases of its gait; rough ground has ten seeds. All controllers get heights over the ground
as a task's observations do; velocities and angles are the world's. None sees the terrain. A robot stands if its root
never sinks 0.45 m below its start's height over the ground. It has walked over a terrain if it stands to the end and
has come at least 90 % as far as the guides. It keeps the guides' return if it stands, and that is within a quarter.

Writes gps_terrain.csv, gps_terrain.png and, with --update-results, the table of docs/gps_terrain.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import common
from common import Line, Panel, parse, plot
from gps_experiments import RUN, controllers, environment, load_search
from tables import Row, digits, markdown
from torch import Tensor

from diffsim.planning import System
from diffsim.planning.terrains import named_terrains
from diffsim.training import Natural

PLACES = [0.5 + 0.1 * i for i in range(10)]  # m, where a slope or a step begins
SEEDS = range(1000, 1010)
FALL, FAR = 0.45, 0.9  # m; of the guides' way
SIZES = {  # of each terrain
    "incline (degrees)": (-10.0, -5.0, -2.5, 0.0, 2.5, 5.0, 10.0),
    "step (cm)": (-5.0, -2.0, 2.0, 5.0),
    "rough, 1 m (degrees)": (5.0, 10.0),
    "rough, 2 m (degrees)": (5.0, 10.0),
}
SHOWN = {  # in the table
    "incline (degrees)": (-10.0, -5.0, 0.0, 5.0, 10.0),
    "step (cm)": (-5.0, 5.0),
    "rough, 1 m (degrees)": (10.0,),
    "rough, 2 m (degrees)": (10.0,),
}
ALL = f"all {sum(map(len, SIZES.values()))}"  # the table's last row
GROUNDS = {  # of training, by the cases of gps_experiments.py; guides are shown of the last
    "feedback": "level",
    "feedback-short": "level",
    "feedback-slope": "one slope",
    "feedback-rough": "rough",
    "feedback-guides": "11 terrains",
    "feedback-practice": "level, random",
    "feedback-terrain": "11 terrains, random",
}
KEY = (*RUN, "T", "terrain", "size", "controller")


@dataclass
class Args(common.CheckpointFlags):
    steps: Natural = 0  # control steps of a trajectory (default: the horizon of training)


def names(terrain: str, size: float) -> list[str]:
    """As diffsim.planning.terrains.named_terrains takes them."""
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


def measure(path: Path, steps: int) -> Iterator[Row]:
    """One row for each terrain, size and controller. Beyond the guides' horizon there is no DDP controller."""
    run, search, env = dict(zip(RUN, path.parent.name.split("__"), strict=True)), load_search(path), environment(path)
    horizon, height = search.args.horizon, 2 if search.system.scene.floating else 1
    steps = steps or horizon
    guides = search.guide_return[0] * steps / horizon
    way = mean((guide.x[-1, 0] - guide.x[0, 0]).item() for guide in search.guides) * steps / horizon
    start = search.guides[0].x[:1].expand(len(PLACES), -1)
    acts = {name: act for name, act in controllers(search).items() if name != "ddp" or steps <= horizon}
    for terrain, size in ((terrain, size) for terrain, sizes in SIZES.items() for size in sizes):
        system = System(env, 1, named_terrains(*names(terrain, size)))
        for name, act in acts.items():
            x, u, finite = system.rollout(start, steps, act)
            returns, (up, distance) = search.measure(x, u, finite).returns, until_fall(x, height)
            standing = up & finite.all(-1)
            kept, walked = returns >= guides - 0.25 * abs(guides), distance >= FAR * way
            shares = dict(kept=kept & standing, walked=walked & standing, standing=standing, distance=distance)
            means = {key: value.double().mean().item() for key, value in shares.items()}
            row = run | dict(T=steps, terrain=terrain, size=size, controller=name) | means
            yield row | dict(median_return=returns.median().item(), guides=guides)


def share(rows: list[dict[str, str]], column: str, size: float | None, **keys: object) -> float:
    """Mean [%] of a column over the rows with this size, None: any, and these keys; nan if there are none."""
    own = [row for row in rows if size in (None, float(row["size"])) and all(row[key] == keys[key] for key in keys)]
    return 100 * mean(float(row[column]) for row in own) if own else math.nan


def table(rows: list[dict[str, str]]) -> list[Row]:
    """Of one task: a row for each terrain, columns for the policies trained on each ground, and the last's guides."""
    cases, result = [case for case in GROUNDS if any(row["variant"] == case for row in rows)], list[Row]()
    shown: list[tuple[str, float | None]] = [(terrain, size) for terrain, sizes in SHOWN.items() for size in sizes]
    for T in dict.fromkeys(row["T"] for row in rows):
        for terrain, size in [*shown, (ALL, None)]:
            cells = {GROUNDS[case]: dict(variant=case, controller="policy") for case in cases}
            cells |= {f"its {name.upper()}": dict(variant=cases[-1], controller=name) for name in ("ddp", "tbdp")}
            row: dict[str, object] = {"steps": T, "terrain": terrain, "size": "" if size is None else f"{size:g}"}
            here = {"T": T} if size is None else {"T": T, "terrain": terrain}
            for column, keys in cells.items():
                walked, kept = (share(rows, c, size, **here, **keys) for c in ("walked", "kept"))
                row[column] = "" if math.isnan(walked) else f"{walked:.0f} ({kept:.0f})"
            result.append(row)
    return result


def panels(rows: list[dict[str, str]]) -> list[list[Panel]]:
    """Of one task and number of steps: what is walked over, by the ground of training; below, by the controller."""
    cases = [case for case in GROUNDS if any(row["variant"] == case for row in rows)]
    grounds = {GROUNDS[case]: dict(variant=case, controller="policy") for case in cases}
    last = {f"its {name.upper()}": dict(variant=cases[-1], controller=name) for name in ("ddp", "tbdp")}
    acts = {GROUNDS[cases[-1]]: grounds[GROUNDS[cases[-1]]]} | last
    colours = [f"C{i}" for i in range(len(cases))]
    grid = list[list[Panel]]()
    for lines, styles in ((grounds, colours), (acts, [colours[-1], "k", "m"])):
        grid.append([])
        for terrain, sizes in SIZES.items():
            drawn = []
            for (label, keys), style in zip(lines.items(), styles, strict=True):
                y = [share(rows, "walked", size, terrain=terrain, **keys) for size in sizes]
                drawn.append(Line(sizes, y, f"{style}o-", label))
            grid[-1].append(Panel(drawn, "", terrain, "walked over (%)", zero=True))
    return grid


def main(args: Args) -> None:
    for path in args.measured:
        for row in measure(common.checkpoint_of(path), args.steps):
            print(", ".join(digits(value) for value in row.values()), flush=True)
            args.merge("gps_terrain", [row], KEY)
    rows = [row for row in args.read("gps_terrain") if row["variant"] in GROUNDS]
    tasks = sorted({row["env"] for row in rows}, reverse=True)  # the page shows the walker
    rows = [row for row in rows if row["env"] == tasks[0]]
    if rows:
        plot(args.picture("gps_terrain"), panels([row for row in rows if row["T"] == rows[0]["T"]]))
        args.publish("gps terrain", markdown(table(rows)), "gps_terrain.md")


if __name__ == "__main__":
    main(parse(Args, __doc__))
