"""The robots' MJCF against the benchmark's tables; observations, rewards and resets against plain loops."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from diffsim.robot.mjcf import load_scene
from diffsim.tasks import REGISTERED, TASKS, TaskError, base_name, find_task
from diffsim.tasks.base import ASSETS

Array = NDArray[np.float64]

# What a robot is, and the sum of it: each number's logarithm with a weight of its own
FIELDS = """body_pos body_quat body_mass body_ipos body_inertia jnt_type jnt_axis jnt_range jnt_stiffness dof_damping
    dof_armature geom_size geom_pos geom_contype site_pos actuator_gear actuator_gainprm actuator_ctrlrange
    numeric_data""".split()
SUMS = {"cartpole": 77.28685, "hopper": 77.76971, "half_cheetah": -70.98179, "ant": -54.91277}
SUMS |= {"humanoid": -69.52460, "humanoid_mtu": 346.73666, "swimmer": -26.58364, "walker": -68.69604}
SUMS |= {"go1": -10.50013, "go2": 3.07764, "g1": -28.74463}
LEAST = {"hopper": -0.45, "ant": 0.27, "humanoid": 0.74, "humanoid_mtu": 0.46}  # height at which an episode ends
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

every_task = pytest.mark.parametrize("name", list(START))


def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))


def test_every_registered_task_is_found_by_its_name() -> None:
    assert list(TASKS) == list(REGISTERED) and len(TASKS) == 13 and "ant" in TASKS and "nothing" not in TASKS
    for name, task in TASKS.items():
        assert task.name == name and find_task(name) is find_task(task) is task is TASKS[name]
    with pytest.raises(TaskError, match="unknown task 'nothing': choose from cartpole, .*, g1_track, or give a file"):
        find_task("nothing")


def test_a_name_without_its_options() -> None:
    for name, base in (
        ("ant", "ant"),
        ("go2:rough=20,mass=0.9:1.1", "go2"),
        ("g1_track:/data/walk.csv:60", "g1_track"),
        ("my/task.py", "my/task.py"),
        ("my/task.py:Class", "my/task.py:Class"),
    ):
        assert base_name(name) == base


# The MJCF files


@pytest.mark.parametrize("name", SUMS)
def test_the_numbers_of_the_robots_are_the_benchmarks(name: str) -> None:
    """They were compared with its tables link by link; the sum keeps them so."""
    model = load(name)
    numbers = np.arcsinh(1e4 * np.concatenate([getattr(model, field).ravel() for field in FIELDS]))
    assert np.cos(np.arange(len(numbers))) @ numbers == pytest.approx(SUMS[name], abs=2e-5)


def test_muscles_of_the_mtu_humanoid() -> None:
    """Segments between two links; no pull at -1; 34 maximum forces, of the benchmark's strength."""
    scene = load_scene(ASSETS / "humanoid_mtu.xml")
    assert len(scene.segment_muscle) == 198 and (np.bincount(scene.segment_muscle) > 0).all()
    force = scene.gear + scene.motor_bias
    np.testing.assert_array_equal(scene.gear, scene.motor_bias)
    np.testing.assert_allclose([force.min(), force.max(), force.sum()], 0.36 * np.array([45, 1792.95, 55158.5]))
    assert len(np.unique(force.round(3))) == 34


# The tasks, each against a loop over the environments


def test_which_robots_cannot_fall() -> None:
    standing = {name for name, task in TASKS.items() if not task.falls()}
    assert standing == {"cartpole", "half_cheetah", "swimmer", "walker"}


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
    least = LEAST.get(name)
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


def test_swimmer_and_walker(rng: np.random.Generator) -> None:
    for name, speed, height, v_x in (("swimmer", 2.0, None, 3), ("walker", 1.2, 0, 8)):
        task, nv = TASKS[name](dtype=torch.float64), load(name).nv
        q, v, a = (torch.tensor(rng.normal(size=n)) for n in (nv, nv, load(name).nu))
        obs = task.observe(q, v, a)
        assert obs.tolist() == [*q[2 if name == "swimmer" else 1 :].tolist(), *v.tolist()]
        cost = (v[0] - speed) ** 2 + 1e-4 * (a**2).sum() + (0 if height is None else 10 * q[1] ** 2)
        assert task.reward(obs, a).item() == pytest.approx(-cost.item()) and obs[v_x] == v[0]


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
