"""Dynamics: Jacobians against differences, tangents of rotations, and trajectories that blow up."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from systems import jacobian_errors, normal, random_states, task_system

from diffsim.planning import dynamics


@pytest.mark.parametrize(
    "name", ["cartpole", "hopper", "ant", "walker", pytest.param("swimmer", marks=pytest.mark.slow)]
)
def test_jacobians_are_those_of_differences(name: str, rng: np.random.Generator) -> None:
    system = task_system(name)
    x, u = random_states(system, rng)
    assert jacobian_errors(system, x, u).max() < 1e-5
    alone = system.jacobians(x[2:3], u[2:3])
    together = system.jacobians(x, u)
    assert torch.equal(alone[0], together[2])  # environments do not know each other
    assert (together.abs().amax(0) > 0).any(0).all()  # no column that never reached the simulator


def test_jacobians_in_several_batches(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    system = task_system("hopper")
    x, u = random_states(system, rng)
    expected = system.jacobians(x, u)
    monkeypatch.setattr(dynamics, "BATCH", 4)  # six states: four, and four with an overlap of two
    assert torch.equal(system.jacobians(x, u), expected)


def test_tangents_of_a_free_joint(rng: np.random.Generator) -> None:
    system = task_system("ant")
    x, u = random_states(system, rng)
    tangent = normal(rng, 6, system.nd)
    moved = system.retract(x, tangent)
    torch.testing.assert_close(moved[:, 3:7].norm(dim=-1), torch.ones(6).double())
    torch.testing.assert_close(system.difference(moved, x), tangent, rtol=0, atol=1e-12)
    moved[:, 3:7] *= -1  # the same rotation
    torch.testing.assert_close(system.difference(moved, x), tangent, rtol=0, atol=1e-12)
    # To first order it is a rotation vector of the body's frame: what its angular velocity integrates to
    turn = 1e-6 * torch.tensor([0.3, -0.2, 0.5]).double()
    step = torch.zeros(6, system.nd).double()
    step[:, 3:6] = turn
    w, v = x[:, 3:4], x[:, 4:7]
    turned = torch.cat((w - v @ turn[:, None] / 2, v + (w * turn + torch.linalg.cross(v, turn.expand(6, -1))) / 2), 1)
    torch.testing.assert_close(system.retract(x, step)[:, 3:7], turned, rtol=0, atol=1e-12)


def test_jacobians_do_not_know_a_quaternions_length(rng: np.random.Generator) -> None:
    system = task_system("ant")
    x, u = random_states(system, rng)
    expected = system.jacobians(x, u)
    longer = x.clone()
    longer[:, 3:7] *= 1 + 1e-4
    atol = 1e-8 * expected.abs().max().item()
    torch.testing.assert_close(system.jacobians(longer, u), expected, rtol=1e-8, atol=atol)


def test_a_trajectory_that_blows_up_stays_where_it_was() -> None:
    system = task_system("cartpole")
    wild, before = torch.tensor([[0.0], [math.nan], [0.0]]).double(), system.steps
    x, u, finite = system.rollout(torch.zeros(3, 4).double(), 5, lambda t, _: wild if t == 2 else 0 * wild.nan_to_num())
    assert finite.tolist() == [[True] * 5, [True, True, False, False, False], [True] * 5]
    assert torch.isfinite(x).all() and torch.isfinite(u).all() and torch.equal(x[1, 2], x[1, 5])
    assert system.steps - before == 15
