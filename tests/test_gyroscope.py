"""The spin of free bodies, which MuJoCo's implicitfast integrates implicitly: against MuJoCo and differences."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
import pytest
import test_constraint
import torch
from scenes import parse, unit
from test_constraint import check_gradients, in_mujoco, step
from test_pairs import VERSION, check_single_precision, model_as_it_is

from diffsim.kernels.thread.division import divide
from diffsim.robot.constants import constrained
from diffsim.robot.scene import FACTORS, Scene

enough_passes = test_constraint.enough_passes
pytestmark = [
    pytest.mark.unoptimized,
    pytest.mark.skipif(VERSION < (4, 0), reason="MuJoCo before 4 has another implicitfast of free bodies"),
]
HAMMER = """{joint} <geom type="box" size=".2 .1 .02" pos=".05 0 .02" density="300"/>
    <body pos="0 .1 0" euler="20 30 0"> <geom type="capsule" size=".02 .1" density="800"/> </body>"""
JOINTS = {
    "plain": "<freejoint/>",
    "damped": '<joint type="free" damping=".05"/>',
    "heavy": '<joint type="free" damping=".05" armature=".02"/>',
}
FLOOR = '<geom type="plane" size="9 9 .1"/>'
ARM = """<body pos=".2 0 .5"> <joint name="arm" axis="0 1 0" damping=".1"/>
      <geom type="capsule" size=".03 .2" pos="0 0 .02"/> </body>
    <body pos="{x} 0 .03"> <joint type="free" damping=".02"/>
      <geom type="box" size=".2 .15 .02" pos=".02 0 0" density="300"/> </body>"""


def alone(joint: str = "plain", z: float = 1.0, option: str = "") -> Scene:
    """A free body with a part fixed to it, on or over the ground."""
    body = HAMMER.format(joint=JOINTS[joint])
    return parse(
        f'<mujoco> <option integrator="implicitfast" timestep="0.004" {option}/> <worldbody> {FLOOR}'
        f'<body pos="0 0 {z}"> {body} </body> </worldbody> </mujoco>'
    )


def several(joint: str = "plain", x: float = 0.0, option: str = "") -> Scene:
    """The same beside an arm and a plate, which it lies on, and which is not a ball."""
    body, arm = HAMMER.format(joint=JOINTS[joint]), ARM.format(x=x)
    return parse(
        f'<mujoco> <option integrator="implicitfast" timestep="0.004" {option}/> <worldbody> {FLOOR} {arm}'
        f'<body pos="{x} 0 .07"> {body} </body> </worldbody>'
        '<actuator> <motor joint="arm" ctrlrange="-1 1"/> </actuator> </mujoco>'
    )


SCENES = {
    "alone": lambda joint, option="": alone(joint, option=option),
    "lying": lambda joint, option="": alone(joint, 0.01, option),
    "several": lambda joint, option="": several(joint, option=option),
    "far away": lambda joint, option="": several(joint, 80.0, option),
}


def spinning(scene: Scene, number: int, rng: np.random.Generator, speed: float) -> list[np.ndarray]:
    qpos = np.tile(scene.qpos0, (number, 1)) + 0.01 * rng.normal(size=(number, scene.nq))
    for adr in scene.quaternion_adr.tolist():
        qpos[:, adr : adr + 4] = unit(qpos[:, adr : adr + 4] + 0.1 * rng.normal(size=(number, 4)))
    qvel = 0.1 * rng.normal(size=(number, scene.nv))
    free = scene.mj_model.jnt_dofadr[scene.mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    for dof in free.tolist():
        qvel[:, dof + 3 : dof + 6] = speed * rng.normal(size=(number, 3))
    states = qpos, qvel, rng.uniform(-1, 1, (number, scene.nu))
    return [x.astype(np.float32).astype(float) for x in states]


QUICK = {"alone": "damped", "lying": "heavy"}


def cases(joints: Iterable[str], scenes: Iterable[str], quick: dict[str, str]) -> list[Any]:
    """All scenes with all joints, of which the quick tests have one joint at most."""
    marks = {True: (), False: pytest.mark.slow}
    pairs = itertools.product(scenes, joints)
    return [pytest.param(name, joint, marks=marks[quick.get(name) == joint]) for name, joint in pairs]


@pytest.mark.parametrize(("name", "joint"), cases(JOINTS, SCENES, QUICK))
def test_spinning_bodies_step_as_in_mujoco(name: str, joint: str, rng: np.random.Generator) -> None:
    """And not as without what MuJoCo adds."""
    scene = SCENES[name](joint)
    for speed in (1.0, 5.0, 20.0):
        states = spinning(scene, 16, rng, speed)
        expected = in_mujoco(scene, *states, model=model_as_it_is(scene))[1]
        change = abs(expected - states[1]).max(1)
        for dtype, tolerance, enough in ((torch.float64, 1e-12, 1e-9), (torch.float32, 1e-4, 1e-3)):
            found = step(scene, states, tolerance=tolerance, dtype=dtype)[1]
            assert (abs(found - expected).max(1) / change).max() < enough, (speed, dtype)
        scene.mj_model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        explicit = step(scene, states)[1]
        scene.mj_model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert (abs(explicit - expected).max(1) / change).max() > 0.03


@pytest.mark.parametrize(("name", "joint"), cases(["plain", "heavy"], SCENES, {"alone": "heavy", "lying": "plain"}))
def test_gradient_of_spinning_bodies_is_that_of_differences(name: str, joint: str, rng: np.random.Generator) -> None:
    scene = SCENES[name](joint)
    states = spinning(scene, 6, rng, 5.0)
    check_gradients(scene, states, rng)
    check_single_precision(scene, states, rng)


def test_factors_of_mass_act_on_spin(rng: np.random.Generator) -> None:
    scene = alone("damped")
    states = spinning(scene, 6, rng, 5.0)
    check_gradients(scene, states, rng, {"factors": rng.uniform(0.5, 2.0, (6, len(FACTORS)))})


def test_energy_of_a_tumbling_plate_falls_as_in_mujoco() -> None:
    """Over two seconds."""
    scene = alone(option='gravity="0 0 0"')
    qpos, qvel = scene.qpos0[None], np.array([[0.0, 0, 0, 0.1, 20, 0.1]])
    _, velocity, _ = step(scene, (qpos, qvel, np.zeros((1, 0))), 500)
    _, expected, _ = in_mujoco(scene, qpos, qvel, np.zeros((1, 0)), substeps=500, model=model_as_it_is(scene))
    np.testing.assert_allclose(velocity, expected, atol=1e-8)
    assert abs(velocity[0, 3:] - qvel[0, 3:]).max() > 1


def test_which_bodies_spin_so() -> None:
    """Free ones without joints, unless they are balls; not with Euler."""
    ball, jointed = "<freejoint/> <geom size='.1'/>", "<body> <joint/> <geom size='.1' pos='.3 0 0'/> </body>"
    for body, integrator, number in (
        (HAMMER.format(joint=JOINTS["plain"]), "implicitfast", 1),
        (HAMMER.format(joint=JOINTS["plain"]), "implicit", 1),
        (HAMMER.format(joint=JOINTS["plain"]), "Euler", 0),
        (HAMMER.format(joint=JOINTS["plain"]) + jointed, "implicitfast", 0),
        (ball, "implicitfast", 0),
    ):
        text = f'<mujoco> <option integrator="{integrator}"/> <worldbody> <body> {body} </body> </worldbody> </mujoco>'
        assert len(constrained(parse(text), 0.002).free_bodies) == number
    with pytest.raises(ValueError, match="must be 1 with free bodies with implicitfast"):
        divide(constrained(alone(), 0.002), 2)
