"""benchmarks/gps_terrain.py on a small run."""

from __future__ import annotations

import math
from pathlib import Path

import gps_experiments as experiments
import gps_terrain
import numpy as np
import pytest
import torch
from common import DOCS, RESULTS, CheckpointFlags
from learners import run
from tables import markdown, read_csv

import gps
from diffsim.planning.terrains import named_terrains

SMALL = (
    "--env hopper --horizon 3 --restarts 1 --screening 1 --ilqr-iterations 1 --pretraining 5 --hidden 8 --samples 2 "
    "--guiding-samples 4 --active 8 --stored 8 --iterations 1 --lbfgs-iterations 2 --eval-every 0 --eval-episodes 1"
).split()


def test_level_ground_repeats_the_plan_and_a_steep_slope_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory, output = tmp_path / "hopper__feedback__1", tmp_path / "results"
    run(gps, directory, *SMALL, "--quiet")
    monkeypatch.setattr(gps_terrain, "PLACES", [-0.5, 0.5])
    monkeypatch.setattr(gps_terrain, "SIZES", {"incline (degrees)": (0.0, 60.0)})
    gps_terrain.main(CheckpointFlags(checkpoints=(directory,), output=output))
    rows = {(row["size"], row["controller"]): row for row in read_csv(output / "gps_terrain.csv")}
    assert len(rows) == 6
    level, steep = (next(row for (s, c), row in rows.items() if (float(s), c) == (size, "ddp")) for size in (0.0, 60.0))
    plan = experiments.load_search(directory / "checkpoint.pt").plan_return
    assert float(level["median_return"]) == pytest.approx(plan, rel=1e-3)
    assert level["kept"] == level["walked"] == level["standing"] == "1"
    assert (
        float(steep["median_return"]) < float(level["median_return"]) and steep["walked"] == "0.5"
    )  # one starts on it
    before = (output / "gps_terrain.csv").read_bytes()
    gps_terrain.main(CheckpointFlags(draw_only=True, output=output))
    assert before == (output / "gps_terrain.csv").read_bytes()


def test_terrains() -> None:
    for terrain, sizes in gps_terrain.SIZES.items():
        for size in sizes:
            profiles = named_terrains(*gps_terrain.names(terrain, size))
            assert len(profiles) == 10 and all((p[p[:, 0] < 0.5, 1] == 0).all() for p in profiles)
            assert len({p.tobytes() for p in profiles}) == 10
    slope = named_terrains(*gps_terrain.names("incline (degrees)", 10.0))
    step = named_terrains(*gps_terrain.names("step (cm)", -5.0))
    np.testing.assert_allclose(slope[:, 1:, 1], [[0.0, math.tan(math.radians(10.0))]] * 10)
    np.testing.assert_allclose(step[:, 2, 1], -0.05)
    for segment in (1, 2):
        rough = named_terrains(*gps_terrain.names(f"rough, {segment} m (degrees)", 10.0))
        np.testing.assert_allclose(np.diff(rough[:, 1:-1, 0]), segment)


def test_table_means_over_seeds() -> None:
    keys = dict(env="walker", T="160", terrain="step (cm)", size="-5.0")
    rows = [
        keys | dict(variant=case, seed=seed, controller=controller, walked=walked)
        for case, seed, controller, walked in (
            ("feedback-short", "1", "policy", "0.2"),
            ("feedback-terrain", "1", "policy", "1"),
            ("feedback-terrain", "2", "policy", "0.5"),
            ("feedback-terrain", "1", "ddp", "0"),
            ("feedback-terrain", "2", "tbdp", "0.25"),
        )
    ]
    (row,) = (row for row in gps_terrain.table(rows) if (row["terrain"], row["size"]) == ("step (cm)", "-5"))
    assert row == {
        "terrain": "step (cm)",
        "size": "-5",
        "level": "20",
        "11 terrains, random": "75",
        "DDP": "0",
        "TBDP": "25",
    }
    other = keys | dict(variant="feedback-terrain", controller="policy", terrain="step (cm)", size="2.0")
    *_, last = gps_terrain.table([*rows, other | dict(seed="1", walked="1"), other | dict(seed="2", walked="0.5")])
    assert (last["terrain"], last["11 terrains, random"], last["level"]) == ("all", "75", "20")


def test_until_a_fall() -> None:
    x = torch.zeros(2, 4, 3)
    x[..., 0] = torch.tensor([0.5, 1.0, 2.0, 4.0])
    x[1, :, 1] = torch.tensor([0.2, -0.2, -0.3, 0.2])  # sinks by half a metre at the third state
    standing, distance = gps_terrain.until_fall(x, 1)
    assert standing.tolist() == [True, False]
    assert distance.tolist() == [3.5, 0.5]


def test_the_page_has_the_table_of_the_csv_file() -> None:
    rows = [row for row in read_csv(RESULTS / "cpu" / "gps_terrain.csv") if row["env"] == "walker"]
    assert markdown(gps_terrain.table(rows)) in (DOCS / "gps_terrain.md").read_text()
