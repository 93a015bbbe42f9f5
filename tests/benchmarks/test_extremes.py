"""benchmarks/extremes.py: counts what holds, and notices what does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import extremes
import pytest
import torch
from tables import read_csv

from diffsim import Simulator


@pytest.mark.parametrize("leak", [0.0, 1e-6])
def test_a_neighbour_that_changes_is_noticed(leak: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extremes, "INTEGRATIONS", {"semi_implicit": extremes.INTEGRATIONS["semi_implicit"]})
    monkeypatch.setattr(extremes, "BATCHES", [(5, None, torch.float32)])
    step = Simulator.step

    def leaking(sim: Simulator, *given: torch.Tensor) -> Any:
        qpos, qvel = step(sim, *given)
        return qpos, qvel + leak * sim.nonfinite.any()

    monkeypatch.setattr(Simulator, "step", leaking)
    extremes.main(extremes.Args(output=tmp_path, parts=("containment",)))
    (row,) = read_csv(tmp_path / "containment.csv")
    assert row["tried"] == "42" and (row["held"] == "42") == (leak == 0)


def test_extreme_contacts_are_mujoco_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One pass of Newton's method does not solve them."""
    monkeypatch.setattr(extremes, "ROBOTS", [(1.0, 1.0, 1.0), (1e5, 1e-4, 1.0)])
    extremes.main(extremes.Args(output=tmp_path / "all", parts=("states",)))
    hasty = {dtype: (how._replace(passes=1), exact) for dtype, (how, exact) in extremes.EXACT.items()}
    monkeypatch.setattr(extremes, "EXACT", hasty)
    extremes.main(extremes.Args(output=tmp_path / "one", parts=("states",)))
    solved, first = (extremes.worst(read_csv(tmp_path / name / "extreme_states.csv")) for name in ("all", "one"))
    assert [row["solved"] for row in solved] == ["64", "64"]
    assert all(float(str(row["solved"])) < 64 for row in first)
