"""benchmarks/gps_terrain.py on a small run."""

from __future__ import annotations

from pathlib import Path

import gps_experiments as experiments
import gps_terrain
import pytest
import torch
from common import CheckpointFlags
from learners import run
from tables import read_csv

import gps

SMALL = (
    "--env hopper --horizon 3 --restarts 1 --screening 1 --ilqr-iterations 1 --pretraining 5 --hidden 8 --samples 2 "
    "--guiding-samples 4 --active 8 --stored 8 --iterations 1 --lbfgs-iterations 2 --eval-every 0 --eval-episodes 1"
).split()


def test_level_ground_repeats_the_plan_and_a_pit_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory, output = tmp_path / "hopper__feedback__1", tmp_path / "results"
    run(gps, directory, *SMALL, "--quiet")
    monkeypatch.setattr(gps_terrain, "PLACES", [-0.5, 0.5])
    monkeypatch.setattr(gps_terrain, "SIZES", {"incline (degrees)": (0.0,), "step (cm)": (-1000.0,)})
    gps_terrain.main(CheckpointFlags(checkpoints=(directory,), output=output))
    rows = {(row["terrain"], row["controller"]): row for row in read_csv(output / "gps_terrain.csv")}
    assert len(rows) == 6
    level, pit = rows["incline (degrees)", "ddp"], rows["step (cm)", "ddp"]
    plan = experiments.load_search(directory / "checkpoint.pt").plan_return
    assert float(level["median_return"]) == pytest.approx(plan, rel=1e-3) and float(level["standing"]) == 1.0
    assert float(pit["median_return"]) < float(level["median_return"])  # ten metres below the start
    assert (output / "gps_terrain.png").is_file()
    before = (output / "gps_terrain.csv").read_bytes()
    gps_terrain.main(CheckpointFlags(draw_only=True, output=output))
    assert before == (output / "gps_terrain.csv").read_bytes()


def test_terrains() -> None:
    for terrain, sizes in gps_terrain.SIZES.items():
        for size in sizes:
            profiles = gps_terrain.profiles(terrain, size)
            assert len(profiles) == 10 and all((p[p[:, 0] < 0.5, 1] == 0).all() for p in profiles)
            assert len({p.tobytes() for p in profiles}) == 10


def test_until_a_fall() -> None:
    x = torch.zeros(2, 4, 3)
    x[..., 0] = torch.tensor([0.5, 1.0, 2.0, 4.0])
    x[1, :, 1] = torch.tensor([0.2, -0.2, -0.3, 0.2])  # sinks by half a metre at the third state
    standing, distance = gps_terrain.until_fall(x, 1)
    assert standing.tolist() == [True, False]
    assert distance.tolist() == [3.5, 0.5]
