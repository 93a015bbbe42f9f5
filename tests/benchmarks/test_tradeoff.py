"""Substeps that adapt: control steps are sorted rightly into those in flight and those on the ground."""

from __future__ import annotations

from pathlib import Path

import motions
import pytest
import tradeoff
from torch import Tensor

import diffsim


@pytest.mark.parametrize(("height", "flight"), [(-0.05, "0.000"), (1.0, "1.000")])
def test_a_hopper_is_in_flight_where_it_is_lifted(
    height: float, flight: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An untrained policy, from the start of an episode, 5 cm lower or 1 m above; only two control steps of it."""

    def start(name: str, _policy: object, count: int, _penalty: object) -> tuple[Tensor, Tensor]:
        env = diffsim.make(name, num_envs=count, stochastic_init=False)
        qpos = env.qpos.double()
        qpos[:, 1] += height
        return qpos, env.qvel.double()

    monkeypatch.setattr(motions, "visited_states", start)
    monkeypatch.setattr(tradeoff, "STEPS", 2)
    (row,) = tradeoff.measure_adaptive(tradeoff.Args(runs=tmp_path, states=2), "hopper")
    assert row["steps in flight"] == flight
    assert "gain" not in row  # there is nothing to compare
