"""Data-parallel training: two processes over gloo do what one does with all environments."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import ROOT, assert_same

import shac

# Trains, with each rank taking its share of the noise and start states that one process alone would draw.
WORKER = """
import sys, torch, shac
from diffsim import distributed
from diffsim.env import DiffEnv

actors, drawn = [], {}

def share(draw, num_envs):
    rank, size = distributed.rank(), distributed.size()
    return draw(num_envs * size)[:, rank * num_envs : (rank + 1) * num_envs]

def stream(of):
    return drawn.setdefault(id(of), torch.Generator().manual_seed(5))

def sample_noise(actor, horizon, num_envs):
    actors[:] = [actor]
    std = actor.log_std.exp()
    return std * share(lambda n: torch.randn(horizon, n, len(std), generator=stream(actor)), num_envs)

def draw(env, steps):
    width = env.task.num_random
    rand = share(lambda n: torch.rand(steps, n, width, generator=stream(env)), env.num_envs)
    qpos, qvel = env.task.reset(rand)
    return qpos, qvel, env.task.observe(qpos, qvel, env._no_action.expand(steps, -1, -1))

shac.Actor.sample_noise, DiffEnv._draw = sample_noise, draw
shac.main(sys.argv[2:])
torch.save(actors[0].state_dict(), f"{sys.argv[1]}_{distributed.rank()}.pt")
"""
# Eight windows of cartpole: the last one holds time-outs and resets.
SETTING = "--env cartpole --num-envs 4 --iterations 8 --eval-every 0 --eval-episodes 1 --quiet --threads 1 --device cpu"


# Saves on every rank.
SAVER = """
import importlib, sys, torch
from diffsim import distributed
from diffsim.run import Run

Run.save = lambda run, checkpoint: torch.save(checkpoint, run.directory / f"rank{distributed.rank()}.pt")
importlib.import_module(sys.argv[1]).main(sys.argv[2:])
"""


def train(size: int, directory: Path, *arguments: object) -> dict[str, Any]:
    """Trains on as many ranks, as torchrun starts them; returns the checkpoint."""
    (directory / "worker.py").write_text(WORKER)
    command = [
        sys.executable,
        *["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={size}"] * (size > 1),
    ]
    command += [str(directory / "worker.py"), str(directory / f"actor{size}"), *map(str, arguments)]
    subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True, timeout=300)
    return load(directory / f"run{size}" / "checkpoint.pt")


def load(path: Path) -> dict[str, Any]:
    return torch.load(path, weights_only=True)


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ranks")


@pytest.fixture(scope="module")
def two_ranks(directory: Path) -> dict[str, Any]:
    return train(2, directory, *SETTING.split(), "--run-dir", directory / "run2")


def test_two_ranks_of_half_the_environments_are_one_of_all(directory: Path, two_ranks: dict[str, Any]) -> None:
    one = train(1, directory, *SETTING.split(), "--run-dir", directory / "run1")
    for part in ("actor", "critic", "target", "normalise"):
        for name, value in one[part].items():
            torch.testing.assert_close(two_ranks[part][name], value, rtol=1e-5, atol=1e-6)
    ((count, total_return, length),) = one["episodes"]
    assert two_ranks["episodes"] == [(count, pytest.approx(total_return, rel=1e-5), length)]
    assert count == 4 and length == 4 * 240


def test_weights_stay_equal_across_ranks(directory: Path, two_ranks: dict[str, Any]) -> None:
    first, second = load(directory / "actor2_0.pt"), load(directory / "actor2_1.pt")
    for name, value in two_ranks["actor"].items():
        assert torch.equal(first[name], value) and torch.equal(second[name], value)
    starts = [rank["env"]["qpos"] for rank in two_ranks["ranks"]]
    assert len(starts) == 2 and not torch.equal(*starts)


@pytest.mark.parametrize("learner", ["bptt", "ppo_baseline"])
def test_ranks_of_other_learners_share_weights_and_statistics(learner: str, tmp_path: Path) -> None:
    (tmp_path / "saver.py").write_text(SAVER)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += [str(tmp_path / "saver.py"), learner, *SETTING.split(), "--horizon", "32", "--run-dir", str(tmp_path)]
    subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True, timeout=300)
    first, second = load(tmp_path / "rank0.pt"), load(tmp_path / "rank1.pt")
    shared = {"bptt": ("actor", "optimizer"), "ppo_baseline": ("policy", "normalise", "normalise_return", "optimizer")}
    for part in shared[learner]:
        assert_same(first[part], second[part])
    assert_same(first["episodes"], second["episodes"])
    assert first["episodes"][0][0] == 4  # two of each rank
    starts = [rank["env"]["qpos"] for rank in first["ranks"]]
    assert len(starts) == 2 and not torch.equal(*starts)


def test_as_many_processes_resume_as_were_saved(
    two_ranks: dict[str, Any], directory: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = directory / "run2" / "checkpoint.pt"
    monkeypatch.setattr(sys, "argv", ["shac.py"])
    with pytest.raises(SystemExit):
        shac.main(["--resume", str(path), "--iterations", "9"])
    assert f"{path} was trained by 2 processes, not 1" in capsys.readouterr().err
    monkeypatch.setenv("WORLD_SIZE", "3")
    with pytest.raises(SystemExit):
        shac.main(["--env", "cartpole", "--num-envs", "4"])
    assert "--num-envs 4 cannot be split evenly among 3 processes" in capsys.readouterr().err
