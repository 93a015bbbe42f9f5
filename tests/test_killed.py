"""Trainings that are killed at random moments and resumed end bitwise like those that were left alone."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from learners import assert_same

COMMON = "--env cartpole --device cpu --threads 1 --num-envs 4 --eval-episodes 2 --save-every 3 --quiet"
FLAGS = {
    "shac": "--horizon 16 --iterations 60",
    "sac_baseline": "--iterations 40 --steps 8 --seed-steps 16 --batch-size 32 --buffer-size 1000",
}


@pytest.mark.slow
@pytest.mark.parametrize("script", FLAGS)
def test_a_killed_run_that_goes_on_ends_bitwise_alike(script: str, tmp_path: Path) -> None:
    path, moments = tmp_path / "killed" / "checkpoint.pt", random.Random(1)

    def start(folder: str) -> subprocess.Popen[bytes]:
        first = [*COMMON.split(), *FLAGS[script].split(), "--run-dir", str(tmp_path / folder)]
        flags = ["--resume", str(path)] if folder == "killed" and path.exists() else first
        return subprocess.Popen([sys.executable, f"{script}.py", *flags], cwd=Path(__file__).parents[1])

    assert start("whole").wait() == 0
    whole = torch.load(tmp_path / "whole" / "checkpoint.pt", weights_only=True)
    for _ in range(3):
        saved, process = path.stat().st_mtime_ns if path.exists() else 0, start("killed")
        while not path.exists() or path.stat().st_mtime_ns == saved:  # until it has saved once more
            assert process.poll() is None
            time.sleep(0.001)
        time.sleep(moments.uniform(0, 0.05))
        process.kill()
        process.wait()
    assert torch.load(path, weights_only=True)["iteration"] < whole["iteration"]
    assert start("killed").wait() == 0
    end = torch.load(path, weights_only=True)
    for name in ("modules", "ranks", "policy", "iteration", "control_steps"):
        assert_same(end[name], whole[name])
