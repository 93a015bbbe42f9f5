"""torch.compile of an environment's step and of --compile: numbers of eager ones, or one line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from learners import PATH, ROOT, SMALL, run
from test_env import random_actions

import diffsim
import shac

pytestmark = pytest.mark.skipif(not shutil.which(os.environ.get("CXX", "g++")), reason="needs a C++ compiler")


@pytest.mark.slow  # compiles for a minute
@pytest.mark.parametrize("name", ["cartpole", "go2"])  # a go2 has a memory, pushes and delays
def test_compiled_steps_are_those_of_eager_ones(name: str) -> None:
    """Through the end of an episode: all that steps return, and the gradient in the actions.

    In float64, because contact turns roundings into other numbers of Newton's passes.
    """
    found = []
    for compiled in (False, True):
        env = diffsim.make(name, 4, seed=3, horizon=6, max_episode_steps=4, dtype=torch.float64)
        if compiled:
            env.compile()
        env.reset(seed=1)
        actions = random_actions(env, 6).requires_grad_()
        steps = [env.step(action) for action in actions]
        obs, rewards = (torch.stack([step[k] for step in steps]) for k in (0, 1))
        ended = torch.stack([step[4]["_episode"] for step in steps])
        returns = torch.stack([step[4]["episode"]["r"] for step in steps]).detach()
        (gradient,) = torch.autograd.grad(rewards.sum() + obs.sum(), actions)
        found.append((obs.detach(), rewards.detach(), ended, returns, gradient, env.memory.detach()))
    assert found[0][2].any() and found[0][4].any()
    torch.testing.assert_close(found[1], found[0], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_a_compiled_training_learns_the_same(tmp_path: Path) -> None:
    weights = {}
    for flags in ((), ("--compile",)):
        state = run(shac, tmp_path / "".join(("run", *flags)), *SMALL["shac"], *flags, stop_after=2)
        weights[bool(flags)] = state["policy"]["weights"]
    torch.testing.assert_close(weights[True], weights[False], rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_without_a_compiler_it_ends_with_one_line(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "shac.py"), *SMALL["shac"], "--compile", "--run-dir", str(tmp_path / "run")]
    variables = os.environ | PATH | {"CXX": "/nonexistent", "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run(command, env=variables, capture_output=True, text=True)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    (line,) = (text for text in done.stderr.splitlines() if "compiling kernels" not in text)
    assert line.startswith("shac.py: --compile: torch.compile failed, train without it: ")
