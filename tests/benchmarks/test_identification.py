"""Identification from logs: what benchmarks/identification.py writes."""

from __future__ import annotations

from pathlib import Path

import identification
import pytest
from common import parse
from learners import refusal
from tables import read_csv

from diffsim.tasks.base import ASSETS


def test_cases_are_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = identification.Case(ASSETS / "hopper.xml", ("mass", "com"), ("torso", "foot"))
    monkeypatch.setattr(identification.Args, "case", lambda self, name: case)
    identification.main(parse(identification.Args, None, ["--cases", "arm", "--output", str(tmp_path)]))
    rows = read_csv(tmp_path / "identify.csv")
    assert [row["element"] for row in rows] == ["torso", "foot", *["torso"] * 3, *["foot"] * 3]
    masses, centres = rows[:2], rows[2:]
    for row in masses:
        assert float(row["error"]) == pytest.approx(100 * abs(float(row["fitted"]) / float(row["truth"]) - 1), abs=0.5)
        assert float(row["error"]) < 5 < float(row["file's error"])
    known = [row for row in centres if float(row["deviation"]) < 0.1]
    assert len(known) == 4 and all(float(row["error"]) < 5 for row in known)  # the robot is planar
    assert {row["determined"] for row in rows} == {"6"}
    assert "| arm | mass | 2 | 2 |" in capsys.readouterr().out


def test_what_is_wrong_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for flags, message in (
        (["--cases", "leg"], "--cases: there is no 'leg'; choose from load, arm, go2"),
        ([str(tmp_path)], "kuka_iiwa_14/scene.xml; MuJoCo Menagerie is at"),
    ):
        args = parse(identification.Args, None, flags)
        assert message in refusal(lambda args=args: identification.main(args), capsys)
