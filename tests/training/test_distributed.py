"""Data-parallel training: two processes over gloo do what one does with all environments."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import mbpo
import pfpn_sac
import pods
import pytest
import ranks
import sac_baseline
import torch
from learners import PATH, assert_same, refusal, run

import gps
import pfpn
import shac
from diffsim.env import DiffEnv

# Three rollouts of cartpole: the last one holds time-outs and resets.
SETTING = (
    "--env cartpole --num-envs 4 --horizon 84 --iterations 3 --eval-every 0 --eval-episodes 1 --quiet --threads 1 "
    "--device cpu"
).split()


def load(path: Path) -> dict[str, Any]:
    return torch.load(path, weights_only=True)


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    """The runs of two ranks."""
    directory = tmp_path_factory.mktemp("ranks")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", ranks.__file__]
    subprocess.run([*command, str(directory), *SETTING], env=os.environ | PATH, check=True, timeout=300)
    return directory


def test_two_ranks_of_half_the_environments_are_one_of_all(directory, tmp_path, monkeypatch):
    monkeypatch.setattr(shac.Actor, "sample_noise", ranks.sample_noise)
    monkeypatch.setattr(DiffEnv, "_uniform", ranks.uniform)
    one, two = run(shac, tmp_path, *SETTING), load(directory / "shac" / "checkpoint.pt")
    for part in ("actor", "critic", "target"):  # the normalizer is a part of the actor
        for name, value in one["modules"][part].items():
            torch.testing.assert_close(two["modules"][part][name], value, rtol=1e-5, atol=1e-6)
    ((count, total_return, length),) = one["episodes"]
    assert two["episodes"] == [(count, pytest.approx(total_return, rel=1e-5), length)]
    assert count == 4 and length == 4 * 240


@pytest.mark.parametrize("name", ["bptt", "ppo_baseline", "rpo", "sapo", "shac"])
def test_ranks_share_weights_and_statistics_and_have_states_of_their_own(directory, name):
    first, second = (load(directory / f"{name}.{rank}.pt") for rank in range(2))
    checkpoint = load(directory / name / "checkpoint.pt")
    assert_same(first, second)
    assert_same(first, {key: checkpoint[key] for key in first})
    assert checkpoint["episodes"][0][0] == 4  # two of each rank
    (one, other), samples = checkpoint["ranks"], 3 * 84 * 4
    assert not torch.equal(one["env"]["qpos"], other["env"]["qpos"]) and not torch.equal(one["rng"], other["rng"])
    assert len(one["env"]["qpos"]) == 2
    actor = first["modules"]["actor_critic" if name == "ppo_baseline" else "actor"]
    assert checkpoint["control_steps"] == actor["normalizer.count"] == samples or name == "bptt"


def test_as_many_processes_resume_as_were_saved(directory, capsys, monkeypatch):
    path = directory / "shac" / "checkpoint.pt"
    line = refusal(lambda: shac.main(["--resume", str(path), "--iterations", "9"]), capsys)
    assert line == f"script.py: {path} was trained by 2 processes, not 1"
    monkeypatch.setenv("WORLD_SIZE", "3")
    line = refusal(lambda: shac.main(["--env", "cartpole", "--num-envs", "4"]), capsys)
    assert line == "script.py: --num-envs 4 cannot be split evenly among 3 processes"
    monkeypatch.setenv("RANK", "1")  # which leaves it to the first to say so
    with pytest.raises(SystemExit) as exit:
        shac.main(["--env", "cartpole", "--num-envs", "4"])
    assert exit.value.code == 2 and capsys.readouterr().err == ""


@pytest.mark.parametrize("script", [gps, mbpo, pfpn, pfpn_sac, pods, sac_baseline], ids=lambda script: script.__name__)
def test_other_learners_refuse_torchrun(script, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("WORLD_SIZE", "2")
    call = ["--env", "cartpole", "--device", "cpu", "--run-dir", str(tmp_path / "run")]
    line = refusal(lambda: script.main(call), capsys)
    assert line == "script.py: this learner trains in one process: start it without torchrun"
    assert not list(tmp_path.iterdir())
