"""Factors of the constants and external forces, of which each environment has its own."""

from __future__ import annotations

import re

import numpy as np
import pytest
import reference
import torch
import warp as wp
from scenes import (
    acceleration,
    free_states,
    grounded_states,
    leg_scene,
    run,
    task_scene,
    tree_scene,
    without_ground,
)
from test_dynamics import mujoco_acceleration, relative_error
from test_gradient import check_gradients

import diffsim
from diffsim.kernels.thread.division import divide
from diffsim.kernels.thread.model import model_of
from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

SETTINGS = [Integration("soft", 8, implicit) for implicit in (False, True)]
BOTH = {"factors": True, "forces": True}
TREE = tree_scene("ball", 1)  # it floats, and some of its bodies are welded to others


def wrenches(scene, count, rng):
    """About the weight of each body; of a light robot more than of a heavy one."""
    return 20 * rng.normal(size=(count, scene.nbody, 6))


def given(scene, count, rng):
    return {"factors": rng.uniform(0.5, 2.0, (count, len(FACTORS))), "forces": wrenches(scene, count, rng)}


def grounded_leg(count, rng):
    return grounded_states(leg_scene(grounded=True), count, rng)


@pytest.mark.parametrize("name", ["hopper", "leg", "tree"])
def test_accelerations_under_forces_are_mujocos(name, rng):
    """Of a robot on the world and of one with muscles, where the factors are one, and of a tree."""
    scenes = {"hopper": task_scene("hopper"), "leg": leg_scene(grounded=True), "tree": TREE}
    scene = without_ground(scenes[name])
    states, forces = free_states(scene, 64, rng), wrenches(scene, 64, rng)
    ones = {} if name == "tree" else {"factors": np.ones((64, len(FACTORS)))}
    qacc, expected = acceleration(scene, *states, forces=forces, **ones), mujoco_acceleration(scene, *states, forces)
    assert relative_error(qacc, expected) < 1e-10
    assert relative_error(qacc, acceleration(scene, *states, forces=0 * forces, **ones)) > 0.01


@pytest.mark.parametrize("integration", SETTINGS)
def test_steps_are_the_references(integration, rng):
    scene, states = grounded_leg(4, rng)
    optional = given(scene, 4, rng)
    ends = run(scene, *states, integration=integration, **optional)
    for e, (row, wrench, *start) in enumerate(zip(*optional.values(), *states, strict=True)):
        expected = reference.step(reference.with_factors(scene, row), *start, 1 / 60, integration, wrench)
        for value, end in zip(ends, expected, strict=True):
            np.testing.assert_allclose(value[e], end, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("integration", SETTINGS)
def test_gradients_are_those_of_differences(integration, rng):
    """In state, control and forces, where the factors are not one."""
    scene, states = grounded_leg(16, rng)
    check_gradients(scene, states, rng, given(scene, 16, rng), integration=integration)


def test_gradients_of_welded_bodies_are_those_of_differences(rng):
    forces = {"forces": wrenches(TREE, 4, rng)}
    check_gradients(TREE, free_states(TREE, 4, rng), rng, forces, integration=SETTINGS[0])


def test_each_environment_and_step_has_its_own(rng):
    """Steps of a rollout see what was written in place before them, and so do their adjoints."""
    scene, states = grounded_leg(2, rng)
    sim = Simulator(scene, 2, SETTINGS[0], horizon=2, dtype=torch.float64, **BOTH)
    q, v, u = (torch.tensor(x, requires_grad=True) for x in states)
    per_step = [{name: torch.tensor(x) for name, x in given(scene, 2, rng).items()} for _ in range(2)]
    a, b = q, v
    for each in per_step:
        sim.factors[:], sim.forces[:] = each["factors"], each["forces"]
        a, b = sim.step(a, b, u)
    slope = torch.autograd.grad(a.sum() + b.sum(), v)[0]
    for e in range(2):
        alone = Simulator(scene, 1, SETTINGS[0], horizon=2, dtype=torch.float64, **BOTH)
        start = v[e : e + 1].detach().requires_grad_()
        a, b = q[e : e + 1], start
        for each in per_step:
            alone.factors, alone.forces = each["factors"][e : e + 1], each["forces"][e : e + 1]
            a, b = alone.step(a, b, u[e : e + 1])
        assert torch.equal(torch.autograd.grad(a.sum() + b.sum(), start)[0], slope[e : e + 1])


def test_gradients_reach_a_tensor_through_the_environment():
    """A whole rollout's, in one force on the torso for all, with factors that are not one."""
    factors = torch.linspace(0.7, 1.4, len(FACTORS)).double().expand(4, -1)

    def total(given):
        env = diffsim.make("hopper", 4, seed=0, horizon=4, dtype=torch.float64, **BOTH)
        torso = torch.eye(env.scene.nbody, dtype=torch.float64)[env.scene.mj_model.body("torso").id]
        env.sim.factors, env.sim.forces = factors, (torso[:, None] * given).expand(4, -1, -1)
        with torch.set_grad_enabled(given.requires_grad):
            return sum(env.step(torch.full((4, 3), 0.2, dtype=torch.float64))[1].sum() for _ in range(4))

    start = torch.tensor([30.0, 5.0, -20.0, 2.0, 3.0, 4.0]).double()
    (slope,) = torch.autograd.grad(total(leaf := start.clone().requires_grad_()), leaf)
    expected = torch.stack([(total(start + d) - total(start - d)) for d in 1e-3 * torch.eye(6).double()]) / 2e-3
    assert (slope[1::2] == 0).all() and (slope[::2] != 0).all()  # the robot is planar
    torch.testing.assert_close(slope, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))


def test_recorded_steps_are_counted():
    env = diffsim.make("hopper", 2, horizon=1, dtype=torch.float64, **BOTH)
    env.sim.forces = env.sim.forces.clone().requires_grad_()
    action = torch.zeros(2, 3, dtype=torch.float64)
    env.step(action)
    with pytest.raises(RuntimeError, match="horizon of 1 differentiable steps exceeded"):
        env.step(action)


NOT_FINITE = float("nan"), float("inf")
WRONG = [  # a value: what is done to one that is right
    ("factors", lambda x: x[:, 1:], "factors is (2, 7) torch.float32 cpu, must be a torch.Tensor of (2, 8)"),
    ("forces", lambda x: x.flatten(1), "forces is (2, 18) torch.float32 cpu, must be a torch.Tensor of (2, 3, 6)"),
    ("forces", torch.Tensor.double, "forces is (2, 3, 6) torch.float64 cpu, must be"),
]
WRONG_NUMBERS = [
    *(("factors", (1, 3), x, f"factors[1, 3] is {x}", "not negative") for x in (-1.0, *NOT_FINITE)),
    *(("forces", (1, 2, 5), x, f"forces[1, 2, 5] is {x}", "finite") for x in NOT_FINITE),
]


def test_wrong_factors_and_forces_are_refused():
    scene = task_scene("cartpole")
    sim, without = Simulator(scene, 2, **BOTH), Simulator(scene, 2)
    right = {name: getattr(sim, name).clone() for name in BOTH}
    for name, change, message in WRONG:
        with pytest.raises(ValueError) as error:
            setattr(sim, name, change(right[name]))
        assert message in str(error.value)
    for name, place, number, message, allowed in WRONG_NUMBERS:
        bad = right[name].clone()
        bad[place] = number
        with pytest.raises(ValueError, match=f"{re.escape(message)}; .*{allowed}"):
            setattr(sim, name, bad)
        getattr(sim, name)[place] = number
        with pytest.raises(ValueError, match=re.escape(message)):
            sim.step(torch.zeros(2, 2), torch.zeros(2, 2), torch.zeros(2, 1))
        setattr(sim, name, right[name].clone())
    for name, sizes in (("factors", ("(2, 8)", "(2, 0)")), ("forces", ("(2, 3, 6)", "(2, 0, 6)"))):
        with pytest.raises(ValueError) as error:
            setattr(without, name, right[name])
        assert all(size in str(error.value) for size in (f"{name} is", *sizes))


def test_a_factor_has_no_gradient():
    """Whether it is assigned or written in place, which is told before a step."""
    sim, scale = Simulator(task_scene("cartpole"), 2, **BOTH), torch.ones(2, 8, requires_grad=True)
    message = "^factors require grad, but a factor has no gradient: use ParametricSimulator.parameters$"
    with pytest.raises(ValueError, match=message):
        sim.factors = scale
    sim.factors[:] = scale
    with pytest.raises(ValueError, match=message):
        sim.step(torch.zeros(2, 2), torch.zeros(2, 2), torch.zeros(2, 1))


@pytest.mark.parametrize("team", [(1, 1), (4, 1), (8, 4)])
def test_one_lane_counts_each_joint_and_has_each_body(team):
    scene = task_scene("humanoid")
    division, count = divide(scene, *team), np.zeros(scene.nlink)
    model = model_of(scene, division, wp.float64, "cpu")
    begin, body, link = model.body_begin.numpy(), model.body.numpy(), model.link.numpy()
    np.add.at(count, link, model.owned.numpy())
    assert (count[1:] == 1).all()
    assert sorted(body) == list(range(1, scene.nbody))
    for entry, (first, end) in enumerate(zip(begin, begin[1:], strict=False)):
        assert (scene.body_link[body[first:end]] == link[entry]).all()
        assert first == end or link[entry] in division.masses[entry // division.slots]
