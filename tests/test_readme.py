"""The Python snippets of README and of the pages on the API, gymnasium and physics run as they are printed."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
import torch
from learners import ROOT

import diffsim
from diffsim.tasks.base import ASSETS

SNIPPETS = [
    pytest.param(code, id=f"{page.stem}-{k}")
    for page in (ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in ("api", "gymnasium", "physics")))
    for k, code in enumerate(re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL))
]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a robot.xml of the reader's."""
    shutil.copy(ASSETS / "hopper.xml", tmp_path / "robot.xml")
    shutil.copy(ASSETS / "stage.xml", tmp_path)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("code", SNIPPETS)
def test_snippet_runs(code: str) -> None:
    """On its own, but for the imports with which README's first one begins."""
    try:
        exec(compile(code, "snippet", "exec"), {"torch": torch, "diffsim": diffsim})
    except RuntimeError as error:
        if "OpenGL" not in str(error):
            raise
        pytest.skip(str(error))
