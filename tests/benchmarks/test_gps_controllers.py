"""benchmarks/gps_controllers.py on a small run: what walks, what falls, and the table."""

from __future__ import annotations

import math
from pathlib import Path

import gps_controllers as controllers
import pytest
import torch
from gps_variants import named_terrains
from learners import run
from tables import read_csv

import gps

SMALL = (
    "--env hopper --horizon 12 --pretraining 5 --hidden 8 --samples 2 --guiding-samples 4 --active 8 --iterations 1 "
    "--lbfgs-iterations 2 --eval-every 0 --eval-episodes 1 --quiet"
).split()


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "hopper__full__1"
    run(gps, directory, *SMALL)
    return directory


@pytest.fixture
def search(hopper: Path) -> gps.Search:
    return controllers.load_search(hopper / "checkpoint.pt")


def test_the_command(hopper: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The guide hops over level ground; a second call draws from the csv file alone."""
    monkeypatch.setattr(controllers, "terrains", lambda env: {"some": ["level", "incline:60:-1"]})
    controllers.main(controllers.Args(checkpoints=(hopper,), output=tmp_path))
    rows = {(row["terrain"], row["controller"]): row for row in read_csv(tmp_path / "gps_controllers.csv")}
    assert (
        len(rows) == 6 and rows["level", "ddp 1"]["walked"] == "1" and rows["incline:60:-1", "ddp 1"]["walked"] == "0"
    )
    before = (tmp_path / "gps_controllers.csv").read_bytes()
    controllers.main(controllers.Args(draw_only=True, output=tmp_path))
    assert before == (tmp_path / "gps_controllers.csv").read_bytes()


def test_who_falls_or_stays_behind_has_not_walked(search: gps.Search) -> None:
    x = search.guides[0].x.expand(4, -1, -1).clone()
    finite = torch.ones(4, 12, dtype=torch.bool)
    x[1, 5, 1] = x[1, 0, 1] - controllers.FALL - 0.01  # it falls, and stands up again
    finite[2, 3] = False
    x[3, -1, 0] = 0.89 * x[3, -1, 0]
    assert controllers.walked(search, x, finite).tolist() == [True, False, False, False]


def test_controllers_by_time_and_by_what_looks_alike(search: gps.Search) -> None:
    guide, act = search.guides[0], controllers.controllers(search)
    torch.testing.assert_close(act["tbdp"](0, guide.x[8:9]), guide.u[8:9])
    torch.testing.assert_close(act["ddp 1"](8, guide.x[8:9]), guide.u[8:9])
    assert not torch.equal(act["ddp 1"](0, guide.x[8:9]), guide.u[8:9])
    away = torch.zeros_like(guide.x[8:9])
    away[0, 0], away[0, 4] = 3.0, 1e-4  # the place does not count
    torch.testing.assert_close(act["tbdp"](0, guide.x[8:9] + away), guide.u[8:9] + 1e-4 * guide.K[8, :, 4])


@pytest.mark.parametrize(("env", "rough"), [("humanoid", 1), ("walker", 3)])
def test_terrains_are_eight_places_and_four_grounds_of_each_steepness(env: str, rough: int) -> None:
    found = controllers.terrains(env)
    assert [len(names) for names in found.values()] == [8, *[4] * rough]
    assert len({named_terrains(name).tobytes() for names in found.values() for name in names}) == 8 + 4 * rough


def test_the_table_has_the_best_guide_of_each_training() -> None:
    shares = {"1": {"policy": 1.0, "ddp 1": 0.0, "ddp 2": 0.5, "tbdp": 0.1}, "2": {"policy": 0.0, "ddp 1": 1.0}}
    shares["2"] |= {"ddp 2": 0.0, "tbdp": 0.3}
    about = {"kind": "rough", "variant": "full"}
    rows = [about | {"seed": s, "controller": c, "walked": f"{x}"} for s, own in shares.items() for c, x in own.items()]
    assert controllers.table(rows) == [{"over": "rough", "full": "50% / 75% / 20%"}]


def test_growth_is_the_largest_exponent() -> None:
    loop = torch.tensor([[1.1, 0.3], [0.0, 0.5]]).double().expand(4000, 2, 2)
    assert controllers.growth(loop, 0.02) == pytest.approx(math.log(1.1) / 0.02, rel=1e-2)
