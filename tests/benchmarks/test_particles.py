"""benchmarks/particles.py: what it reads off policies and runs."""

from __future__ import annotations

from pathlib import Path

import particles
import pytest
import torch
from tables import read_csv, write_csv


def test_the_reward_has_two_equal_peaks() -> None:
    found = particles.reward(torch.tensor([-0.25, 0.75, 0.25, -0.75]))
    torch.testing.assert_close(found, torch.tensor([10.0, 10.0, 1 / 0.6, 1 / 0.6]))


def test_each_policy_is_a_line_of_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(particles, "CASES", {"0": (1,), "0.2": (2,)})
    monkeypatch.setattr(particles, "POLICIES", ("pfpn", "discrete"))
    particles.main(particles.Args(output=tmp_path, seeds=(1, 2)))
    rows = read_csv(tmp_path / "bandit.csv")
    assert [(row["policy"], row["iterations"]) for row in rows] == [(p, k) for p in ("pfpn", "discrete") for k in "12"]
    for row in rows:  # still almost uniform over [-1, 1], of which a peak's neighbourhood is 0.3 wide
        shares = [float(x) for peak in particles.PEAKS for x in row[f"near {peak}"].split()]
        assert len(shares) == 4 and max(abs(share - 0.15) for share in shares) < 0.05
    located = read_csv(tmp_path / "particles.csv")
    assert len(located) == 2 * 35 and float(located[0]["location"]) == pytest.approx(-1, abs=0.05)
    assert sum(float(row["weight"]) for row in located[:35]) == pytest.approx(1, abs=1e-4)
    assert (tmp_path / "particles.png").stat().st_size > 0


def test_the_particles_of_a_run_are_read_from_its_log(tmp_path: Path) -> None:
    names = [(f"particles_{x}_{action}_{i}", i) for x in ("loc", "weight") for action in (0, 3) for i in (0, 1)]
    log = [{"iteration": k, "return": 0.0} | {name: k + i for name, i in names} for k in range(200)]
    write_csv(tmp_path / "run" / "progress.csv", log)
    particles.main(particles.Args(output=tmp_path, run=tmp_path / "run"))
    rows = read_csv(tmp_path / "particles.csv")
    assert len(rows) == particles.POINTS * 4 and {row["action"] for row in rows} == {"0", "3"}
    assert {name: rows[-1][name] for name in ("iteration", "particle", "location", "weight")} == {
        "iteration": "199", "particle": "1", "location": "200", "weight": "200"
    }  # fmt: skip
    assert not (tmp_path / "bandit.csv").exists() and (tmp_path / "particles.png").stat().st_size > 0
