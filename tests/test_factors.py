"""Factors of the constants that differ between environments."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import torch
import warp as wp
from scenes import leg_scene, run, task_scene, varied_robot
from test_accuracy import source

import diffsim
from diffsim.kernels.lanes import divide
from diffsim.kernels.model import model_of
from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

SETTINGS = [Integration("semi_implicit", 8), Integration("implicit", 8, 0.5)]


@pytest.mark.parametrize("integration", SETTINGS)
@pytest.mark.parametrize("name", ["leg", "hopper"])
def test_steps_are_the_references(name, integration, rng):
    scene, states = varied_robot(name, 4, rng)
    factors = rng.uniform(0.5, 2.0, (4, len(FACTORS)))
    ends = run(scene, *states, factors=factors, integration=integration)
    for e, (row, *start) in enumerate(zip(factors, *states, strict=True)):
        expected = reference.step(reference.with_factors(scene, row), *start, 1 / 60, integration)
        for value, end in zip(ends, expected, strict=True):
            np.testing.assert_allclose(value[e], end, rtol=1e-9, atol=1e-9)


def test_factors_of_one_change_no_bit(rng):
    scene, states = varied_robot("hopper", 16, rng)
    results = []
    for factors in (False, True):
        sim = Simulator(scene, 16, SETTINGS[0], dtype=torch.float64, factors=factors)
        leaves = [torch.tensor(x, requires_grad=True) for x in states]
        q, v = sim.step(*leaves)
        results.append([q, v, *torch.autograd.grad(q.sin().sum() + v.cos().sum(), leaves)])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


def test_each_environment_and_step_has_its_own(rng):
    """Steps of a window see what was written in place before them, and so do their adjoints."""
    scene, states = varied_robot("leg", 2, rng)
    sim = Simulator(scene, 2, SETTINGS[0], horizon=2, dtype=torch.float64, factors=True)
    q, v, u = (torch.tensor(x, requires_grad=True) for x in states)
    per_step = rng.uniform(0.5, 2.0, (2, 2, len(FACTORS)))
    a, b = q, v
    for row in per_step:
        sim.factors[:] = torch.tensor(row)
        a, b = sim.step(a, b, u)
    slope = torch.autograd.grad(a.sum() + b.sum(), v)[0]
    for e in range(2):
        alone = Simulator(scene, 1, SETTINGS[0], horizon=2, dtype=torch.float64, factors=True)
        start = v[e : e + 1].detach().requires_grad_()
        a, b = q[e : e + 1], start
        for row in per_step[:, e : e + 1]:
            alone.factors = torch.tensor(row)
            a, b = alone.step(a, b, u[e : e + 1])
        assert torch.equal(torch.autograd.grad(a.sum() + b.sum(), start)[0], slope[e : e + 1])


@pytest.mark.parametrize("integrator", ["semi_implicit", "extrapolated"])
def test_gradients_reach_a_tensor_through_the_environment(integrator):
    """A whole window's, in the logarithms of one set of factors for all."""

    def total(log_factors):
        env = diffsim.make("hopper", 4, seed=0, horizon=4, dtype=torch.float64, integrator=integrator, factors=True)
        env.sim.factors = log_factors.exp().expand(4, -1)
        with torch.set_grad_enabled(log_factors.requires_grad):
            return sum(env.step(torch.full((4, 3), 0.2, dtype=torch.float64))[1].sum() for _ in range(4))

    start = 0.1 * torch.arange(len(FACTORS), dtype=torch.float64)
    (slope,) = torch.autograd.grad(total(leaf := start.clone().requires_grad_()), leaf)
    eps = 1e-6 * torch.eye(len(FACTORS), dtype=torch.float64)
    expected = torch.stack([(total(start + d) - total(start - d)) / 2e-6 for d in eps])
    assert (slope[FACTORS.index("d_limit")] == 0) and (slope[-2:] != 0).all()  # no task damps its limits
    torch.testing.assert_close(slope, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))


def test_recorded_steps_are_counted():
    env = diffsim.make("hopper", 2, horizon=1, dtype=torch.float64, factors=True)
    env.sim.factors = torch.ones(2, len(FACTORS), dtype=torch.float64, requires_grad=True)
    action = torch.zeros(2, 3, dtype=torch.float64)
    env.step(action)
    with pytest.raises(RuntimeError, match="horizon of 1 differentiable steps exceeded"):
        env.step(action)


def test_wrong_factors_are_refused():
    sim, ones = Simulator(task_scene("cartpole"), 2, factors=True), torch.ones(2, len(FACTORS))
    for value, message in (
        (ones[:, 1:], r"factors has shape \(2, 7\), must be \(2, 8\)"),
        (ones.double(), "factors has dtype torch.float64, must be torch.float32"),
        (ones.numpy(), "factors is a ndarray"),
    ):
        with pytest.raises(ValueError, match=message):
            sim.factors = value
    start = torch.zeros(2, 2), torch.zeros(2, 2), torch.zeros(2, 1)
    for number in (-1.0, float("nan"), float("inf")):
        bad = ones.clone()
        bad[1, 3] = number
        with pytest.raises(ValueError, match=f"the factor of mu is {number} in environment 1; .* not negative"):
            sim.factors = bad
        sim.factors = ones.clone()
        sim.factors[1, 3] = number
        with pytest.raises(ValueError, match=f"the factor of mu is {number} in environment 1"):
            sim.step(*start)
    with pytest.raises(ValueError, match=r"factors has shape \(2, 8\), must be \(2, 0\)"):
        Simulator(task_scene("cartpole"), 2).factors = ones


def test_kernels_without_factors_do_not_know_them():
    scene = leg_scene(grounded=True)
    plain, varied = source(scene), source(scene, varied=True)
    for name in ("contact_constants_adjoint", "limit_constants_gain", "(var_m).carried"):
        assert name in varied and name not in plain


@pytest.mark.parametrize("team", [(1, 1), (4, 1), (8, 4)])
def test_one_lane_counts_each_joint(team):
    scene = task_scene("humanoid")
    model = model_of(scene, divide(scene, *team), wp.float64, "cpu")
    count = np.zeros(scene.nlink)
    np.add.at(count, model.link.numpy(), model.carried.numpy())
    assert (count[1:] == 1).all()
