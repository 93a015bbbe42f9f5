"""Of a task that shows its actor a part of the observation, no learner's policy uses more."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import refusal

import bptt
import diffsim
import gps
import mbpo
import pfpn
import pfpn_sac
import pods
import ppo_baseline
import sac_baseline
import sapo
import shac
from diffsim.tasks import TASKS
from diffsim.training import parse

LEARNERS = [shac.SHAC, sapo.SAPO, bptt.BPTT, pods.PODS, ppo_baseline.PPO, sac_baseline.SAC, mbpo.MBPO]


class Blinkered(TASKS["cartpole"]):  # type: ignore[misc]
    actor_dim = 3


@pytest.mark.parametrize("kind", [*LEARNERS, pfpn.PPO, pfpn_sac.SAC], ids=lambda kind: kind.__module__)
def test_a_policy_uses_what_its_actor_sees(kind: Any) -> None:
    args = parse(sys.modules[kind.__module__].Args, "--env cartpole --device cpu --num-envs 2".split())
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
