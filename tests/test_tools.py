"""tools/: a wrong command ends in one line."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[1] / "tools"


@pytest.mark.parametrize("words", [[], ["--help"], ["jellyfish"]])
def test_kernels_names_the_tasks(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["kernels.py", *words])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(TOOLS / "kernels.py"), run_name="__main__")
    assert capsys.readouterr().err.startswith("kernels.py: give a task: cartpole, ")
