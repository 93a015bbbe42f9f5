"""examples/servo_tasks.py: robots whose policies set the targets of servos 30 times a second."""

from __future__ import annotations

from hashlib import sha256

import mujoco
import numpy as np
import pytest
import servo_tasks
import torch
from tables import ROOT

from diffsim.tasks.base import ASSETS
from diffsim_robots.imitation.clip import read_clip

TROT = ROOT / "examples" / "dog_trot.npz"


def test_servos_hold_targets_within_the_joints_limits_and_the_motors_torques() -> None:
    model = servo_tasks.with_servos("humanoid.xml")
    motors = mujoco.MjModel.from_xml_path(str(ASSETS / "humanoid.xml"))
    torque = motors.actuator_gear[:, 0]
    joints = model.actuator_trnid[:, 0]
    np.testing.assert_allclose(model.actuator_ctrlrange, model.jnt_range[joints])
    np.testing.assert_allclose(model.actuator_forcerange, np.stack((-torque, torque), 1))
    data = mujoco.MjData(model)
    data.ctrl[:] = data.qpos[7:] + 0.1 * np.arange(21)  # up to 2 rad away, so that some are at their bound
    mujoco.mj_forward(model, data)
    expected = np.minimum(servo_tasks.STIFFNESS * torque * 0.1 * np.arange(21), torque)
    inside = data.ctrl <= model.actuator_ctrlrange[:, 1]  # MuJoCo bounds targets
    assert inside.sum() > 3 and (expected[inside] == torque[inside]).any()
    np.testing.assert_allclose(data.actuator_force[inside], expected[inside], rtol=1e-6)


def test_the_trot_is_that_of_the_results() -> None:
    """The returns of docs/pfpn.md are of imitating it."""
    assert sha256(TROT.read_bytes()).hexdigest()[:16] == "cf63ee7a370641a7"


@pytest.fixture(params=["humanoid", "dog"])
def task(request: pytest.FixtureRequest) -> servo_tasks.HumanoidImitation:
    if request.param == "dog":
        return servo_tasks.Dog(dtype=torch.float64)
    return servo_tasks.HumanoidServo(dtype=torch.float64)


def test_the_reference_has_every_second_frame_of_the_clip(task: servo_tasks.HumanoidImitation) -> None:
    rand = ((torch.arange(task.period, dtype=torch.float64) + 0.5) / task.period + 0.5).remainder(1.0).unsqueeze(-1)
    step = task.first_step(rand)
    assert step.tolist() == list(range(task.period)) and task.period == len(task.clip) // 2
    qpos, qvel = task.reset(rand)
    torch.testing.assert_close(qpos, task.clip.qpos[: 2 * task.period : 2])
    turn = (task.clip.qpos[4, 7:] - task.clip.qpos[0, 7:]) * 15  # rad/s, over two control steps of 1/30 s
    torch.testing.assert_close(qvel[1, 6:], turn)
    obs = task.observe_with(qpos, qvel, torch.zeros(task.period, 12), task.begin(rand))
    assert obs.shape == (task.period, task.obs_dim) == (task.period, qpos.shape[1] + qvel.shape[1] + 2)
    torch.testing.assert_close(task.reward(obs, obs), torch.ones(task.period, dtype=torch.float64))
    assert not task.terminated(obs).any()


def test_a_dog_that_lies_down_ends_its_episode() -> None:
    task = servo_tasks.Dog(dtype=torch.float64)
    qpos, qvel = task.reset(torch.full((2, 1), 0.5, dtype=torch.float64))
    qpos[1, 2] = 0.15
    obs = task.observe_with(qpos, qvel, qvel, torch.zeros(2, 1, dtype=torch.float64))
    assert task.terminated(obs).tolist() == [False, True]


def test_a_clip_at_its_own_rate_is_itself() -> None:
    clip = read_clip(TROT)
    assert clip.at(1 / 60) is clip and len(clip) == 30 and len(clip.at(1 / 30)) == 15
