"""benchmarks/stages.py: both times are in the progress, and the fit that is timed changes nothing."""

from __future__ import annotations

from pathlib import Path

import stages
from learners import assert_same, read_progress, run

import shac


def test_stages_are_timed(tmp_path: Path) -> None:
    flags = "--env cartpole --device cpu --num-envs 4 --horizon 8 --iterations 3 --eval-episodes 2 --quiet --threads 1"
    timed = run(stages, tmp_path / "timed", *flags.split())
    rows = read_progress(tmp_path / "timed")
    for row in rows:
        assert 0 < float(row["time_fit_critic"]) < float(row["time_total"]) > float(row["time_iterate"]) > 0
    assert timed["modules"].keys() == run(shac, tmp_path / "plain", *flags.split())["modules"].keys()
    assert timed["modules"]["critic_optimizer"]["adam"][0]["step"] == 3 * 16 * 4
    assert_same(timed["modules"]["critic_optimizer"]["skipped"], timed["modules"]["actor_optimizer"]["skipped"])
