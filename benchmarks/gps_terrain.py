"""Guided policy search on slopes, steps and rough ground, beside its guides (Figures 3 and 4).

    python benchmarks/gps_terrain.py runs/gps/walker__feedback-short__1 runs/gps/hopper__feedback__1

Takes runs of gps_experiments.py. Each terrain has ten profiles: a slope or step begins at ten places 10 cm apart, so
that a robot meets it in ten phases of its gait; rough ground has ten seeds. All controllers get heights over the ground
as a task's observations do; velocities and angles are the world's. None sees the terrain. A robot stands if its root
never sinks 0.45 m below its start's height over the ground. It has walked over a terrain if it stands to the end and
has come at least 90 % as far as the guides. It keeps the guides' return if it stands, and that is within a quarter.

Writes gps_terrain.csv and, with --update-results, the table of docs/gps_terrain.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import mean

from common import CheckpointFlags, Part, measured, run
from gps_experiments import RUN, controllers, keeps, load_run, scalars
from groups import grouped, numbers
from tables import Row
from torch import Tensor

from diffsim.planning import System
from diffsim.planning.terrains import named_terrains

PLACES = [0.5 + 0.1 * i for i in range(10)]  # m, where a slope or a step begins
SEEDS = range(1000, 1010)
FALL, FAR = 0.45, 0.9  # m; of the guides' way
SIZES = {  # of each terrain
    "incline (degrees)": (-10.0, -5.0, -2.5, 0.0, 2.5, 5.0, 10.0),
    "step (cm)": (-5.0, -2.0, 2.0, 5.0),
    "rough, 1 m (degrees)": (5.0, 10.0),
    "rough, 2 m (degrees)": (5.0, 10.0),
}
HIDDEN = {*(-2.5, 2.5), *(-2.0, 2.0)}  # slopes and steps that the table leaves out
GROUNDS = {  # the walker's training, by the cases of gps_experiments.py; guides are shown of the last
    "feedback-short": "level",
    "feedback-slope": "one slope",
    "feedback-rough": "rough",
    "feedback-guides": "11 terrains",
    "feedback-practice": "level, random",
    "feedback-terrain": "11 terrains, random",
}
KEY = (*RUN, "T", "terrain", "size", "controller")


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


def measure(args: CheckpointFlags, path: Path) -> Iterator[Row]:
    """One row for each terrain, size and controller."""
    about, search = load_run(path)
    steps, height, guides = search.args.horizon, 2 if search.system.scene.floating else 1, search.guide_return[0]
    way = mean((guide.x[-1, 0] - guide.x[0, 0]).item() for guide in search.guides)
    start = search.guides[0].x[:1].expand(len(PLACES), -1)
    for terrain, size in ((terrain, size) for terrain, sizes in SIZES.items() for size in sizes):
        system = System(search.env, 1, named_terrains(*names(terrain, size)))
        for name, act in controllers(search).items():
            x, u, finite = system.rollout(start, steps, act)
            returns, (up, distance) = search.measure(x, u, finite).returns, until_fall(x, height)
            standing = up & finite.all(-1)
            kept, walked = keeps(returns, guides), distance >= FAR * way
            shares = dict(kept=kept & standing, walked=walked & standing, standing=standing, distance=distance)
            row = about | dict(T=steps, terrain=terrain, size=size, controller=name)
            row |= scalars(**{key: value.double().mean() for key, value in shares.items()})
            yield row | scalars(median_return=returns.median(), guides=guides)


def table(rows: list[dict[str, str]]) -> list[Row]:
    """A row for each terrain, a column for the walkers trained on each ground, and two for the last one's guides."""
    walkers = grouped((row for row in rows if row["env"] == "walker"), "variant", "controller")
    cases = [case for case in GROUNDS if (case, "policy") in walkers]
    columns = {GROUNDS[case]: walkers[case, "policy"] for case in cases}
    columns |= {name.upper(): walkers.get((cases[-1], name), []) for name in ("ddp", "tbdp") if cases}
    shown = [(terrain, [size]) for terrain, sizes in SIZES.items() for size in sizes if size not in HIDDEN]
    result = list[Row]()
    for terrain, sizes in [*shown, ("all", [])]:
        line: dict[str, object] = {"terrain": terrain, "size": f"{sizes[0]:g}" if sizes else ""}
        for column, own in columns.items():
            here = [r for r in own if not sizes or (r["terrain"] == terrain and float(r["size"]) in sizes)]
            line[column] = f"{100 * mean(numbers(here, 'walked')):.0f}" if here else ""
        result.append(line)
    return result


def main(args: CheckpointFlags) -> None:
    measured(args, Part("gps_terrain", measure, KEY, "gps terrain", "gps_terrain.md", table))


if __name__ == "__main__":
    run(main, CheckpointFlags, __doc__)
