"""Statistics of rows between bodies: the benchmark repeats the kernels' steps, and notices where it does not."""

from __future__ import annotations

from pathlib import Path

import pairs
import pytest
from common import parse
from learners import refusal


@pytest.mark.slow  # for its kernels
def test_the_kernels_steps_are_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """With another accuracy they are not, and MuJoCo needs a similar number of passes."""
    monkeypatch.setattr(pairs, "ROLLOUTS", 1)
    (row,) = pairs.measure_solver(pairs.Args(), "stack")
    assert int(str(row["states"])) > 20 and row["left out"] == 0
    assert all(1 < float(str(row[name])) < 15 for name in ("steps per pass", "adjoint's steps"))
    assert float(str(row["residual"])) < 1e-4 and abs(float(str(row["passes"])) - float(str(row["cold"]))) < 1
    monkeypatch.setattr(pairs, "ACCURACY", 0.3)
    (other,) = pairs.measure_solver(pairs.Args(), "stack")
    assert int(str(other["left out"])) > 0.2 * int(str(row["states"]))


def test_a_missing_robot_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = parse(pairs.Args, None, [str(tmp_path), "--parts", "solver", "--scenes", "cassie"])
    message = "agility_cassie/scene.xml; MuJoCo Menagerie is at"
    assert message in refusal(lambda: pairs.main(args), capsys)
