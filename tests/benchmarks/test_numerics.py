"""docs/numerics.md: its tables are those of the csv files, presets lie on their front, and more substeps cost more."""

from __future__ import annotations

from pathlib import Path

import extremes
import numerics
import pytest
from common import DOCS, RESULTS
from tables import Cells, grouped, read_csv

from diffsim.training.errors import UsageError

ERRORS = ("state 0.5 s", "gradient 8", "gradient 32")
SETTINGS = read_csv(RESULTS / "cpu" / "numerics_presets.csv")


def test_the_page_has_the_tables_of_the_csv_files(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    page, cpu = (DOCS / "numerics.md").read_text(), RESULTS / "cpu"
    for part in ("presets",):
        numerics.main(numerics.Args(parts=(part,), draw_only=True, output=cpu, figures=tmp_path))
        printed = capsys.readouterr().out.partition("\n\n")[0]
        assert f"<!-- {part} -->\n{printed}\n<!-- /{part} -->" in page and "(none yet)" not in printed
    assert (tmp_path / "numerics.png").is_file()
    extremes.main(extremes.Args(parts=("newton",), draw_only=True, output=cpu))
    assert f"<!-- newton -->\n{capsys.readouterr().out.strip()}\n<!-- /newton -->" in page


def test_the_page_is_short() -> None:
    assert len((DOCS / "numerics.md").read_text().replace("|", " ").split()) <= 1400


def test_accurate_is_more_accurate_and_fast_is_faster() -> None:
    for _, own in grouped(numerics.presets(SETTINGS), "task").items():
        by = {row["preset"]: row for row in own}
        for name in ERRORS if "accurate" in by else ():
            assert float(by["accurate"][name]) < float(by["default"][name]), by
        assert "fast" not in by or float(by["fast"]["speed"]) >= 1, by


def substeps(row: Cells) -> int:
    return int(row["setting"].split()[-2])


def test_a_bound_is_the_mildest_value_that_fails() -> None:
    rows = [
        {"task": "ant", "sweep": "substeps", "implicit 0": "3 (energy)", "mujoco": ""},
        {"task": "hopper", "sweep": "substeps", "implicit 0": "6 (not finite)", "mujoco": ""},
        {"task": "go2", "sweep": "substeps", "implicit 0": "", "mujoco": "-"},
        {"task": "ant", "sweep": "drop (m)", "implicit 0": "100 (energy)", "mujoco": ""},
        {"task": "hopper", "sweep": "drop (m)", "implicit 0": "10 (energy)", "mujoco": ""},
    ]
    assert numerics.bounds(rows) == [
        {"sweep": "substeps", "implicit 0": "6 (2 of 2)", "mujoco": "- (0 of 1)"},
        {"sweep": "drop (m)", "implicit 0": "10 (2 of 2)", "mujoco": ""},
    ]


def test_a_robot_that_there_is_not_ends_the_benchmark_with_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="unknown task 'nobody'"):
        numerics.main(numerics.Args(robots=("nobody",), output=tmp_path))
