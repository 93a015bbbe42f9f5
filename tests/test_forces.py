"""External forces on bodies."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import reference
import torch
import warp as wp
from scenes import (
    acceleration,
    acting_states,
    free_states,
    grounded_states,
    in_free_flight,
    leg_scene,
    run,
    task_scene,
    tree_scene,
    without_ground,
)
from test_accuracy import source
from test_dynamics import mujoco_acceleration, relative_error
from test_gradient import check_gradients

import diffsim
from diffsim.kernels.lanes import divide
from diffsim.kernels.model import model_of
from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

SETTINGS = [Integration("semi_implicit", 8), Integration("implicit", 8, 0.5)]
# A robot on the world, and a tree that floats, in which some bodies are welded to others: kernels take time to compile
SCENES = {"hopper": task_scene("hopper"), "tree": tree_scene("ball", 1)}


def wrenches(scene, count, rng):
    """About the weight of each body; of a light robot more than of a heavy one."""
    return 20 * rng.normal(size=(count, scene.nbody, 6))


@pytest.mark.parametrize("name", SCENES)
def test_accelerations_are_mujocos(name, rng):
    scene = without_ground(SCENES[name])
    states, forces = free_states(scene, 64, rng), wrenches(scene, 64, rng)
    qacc, expected = acceleration(scene, *states, forces=forces), mujoco_acceleration(scene, *states, forces)
    assert relative_error(qacc, expected) < 1e-10
    assert relative_error(qacc, acceleration(scene, *states)) > 0.01


@pytest.mark.parametrize("name, integration", [("leg", SETTINGS[1]), ("hopper", SETTINGS[0])])
def test_steps_are_the_references(name, integration, rng):
    """The leg's with factors besides the forces."""
    if name == "hopper":
        scene, states = SCENES[name], acting_states(SCENES[name], 4, rng)
    else:
        scene, states = grounded_states(leg_scene(grounded=True), 4, rng)
    factors, forces = rng.uniform(0.5, 2.0, (4, len(FACTORS))), wrenches(scene, 4, rng)
    given = {} if name == "hopper" else {"factors": factors}
    ends = run(scene, *states, forces=forces, integration=integration, **given)
    for e, (row, wrench, *start) in enumerate(zip(factors, forces, *states, strict=True)):
        changed = reference.with_factors(scene, row) if given else scene
        expected = reference.step(changed, *start, 1 / 60, integration, wrench)
        for value, end in zip(ends, expected, strict=True):
            np.testing.assert_allclose(value[e], end, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_gradients_are_those_of_differences(name, rng):
    scene = SCENES[name]
    forces = {"forces": wrenches(scene, 4, rng)}
    check_gradients(scene, free_states(scene, 4, rng), rng, forces, integration=Integration(substeps=8))


def test_gradients_on_the_ground_with_factors_are_those_of_differences(rng):
    scene, states = grounded_states(leg_scene(grounded=True), 8, rng)
    optional = {"factors": rng.uniform(0.5, 2.0, (8, len(FACTORS))), "forces": wrenches(scene, 8, rng)}
    check_gradients(scene, states, rng, optional, integration=SETTINGS[1])


def test_no_force_changes_no_bit(rng):
    scene, states = grounded_states(leg_scene(grounded=True), 16, rng)
    results = []
    for forces in (False, True):
        sim = Simulator(scene, 16, SETTINGS[1], dtype=torch.float64, factors=True, forces=forces)
        leaves = [torch.tensor(x, requires_grad=True) for x in states]
        q, v = sim.step(*leaves)
        results.append([q, v, *torch.autograd.grad(q.sin().sum() + v.cos().sum(), leaves)])
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


def test_a_push_changes_the_momentum_by_its_impulse(rng):
    """And each environment's its own, in the steps in which it acts."""
    scene = in_free_flight(SCENES["tree"])
    sim = Simulator(scene, 3, Integration(substeps=64), dtype=torch.float64, forces=True)
    qpos, qvel, _ = (torch.tensor(x).expand(3, -1) for x in free_states(scene, 1, rng))
    impulse = torch.tensor([[0.0, 0.0, 0.0], [3.0, -1.0, 2.0], [0.0, 5.0, 0.0]], dtype=torch.float64)
    with torch.no_grad():
        for step in range(9):
            sim.forces[:, 1, :3] = impulse * 60 / 6 if step < 6 else 0.0
            qpos, qvel = sim.step(qpos, qvel, torch.zeros(3, scene.nu, dtype=torch.float64))
    ends = [reference.momentum(scene, q, v)[0] for q, v in zip(qpos.numpy(), qvel.numpy(), strict=True)]
    for e in (1, 2):  # gravity acts on all alike; semi-implicit Euler keeps momentum to first order in the substep
        np.testing.assert_allclose(ends[e] - ends[0], impulse[e], atol=0.02)


def test_a_floating_world_feels_nothing():
    scene = SCENES["tree"]
    sim = Simulator(scene, 1, dtype=torch.float64, forces=True)
    qpos, zeros = torch.tensor(scene.qpos0[None]), torch.zeros(1, scene.nbody, 6, dtype=torch.float64)
    sim.forces = (zeros + 1.0).requires_grad_()
    q, v = sim.step(qpos, zeros.new_zeros(1, scene.nv), zeros.new_zeros(1, scene.nu))
    (slope,) = torch.autograd.grad(v.sum() + q.sum(), sim.forces)
    assert (slope[0, 0] == 0).all() and (slope[0, 1:].abs().sum(1) > 0).all()


@pytest.mark.parametrize("integrator", ["semi_implicit", "extrapolated"])
def test_gradients_reach_a_tensor_through_the_environment(integrator):
    """A whole window's, in one force for all."""

    def total(force):
        env = diffsim.make("hopper", 4, seed=0, horizon=4, dtype=torch.float64, integrator=integrator, forces=True)
        torso = torch.eye(env.scene.nbody, dtype=torch.float64)[env.scene.mj_model.body("torso").id]
        env.sim.forces = (torso[:, None] * force).expand(4, -1, -1)
        with torch.set_grad_enabled(force.requires_grad):
            return sum(env.step(torch.full((4, 3), 0.2, dtype=torch.float64))[1].sum() for _ in range(4))

    start = torch.tensor([30.0, 5.0, -20.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    (slope,) = torch.autograd.grad(total(leaf := start.clone().requires_grad_()), leaf)
    expected = torch.stack([(total(start + d) - total(start - d)) / 2e-3 for d in 1e-3 * torch.eye(6).double()])
    assert (slope[[1, 3, 5]] == 0).all() and (slope[[0, 2, 4]] != 0).all()  # the robot is planar
    torch.testing.assert_close(slope, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))


def test_recorded_steps_are_counted():
    env = diffsim.make("hopper", 2, horizon=1, dtype=torch.float64, forces=True)
    env.sim.forces = torch.ones(2, env.scene.nbody, 6, dtype=torch.float64, requires_grad=True)
    action = torch.zeros(2, 3, dtype=torch.float64)
    env.step(action)
    with pytest.raises(RuntimeError, match="horizon of 1 differentiable steps exceeded"):
        env.step(action)


def test_wrong_forces_are_refused():
    scene = task_scene("cartpole")
    sim, zeros = Simulator(scene, 2, forces=True), torch.zeros(2, scene.nbody, 6)
    for value, message in (
        (zeros[:, 1:], r"forces has shape \(2, 2, 6\), must be \(2, 3, 6\) \(environments, bodies, numbers each\)"),
        (zeros.flatten(1), r"forces has shape \(2, 18\), must be \(2, 3, 6\)"),
        (zeros.double(), "forces has dtype torch.float64, must be torch.float32"),
        (zeros.numpy(), "forces is a ndarray"),
    ):
        with pytest.raises(ValueError, match=message):
            sim.forces = value
    name = scene.mj_model.body(2).name
    for column, what in ((1, "force y"), (5, "torque z")):
        for number in (float("nan"), float("inf")):
            bad = zeros.clone()
            bad[1, 2, column] = number
            with pytest.raises(ValueError, match=f"{what} on body {name} is {number} in environment 1; .* be finite"):
                sim.forces = bad
            sim.forces = zeros.clone()
            sim.forces[1, 2, column] = number
            with pytest.raises(ValueError, match=f"{what} on body {name} is {number} in environment 1"):
                sim.step(torch.zeros(2, 2), torch.zeros(2, 2), torch.zeros(2, 1))
    with pytest.raises(ValueError, match=r"forces has shape \(2, 3, 6\), must be \(2, 0, 6\)"):
        Simulator(scene, 2).forces = zeros


def test_kernels_without_forces_do_not_know_them():
    scene = leg_scene(grounded=True)
    plain, forced = source(scene, varied=True), source(scene, varied=True, forced=True)
    for name in ("add_forces", "add_forces_adjoint", "(var_m).body_com"):
        assert name in forced and name not in plain


@pytest.mark.parametrize("team", [(1, 1), (4, 1), (8, 4)])
def test_one_lane_has_each_body(team):
    scene = task_scene("humanoid")
    division = divide(scene, *team)
    model = model_of(scene, division, wp.float64, "cpu")
    begin, body, link = model.body_begin.numpy(), model.body.numpy(), model.link.numpy()
    assert sorted(body) == list(range(1, scene.nbody))
    for entry, (first, end) in enumerate(zip(begin, begin[1:], strict=False)):
        assert (scene.body_link[body[first:end]] == link[entry]).all()
        assert first == end or link[entry] in division.weighs[entry // division.slots]


def test_the_bodies_are_mujocos(rng):
    """Their centres of mass."""
    scene = tree_scene("floating", 4)
    model = scene.mj_model
    data, qpos = mujoco.MjData(model), free_states(scene, 1, rng)[0][0]
    data.qpos = qpos
    mujoco.mj_forward(model, data)
    links = reference.kinematics(scene, qpos, np.zeros(scene.nv))
    assert len(set(scene.body_link)) < scene.nbody  # some are welded
    for body in range(1, scene.nbody):
        link = links[scene.body_link[body]]
        np.testing.assert_allclose(link.position + link.rotation @ scene.body_com[body], data.xipos[body], atol=1e-12)
