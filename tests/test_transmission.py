"""Actuators on fixed tendons and at sites: against MuJoCo, and their gradients against differences."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import reference
import torch
from scenes import DRONE, GRIPPER, free_states, parse, pendulum, run
from test_constraint import SLOW, check_gradients, check_step, enough_passes  # noqa: F401
from test_dynamics import mujoco_acceleration, relative_error
from test_gradient import check_gradients as check_soft_gradients

from diffsim.parameters import ParametricSimulator
from diffsim.robot.elements import control_range
from diffsim.robot.scene import FACTORS, Scene
from diffsim.robot.types import SceneError
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.symmetry.mirror import reflections
from diffsim.tasks.own_task import start_control

EXACT = Integration("mujoco", 1, tolerance=1e-12)
CASES = ["implicitfast", "Euler", "drone"]
pytestmark = pytest.mark.unoptimized


def case(name: str, count: int, rng: np.random.Generator) -> tuple[Scene, list[np.ndarray]]:
    """A gripper by its integrator, or the drone near the ground, and states."""
    if name == "drone":
        scene = parse(DRONE)
        qpos, qvel, ctrl = free_states(scene, count, rng)
        depth = [reference.contacts(scene, *state)[0].min() for state in zip(qpos, qvel, strict=True)]
        qpos[:, 2] -= np.array(depth) + 0.01 * rng.normal(size=count)
        return scene, [qpos, qvel, ctrl]
    scene = parse(GRIPPER.format(integrator=name))
    return scene, [*free_states(scene, count, rng)]


@pytest.mark.parametrize("name", CASES)
def test_steps_are_mujocos(name, rng):
    """Forces are within their bounds and at each of them, those of actuators and those of joints."""
    scene, states = case(name, 128, rng)
    check_step(scene, states, 1.0)
    if name != "drone":
        law, (low, high) = scene.transmissions.law, control_range(scene.mj_model)
        data, zones = mujoco.MjData(scene.mj_model), set()
        for qpos, qvel, ctrl in zip(*states, strict=True):
            data.qpos, data.qvel, data.ctrl = qpos, qvel, low + (ctrl + 1) / 2 * (high - low)
            mujoco.mj_forward(scene.mj_model, data)
            force, push = data.actuator_force[0], data.qfrc_actuator[1]
            zones |= {("tendon", *(force <= law[0, 2], force >= law[0, 3])), ("joint", *(push <= -8, push >= 9))}
        assert len(zones) == 6


@pytest.mark.parametrize("name", [CASES[1], *(pytest.param(name, marks=SLOW) for name in CASES[2:])])
def test_accelerations_are_mujocos(name, rng):
    """Without ground and constraints, on soft contact."""
    scene, states = case(name, 64, rng)
    scene.mj_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    if name == "drone":
        states[0][:, 2] += 9.0
    qvel = run(scene, *states, control_dt=1.0, integration=Integration(substeps=1))[1]
    assert relative_error(qvel - states[1], mujoco_acceleration(scene, *states)) < 1e-10


@pytest.mark.parametrize("name, varied", [*((name, False) for name in CASES), pytest.param(CASES[0], True, marks=SLOW)])
def test_gradients_are_those_of_differences(name, varied, rng):
    scene, states = case(name, 32, rng)
    check_gradients(scene, states, rng, {"factors": rng.uniform(0.7, 1.4, (32, len(FACTORS)))} if varied else None)


@pytest.mark.parametrize("implicit", [pytest.param(False, marks=SLOW), True])
@pytest.mark.parametrize("name", [CASES[1], *(pytest.param(name, marks=SLOW) for name in CASES[2:])])
def test_gradients_on_soft_contact_are_those_of_differences(name, implicit, rng):
    scene, states = case(name, 16, rng)
    factors = {"factors": rng.uniform(0.5, 2.0, (16, len(FACTORS)))}
    check_soft_gradients(scene, states, rng, factors, integration=Integration("soft", 8, implicit))


def test_actions_and_the_start_of_a_tendon():
    """An action covers the ctrlrange, or without one [-1, 1]; the start's control is that without force."""
    scene = parse(GRIPPER.format(integrator="Euler"))
    m, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    np.testing.assert_array_equal(control_range(m), [[-1.0] * m.nu, [2.0, *[1.0] * (m.nu - 1)]])
    data.qpos = m.key_qpos[0]
    data.ctrl = start_control(m)
    mujoco.mj_forward(m, data)
    assert data.ctrl[0] != 0 and abs(data.actuator_force).max() < 1e-12


def test_what_such_actuators_do_not_have_is_named():
    scene = parse(DRONE)
    with pytest.raises(ValueError, match="threads_per_env is 2, must be 1 with actuators on fixed tendons or at sites"):
        Simulator(scene, 1, Integration("mujoco", 4), division=(2, 1))
    with pytest.raises(SceneError, match="parameters are not supported with fixed tendons, actuators at sites"):
        ParametricSimulator(scene, 1)
    tendon = '<tendon><fixed name="t"><joint joint="hinge" coef="1"/></fixed></tendon>'
    driven = parse(pendulum(rest=f'{tendon}<actuator><motor name="pull" tendon="t"/></actuator>'))
    with pytest.raises(ValueError, match="actuator 'pull' has no known mirror image: it is on no joint"):
        reflections(driven.mj_model, [("right", "left")], "cpu", torch.float32)


def test_a_site_on_the_world_pushes_nothing():
    rest = '<actuator><motor site="w" gear="1 1 1 1 1 1"/><motor joint="hinge"/></actuator>'
    scene = parse(pendulum(world='<site name="w"/>', rest=rest))
    assert scene.transmissions is None and scene.features == {"hinge", "motor"}
