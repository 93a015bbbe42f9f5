"""Planning from many starts at once."""

from __future__ import annotations

from pathlib import Path

import pytest
import starts
from tables import read_csv


def test_more_starts_contain_the_fewer(tmp_path: Path) -> None:
    """Each trajectory is optimised as if it were alone, so that the best of more is at least as good."""
    flags = "--robots cartpole --starts 1 3 --iterations 3 --output".split()
    args = starts.parse(starts.Args, None, [*flags, str(tmp_path)])
    starts.main(args)
    one, three = read_csv(args.csv("starts"))
    assert (one["starts"], three["starts"], three["finite"], three["done"]) == ("1", "3", "3", "3")
    assert one["best"] == one["median"] and float(three["best"]) <= float(one["best"]) <= 1.0001 * float(one["median"])
    assert float(three["best"]) < float(three["median"])
    for row in (one, three):
        per_start = 1e3 * float(row["seconds"]) / int(row["starts"])
        assert float(row["ms_per_start"]) == pytest.approx(per_start, rel=0.01) and per_start > 0
        # An iteration takes T nd Jacobian rows and 11 rollouts of T steps, of each start.
        steps = float(row["steps_per_second"]) * float(row["seconds"])
        assert steps == pytest.approx(int(row["starts"]) * 240 * (4 + 11), rel=0.35)
