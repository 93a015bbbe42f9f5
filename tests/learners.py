"""What the tests of the learners share."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]


def run(learner: ModuleType, directory: Path, *arguments: object) -> dict[str, Any]:
    """Trains in directory; returns the checkpoint."""
    learner.main([*map(str, arguments), "--run-dir", str(directory)])
    return torch.load(directory / "checkpoint.pt", weights_only=True)


def assert_same(a: Any, b: Any) -> None:
    """Bitwise, whatever a checkpoint holds."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
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


def assert_refuses(
    learner: ModuleType,
    arguments: str,
    message: str,
    trained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Arguments, with {places} to fill in, give one line that holds the message, exit code 2, and no file."""
    places = {name: tmp_path / name for name in ("file", "truncated", "foreign", "elsewhere")} | {"trained": trained}
    places["file"].write_text("hello")
    places["truncated"].write_bytes((trained / "checkpoint.pt").read_bytes()[:5000])
    torch.save({"weights": torch.zeros(3)}, places["foreign"])
    checkpoint = torch.load(trained / "checkpoint.pt", weights_only=True)
    torch.save(checkpoint | {"args": checkpoint["args"] | {"device": "cuda:0"}}, places["elsewhere"])
    before = sorted(tmp_path.rglob("*"))
    argv = arguments.format(**places).split()
    if not {"--run-dir", "--resume", "--evaluate"} & set(argv):
        argv += ["--run-dir", str(tmp_path / "run")]
    with pytest.raises(SystemExit) as exit:
        learner.main(argv)
    assert exit.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"{learner.__name__}.py: ") and error.count("\n") == 1
    assert message.format(**places, name=learner.__name__) in error
    assert sorted(tmp_path.rglob("*")) == before


def assert_refuses_a_missing_gpu(learner: ModuleType) -> None:
    command = [sys.executable, str(ROOT / f"{learner.__name__}.py"), "--device", "cuda"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.splitlines()[-1].startswith(f"{learner.__name__}.py: ") and "cuda" in result.stderr.lower()
