"""benchmarks/gps_controllers.py on a small run: what is kept, what falls, and the tables."""

from __future__ import annotations

from pathlib import Path

import gps_controllers as controllers
import numpy as np
import pytest
import torch
from common import DOCS, RESULTS, CheckpointFlags
from gps_variants import named_terrains
from learners import run
from tables import markdown, read_csv

import gps

SMALL = (
    "--env hopper --horizon 12 --restarts 1 --screening 1 --ilqr-iterations 1 --pretraining 5 --hidden 8 --samples 2 "
    "--guiding-samples 4 --active 8 --stored 8 --iterations 1 --lbfgs-iterations 2 --eval-every 0 --eval-episodes 1"
).split()


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "hopper__feedback__1"
    run(gps, directory, *SMALL, "--quiet")
    return directory


@pytest.fixture
def search(hopper: Path) -> gps.Search:
    return controllers.load_search(hopper / "checkpoint.pt")


def test_the_command(hopper: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plan walks over level ground; a second call draws from the csv file alone."""
    incline, _ = controllers.TERRAINS["incline (degrees)"]
    monkeypatch.setattr(controllers, "TERRAINS", {"incline (degrees)": (incline, (0.0, 60.0))})
    controllers.main(CheckpointFlags(checkpoints=(hopper,), output=tmp_path))
    rows = {(row["size"], row["controller"]): row for row in read_csv(tmp_path / "gps_controllers.csv")}
    assert len(rows) == 6 and rows["0", "ddp"]["walked"] == "1"
    before = (tmp_path / "gps_controllers.csv").read_bytes()
    controllers.main(CheckpointFlags(draw_only=True, output=tmp_path))
    assert before == (tmp_path / "gps_controllers.csv").read_bytes()


def test_walkers_fall_on_a_steep_slope(search: gps.Search, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plan walks over level ground; on 60 degrees the robot that starts on the slope does not."""
    monkeypatch.setattr(controllers, "PLACES", [-0.5, 0.5])
    incline, _ = controllers.TERRAINS["incline (degrees)"]
    monkeypatch.setattr(controllers, "TERRAINS", {"incline (degrees)": (incline, (0.0, 60.0))})
    level, steep = (roll(controllers.controllers(search)["ddp"]) for _, _, roll in controllers.walking(search))
    torch.testing.assert_close(level[0][1, -1], search.guides[0].x[-1], rtol=1e-3, atol=1e-3)
    assert controllers.walked(search, *level).tolist() == [True, True]
    assert controllers.walked(search, *steep).tolist() == [False, True]
    x, u, finite = level
    x[0, 5, 1] = -1.0  # it falls, and stands up again
    assert controllers.walked(search, x, u, finite).tolist() == [False, True]


def test_humanoids_run_until_they_fall(search: gps.Search, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(controllers, "COUNT", 4)
    monkeypatch.setattr(controllers, "RUNNING", ((0.0, 99.0), (3.0,)))
    found = {
        (kind, size): controllers.seconds(search, *roll(controllers.controllers(search)["ddp"]))
        .double()
        .round(decimals=6)
        for kind, size, roll in controllers.running(search)
    }
    assert found["start", 0.0].tolist() == [0.2] * 4 and found["start", 99.0].min() < 0.2
    assert [len(each) for each in found.values()] == [4] * 4
    assert found["rough, 1 m (degrees)", 3.0].tolist() == [0.2] * 4  # level for the first metre


def test_controllers_by_time_and_by_what_looks_alike(search: gps.Search) -> None:
    guide, act = search.guides[0], controllers.controllers(search)
    torch.testing.assert_close(act["tbdp"](0, guide.x[8:9]), guide.u[8:9])
    torch.testing.assert_close(act["ddp"](8, guide.x[8:9]), guide.u[8:9])
    assert not torch.equal(act["ddp"](0, guide.x[8:9]), guide.u[8:9])


def test_terrains_are_ten_places_or_seeds(search: gps.Search, monkeypatch: pytest.MonkeyPatch) -> None:
    made = list[np.ndarray]()
    monkeypatch.setattr(controllers, "named_terrains", lambda *names: made.append(named_terrains(*names)) or made[-1])
    assert len(list(controllers.walking(search))) == len(made) == 15
    for profiles in made:
        assert len(profiles) == 10 and all((p[p[:, 0] < 0.5, 1] == 0).all() for p in profiles)
        assert len({p.tobytes() for p in profiles}) == 10


def test_a_policy_is_shown_beside_the_guides_of_its_own_training() -> None:
    rows = [
        dict(env="walker", variant=case, seed=str(seed), kind="step (cm)", size=size, controller=name)
        | dict(walked=str(share), seconds="")
        for case, shares in (("feedback-guides", (1.0, 0.0, 0.5)), ("feedback-slope", (0.5, 0.25, 1.0)))
        for size in ("5", "-5")
        for name, share in zip(controllers.CONTROLLERS, shares, strict=True)
        for seed in (1, 2)
    ]
    rows += [row | {"seed": "3", "size": "5", "walked": "1"} for row in rows[:6:2]]
    tables = controllers.printed(rows)
    assert not tables["gps humanoid"]
    up, _, everywhere = tables["gps terrain"]
    assert up["one slope"] == everywhere["one slope"] == "50% / 25% / 100%"
    assert up["11 terrains"] == "100% / 33% / 67%" and everywhere["11 terrains"] == "100% / 20% / 60%"


def test_pages_have_the_tables_of_the_csv_file() -> None:
    tables = controllers.printed(read_csv(RESULTS / "cpu" / "gps_controllers.csv"))
    page = (DOCS / "gps_terrain.md").read_text()
    assert all(f"<!-- {name} -->\n{markdown(table)}<!--" in page for name, table in tables.items())
    row = next(row for row in tables["gps terrain"] if row["trial"] == "incline (degrees) 10")
    assert row["one slope"] == "50% / 60% / 100%"  # the figure of the claim on Figure 3
