"""What the tests of the scripts and of what surrounds them share."""

from __future__ import annotations

import csv
import importlib
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from diffsim.training import Run, command

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = str(ROOT), str(ROOT / "baselines")
PATH = {"PYTHONPATH": os.pathsep.join([*FOLDERS, *os.environ.get("PYTHONPATH", "").split(os.pathsep)])}
# Rollouts of cartpole with a time-out on the way (240 steps), an evaluation before the end and one at it.
_SMALL = (
    "--env cartpole --num-envs 3 --horizon 32 --iterations 10 --eval-every 4 --eval-episodes 3 --quiet --device cpu"
).split()
SMALL = {
    "shac": [*_SMALL, "--critic-iterations", "3"],
    "rpo": [*_SMALL, "--critic-iterations", "3", "--epochs", "2", "--minibatches", "3"],
    "sapo": [*_SMALL, "--critic-iterations", "3", "--population", "3"],
    "bptt": _SMALL,
    "ppo_baseline": [*_SMALL, "--minibatch-size", "40", "--epochs", "2"],
    "pfpn": [*_SMALL, "--minibatch-size", "40", "--epochs", "2", "--particles", "7"],
}
SCRIPTS = {name: importlib.import_module(name) for name in SMALL}


@contextmanager
def stopped(after: int) -> Iterator[None]:
    """Let runs stop after an iteration; 0: at their end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Run, "stop_after", after)
        yield


def run(script: ModuleType, directory: Path, *arguments: object, stop_after: int = 0) -> dict[str, Any]:
    """Trains in directory; returns the checkpoint."""
    with stopped(stop_after):
        script.main([*map(str, arguments), "--run-dir", str(directory)])
    return torch.load(directory / "checkpoint.pt", weights_only=True)


def assert_resumes(script: ModuleType, directory: Path, flags: str, stop_after: int) -> dict[str, Any]:
    """A training that stops and goes on ends bitwise as one that does not; returns the checkpoint of `whole`."""
    whole = run(script, directory / "whole", *flags.split())
    run(script, directory / "part", *flags.split(), stop_after=stop_after)
    part = run(script, directory / "part", "--resume", directory / "part" / "checkpoint.pt", "--quiet")
    for name in ("modules", "ranks", "iteration", "control_steps"):
        assert_same(part[name], whole[name])
    return whole


def read_progress(directory: Path) -> list[dict[str, str]]:
    with (directory / "progress.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def assert_same(a: Any, b: Any) -> None:
    """Bitwise and equal in type, whatever the nesting: of checkpoints, observations and infos."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple) or (isinstance(a, np.ndarray) and a.dtype == object):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    else:
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def assert_derivatives(
    parameters: dict[str, torch.Tensor], loss: Callable[[], torch.Tensor], at: Iterable[tuple[str, int]], rel: float
) -> None:
    """The loss's gradient at some weights, named and counted, against central differences."""
    gradients = dict(zip(parameters, torch.autograd.grad(loss(), parameters.values()), strict=True))
    for name, index in at:
        weight, step = parameters[name].data.view(-1), 1e-6
        with torch.no_grad():
            value = weight[index].item()
            weight[index] = value + step
            above = loss()
            weight[index] = value - step
            difference = (above - loss()).item() / (2 * step)
            weight[index] = value
        assert gradients[name].flatten()[index].item() == pytest.approx(difference, rel=rel), name


def refusal(call: Callable[[], object], capsys: pytest.CaptureFixture[str], silent: bool = True) -> str:
    """The one line with which a call ends a script, exit code 2; if silent it has printed nothing else."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit:
        command(call)()
    out, error = capsys.readouterr()
    error = re.sub(r"^compiling kernels for .*\n", "", error)  # the first test of a robot is told so
    assert exit.value.code == 2 and (out == "" or not silent) and error.count("\n") == 1
    return error.strip()


def assert_refuses(
    script: ModuleType, arguments: str, message: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Arguments, with {places} to fill in, give one line that holds the message, exit code 2, and no file."""
    places = {name: tmp_path / name for name in ("file", "other", "elsewhere")} | {"trained": trained}
    checkpoint = torch.load(trained / "checkpoint.pt", weights_only=True)
    places["file"].write_text("hello")
    torch.save(checkpoint | {"script": "other"}, places["other"])
    torch.save(checkpoint | {"args": checkpoint["args"] | {"device": "cuda:0"}}, places["elsewhere"])
    before = sorted(tmp_path.rglob("*"))
    argv = arguments.format(**places).split()
    if not {"--run-dir", "--resume", "--evaluate"} & set(argv):
        argv += ["--run-dir", str(tmp_path / "run")]
    error = refusal(lambda: script.main(argv), capsys)
    assert error.startswith(f"{Path(sys.argv[0]).name}: ") and message.format(**places) in error
    assert sorted(tmp_path.rglob("*")) == before
