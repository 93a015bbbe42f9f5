"""benchmarks/gps_terrain.py on a small run: what stands, what falls, and the tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import gps_experiments as experiments
import gps_terrain
import numpy as np
import pytest
import torch
from common import DOCS, RESULTS, CheckpointFlags
from gps_ground import named_terrains
from learners import run
from tables import Row, markdown, read_csv

import gps

SMALL = (
    "--env hopper --horizon 6 --restarts 1 --screening 1 --ilqr-iterations 1 --pretraining 5 --hidden 8 --samples 2 "
    "--guiding-samples 4 --active 8 --stored 8 --iterations 1 --lbfgs-iterations 2 --eval-every 0 --eval-episodes 1"
).split()


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "hopper__feedback__1"
    run(gps, directory, *SMALL, "--quiet")
    return directory


def test_level_ground_repeats_the_plan_and_a_steep_slope_does_not(
    hopper: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gps_terrain, "PLACES", [-0.5, 0.5])
    monkeypatch.setattr(gps_terrain, "SIZES", {"incline (degrees)": (0.0, 60.0)})
    gps_terrain.main(CheckpointFlags(checkpoints=(hopper,), output=tmp_path))
    rows = {(float(row["size"]), row["controller"]): row for row in read_csv(tmp_path / "gps_terrain.csv")}
    assert len(rows) == 6 and not read_csv(tmp_path / "gps_humanoid.csv")
    level, steep = rows[0.0, "ddp"], rows[60.0, "ddp"]
    plan = experiments.load_search(hopper / "checkpoint.pt").plan_return
    assert float(level["median_return"]) == pytest.approx(plan, rel=5e-3)
    assert level["kept"] == level["walked"] == level["standing"] == "1"
    assert (
        float(steep["median_return"]) < float(level["median_return"]) and steep["walked"] == "0.5"
    )  # one starts on it
    before = (tmp_path / "gps_terrain.csv").read_bytes()
    gps_terrain.main(CheckpointFlags(draw_only=True, output=tmp_path))
    assert before == (tmp_path / "gps_terrain.csv").read_bytes()


def test_until_humanoids_fall(hopper: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody falls within a tenth of a second, unless it starts in the ground; perturbed starts differ from none."""
    sizes = {"policy's noise": (1.0,), "perturbed start": (0.0, 99.0), "rough, 1 m (degrees)": (3.0,)}
    monkeypatch.setattr(gps_terrain, "HUMANOID", sizes)
    monkeypatch.setattr(gps_terrain, "COUNT", 4)
    monkeypatch.setattr(gps_terrain, "is_humanoid", lambda path: True)
    gps_terrain.main(CheckpointFlags(checkpoints=(hopper,), output=tmp_path))
    rows = {(row["case"], row["size"], row["controller"]): row for row in read_csv(tmp_path / "gps_humanoid.csv")}
    assert len(rows) == 12 and not read_csv(tmp_path / "gps_terrain.csv")
    noisy = [rows["policy's noise", "1", name] for name in ("ddp", "tbdp")]
    assert all(float(row["seconds"]) == 0.1 for row in noisy)
    still, far = rows["perturbed start", "0", "ddp"], rows["perturbed start", "99", "ddp"]
    assert float(still["whole"]) == 1.0 > float(far["whole"]) and still["trajectories"] == "4"
    assert float(still["speed"]) != float(noisy[0]["speed"])
    rough = rows["rough, 1 m (degrees)", "3", "ddp"]  # level for the first metre
    assert rough["speed"] == still["speed"] and rough["trajectories"] == "4"


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


def test_humanoids_table_means_over_seeds() -> None:
    """A column a kind of run."""
    rows = [
        dict(env="humanoid", variant=variant, seed=str(seed), case="rough", size="3", controller=name)
        | dict(seconds=str(4 * share + seed))
        for variant in ("feedback", "other")
        for name, share in (("policy", 0.25), ("ddp", 0.5), ("tbdp", 0.0))
        for seed in (0, 2)
    ]
    (row,) = gps_terrain.humanoids(rows)
    assert row == {"": "rough", "size": "3"} | dict.fromkeys(("feedback", "other"), "2.0 / 3.0 / 1.0")


def test_until_a_fall() -> None:
    """The way after it is not run, also by one that stands up again."""
    x, up = torch.zeros(2, 4, 3), torch.tensor([[True] * 3, [True, False, True]])
    x[..., 0] = torch.tensor([0.5, 1.0, 2.0, 4.0])
    steps, way = gps_terrain.until_fall(x, up)
    assert steps.tolist() == [3, 1] and way.tolist() == [3.5, 0.5]


def test_noise_is_of_its_own_step() -> None:
    noise = torch.arange(6.0).view(1, 3, 2)
    act = experiments.noisy(lambda t, x: 10 * t + x, noise)
    assert act(2, torch.ones(1, 2)).tolist() == [[25.0, 26.0]]


@pytest.mark.parametrize(
    ("name", "table"), [("gps_terrain", gps_terrain.table), ("gps_humanoid", gps_terrain.humanoids)]
)
def test_the_page_has_the_tables_of_the_csv_files(name: str, table: Callable[..., list[Row]]) -> None:
    rows = read_csv(RESULTS / "cpu" / f"{name}.csv")
    assert markdown(table(rows)) in (DOCS / "gps_terrain.md").read_text()
