"""Trainings that are stopped, moved, killed or signalled; `pytest -m slow` makes 27 such trainings and 70 signals."""

from __future__ import annotations

import importlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import PATH, ROOT, assert_same, read_progress

from diffsim.training import Run

pytestmark = pytest.mark.slow
COMMON = "--env cartpole --device cpu --iterations 6 --eval-every 4 --eval-episodes 2 --quiet --threads 1"
ROLLOUTS = "--env cartpole:motor=0.7:1.3,mass=0.5:2 --num-envs 6 --horizon 16"
REPLAY = "--num-envs 5 --steps 8 --buffer-size 2000 --batch-size 32 --hidden 16 16"
FLAGS = {
    "shac": f"{ROLLOUTS} --critic-iterations 2",
    "rpo": f"{ROLLOUTS} --critic-iterations 2 --epochs 2",
    "sapo": f"{ROLLOUTS} --critic-iterations 2 --population 3",
    "bptt": ROLLOUTS,
    "ppo_baseline": f"{ROLLOUTS} --minibatch-size 40 --epochs 2",
    "pfpn": f"{ROLLOUTS} --minibatch-size 40 --epochs 2 --particles 7",
    "pods": "--num-envs 5 --horizon 16 --candidates 3 --epochs 2 --batch-size 32 --order 2",
    "gps": "--horizon 30 --pretraining 20 --hidden 8 --samples 4 "
    "--guiding-samples 8 --active 16 --lbfgs-iterations 4 --adaptive 1 --adaptive-iterations 2",
    "mbpo": f"{REPLAY} --seed-steps 8 --model-hidden 16 16 --model-updates 3 --branches 20 --updates 5",
    "sac_baseline": f"{REPLAY} --seed-steps 20",
}
COMPARED = ("modules", "ranks", "policy", "totals", "episodes", "iteration", "control_steps")
ENDLESS = "--env cartpole --device cpu --num-envs 8 --horizon 4 --iterations 1000000 --eval-every 3 --eval-episodes 2"


def load(directory: Path) -> dict[str, Any]:
    return torch.load(directory / "checkpoint.pt", weights_only=True)


def start(script: str, *arguments: object, **options: Any) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, ROOT / f"{script}.py", *map(str, arguments)], text=True, **options)


@pytest.fixture(autouse=True)
def hangups() -> Iterator[None]:
    """Reach trainings also where pytest itself runs under nohup, whose children would not hear them."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="module")
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, dict[str, Any]]:
    """A script, and the checkpoint of its run that nothing disturbs."""
    directory = tmp_path_factory.mktemp(request.param)
    train(request.param, directory)
    return request.param, load(directory)


def train(script: str, directory: Path, stop_after: int = 0) -> None:
    main, path = importlib.import_module(script).main, directory / "checkpoint.pt"
    new = [*COMMON.split(), *FLAGS[script].split(), "--run-dir", directory]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [f"{script}.py"])
        patch.setattr(Run, "stop_after", stop_after)
        main([*map(str, ["--resume", path] if path.exists() else new)])


@pytest.mark.parametrize("case", ["elsewhere", "each", "moved"])
@pytest.mark.parametrize("whole", FLAGS, indirect=True)
def test_a_run_that_is_stopped_and_resumed_ends_bitwise_alike(
    whole: tuple[str, dict[str, Any]], case: str, tmp_path: Path
) -> None:
    """Stopped after each iteration, moved, and as another process in another place."""
    (script, expected), directory = whole, tmp_path / "run"
    if case == "elsewhere":
        other = os.environ | dict(PYTHONHASHSEED="5", TZ="Asia/Kolkata", OMP_NUM_THREADS="3") | PATH
        flags = [*COMMON.split(), *FLAGS[script].split(), "--run-dir", directory, "--threads", 2]
        assert start(script, *flags, cwd=tmp_path, env=other).wait() == 0
    else:
        for stop in {"each": range(1, 6), "moved": [2]}[case]:
            train(script, directory, stop)
        directory = directory.rename(tmp_path / "moved ü") if case == "moved" else directory
        train(script, directory)
    for name in COMPARED:
        assert_same(load(directory)[name], expected[name])


def test_a_run_that_is_killed_ends_bitwise_alike(tmp_path: Path) -> None:
    """At random moments, after it has saved."""
    flags = [*ENDLESS.split(), "--iterations", 60, "--save-every", 3, "--threads", 1, "--quiet", "--run-dir"]
    path, moments = tmp_path / "killed" / "checkpoint.pt", random.Random(1)
    assert start("shac", *flags, tmp_path / "whole").wait() == 0
    for _ in range(3):
        saved = path.stat().st_mtime_ns if path.exists() else 0
        process = start("shac", *(["--resume", path] if saved else [*flags, path.parent]))
        while not path.exists() or path.stat().st_mtime_ns == saved:  # until it has saved once more
            assert process.poll() is None
            time.sleep(0.001)
        time.sleep(moments.uniform(0, 0.05))
        process.kill()
        process.wait()
    assert load(path.parent)["iteration"] < 60
    assert start("shac", "--resume", path).wait() == 0
    for name in COMPARED:
        assert_same(load(path.parent)[name], load(tmp_path / "whole")[name])


@pytest.mark.parametrize("seed", range(70))
def test_a_run_that_is_signalled_leaves_a_whole_checkpoint_or_none(seed: int, tmp_path: Path) -> None:
    """Once or several times, at any moment: 50 while it trains, 16 from its first one, four while it compiles."""
    draw, environment = random.Random(seed), os.environ | PATH
    signals = [draw.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP]) for _ in range(draw.choice([1, 1, 2, 4]))]
    if seed >= 66:
        environment["WARP_CACHE_PATH"] = str(tmp_path / "cache")
    flags = [*ENDLESS.split(), "--save-every", 2, "--quiet", "--run-dir", tmp_path / "run"]
    pipe = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)
    process, progress = start("shac", *flags, **pipe), tmp_path / "run" / "progress.csv"
    while seed < 50 and not progress.exists():
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(draw.uniform(0, 1 if seed < 50 else 8))
    for number in signals:
        process.send_signal(number)
        time.sleep(draw.uniform(0, 0.02))
    try:
        _, error = process.communicate(timeout=120)
    finally:
        process.kill()
    if not (tmp_path / "run").exists():  # while Python imports, its own traceback ends it
        assert process.returncode != 0 and seed >= 50
        return
    codes = {128 + number for number in signals} | {-number for number in signals}  # the latter once it has ended
    assert process.returncode in codes | {130} and "Traceback" not in error
    assert not list(tmp_path.glob("run/*.tmp"))
    if seed < 50 and len(signals) == 1:
        assert process.returncode == 128 + signals[0]
        assert load(tmp_path / "run")["iteration"] == int(read_progress(tmp_path / "run")[-1]["iteration"])
    elif (tmp_path / "run" / "checkpoint.pt").exists():
        assert load(tmp_path / "run")["iteration"] > 0
