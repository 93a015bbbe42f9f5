"""Pushes of benchmarks/robustness.py on systems whose answers are known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import robustness
import torch
from common import Case, parse
from learners import refusal
from scenes import parse as scene_of
from tables import read_csv
from torch import Tensor

import diffsim
from diffsim import DiffEnv, Integration
from diffsim.tasks import Task
from diffsim.training import SavedPolicy, checkpoint
from diffsim.training.checkpoint import POLICIES
from diffsim.training.evaluation import SEED
from diffsim.training.layers import Chain
from diffsim_robots.imitation.clip import Clip, read_clip
from diffsim_robots.imitation.task import HumanoidImitation

pytestmark = pytest.mark.unoptimized
PUCK = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody> <body> <freejoint/> <geom size=".1" mass="2"/> </body> </worldbody>
</mujoco>"""
FAST = 0.7  # m/s


class Puck(Task):
    """Observes the time, which starts anywhere within 100 control steps; falls at 190, or faster than FAST."""

    name, obs_dim = "puck", 3
    num_random = num_memory = 1
    start = spread = ()

    def reset(self, rand: Tensor) -> tuple[Tensor, Tensor]:
        return torch.eye(7)[3].expand(*rand.shape[:-1], -1), torch.zeros(*rand.shape[:-1], 6)

    def begin(self, rand: Tensor) -> Tensor:
        return (100 * rand).floor()

    def remember(self, memory: Tensor, action: Tensor, noise: Tensor) -> Tensor:
        return memory + 1

    def observe_with(self, qpos: Tensor, qvel: Tensor, action: Tensor, memory: Tensor) -> Tensor:
        return torch.cat((memory, qvel[..., :2]), -1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        return obs[..., 0]

    def terminated(self, obs: Tensor) -> Tensor:
        return (obs[..., 0] == 190) | (obs[..., 1:].abs().amax(-1) > FAST)


def idle(obs: Tensor) -> Tensor:
    return torch.zeros(len(obs), 0)


def resting() -> robustness.Walkers:
    env = DiffEnv(Puck(), scene_of(PUCK), 1, integration=Integration(substeps=4))
    qpos = torch.tensor(env.scene.qpos0).float().expand(3, -1)
    state = robustness.State(qpos, torch.zeros(3, 6), torch.zeros(3, 0), torch.zeros(3, 1))
    return robustness.Walkers(env, idle, state)


def test_the_smallest_push_is_found() -> None:
    """The one that accelerates 2 kg to FAST in 0.1 s: 14 N; a share that never reaches a half has none."""
    walkers, pushes = resting(), list[float]()

    def fallen(newtons: float) -> float:
        return float(walkers.felled(1.0, "sideways", newtons).double().mean())

    for first in (1.0, 500.0):
        assert 14 <= robustness.smallest(fallen, first) <= 14 * (1 + robustness.TOLERANCE)
    assert 5 <= robustness.smallest(lambda newtons: newtons / 10, 1.0) <= 5 * (1 + robustness.TOLERANCE)
    assert robustness.smallest(lambda newtons: pushes.append(newtons) or 0.49, 3.0) == math.inf
    assert max(pushes) == 3.0 * robustness.MOST


def test_a_task_keeps_its_memory() -> None:
    """Robots start at the phases of an evaluation, and are pushed at those that they have reached."""
    env, seen = DiffEnv(Puck(), scene_of(PUCK), 7, integration=Integration(substeps=4)), list[Tensor]()

    def policy(obs: Tensor) -> Tensor:
        seen.append(obs[:, 0].long())
        return idle(obs)

    first = env.reset(seed=SEED)[0][:, 0].long()
    walkers = robustness.walking(env, policy)
    assert torch.equal(torch.stack(seen), first + torch.arange(240)[:, None])
    reached = first + torch.randint(120, 241, (7,), generator=torch.Generator().manual_seed(SEED))
    steps = walkers.start.memory[:, 0].long()
    assert torch.equal(steps, reached[reached < 190]) and 0 < len(steps) < 7
    for _ in range(2):  # a push after the other
        seen.clear()
        walkers.felled(0.1, "forward", 0.0)
        assert torch.equal(torch.stack(seen), steps + torch.arange(6)[:, None])


def test_the_command_writes_a_row(tmp_path: Path) -> None:
    flags = "--num-envs 7 --output".split()
    robustness.main(parse(robustness.Args, None, [str(POLICIES / "hopper.pt"), *flags, str(tmp_path)]))
    (row,) = read_csv(tmp_path / "robustness.csv")
    assert row["robots"] == "7" and row["unpushed"] == "0"
    assert "sideways N" not in row and 10 < float(row["forward N"]) < 500


def test_a_policy_of_a_file_s_task_is_measured_if_the_file_is_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own, path = "examples/servo_tasks.py:Dog", tmp_path / "dog.pt"
    env = diffsim.make(own, 1)
    network = Chain(torch.nn.Linear(env.task.obs_dim, env.scene.nu))
    learner = SimpleNamespace(policy=network)
    checkpoint.save(path, "pfpn", learner, {"args": {"env": own, "seed": 1, "contact": "mujoco"}, "iteration": 1})
    args = parse(robustness.Args, None, [str(path), "--num-envs", "2"])
    assert "give its file" in refusal(lambda: robustness.load(args, path), capsys)
    case = robustness.load(replace(args, own=own), path)
    assert case.about["task"] == "dog" and case.about["learner"] == "pfpn"


def test_a_motion_that_ends_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its end would count as a fall. A loop is welcome."""
    args = parse(robustness.Args, None, ["imitation.pt"])
    for clip in (whole := read_clip("humanoid_run")), Clip("once", whole.qpos, loop=False):
        env = diffsim.make(HumanoidImitation.with_clip(clip), 1)
        case = Case("run", Path("imitation.pt"), SavedPolicy(torch.nn.Sequential(), "shac", {}, 1), env)
        monkeypatch.setattr(robustness, "load_case", lambda *_, case=case: case)
        if clip.loop:
            assert robustness.load(args, args.checkpoints[0]) == case
    line = refusal(lambda: robustness.main(args), capsys)
    assert "imitation.pt tracks a motion that ends, and with it the episode: train with a loop" in line
