"""Mirror images of tasks: a mirrored robot under mirrored actions moves like the image of the robot."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

import diffsim
from diffsim.symmetry.mirror import reflections
from diffsim.tasks import TASKS
from diffsim.tasks.humanoid_mtu import HumanoidMTU
from diffsim.tasks.locomotion import Locomotion
from diffsim_cli.gait import trace

MIRRORED = ("ant", "humanoid", "go1", "go2", "g1", "g1_track")


@pytest.mark.parametrize("name, dtype, tolerance", [("ant", torch.float32, 3e-5), ("humanoid", torch.float64, 1e-12)])
@torch.no_grad()
def test_the_image_moves_like_the_robot(name: str, dtype: torch.dtype, tolerance: float) -> None:
    """From states visited at random: observations and rewards, and the image of the image is the original."""
    env = diffsim.make(name, num_envs=7, horizon=1, dtype=dtype)
    task, mirror, sim = env.task, env.task.mirror, env.sim
    env.reset(seed=3)
    actions = 2 * torch.rand(30, 7, env.scene.nu, dtype=dtype, generator=env.generator) - 1
    for action in actions[:25]:
        env.step(action)
    state, image = (env.qpos, env.qvel), (mirror.qpos(env.qpos), mirror.qvel(env.qvel))
    assert torch.equal(mirror.qpos(image[0]), state[0]) and torch.equal(mirror.qvel(image[1]), state[1])
    assert not torch.allclose(image[0], state[0], atol=0.01)
    for action in actions[25:]:
        state, image = sim.step(*state, action), sim.step(*image, mirror.action(action))
        obs, seen = task.observe(*state, action), task.observe(*image, mirror.action(action))
        torch.testing.assert_close(seen, mirror.obs(obs), rtol=0, atol=tolerance)
        rewards = task.reward(obs, action), task.reward(seen, mirror.action(action))
        torch.testing.assert_close(*rewards, rtol=0, atol=tolerance)
        assert torch.equal(mirror.obs(mirror.obs(obs)), obs)
    assert (trace(env.scene, state[0].double().numpy())[0].max(1) > 0).sum() > 1  # so the ground pushed


class Muscles(HumanoidMTU):
    """Paired by names, as if it had an image."""

    mirrored_by, sides = Locomotion.mirrored_by, (("R_", "L_"), ("R", "L"))


def test_muscles_change_places_with_their_mirror_images() -> None:
    """Their paths in the reference configuration, not those of toes. A mirror turns the sign of y, and of no pull."""
    m, mirror = Muscles.load_robot().mj_model, Muscles().mirror
    mujoco.mj_kinematics(m, data := mujoco.MjData(m))
    paths = [data.site_xpos[m.wrap_objid[m.tendon_adr[t] :][: m.tendon_num[t]]] for t in m.actuator_trnid[:, 0]]
    apart = [abs(paths[k] * (1, -1, 1) - paths[partner]).max() for k, partner in enumerate(mirror.action.index)]
    assert np.median(apart) < 1e-6 and np.mean(np.array(apart) < 1e-6) > 0.8 and mirror.action.sign.eq(1).all()


@torch.no_grad()
def test_the_robot_of_muscles_has_no_image() -> None:
    """Its left foot has the toes in the other order, so one step moves the image 0.1 rad/s and more another way."""
    env, mirror = diffsim.make("humanoid_mtu", 4, horizon=1, dtype=torch.float64), Muscles(dtype=torch.float64).mirror
    env.reset(seed=0)
    action = torch.rand(4, env.scene.nu, dtype=torch.float64, generator=env.generator)
    _, qvel = env.sim.step(env.qpos, env.qvel, action)
    _, image = env.sim.step(mirror.qpos(env.qpos), mirror.qvel(env.qvel), mirror.action(action))
    assert (mirror.qvel(qvel) - image).abs().amax(1).min() > 0.1
    m = env.scene.mj_model
    right, left, other = (m.body(name).pos[1] for name in ("FootThumbR", "FootThumbL", "FootPinkyL"))
    assert abs(-right - other) < 0.01 < abs(-right - left)


@pytest.mark.parametrize("name", MIRRORED)
def test_signs_and_places(name: str) -> None:
    task = TASKS[name](dtype=torch.float64)
    for part, width in zip(task.mirror, (None, None, None, task.obs_dim), strict=True):
        assert width is None or len(part.index) == width
        assert torch.equal(part.index[part.index], torch.arange(len(part.index)))
        assert torch.equal(part.sign[part.index], part.sign) and part.sign.abs().eq(1).all()
    assert task.mirror is task.mirror


def test_the_others_have_no_image() -> None:
    assert tuple(name for name, task in TASKS.items() if task.has_mirror()) == MIRRORED
    with pytest.raises(ValueError, match="task 'hopper' has no mirror image"):
        _ = TASKS["hopper"]().mirror


@pytest.mark.parametrize(
    ("left", "axis", "message"),
    [("left_knee", "0 1 1", "axis of joint 'left_knee'"), ("other", "0 1 0", "there is no 'left_knee'")],
)
def test_what_has_no_partner_is_named(left: str, axis: str, message: str) -> None:
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><worldbody><body><geom size=".1"/>
          <body><joint name="right_knee" axis="0 1 0"/><geom size=".1"/></body>
          <body><joint name="{left}" axis="{axis}"/><geom size=".1"/></body>
        </body></worldbody></mujoco>""")
    with pytest.raises(ValueError, match=message):
        reflections(model, (("right_", "left_"),), torch.device("cpu"), torch.float32)
