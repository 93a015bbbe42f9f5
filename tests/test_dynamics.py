"""Values: accelerations against MuJoCo, whole control steps against plain NumPy, and motions known in closed form."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
import reference
import torch
from scenes import (
    BOUNDED_SERVOS,
    DISTINCT,
    ROBOTS,
    SMALL,
    acceleration,
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
    without_ground,
)

from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks import TASKS

SLOW, UNOPTIMIZED = pytest.mark.slow, pytest.mark.unoptimized
TREES = [
    pytest.param(base, seed, marks=[SLOW] * (seed > 1 or base == "planar"))  # the cheetah is planar, too
    for base in ("floating", "fixed", "planar", "ball")
    for seed in range(4)
]


def relative_error(value, expected):
    """Largest error of any row, relative to the row's largest entry."""
    return (np.abs(value - expected).max(-1) / np.abs(expected).max(-1)).max()


# Against MuJoCo


def mujoco_acceleration(scene, qpos, qvel, ctrl, forces=None):
    model = copy.copy(scene.mj_model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    muscles = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE
    model.actuator_gaintype[muscles] = mujoco.mjtGain.mjGAIN_FIXED  # that force without its curves
    model.actuator_biastype[muscles] = mujoco.mjtBias.mjBIAS_NONE
    model.actuator_gainprm[muscles, 0] = -2 * scene.gear[muscles]
    data, qacc = mujoco.MjData(model), np.empty_like(qvel)
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    for e in range(len(qpos)):
        data.qpos, data.qvel, data.ctrl = qpos[e], qvel[e], low + (ctrl[e] + 1) / 2 * (high - low)
        if model.na:  # of a <muscle>, whose activation follows ctrl at once here
            data.act = (ctrl[e, muscles] + 1) / 2
        if forces is not None:
            data.xfrc_applied = forces[e]
        mujoco.mj_forward(model, data)
        qacc[e] = data.qacc
    return qacc


def check_against_mujoco(scene, dtype, rng, count=64):
    states = [torch.as_tensor(x).to(dtype).double().numpy() for x in free_states(scene, count, rng)]
    qacc = acceleration(without_ground(scene), *states, dtype=dtype)
    tolerance = {torch.float64: 1e-10, torch.float32: 1e-4}[dtype]
    assert relative_error(qacc, mujoco_acceleration(scene, *states)) < tolerance


@pytest.mark.parametrize("name", ROBOTS)
def test_task_accelerations_are_mujocos(name, rng):
    check_against_mujoco(task_scene(name), torch.float64, rng)


@pytest.mark.parametrize(
    "name, count", [("hopper", 64), ("ant", 64), pytest.param("humanoid_mtu", 15, marks=UNOPTIMIZED)]
)
def test_accelerations_in_float32_are_mujocos(name, count, rng):
    """In blocks of 16 or of 8."""
    check_against_mujoco(task_scene(name), torch.float32, rng, count)


@pytest.mark.parametrize("base, seed", TREES)
def test_tree_accelerations_are_mujocos(base, seed, rng):
    check_against_mujoco(tree_scene(base, seed), torch.float64, rng)


ALONE = "gravity compensation", "muscle on the world", "muscle by its maximum force"


# Other tests have bounded servos, and muscles under forces.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[SLOW] * (name in ("servos", "muscles")) + [UNOPTIMIZED] * (name in ALONE))
        for name in SMALL
    ],
)
def test_accelerations_of_small_robots_are_mujocos(name, rng):
    check_against_mujoco(small_scene(name), torch.float64, rng)


def bounded_servos(count, rng):
    """Their scene, and states in which each bounded joint is at either bound and between them."""
    scene = parse(BOUNDED_SERVOS)
    qpos, qvel, ctrl = free_states(scene, count, rng)
    links, joints = reference.scalar_joints(scene)
    for joint, (i, adr) in enumerate(zip(links, joints, strict=True)):
        motors = scene.motor_link == i
        force = ctrl[:, motors] @ scene.gear[motors] + scene.motor_bias[motors].sum()
        force += (
            scene.servo_stiffness[i] * (scene.servo_ref[i] - qpos[:, adr]) - scene.servo_damping[i] * qvel[:, joint]
        )
        zones = (force > scene.force_low[i]).astype(int) + (force > scene.force_high[i])
        assert set(zones) == ({1} if scene.force_high[i] == np.inf else {0, 1, 2})
    return scene, (qpos, qvel, ctrl)


@UNOPTIMIZED
def test_bounds_of_actuators_are_mujocos(rng):
    """forcerange of an actuator, actuatorfrcrange of a joint with several, both, and of a motor that has no spring."""
    scene, states = bounded_servos(64, rng)
    assert scene.features == {"hinge", "slide", "stiffness", "damping", "motor", "clamp"}
    qacc = acceleration(scene, *states)
    assert relative_error(qacc, mujoco_acceleration(scene, *states)) < 1e-10
    check_against_mujoco(scene, torch.float32, rng)  # in blocks
    check_against_reference(scene, *(x[:8] for x in states), 16, implicit=True)


# Against the plain NumPy reference


def check_against_reference(scene, qpos, qvel, ctrl, substeps, implicit=False, **optional):
    """Over four of a control step's substeps: all are alike, and the reference is slow."""
    how = {"control_dt": 4 / substeps / 60, "integration": Integration("soft", 4, implicit)}
    q, v = run(scene, qpos, qvel, ctrl, **how, **optional)
    expected = [reference.step(scene, *state, **how) for state in zip(qpos, qvel, ctrl, strict=True)]
    assert relative_error(q, np.array([e[0] for e in expected])) < 1e-10
    assert relative_error(v, np.array([e[1] for e in expected])) < 1e-10


@pytest.mark.parametrize("implicit", [False, pytest.param(True, marks=SLOW)])  # test_factors.py has an implicit leg
@pytest.mark.parametrize("name", DISTINCT)
def test_task_steps_are_the_references(name, implicit, rng):
    scene = task_scene(name)
    states = acting_states(scene, 3, rng)
    check_that_ground_and_limits_act(scene, *states[:2])
    check_against_reference(scene, *states, TASKS[name].substeps, implicit)


@pytest.mark.parametrize("base, seed", TREES)
def test_tree_steps_are_the_references(base, seed, rng):
    scene = tree_scene(base, seed)
    qpos, qvel, ctrl = free_states(scene, 4, rng)
    pass_limits(scene, qpos, rng)
    scene = raise_ground(scene, qpos)
    check_against_reference(scene, qpos, qvel, ctrl, 16)


@pytest.mark.parametrize(
    "name, substeps, implicit",
    [
        ("ball joint on the world", 4, False),
        pytest.param("ball joint on the world", 4, True, marks=SLOW),
        ("gravity compensation", 4, True),
        ("fluid", 4, False),
        pytest.param("muscles", 16, False, marks=SLOW),
    ],
)
def test_steps_of_small_robots_are_the_references(name, substeps, implicit, rng):
    scene = small_scene(name)
    ones = {"factors": np.ones((4, len(FACTORS)))} if name == "gravity compensation" else {}  # as its gradients have
    check_against_reference(scene, *free_states(scene, 4, rng), substeps, implicit, **ones)


# Laws of motion


@pytest.mark.parametrize("name", ["ant", "hopper"])
def test_motion_is_the_same_far_from_the_origin(name, rng):
    """Horizontally, 10 km away: a step's end is rounded to float32's spacing there, nothing else notices."""
    scene, steps, substeps = task_scene(name), 4, 16
    qpos, qvel, ctrl = acting_states(scene, 16, rng)
    horizontal = [0, 1] if scene.floating else [0]
    weights = [torch.tensor(rng.normal(size=x.shape), dtype=torch.float32) for x in (qpos, qvel)]

    def motion(place):
        qpos[:, horizontal] = place
        inputs = [torch.tensor(x, dtype=torch.float32, requires_grad=True) for x in (qpos, qvel, ctrl)]
        sim = Simulator(scene, 16, Integration(substeps=substeps), horizon=steps)
        q, v, u = inputs
        for _ in range(steps):
            q, v = sim.step(q, v, u)
        return q.detach().numpy(), v.detach().numpy(), torch.autograd.grad([q, v], inputs, weights)

    near_q, near_v, near_gradients = motion(0.0)
    far_q, far_v, far_gradients = motion(1e4)
    np.testing.assert_array_equal(far_v, near_v)
    np.testing.assert_array_equal(np.delete(far_q, horizontal, 1), np.delete(near_q, horizontal, 1))
    for far, near in zip(far_gradients, near_gradients, strict=True):
        np.testing.assert_array_equal(far, near)
    rounding = np.spacing(np.float32(1e4)) / 2 * steps * 1.01  # once in a control step
    np.testing.assert_allclose(far_q[:, horizontal] - 1e4, near_q[:, horizontal], rtol=0, atol=rounding)


# Contact law
