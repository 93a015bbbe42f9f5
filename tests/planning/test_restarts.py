"""Planning from random action sequences."""

from __future__ import annotations

import math

import pytest
import torch
from systems import task_system

from diffsim.planning import AfterStep, best_of_random_starts, receding_horizon, starting_actions


def test_starting_actions() -> None:
    """The first is nothing; they depend on the generator alone, and not on how many there are."""
    few, many = (starting_actions(n, 40, 2, 1 / 60, torch.Generator().manual_seed(3)) for n in (3, 7))
    assert many.shape == (7, 40, 2) and not many[0].any() and torch.equal(few, many[:3])
    assert (many[1:].std(1) > 0).all() and many[1].abs().max() <= 1
    rough = many.diff(dim=1).square().mean((1, 2)) / many.var(1).mean(1)
    assert max(rough[[1, 4]]) < (16 * math.pi / 60) ** 2 < 1 < min(rough[[3, 6]])  # waves, white noise
    curvature = many[[1, 4], 2:] - 2 * many[[1, 4], 1:-1] + many[[1, 4], :-2]
    ratio = curvature / many[[1, 4], 1:-1]  # 2 cos(omega dt) - 2: all motors of a wave have its frequency
    torch.testing.assert_close(ratio, ratio[:, :1, :1].expand_as(ratio))


def test_the_best_are_kept_and_divergent_ones_left_out() -> None:
    system = task_system("cartpole")
    cost = AfterStep(system, lambda x, u: -system.reward(x, u))
    actions = starting_actions(4, 10, 1, system.control_dt, torch.Generator().manual_seed(0))
    actions[1, 3] = math.nan
    x, u = best_of_random_starts(system, cost, system.start()[0], actions, keep=2, iterations=1)
    assert x.shape == (2, 11, 4) and u.shape == (2, 10, 1) and torch.equal(x[:, 0], system.start().expand(2, -1))
    first, second = cost.value(x, u).sum(-1).tolist()
    assert first <= second
    with pytest.raises(ValueError, match="every random start"):
        best_of_random_starts(system, cost, system.start()[0], actions * math.nan, 2, 1)


def test_windows_are_stitched_to_a_trajectory_of_the_system() -> None:
    """Its first steps are the first window's; what windows add is no worse than no action."""
    system, rng = task_system("cartpole"), torch.Generator().manual_seed(0)
    cost = AfterStep(system, lambda x, u: -system.reward(x, u))
    actions = starting_actions(2, 20, 1, system.control_dt, rng)
    x, u = best_of_random_starts(system, cost, system.start()[0], actions, keep=2, iterations=5)
    xs, us = receding_horizon(system, cost, x, u, 33, 5, 3, rng)
    assert xs.shape == (2, 34, 4) and us.shape == (2, 33, 1)
    torch.testing.assert_close(xs[:, :6], x[:, :6])
    again, _, _ = system.rollout(x[:, 0], 33, lambda t, _: us[:, t])
    torch.testing.assert_close(again, xs)
    idle, _, _ = system.rollout(x[:, -1], 13, lambda t, _: 0 * us[:, t])
    assert (cost.value(xs, us).sum(-1) < cost.value(x, u).sum(-1) + cost.value(idle, 0 * us[:, :13]).sum(-1)).all()
