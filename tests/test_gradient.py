"""Gradients of whole control steps, against central differences of the forward step and in closed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scenes import (
    BALL,
    BOUNDED_SERVOS,
    COMPENSATED,
    DISTINCT,
    SHOULDER,
    acting_states,
    check_that_ground_and_limits_act,
    free_states,
    parse,
    pass_limits,
    raise_ground,
    run,
    small_scene,
    task_scene,
    tree_scene,
)

from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks import TASKS

ONE = Integration(substeps=1)


def weights(scene, rng):
    return rng.normal(size=scene.nq), rng.normal(size=scene.nv)


def measure(qpos, qvel, weights):
    """A random function of the state, one number per environment; of NumPy arrays and torch tensors alike."""
    sin = torch.sin if isinstance(qpos, torch.Tensor) else np.sin
    w_q, w_v = (torch.as_tensor(w).to(qpos) for w in weights) if isinstance(qpos, torch.Tensor) else weights
    return (sin(qpos + w_v.sum()) * w_q).sum(-1) + (sin(qvel + w_q.sum()) * w_v).sum(-1)


def gradients(scene, states, weights, dtype=torch.float64, optional=None, **simulator):
    """Of the measure after one control step with respect to qpos, qvel, ctrl and optional forces, given any factors."""
    optional = {name: torch.tensor(x, dtype=dtype) for name, x in (optional or {}).items()}
    leaves = [torch.tensor(x, dtype=dtype, requires_grad=True) for x in states]
    leaves += [optional["forces"].requires_grad_()] if "forces" in optional else []
    sim = Simulator(scene, len(states[0]), dtype=dtype, **dict.fromkeys(optional, True), **simulator)
    for name, value in optional.items():
        setattr(sim, name, value)
    q, v = sim.step(*leaves[:3])
    measure(q, v, weights).sum().backward()
    return [leaf.grad.double().numpy() for leaf in leaves]


def differences(scene, states, weights, optional=None, scale=1.0, **simulator):
    """The same by central differences of fourth order, all in one batch; small steps, as contacts make corners."""
    optional, rows = optional or {}, len(states[0])
    states = [*states, *(x.reshape(rows, -1) for name, x in optional.items() if name == "forces")]
    sizes = [x.shape[1] for x in states]
    steps = (1e-7 * scale, 1e-6 * scale, 1e-5 * scale, 1e-2)[: len(sizes)]
    eps, splits = np.repeat(steps, sizes), np.cumsum(sizes)[:-1]
    offsets = np.array([-2.0, -1.0, 1.0, 2.0])[:, None, None, None] * np.diag(eps)[:, None, :]
    batch = (np.concatenate(states, 1) + offsets).reshape(-1, sum(sizes))
    parts = np.split(batch, splits, axis=1)
    given = {name: np.tile(x, (4 * sum(sizes), *[1] * (x.ndim - 1))) for name, x in optional.items()}
    if "forces" in given:
        given["forces"] = parts[3].reshape(given["forces"].shape)
    values = measure(*run(scene, *parts[:3], **given, **simulator), weights)
    far_low, low, high, far_high = values.reshape(4, sum(sizes), rows)
    slopes = (8 * (high - low) - (far_high - far_low)) / 12
    return np.split(slopes.T / eps, splits, axis=1)


def check_gradients(scene, states, rng, optional=None, **simulator):
    w = weights(scene, rng)
    values, expected = (f(scene, states, w, optional=optional, **simulator) for f in (gradients, differences))
    for name, value, slope in zip(("qpos", "qvel", "ctrl", "forces"), values, expected, strict=False):
        value = value.reshape(slope.shape)
        if slope.size:
            error, size = np.linalg.norm(value - slope, axis=-1), np.linalg.norm(slope, axis=-1)
            assert (error <= 1e-6 * size).all() and size.any(), f"gradient with respect to {name}"


# test_factors.py has those of an implicit leg with muscles.
@pytest.mark.parametrize("implicit", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "humanoid_mtu")) for name in DISTINCT]
)
def test_task_gradient_is_that_of_differences(name, implicit, rng):
    scene = task_scene(name)
    states = acting_states(scene, 8, rng)
    check_that_ground_and_limits_act(scene, *states[:2])
    check_gradients(scene, states, rng, integration=Integration("soft", TASKS[name].substeps, implicit))


@pytest.mark.parametrize(
    "base, seed",
    [
        pytest.param(base, seed, marks=[pytest.mark.slow] * (seed > 0 or base != "floating"))
        for base in ("floating", "fixed", "planar", "ball")
        for seed in range(4)
    ],
)
def test_tree_gradient_is_that_of_differences(base, seed, rng):
    scene = tree_scene(base, seed)
    qpos, qvel, ctrl = free_states(scene, 4, rng)
    pass_limits(scene, qpos, rng)
    check_gradients(raise_ground(scene, qpos), (qpos, qvel, ctrl), rng, integration=Integration(substeps=16))


@pytest.mark.parametrize("implicit", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_ball_joint_gradient_is_that_of_differences(implicit, rng):
    """Quaternions of any length and sign, and one turn of nothing, where the spring's rotation vector is zero."""
    scene = parse(SHOULDER)
    qpos, qvel, ctrl = free_states(scene, 8, rng)
    qpos[:, :4] *= np.linspace(0.5, -2.0, 8)[:, None]
    qpos[0, :4] = 1.0, 0.0, 0.0, 0.0
    check_gradients(scene, (qpos, qvel, ctrl), rng, integration=Integration(implicit=implicit))


@pytest.mark.parametrize("name", ["fluid", pytest.param("muscles", marks=pytest.mark.slow)])
def test_gradient_of_small_robots_is_that_of_differences(name, rng):
    scene = small_scene(name)
    check_gradients(scene, free_states(scene, 16, rng), rng, integration=Integration(substeps=8))


@pytest.mark.unoptimized
@pytest.mark.parametrize("implicit", [pytest.param(False, marks=pytest.mark.slow), True])
def test_gradient_of_bounded_servos_is_that_of_differences(implicit, rng):
    """At a bound the force depends on nothing; also with factors of motors and mass."""
    scene, factors = parse(BOUNDED_SERVOS), {"factors": rng.uniform(0.5, 2.0, (16, len(FACTORS)))}
    check_gradients(scene, free_states(scene, 16, rng), rng, factors, integration=Integration("soft", 8, implicit))


@pytest.mark.parametrize(
    "integration",
    [
        pytest.param(Integration("soft", 8), marks=pytest.mark.slow),
        Integration("soft", 8, implicit=True),
        Integration("mujoco", 8),
    ],
)
def test_gradient_under_gravity_compensation_is_that_of_differences(integration, rng):
    """Also with factors of mass."""
    scene = parse(COMPENSATED)
    factors = {"factors": rng.uniform(0.5, 2.0, (16, len(FACTORS)))} if integration.contact == "soft" else None
    check_gradients(scene, free_states(scene, 16, rng), rng, factors, integration=integration)


def test_quaternion_of_any_length(rng):
    """The step normalises it, so it only sees its direction, and the gradient knows."""
    scene = parse(BALL)
    qpos, qvel, ctrl = acting_states(scene, 4, rng)
    longer = qpos.copy()
    longer[:, 3:7] *= [[0.5], [0.9], [2.0], [3.0]]
    for value, expected in zip(run(scene, longer, qvel, ctrl), run(scene, qpos, qvel, ctrl), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-12)
    check_gradients(scene, (longer, qvel, ctrl), rng)


def test_gradient_at_rest_is_the_viscous_one(rng):
    """|v| v has slope 0 at 0, so a body at rest feels viscosity only, and no division by zero."""
    fish = small_scene("fluid")
    qpos, _, ctrl = (torch.tensor(x) for x in free_states(fish, 8, rng))
    slopes = {}
    for density, viscosity in ((300.0, 2.0), (0.0, 2.0), (300.0, 0.0), (1e-300, 0.0)):
        scene = dataclasses.replace(fish, density=density, viscosity=viscosity)
        sim = Simulator(scene, 8, Integration(substeps=1), dtype=torch.float64)
        qvel = torch.zeros(8, scene.nv, dtype=torch.float64, requires_grad=True)
        (slopes[density, viscosity],) = torch.autograd.grad(sim.step(qpos, qvel, ctrl)[1].sin().sum(), qvel)
    torch.testing.assert_close(slopes[300.0, 2.0], slopes[0.0, 2.0], rtol=1e-12, atol=0)
    torch.testing.assert_close(slopes[300.0, 0.0], slopes[1e-300, 0.0], rtol=1e-12, atol=0)
    assert not torch.allclose(slopes[0.0, 2.0], slopes[300.0, 0.0], rtol=0.1)
