"""Mirror images of tasks: a mirrored robot under mirrored actions moves like the image of the robot."""

from __future__ import annotations

import shutil
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import torch

import diffsim
from diffsim import DiffEnv, Scene, Simulator, load_scene
from diffsim.tasks import TASKS
from diffsim.tasks.mirror import reflections
from diffsim.training.gait import trace

MIRRORED = ("ant", "humanoid", "humanoid_mtu", "go1", "go2", "g1")
ASSETS = Path(diffsim.__file__).parent / "assets"


def random_actions(env: DiffEnv, *size: int) -> torch.Tensor:
    return 2 * torch.rand(*size, env.num_envs, env.scene.nu, dtype=env.dtype, generator=env.generator) - 1


def errors(env: DiffEnv, scene: Scene, steps: int = 5) -> tuple[float, float, float]:
    """Greatest errors of observations, of rewards and of the return to the original, of states visited at random."""
    task, mirror = env.task, env.task.mirror
    sim = Simulator(scene, env.num_envs, env.sim.integration, dtype=env.dtype)
    with torch.no_grad():
        env.reset(seed=3)
        for action in random_actions(env, 25):
            env.step(action)
        state, image = (env.qpos, env.qvel), (mirror.qpos(env.qpos), mirror.qvel(env.qvel))
        assert torch.equal(mirror.qpos(image[0]), state[0]) and torch.equal(mirror.qvel(image[1]), state[1])
        assert not torch.allclose(image[0], state[0], atol=0.01)
        worst = np.zeros(3)
        for action in random_actions(env, steps):
            state, image = sim.step(*state, action), sim.step(*image, mirror.action(action))
            obs, seen = task.observe(*state, action), task.observe(*image, mirror.action(action))
            rewards = task.reward(obs, action) - task.reward(seen, mirror.action(action))
            back = mirror.obs(mirror.obs(obs)) - obs
            worst = np.maximum(worst, [x.abs().max() for x in (mirror.obs(obs) - seen, rewards, back)])
    assert (trace(scene, state[0].double().numpy())[0].max(1) > 0).sum() > 1  # so the ground pushed
    return worst[0], worst[1], worst[2]


@pytest.mark.parametrize("name, dtype", [("ant", torch.float32), ("humanoid", torch.float64)])
def test_the_image_moves_like_the_robot(name: str, dtype: torch.dtype) -> None:
    env = diffsim.make(name, num_envs=7, horizon=1, dtype=dtype)
    observation, reward, back = errors(env, env.scene)
    tolerance = 1e-12 if dtype == torch.float64 else 3e-5
    assert observation < tolerance and reward < tolerance and back == 0


def symmetric_toes(path: Path) -> Scene:
    """humanoid_mtu with the left toes made mirror images of the right ones.

    In the benchmark's model, which the asset follows, the left big toe is where the little toes should be, and the
    other way round. All else is symmetric, and so are the muscles' points in the reference configuration.
    """
    tree = ElementTree.parse(ASSETS / "humanoid_mtu.xml")
    bodies = {body.get("name"): body for body in tree.iter("body")}
    for toe in ("FootThumb", "FootPinky"):
        for right, left in zip(bodies[f"{toe}R"].iter(), bodies[f"{toe}L"].iter(), strict=True):
            for key, signs in (("pos", (1, -1, 1)), ("quat", (1, -1, 1, -1))):
                if key in right.attrib:
                    numbers = np.array(right.attrib[key].split(), float) * signs
                    left.set(key, " ".join(map(str, numbers)))
    tree.write(path / "humanoid_mtu.xml")
    shutil.copy(ASSETS / "stage.xml", path)
    return load_scene(path / "humanoid_mtu.xml")


def test_the_image_of_the_muscles(tmp_path: Path) -> None:
    """Exact where the left toes are; 5 control steps of random activations, nothing else being off."""
    env = diffsim.make("humanoid_mtu", num_envs=4, horizon=1, dtype=torch.float64)
    observation, reward, back = errors(env, symmetric_toes(tmp_path))
    assert observation < 1e-10 and reward < 1e-10 and back == 0
    off, _, _ = errors(env, env.scene, steps=1)  # the robot as it is
    assert 1e-3 < off < 2.0


@pytest.mark.parametrize("name", MIRRORED)
def test_signs_and_places(name: str) -> None:
    task = TASKS[name](dtype=torch.float64)
    for part, width in zip(task.mirror, (None, None, None, task.obs_dim), strict=True):
        assert width is None or len(part.index) == width
        assert torch.equal(part.index[part.index], torch.arange(len(part.index)))
        assert torch.equal(part.sign[part.index], part.sign) and part.sign.abs().eq(1).all()
    assert task.mirror is task.mirror


def test_gradients_pass_the_mirror() -> None:
    mirror = TASKS["humanoid"](dtype=torch.float64).mirror
    x = torch.randn(2, 3, 76, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(mirror.obs, x)
    assert mirror.action(torch.zeros(2, 3, 21, dtype=torch.float64)).shape == (2, 3, 21)


@pytest.mark.parametrize("name", sorted(TASKS.keys() - set(MIRRORED)))
def test_a_robot_in_a_plane_or_on_a_clip_has_no_mirror_image(name: str) -> None:
    with pytest.raises(ValueError, match=f"task '{name}' has no mirror image"):
        TASKS[name]().mirror  # noqa: B018


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
