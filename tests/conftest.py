from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from browser import CHROMIUM, Browser

import shac
from diffsim.training import Evaluation
from diffsim_cli import render

torch.set_num_threads(1)
Evaluation.compared = False  # except in the tests of that
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as shells leave it to what they run in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)  # before pytest looks for the marks that are asked for
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:  # of the benchmarks' tests, those that write files run commands
        commands = item.path.parent.name == "benchmarks" and item.path.name != "test_tables.py"
        if commands and "tmp_path" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
    # First, because what one process takes from another's end would include them, and each would train the ranks.
    items.sort(key=lambda item: item.path.name != "test_distributed.py")
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="needs a CUDA GPU, and PyTorch sees none"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, bool | None, bool | None]:
    """Compile the kernels of tests marked so in a quarter of the time; they run at a fifth of the speed."""
    with pytest.MonkeyPatch.context() as patch:
        if item.get_closest_marker("unoptimized"):
            patch.setattr(wp.config, "optimization_level", 0)
        return (yield)


def pytest_collection_finish() -> None:
    """What the imports made stays: looking through it again and again took a tenth of the tests' time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name with which messages of scripts begin."""
    monkeypatch.setattr(sys, "argv", ["script.py"])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of two iterations of shac.py on cartpole."""
    directory = tmp_path_factory.mktemp("runs") / "cartpole"
    flags = "--env cartpole --device cpu --iterations 2 --num-envs 4 --horizon 4 --eval-episodes 2 --quiet"
    shac.main([*flags.split(), "--run-dir", str(directory)])
    return directory


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips what draws where nothing can."""
    try:
        render.check_opengl()
    except RuntimeError as error:
        pytest.skip(str(error))


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no chromium")
    opened = Browser(tmp_path / "profile")
    yield opened
    opened.close()
