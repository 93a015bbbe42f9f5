"""What the tests of the learners share."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

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
