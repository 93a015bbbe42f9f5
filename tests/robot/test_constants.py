"""Constants of contact and limits: those of the file, and what takes their place where it names none."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import reference
import torch
from scenes import parse, pendulum, robot

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import PENALTY_CONSTANTS, Scene
from diffsim.sim.simulator import Simulator

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
BALL = robot('<body pos="0 0 1"><freejoint/><geom name="ball" size="0.1" mass="2" {}/></body>', "<custom>{}</custom>")


def custom(**constants: float) -> str:
    return "".join(f'<numeric name="{name}" data="{value}"/>' for name, value in constants.items())


def constants(scene: Scene) -> dict[str, float]:
    return {name: np.unique(np.atleast_1d(getattr(scene, name))[-1:]).item() for name in PENALTY_CONSTANTS}


def test_the_file_decides():
    given = {name: 10.0 + i for i, name in enumerate(PENALTY_CONSTANTS)}
    scene = parse(pendulum('range="-1 1"', rest=f"<custom>{custom(**given)}</custom>"))
    assert constants(scene) == given


def test_replaced_constants_hold_for_every_joint():
    scene = load_scene(ASSETS / "ant.xml")
    other = scene.with_penalty({"k_n": 5.0, "k_limit": 7.0})
    assert other.k_n == 5 and (other.k_limit == 7).all()
    assert other.k_d == scene.k_d and (other.d_limit == scene.d_limit).all()


def test_default_contact():
    """Of a ball of 2 kg, which turns when it is pushed at its lowest point."""
    least = 1 / (1 / 2 + 0.1**2 / (0.4 * 2 * 0.1**2))  # kg
    expected = {"k_n": 2 * 2 * 50**2, "k_d": 2 * 2 * 2 * 50**2, "k_t": least * 480, "mu": 1.0}
    scene = parse(BALL.format("", ""))
    np.testing.assert_allclose([getattr(scene, name) for name in expected], list(expected.values()))
    # The file's solref: (0.04, 0.5) has the same stiffness and half the damping, as has the direct format.
    for solref in ("0.04 0.5", "-2500 -50"):
        soft = parse(BALL.format(f'solref="{solref}" priority="1" friction="0.3"', ""))
        np.testing.assert_allclose([soft.k_n, soft.k_d, soft.k_t, soft.mu], [1e4, 1e4, scene.k_t, 0.3])
    # A named k_n keeps the damping ratio.
    stiff = parse(BALL.format("", custom(k_n=4e4)))
    np.testing.assert_allclose([stiff.k_n, stiff.k_d, stiff.k_t], [4e4, 8e4, scene.k_t])
    # MuJoCo mixes: the mean solref, the larger friction; no friction if both geoms want none.
    mixed = parse(BALL.format('solref="0.06 1" friction="0.3"', ""))
    np.testing.assert_allclose([mixed.k_n, mixed.mu], [1e4 / 4, 1.0])
    smooth = BALL.format('condim="1"', "").replace('type="plane"', 'type="plane" condim="1"')
    assert parse(smooth).mu == 0
    # Faster than a substep can follow
    hard = parse(BALL.format('solref="1e-6 1" priority="1"', ""))
    np.testing.assert_allclose(hard.k_n, 0.1 * least * 960**2)


def test_default_limits():
    """Scaled by the inertia that each joint moves."""
    joints = """
      <body>
        <joint name="slide" type="slide" range="-1 1" axis="1 0 0" armature="0.5"/>
        <inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>
        <body>
          <joint name="hinge" range="-1 1" axis="0 0 1" solreflimit="0.05 0.5"/>
          <inertial pos="0 0 0" mass="3" diaginertia="0.1 0.2 0.3"/>
          <body> <joint name="free" axis="0 0 1"/> <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/> </body>
        </body>
      </body>"""
    scene = parse(robot(joints))
    np.testing.assert_allclose(scene.k_limit, [0, 2 * 6.5 * 50**2, 2 * 0.3 * 40**2, 0])
    np.testing.assert_allclose(scene.d_limit, scene.k_limit * [0, 4, 2, 0])
    # A named k_limit keeps the damping ratio.
    named = parse(robot(joints, f"<custom>{custom(k_limit=100)}</custom>"))
    np.testing.assert_allclose(named.k_limit[1:3], 100)
    np.testing.assert_allclose(named.d_limit[1:3], [400, 200])


def test_a_ball_sinks_in_as_far_as_it_says():
    scene = parse(BALL.format("", ""))
    depth = reference.contacts(scene, motion(scene, 2.0, torch.float64)[-1], np.zeros(scene.nv))[0].min()
    np.testing.assert_allclose(depth, -2 * 9.81 / scene.k_n, rtol=1e-3)
    assert "at rest the robot sinks in by about 2 mm" in scene.approximations[0]


def start(scene: Scene) -> np.ndarray:
    """(nq,) the reference pose, but within the limits: the ankles of gymnasium's ant are 0.5 rad beyond theirs."""
    qpos, (links, joints) = scene.qpos0, reference.scalar_joints(scene)
    qpos[joints] = qpos[joints].clip(scene.lower[links], scene.upper[links])
    return qpos


def motion(scene: Scene, seconds: float, dtype: torch.dtype = torch.float32) -> np.ndarray:
    """(control steps + 1, nq) from the start without control, at the default substeps."""
    sim = Simulator(scene, 1, dtype=dtype)
    qpos, qvel = torch.tensor(start(scene)[None], dtype=dtype), torch.zeros(1, scene.nv, dtype=dtype)
    ctrl = torch.tensor(-scene.motor_bias / np.where(scene.gear, scene.gear, 1), dtype=dtype)[None]
    rows = [qpos[0].double().numpy()]
    with torch.no_grad():
        for _ in range(round(60 * seconds)):
            qpos, qvel = sim.step(qpos, qvel, ctrl)
            assert not sim.nonfinite.any()
            rows.append(qpos[0].double().numpy())
    return np.array(rows)


def centre_of_mass(model: mujoco.MjModel, qpos: np.ndarray) -> float:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return float(data.subtree_com[0, 2])


@pytest.mark.parametrize(
    "name", ["walker2d_v5", *(pytest.param(name, marks=pytest.mark.slow) for name in ("ant", "humanoidstandup"))]
)
def test_gymnasium_robots_fall_as_in_mujoco(name):
    """Two seconds without control: the centre of mass is as high, nothing bounces, and the ground carries."""
    scene = load_scene(ASSETS / f"{name}.xml")
    model = scene.mj_model
    model.opt.timestep = 1 / 960
    data, heights = mujoco.MjData(model), []
    data.qpos[:] = start(scene)
    for _ in range(121):
        heights.append(centre_of_mass(model, data.qpos))
        mujoco.mj_step(model, data, nstep=16)
    rows = motion(scene, 2.0)
    ours = np.array([centre_of_mass(model, row) for row in rows])
    assert abs(ours - heights)[:31].max() < 0.04  # m, in the first half second, until what balances tips over
    assert abs(ours - heights)[-1] < 0.05
    assert ours.max() < heights[0] + 5e-3
    depths = np.array([reference.contacts(scene, row, np.zeros(scene.nv))[0].min() for row in rows])
    assert depths.min() > -0.04 and -0.006 < depths[-1] < 0  # m
