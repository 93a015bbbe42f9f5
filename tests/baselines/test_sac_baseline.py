"""SAC's parts against torch's distributions, closed forms, and problems whose soft optimum is known."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import sac_baseline as sac
import torch
from learners import assert_resumes
from problems import Problem, assert_soft_updates, assert_squashed_gaussian, assert_system_controlled

import diffsim
from diffsim.training import parse

FLAGS = "--env ant --device cpu --hidden 16 --num-envs 3 --steps 4 --batch-size 32 --seed-steps 0"


def build(*arguments: str, env: Any = None) -> sac.SAC:
    args = parse(sac.Args, [*FLAGS.split(), *arguments])
    return sac.SAC(args, env or diffsim.make("ant", num_envs=3, seed=0, horizon=4))


def test_density_is_that_of_the_squashed_gaussian() -> None:
    assert_squashed_gaussian(build().actor)


def test_time_limits_are_bootstrapped_and_failures_are_not() -> None:
    """Of three ants that run out of time, fall, and do neither, what the buffer keeps."""
    learner = build()
    env = learner.env
    env.episode_step[0] = env.episode_length - 1
    qpos, qvel = env.qpos.clone(), env.qvel.clone()
    qpos[1, 2], qvel[1, 2] = 0.28, -6.0
    obs = env.set_state(qpos, qvel)
    next_obs = learner.act(obs, random=True)
    rows = learner.buffer.split(learner.buffer.rows[:3])
    assert rows.terminated.tolist() == [0, 1, 0]
    torch.testing.assert_close(rows.obs, obs)
    assert (rows.next_obs[:2] != next_obs[:2]).any(1).all() and torch.equal(rows.next_obs[2], next_obs[2])


@pytest.mark.parametrize("flags, subset", [("", None), ("--critics 4 --critic-subset 2", 2)], ids=["sac", "redq"])
def test_targets_and_losses(flags: str, subset: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = build(*flags.split())
    optimizers = learner.actor_optimizer, learner.temperature_optimizer
    assert_soft_updates(learner, optimizers, monkeypatch, subset)


def test_a_linear_quadratic_system_is_controlled() -> None:
    torch.manual_seed(0)
    flags = "--lr 3e-3 --temperature-lr 1e-12 --gamma 0.9 --tau 0.05"
    flags += " --hidden 32 32 --num-envs 16 --steps 8 --batch-size 128 --buffer-size 5000"
    learner = build(*flags.split(), env=Problem(16))
    learner.temperature["log"].data.fill_(math.log(0.1))
    for _ in range(10):
        learner.explore()
    for _ in range(75):
        learner.iterate()
    assert_system_controlled(learner.policy)


def test_skipped_updates_of_every_optimizer_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = build("--hidden", "4", "--num-envs", "2", "--steps", "1", env=Problem(2))
    for k, optimizer in enumerate((learner.actor_optimizer, learner.critic_optimizer, learner.temperature_optimizer)):
        optimizer.skipped += 10**k
    assert learner.explore()["grad/skipped"] == 111


def test_a_run_resumes_bitwise_with_its_buffer(tmp_path: Path) -> None:
    flags = "--env cartpole --num-envs 4 --steps 8 --seed-steps 16 --batch-size 16 --hidden 16 --iterations 8 --quiet"
    flags += " --eval-episodes 2 --device cpu --threads 1 --buffer-size 100"
    whole = assert_resumes(sac, tmp_path, flags, 5)
    assert whole["modules"]["buffer"]["_extra_state"].shape[0] == 100
