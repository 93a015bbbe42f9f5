"""benchmarks/particles.py: what it reads off policies."""

from __future__ import annotations

from pathlib import Path

import particles
import pytest
import torch
from common import DOCS, RESULTS
from tables import markdown, read_csv


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
    assert [row["policy"] for row in particles.table(rows)] == ["pfpn", "discrete"]


def test_the_page_has_the_table_of_the_csv_file() -> None:
    rows = read_csv(RESULTS / "cpu" / "bandit.csv")
    assert markdown(particles.table(rows)) in (DOCS / "pfpn.md").read_text()
