"""The robots' MJCF against the benchmark's tables; observations, rewards and resets against plain loops."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import diffsim.tasks
from diffsim.robot.mjcf import load_scene
from diffsim.tasks import SHAC_TASKS, TASKS

Array = NDArray[np.float64]
ASSETS = Path(diffsim.tasks.__file__).parent.parent / "assets"

# The benchmark's models, a link a line, link 0 being the base: parent | joint axis | joint position in the parent's
# frame | range | stiffness, damping, limit damping (always on) | armature | mass | centre of mass in the joint's frame.
LINKS = {
    "cartpole": """
        0 | 1 0 0 | 0 0 2.5 | -4 4 | 0 0 1 | .01 | 50 | 0 0 0
        1 | 0 1 0 | 0 0 0 | | 0 0 1 | .01 | 2.5 | 0 0 .5""",
    "hopper": """
        0 | 1 0 0 | 0 0 0 | | 0 0 10 | 1 | 0 | 0 0 0
        1 | 0 0 1 | 0 0 1.25 | | 0 0 10 | 1 | 0 | 0 0 0
        2 | 0 1 0 | 0 0 0 | | 0 0 10 | 1 | 3.66519 | 0 0 0
        3 | 0 -1 0 | 0 0 -.2 | -2.618 0 | 0 2 10 | 1 | 4.05789 | 0 0 -.225
        4 | 0 -1 0 | 0 0 -.45 | -2.618 0 | 0 2 10 | 1 | 2.78136 | 0 0 -.25
        5 | 0 -1 0 | 0 0 -.5 | -.7854 .7854 | 0 2 10 | 1 | 5.31557 | .06 0 0""",
    "half_cheetah": """
        0 | 1 0 0 | 0 0 1 | | 0 0 10 | .1 | 0 | 0 0 0
        1 | 0 0 1 | 0 0 0 | | 0 0 10 | .1 | 0 | 0 0 0
        2 | 0 1 0 | 0 0 0 | | 0 0 10 | .1 | 9.45733 | .1524 0 .0254
        3 | 0 1 0 | -.5 0 0 | -.52 1.05 | 240 6 10 | .1 | 2.33553 | .1 0 -.13
        4 | 0 1 0 | .16 0 -.25 | -.785 .785 | 180 4.5 10 | .1 | 2.402 | -.14 0 -.07
        5 | 0 1 0 | -.28 0 -.14 | -.4 .785 | 120 3 10 | .1 | 1.65747 | .03 0 -.097
        3 | 0 1 0 | .5 0 0 | -1.5 .8 | 180 4.5 10 | .1 | 2.17598 | -.07 0 -.12
        7 | 0 1 0 | -.14 0 -.24 | -1.2 1.1 | 120 3 10 | .1 | 1.81701 | .065 0 -.09
        8 | 0 1 0 | .13 0 -.18 | -3.1 -.3 | 60 1.5 10 | .1 | 1.33839 | .045 0 -.07""",
    "ant": """
        0 | 0 0 1 | .2 .2 0 | -.6981 .6981 | 0 1 10 | .05 | 7.83155 | .1 .1 0
        1 | -.7071 .7071 0 | .2 .2 0 | .5236 1.745 | 0 1 10 | .05 | 13.5184 | .2 .2 0
        0 | 0 0 1 | -.2 .2 0 | -.6981 .6981 | 0 1 10 | .05 | 7.83155 | -.1 .1 0
        3 | .7071 .7071 0 | -.2 .2 0 | -1.745 -.5236 | 0 1 10 | .05 | 13.5184 | -.2 .2 0
        0 | 0 0 1 | -.2 -.2 0 | -.6981 .6981 | 0 1 10 | .05 | 7.83155 | -.1 -.1 0
        5 | -.7071 .7071 0 | -.2 -.2 0 | -1.745 -.5236 | 0 1 10 | .05 | 13.5184 | -.2 -.2 0
        0 | 0 0 1 | .2 -.2 0 | -.6981 .6981 | 0 1 10 | .05 | 7.83155 | .1 -.1 0
        7 | .7071 .7071 0 | .2 -.2 0 | .5236 1.745 | 0 1 10 | .05 | 13.5184 | .2 -.2 0""",
    "humanoid": """
        0 | 0 0 1 | -.01 0 -.195 | -.7854 .7854 | 20 5 10 | .02 | 0 | 0 0 0
        1 | 0 1 0 | 0 0 0 | -1.309 .5236 | 20 5 10 | .01 | 2.26195 | 0 0 -.065
        2 | 1 0 0 | 0 0 -.13 | -.6109 .6109 | 10 5 10 | .01 | 6.61619 | -.02 0 -.1
        3 | 1 0 0 | 0 -.1 -.14 | -.4363 .08727 | 10 5 10 | .01 | 0 | 0 0 0
        4 | 0 0 1 | 0 0 0 | -1.047 .6109 | 10 5 10 | .01 | 0 | 0 0 0
        5 | 0 1 0 | 0 0 0 | -1.396 .3491 | 20 5 10 | .01 | 4.75175 | 0 .005 -.17
        6 | 0 -1 0 | 0 .01 -.383 | -2.793 .03491 | 5 .1 10 | .007 | 2.7557 | 0 0 -.17
        7 | 0 1 0 | 0 0 -.33 | -.8727 .8727 | 2 1 10 | .006 | 0 | 0 0 0
        8 | .8944 0 .4472 | 0 0 0 | -.8727 .8727 | 2 1 10 | .006 | 1.13114 | .035 -.01 -.08
        3 | -1 0 0 | 0 .1 -.14 | -.4363 .08727 | 10 5 10 | .01 | 0 | 0 0 0
        10 | 0 0 -1 | 0 0 0 | -1.047 .6109 | 10 5 10 | .01 | 0 | 0 0 0
        11 | 0 1 0 | 0 0 0 | -1.396 .3491 | 20 5 10 | .01 | 4.75175 | 0 -.005 -.17
        12 | 0 -1 0 | 0 -.01 -.383 | -2.793 .03491 | 5 .1 10 | .007 | 2.7557 | 0 0 -.17
        13 | 0 1 0 | 0 0 -.33 | -.8727 .8727 | 2 1 10 | .006 | 0 | 0 0 0
        14 | .8944 0 .4472 | 0 0 0 | -.8727 .8727 | 2 1 10 | .006 | 1.13114 | .035 .01 -.08
        0 | .8165 .4082 .4082 | 0 -.17 .06 | -1.047 1.047 | 10 5 10 | .01 | 0 | 0 0 0
        16 | 0 -.7071 .7071 | 0 0 0 | -1.047 1.047 | 10 5 10 | .01 | 1.66108 | .08 -.08 -.08
        17 | 0 -.7071 .7071 | .18 -.18 -.18 | -1.571 .8727 | 2 1 10 | .006 | 1.22954 | .1096 .1096 .1096
        0 | -.8165 .4082 -.4082 | 0 .17 .06 | -1.047 1.047 | 10 5 10 | .01 | 0 | 0 0 0
        19 | 0 -.7071 -.7071 | 0 0 0 | -1.047 1.047 | 10 5 10 | .01 | 1.66108 | .08 .08 -.08
        20 | 0 -.7071 -.7071 | .18 .18 -.18 | -1.571 .8727 | 2 1 10 | .006 | 1.22954 | .1096 -.1096 .1096""",
    # Turned from y up to z up. No axis: a ball joint; the benchmark's spring k pulls back by k sin(angle / 2).
    "humanoid_mtu": """
        0 | | .0192 -.0903 -.0472 | | 1.708 2 0 | .05 | 7 | -.0111 -.0056 -.2096
        1 | 0 1 0 | .0013 -.0092 -.395 | 0 2.3 | 2.236 2 2 | .05 | 3 | -.0238 .0067 -.2369
        2 | | -.0316 .0195 -.4611 | | 0.5 2 0 | .05 | 0.6 | .0177 -.0026 -.0373
        3 | 0 1 0 | .1111 .0019 -.0575 | -.6 .6 | 0.5774 2 0.1333 | .05 | 0.2 | .0246 .0016 .0067
        3 | 0 1 0 | .0913 -.0427 -.0634 | -.6 .6 | 0.5774 2 0.1333 | .05 | 0.2 | .0316 -.0017 .0127
        0 | | .0192 .0903 -.0472 | | 1.708 2 0 | .05 | 7 | -.0111 .0056 -.2096
        6 | 0 1 0 | .0013 .0092 -.395 | 0 2.3 | 2.236 2 2 | .05 | 3 | -.0238 -.0067 -.2369
        7 | | -.0316 -.0195 -.4611 | | 0.5 2 0 | .05 | 0.6 | .0177 .0026 -.0373
        8 | 0 1 0 | .0913 .0415 -.066 | -.6 .6 | 0.5774 2 0.1333 | .05 | 0.2 | .0316 .0029 .0153
        8 | 0 1 0 | .1095 -.0044 -.0658 | -.6 .6 | 0.5774 2 0.1333 | .05 | 0.2 | .0262 .0009 .015""",
}
FREE_BASE = {  # z, kg, com
    "ant": (0.75, 96.776, (0, 0, 0)),
    "humanoid": (1.35, 8.90746, (-0.002539, 0, 0.03466)),
    "humanoid_mtu": (1.0, 15, (0, 0, 0)),
}
SLIDES = {"cartpole": 1, "hopper": 2, "half_cheetah": 2, "ant": 0, "humanoid": 0, "humanoid_mtu": 0}  # first so many
STRENGTH = [200, 200, 200, *(200, 200, 600, 400, 100, 100) * 2, 100, 100, 200, 100, 100, 200]
GEAR = {
    "cartpole": [1000.0],
    "hopper": [200.0] * 3,
    "half_cheetah": [200.0] * 6,
    "ant": [200.0] * 8,
    "humanoid": [0.35 * strength for strength in STRENGTH],
}
PENALTIES = {
    "cartpole": {"k_limit": 100},
    "hopper": {"k_n": 2e4, "k_d": 1e3, "k_t": 1e3, "mu": 0.9, "k_limit": 1e3},
    "half_cheetah": {"k_n": 2e4, "k_d": 1e3, "k_t": 1e3, "mu": 1, "k_limit": 1e3},
    "ant": {"k_n": 4e4, "k_d": 1e4, "k_t": 3e3, "mu": 0.75, "k_limit": 1e3},
    "humanoid": {"k_n": 2e4, "k_d": 5e3, "k_t": 1e3, "mu": 0.75, "k_limit": 1e3},
    "humanoid_mtu": {"k_n": 5e3, "k_d": 2e3, "k_t": 1e3, "mu": 0.5, "k_limit": 200, "muscle_strength": 0.36},
}
TOTAL_MASS = {"cartpole": 52.5, "hopper": 15.82, "half_cheetah": 21.1837, "ant": 182.176, "humanoid": 40.844}
TOTAL_MASS |= {"humanoid_mtu": 37}  # kg
# substeps, episode length, length of the observation, height of the end
SIZES = {
    "cartpole": (4, 240, 5, None),
    "hopper": (16, 1000, 11, -0.45),
    "half_cheetah": (16, 1000, 17, None),
    "ant": (16, 1000, 37, 0.27),
    "humanoid": (48, 1000, 76, 0.74),
    "humanoid_mtu": (48, 1000, 53, 0.46),
}
FREE = ["ant", "humanoid", "humanoid_mtu"]
TARGET = {"ant": 10_000.0, "humanoid": 200.0, "humanoid_mtu": 10_000.0}  # m
SEES_ACTION = ["ant", "humanoid"]
LEG_START = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0]  # of a muscle-driven leg: hip, knee, ankle, toes
START = {  # qpos, unperturbed
    "cartpole": [0, -math.pi],
    "hopper": [0] * 6,
    "half_cheetah": [0, -0.2, *[0] * 7],
    "ant": [0, 0, 0.75, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1],
    "humanoid": [0, 0, 1.35, 1, 0, 0, 0, *[0] * 21],
    "humanoid_mtu": [0, 0, 1, 1, 0, 0, 0, *LEG_START, *LEG_START],
}
PRINTED = {"rtol": 2e-4, "atol": 6e-5}  # the tables have four digits

every_task = pytest.mark.parametrize("name", list(LINKS))


def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))


def numbers(text: str) -> Array:
    return np.array([float(word) for word in text.split()])


def rows(table: str) -> list[list[Array]]:
    return [[numbers(cell) for cell in row.split("|")] for row in table.replace(";", "\n").strip().splitlines() if row]


def moving_joints(model: mujoco.MjModel) -> list[int]:
    """The joints of the tables' links 1, 2, ..."""
    return [j for j in range(model.njnt) if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]


def link_of_body(model: mujoco.MjModel, body: int) -> int:
    """The link that a body's last joint moves; 0 for the world and the floating base."""
    last = model.body_jntadr[body] + model.body_jntnum[body] - 1
    joints = moving_joints(model)
    return joints.index(last) + 1 if model.body_jntnum[body] and last in joints else 0


# The MJCF files


@every_task
def test_joints_are_the_tables(name: str) -> None:
    model = load(name)
    joints, table = moving_joints(model), rows(LINKS[name])
    assert len(joints) == len(table)
    np.testing.assert_array_equal(model.body_quat[1:], [[1, 0, 0, 0]] * (model.nbody - 1))
    np.testing.assert_array_equal(model.jnt_pos, np.zeros((model.njnt, 3)))
    height = 0.0  # of the slides passed: the tables give the root's height to its x or to its z slide, MJCF to the body
    for link, (joint, row) in enumerate(zip(joints, table, strict=True), start=1):
        parent, axis, position, bounds, (stiffness, damping, limit_damping), armature, mass, com = row
        body, dof = model.jnt_bodyid[joint], model.jnt_dofadr[joint]
        first = joint == model.body_jntadr[body]
        last = joint == model.body_jntadr[body] + model.body_jntnum[body] - 1
        assert parent == (link_of_body(model, model.body_parentid[body]) if first else link - 1)
        slide = link <= SLIDES[name]
        kind = mujoco.mjtJoint.mjJNT_HINGE if len(axis) else mujoco.mjtJoint.mjJNT_BALL
        assert model.jnt_type[joint] == (mujoco.mjtJoint.mjJNT_SLIDE if slide else kind)
        if len(axis):
            np.testing.assert_allclose(model.jnt_axis[joint], axis, **PRINTED)
        if slide:
            height += position[2]
        elif first:
            np.testing.assert_allclose(model.body_pos[body], position, **PRINTED)
        else:
            np.testing.assert_array_equal(position, 0)
        assert model.jnt_limited[joint] == (len(bounds) > 0)
        if len(bounds):
            np.testing.assert_allclose(model.jnt_range[joint], bounds, **PRINTED)
        assert model.jnt_stiffness[joint].item() == stiffness
        assert model.qpos_spring[model.jnt_qposadr[joint]] == (0 if len(axis) else 1)
        np.testing.assert_allclose(model.dof_damping[dof], damping + limit_damping, rtol=1e-12)
        assert model.dof_armature[dof] == armature
        np.testing.assert_allclose(model.body_mass[body] if last else 0, mass.item(), **PRINTED)
        np.testing.assert_allclose(model.body_ipos[body] if last else np.zeros(3), com, **PRINTED)
    if name in FREE:
        height, base_mass, base_com = FREE_BASE[name]
        np.testing.assert_allclose(model.body_mass[1], base_mass, **PRINTED)
        np.testing.assert_allclose(model.body_ipos[1], base_com, **PRINTED)
        for of_base in (model.dof_damping[:6], model.dof_armature[:6], model.jnt_stiffness[:1]):
            assert not of_base.any()
    np.testing.assert_allclose(model.body_pos[1], [0, 0, height])
    np.testing.assert_allclose(model.body_mass.sum(), TOTAL_MASS[name], **PRINTED)


def test_muscles_of_the_mtu_humanoid() -> None:
    """Numbers of muscles, points and segments; maximum forces."""
    model, scene = load("humanoid_mtu"), load_scene(ASSETS / "humanoid_mtu.xml")
    assert (model.nu, model.nsite, model.ntendon) == (152, 636, 152)
    assert np.bincount(model.tendon_num).tolist() == [0, 0, 6, 38, 64, 18, 18, 8]
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], range(152))
    assert len(scene.segment_muscle) == 198 and (np.bincount(scene.segment_muscle) > 0).all()
    force = scene.gear + scene.motor_bias
    np.testing.assert_array_equal(scene.gear, scene.motor_bias)  # no pull at -1
    np.testing.assert_allclose([force.min(), force.max(), force.sum()], 0.36 * np.array([45, 1792.95, 55158.5]))
    assert len(np.unique(force.round(3))) == 34
    # The two legs are mirror images.
    names = {model.actuator(k).name for k in range(model.nu)}
    assert len(left := [name for name in names if name.startswith("L_")]) == 76
    for name in left:
        np.testing.assert_allclose(model.actuator(name).gainprm, model.actuator(f"R_{name[2:]}").gainprm)


@every_task
def test_motors_penalties_and_options(name: str) -> None:
    model = load(name)
    if name in GEAR:
        motors = moving_joints(model)[-model.nu :] if name != "cartpole" else [0]
        np.testing.assert_array_equal(model.actuator_trnid[:, 0], motors)
        np.testing.assert_allclose(model.actuator_gear[:, 0], GEAR[name])
        np.testing.assert_array_equal(model.actuator_ctrlrange, [[-1, 1]] * model.nu)
    assert model.actuator_ctrllimited.all()
    numerics = {model.numeric(i).name: model.numeric(i).data.item() for i in range(model.nnumeric)}
    assert numerics == PENALTIES[name] | {"d_limit": 0}
    np.testing.assert_allclose(model.opt.timestep * SIZES[name][0], 1 / 60)
    np.testing.assert_array_equal(model.opt.gravity, [0, 0, -9.81])
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER


# The tasks, each against a loop over the environments


def test_which_robots_cannot_fall() -> None:
    standing = {name for name, task in TASKS.items() if not task.falls()}
    assert standing == {"cartpole", "half_cheetah", "swimmer", "walker"}


@every_task
def test_sizes(name: str) -> None:
    task, model = TASKS[name], load(name)
    assert (task.substeps, task.episode_length, task.obs_dim, task.min_height) == SIZES[name]
    assert (task.name, task.asset, task.control_dt) == (name, f"{name}.xml", 1 / 60)
    assert SHAC_TASKS == tuple(SIZES)
    instance = task()
    qpos, qvel = instance.reset(torch.rand(3, task.num_random))
    assert (qpos.shape, qvel.shape) == ((3, model.nq), (3, model.nv))
    obs = instance.observe(qpos, qvel, torch.zeros(3, model.nu))
    assert obs.shape == (3, task.obs_dim) and obs.dtype == torch.float32


def random_states(name: str, shape: tuple[int, ...], rng: np.random.Generator) -> tuple[torch.Tensor, ...]:
    """States far from the start and actions, float64: the observation's every term matters in them."""
    model = load(name)
    qpos, qvel = rng.uniform(-2, 2, (*shape, model.nq)), rng.uniform(-5, 5, (*shape, model.nv))
    if name == "cartpole":
        qpos[..., 1] *= 5  # the angle is wrapped
    if name in FREE:
        qpos[..., :2] *= 0.4 * TARGET[name]  # the way to the target turns
        qpos[..., 3:7] = rng.normal(size=(*shape, 4))
        qpos[..., 3:7] /= np.linalg.norm(qpos[..., 3:7], axis=-1, keepdims=True)
    action = rng.uniform(-1, 1, (*shape, model.nu))
    return torch.tensor(qpos), torch.tensor(qvel), torch.tensor(action)


def plain_observation(name: str, model: mujoco.MjModel, q: Array, v: Array, action: Array) -> Array:
    if name == "cartpole":
        return np.array([q[0], v[0], math.sin(q[1]), math.cos(q[1]), v[1]])
    if name in ("hopper", "half_cheetah"):
        return np.concatenate([q[1:], v])
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    twist = np.zeros(6)  # of the torso's frame in world axes: angular, linear
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, 1, twist, 0)
    torso = data.body(1).xmat.reshape(3, 3)
    way = np.array([TARGET[name] - q[0], -q[1], 0.0])
    mujoco.mju_normalize3(way)
    up, heading = torso[2, 2], torso[:, 0] @ way
    w, x, y, z = q[3:7]
    seen = action if name in SEES_ACTION else ()
    return np.array([q[2], x, y, z, w, *twist[3:], *twist[:3], *q[7:], *(0.1 * v[6:]), up, heading, *seen])


def plain_height_reward(d: float, upper: float, slope: float) -> float:
    d = min(max(d, -1.0), upper)
    return -200 * d**2 if d < 0 else slope * d


def plain_reward(name: str, obs: Array, action: Array) -> float:
    effort = float(np.sum(action**2))
    if name == "cartpole":
        x, x_dot, sin, cos, theta_dot = obs
        return -(math.atan2(sin, cos) ** 2) - 0.1 * theta_dot**2 - 0.05 * x**2 - 0.1 * x_dot**2
    if name == "hopper":
        angle = 1 - (math.degrees(obs[1]) / 30) ** 2
        return obs[5] + plain_height_reward(obs[0] + 0.3, 0.3, 1) + angle - 0.1 * effort
    if name == "half_cheetah":
        return obs[8] - 0.1 * effort
    last = len(obs) - (len(action) if name in SEES_ACTION else 0)
    up, heading = obs[last - 2], obs[last - 1]
    running = obs[5] + 0.1 * up + heading
    if name == "ant":
        return running + obs[0] - 0.27
    if name == "humanoid_mtu":
        effort = float(np.sum((action / 2 + 0.5) ** 2))  # of activations
        return running + plain_height_reward(obs[0] - 0.51, 0.05, 4) - 0.001 * effort
    return running + plain_height_reward(obs[0] - 0.84, 0.1, 10) - 0.002 * effort


@every_task
def test_observation_reward_and_end(name: str, rng: np.random.Generator) -> None:
    task, model = TASKS[name](dtype=torch.float64), load(name)
    qpos, qvel, action = random_states(name, (4, 50), rng)
    obs = task.observe(qpos, qvel, action)
    reward, terminated = task.reward(obs, action), task.terminated(obs)
    assert obs.shape == (4, 50, task.obs_dim) and reward.shape == terminated.shape == (4, 50)
    assert terminated.dtype == torch.bool
    least = SIZES[name][3]
    for index in np.ndindex(4, 50):
        q, v, a = (x[index].numpy() for x in (qpos, qvel, action))
        expected = plain_observation(name, model, q, v, a)
        np.testing.assert_allclose(obs[index], expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(reward[index], plain_reward(name, expected, a), rtol=1e-12, atol=1e-12)
        assert terminated[index].item() == (least is not None and expected[0] < least)
    assert len(set(terminated.flatten().tolist())) == (1 if least is None else 2)
    one = task.observe(qpos[0, 0], qvel[0, 0], action[0, 0])  # no batch
    torch.testing.assert_close(one, obs[0, 0])
    torch.testing.assert_close(task.reward(one, action[0, 0]), reward[0, 0])


@pytest.mark.parametrize("name, level", [("hopper", -0.3), ("humanoid", 0.84), ("humanoid_mtu", 0.51)])
def test_height_reward_at_its_corners(name: str, level: float) -> None:
    """Eqs. 16-17, 21-22, 24-25: parabola, line and the two clips; the gradient at the corner is the line's."""
    task = TASKS[name](dtype=torch.float64)
    upper, slope = {"hopper": (0.3, 1.0), "humanoid": (0.1, 10.0), "humanoid_mtu": (0.05, 4.0)}[name]
    depth = torch.tensor([-3, -1.5, -0.5, -0.1, 0.0, upper / 2, 2 * upper, 5], dtype=torch.float64)
    obs = torch.zeros(len(depth), task.obs_dim, dtype=torch.float64)
    obs[:, 0] = depth + level
    obs.requires_grad_()
    idle = -1.0 if name == "humanoid_mtu" else 0.0
    reward = task.reward(obs, torch.full((len(depth), 1), idle, dtype=torch.float64))
    base = 1.0 if name == "hopper" else 0.0  # R_angle of an upright hopper
    expected = [-200, -200, -50, -2, 0, slope * upper / 2, slope * upper, slope * upper]
    np.testing.assert_allclose(reward.detach() - base, expected, atol=1e-12)
    (gradient,) = torch.autograd.grad(reward.sum(), obs)
    np.testing.assert_allclose(gradient[:, 0], [0, 0, 200, 40, slope, slope, 0, 0], atol=1e-9)


@every_task
def test_gradients(name: str, rng: np.random.Generator) -> None:
    task = TASKS[name](dtype=torch.float64)
    states = [x.requires_grad_() for x in random_states(name, (3,), rng)]
    if name in SEES_ACTION:  # an action enters the observation, and its gradient with it
        obs = task.observe(*states)
        torch.testing.assert_close(torch.autograd.grad(obs.sum(), states[2])[0], torch.ones_like(states[2]))
    assert torch.autograd.gradcheck(task.observe, states)
    assert torch.autograd.gradcheck(lambda q, v, a: task.reward(task.observe(q, v, a), a), states)


# Resets


@every_task
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_middle_of_the_draw_is_the_unperturbed_start(name: str, dtype: torch.dtype) -> None:
    task = TASKS[name](dtype=dtype)
    qpos, qvel = task.reset(torch.full((2, task.num_random), 0.5, dtype=dtype))
    assert torch.equal(qpos, torch.tensor([START[name]] * 2, dtype=dtype))
    assert torch.equal(qvel, torch.zeros_like(qvel))


def plain_draws(name: str, q: Array, v: Array) -> Array:
    """Undoes a reset: what was drawn, each uniform in [-1, 1] and independent of the others."""
    if name not in FREE:
        size_q = {"cartpole": math.pi / 2, "hopper": 0.05, "half_cheetah": 0.1}[name]
        size_v = {"cartpole": 0.25, "hopper": 0.05, "half_cheetah": 0.25}[name]
        return np.concatenate([(q - START[name]) / size_q, v / size_v])
    start, joints = np.split(np.delete(START[name], range(3, 7)), [3])
    angular, turn = np.zeros(3), np.zeros(3)
    mujoco.mju_rotVecQuat(angular, v[3:6], q[3:7])  # body to world
    mujoco.mju_quat2Vel(turn, q[3:7], 1.0)
    at_origin = v[:3] + np.cross(angular, -q[:3])
    # The turn's axis points to a uniform point of a cube: its largest component is 1 after scaling.
    angle = math.copysign(np.linalg.norm(turn), turn[0]) / math.radians(7.5)
    cube = turn / np.abs(turn).max() if turn[0] > 0 else -turn / np.abs(turn).max()
    draws = [(q[:3] - start) / 0.1, [angle], cube[1:], (q[7:] - joints) / 0.2, angular / 0.25, at_origin / 0.25]
    if name == "humanoid_mtu":  # always starts in the same posture
        assert not draws.pop(3).any()
    return np.concatenate([*draws, v[6:] / 0.25])


@every_task
def test_resets_fill_the_benchmark_s_distribution(name: str) -> None:
    """Bounds of every drawn number, reached; mean and variance of a uniform one; no two correlated."""
    task, count = TASKS[name](dtype=torch.float64), 4000
    rand = torch.rand(count, task.num_random, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    qpos, qvel = task.reset(rand)
    draws = np.array([plain_draws(name, q, v) for q, v in zip(qpos.numpy(), qvel.numpy(), strict=True)])
    unused = (1 if name in FREE else 0) + (22 if name == "humanoid_mtu" else 0)  # a direction has one number less
    assert draws.shape[1] == task.num_random - unused
    uniform = np.ones(draws.shape[1], bool)
    if name in FREE:
        np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, rtol=1e-12)
        uniform[4:6] = False  # ratios of uniform numbers
    assert np.abs(draws).max() <= 1 + 1e-9
    assert (draws.min(0) < -0.99).all() and (draws.max(0) > 0.99).all()
    np.testing.assert_allclose(draws.mean(0), 0, atol=0.05)
    np.testing.assert_allclose(draws[:, uniform].var(0), 1 / 3, atol=0.03)
    assert np.abs(np.corrcoef(draws.T) - np.eye(draws.shape[1])).max() < 0.1
