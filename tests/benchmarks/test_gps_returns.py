"""benchmarks/gps_returns.py: the picture of the page, from the csv file that is shown."""

from __future__ import annotations

import shutil
from pathlib import Path

import common
import gps_returns
from suites import SUITES
from tables import read_csv


def test_it_is_drawn_from_the_csv_file(tmp_path: Path) -> None:
    shutil.copy(common.RESULTS / "cpu" / "gps_runs.csv", tmp_path)
    gps_returns.main(common.CommonFlags(output=tmp_path))
    assert (tmp_path / "gps_runs.png").read_bytes()[:4] == b"\x89PNG"


def test_every_variant_of_a_group_has_its_name() -> None:
    rows = read_csv(common.RESULTS / "cpu" / "gps_runs.csv")
    shown = {row["cell"] for row in rows if row["group"] in gps_returns.GROUPS}
    assert shown <= {*gps_returns.NAMES} <= {*SUITES["gps"].cells}
