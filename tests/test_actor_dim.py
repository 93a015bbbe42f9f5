"""Of a task that shows its actor a part of the observation, no learner's policy uses more."""

from __future__ import annotations

import importlib
import inspect
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import refusal

import diffsim
import gps
from diffsim.tasks import TASKS
from diffsim.training import parse
from diffsim_cli.commands import find_learners


def algorithm(script: str) -> Any:
    """The class of a script that is made of its arguments and environments."""
    own = [each for each in vars(importlib.import_module(script)).values() if getattr(each, "__module__", "") == script]
    kinds = [kind for kind in own if inspect.isclass(kind) and [*inspect.signature(kind).parameters] == ["args", "env"]]
    (kind,) = [kind for kind in kinds if not issubclass(kind, torch.nn.Module)]
    return kind


class Blinkered(TASKS["cartpole"]):  # type: ignore[misc]
    actor_dim = 3


@pytest.mark.parametrize("script", sorted({*find_learners()} - {"gps"}))
def test_a_policy_uses_what_its_actor_sees(script: str) -> None:
    kind = algorithm(script)
    args = parse(sys.modules[script].Args, "--env cartpole --device cpu --num-envs 2".split())
    policy = kind(args, diffsim.make(Blinkered, num_envs=2, horizon=240)).policy
    obs = torch.randn(9, 5)
    hidden, seen = obs.clone(), obs.clone()
    hidden[:, 3:], seen[:, :3] = 9.0, 9.0
    assert torch.equal(policy(hidden), policy(obs)) and not torch.equal(policy(seen), policy(obs))


def test_guided_policy_search_refuses_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "blinkered.py"
    path.write_text("from diffsim.tasks import TASKS\n\n\nclass Blinkered(TASKS['cartpole']):\n    actor_dim = 3\n")
    line = refusal(lambda: parse(gps.Args, ["--env", str(path)]), capsys)
    assert "shows its actor the first 3 numbers of an observation" in line
