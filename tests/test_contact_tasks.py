"""examples/get_up.py, dribble.py and self_contact.py, and the benchmark that judges them."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import dribble
import get_up
import mujoco
import numpy as np
import own_tasks
import pytest
import self_contact
import test_constraint
import torch
from learners import ROOT
from tables import read_csv
from test_constraint import in_mujoco, step
from worlds import State, Step

import diffsim
import rpo
from diffsim.tasks.base import ASSETS

enough_passes = test_constraint.enough_passes
GET_UP, DRIBBLE = (str(ROOT / "examples" / f"{name}.py") for name in ("get_up", "dribble"))
FILE = Path("mujoco_menagerie", "unitree_go2", "scene.xml")


@pytest.fixture
def field(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a working directory with a likeness of Menagerie's Go2: this project's, with motors."""
    text = re.sub(
        r"<position kp=.*? forcerange=\"(.*?)\"/>", r'<motor ctrlrange="\1"/>', (ASSETS / "go2.xml").read_text()
    )
    text = re.sub(r"<position (name=\"\w+\" class=\"\w+\" joint=\"\w+\")/>", r"<motor \1/>", text)
    text = re.sub(r'<geom name="(\w\w)" class="foot"/>', r'<geom name="\1" class="foot" conaffinity="1"/>', text)
    (tmp_path / FILE).parent.mkdir(parents=True)
    (tmp_path / FILE).write_text(text)
    (tmp_path / FILE.with_name("stage.xml")).write_text((ASSETS / "stage.xml").read_text())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_robots_begin_tilted_as_far_as_drawn_and_lie_in_tests() -> None:
    task = get_up.GetUp(dtype=torch.float64)
    rand = torch.rand(200, task.num_random, dtype=torch.float64)
    turn, heights = np.empty(9), []
    for numbers in (rand, task.for_test(rand)):
        qpos, _ = task.reset(numbers)
        for quat, tilt in zip(qpos[:, 3:7].numpy(), numbers[:, 71].numpy(), strict=True):
            mujoco.mju_quat2Mat(turn, quat)
            assert turn[8] == pytest.approx(np.cos(min(1.0, 2.5 * tilt) * np.pi / 2), abs=1e-12)
        heights.append(qpos[:, 2])
        assert (task.begin(numbers)[:, 58] > 0).any() == (numbers is rand)
    assert heights[0].max() > 0.7 and (heights[1] == get_up.LOWEST).all()
    upright = torch.cat((torch.tensor([0.0, 0.0, get_up.HEIGHT, 1.0, 0.0, 0.0, 0.0]).double(), task._home))
    assert task.achieved(upright, rand[0]) and not task.achieved(qpos, rand).any()


@pytest.mark.slow
@torch.no_grad()
def test_the_image_of_a_robot_that_gets_up_moves_like_it() -> None:
    env = diffsim.make(GET_UP, 4, horizon=1, dtype=torch.float64, accuracy="accurate")
    task, mirror, sim = env.task, env.task.mirror, env.sim
    state, image = (env.qpos, env.qvel), (mirror.qpos(env.qpos), mirror.qvel(env.qvel))
    memory = ahead = task.begin(torch.rand(4, task.num_random, dtype=torch.float64, generator=env.generator))
    for action in 0.5 * torch.rand(2, 4, 29, dtype=torch.float64, generator=env.generator):
        turned = mirror.action(action)
        state, image = sim.step(*state, action), sim.step(*image, turned)
        memory, ahead = task.remember(memory, action, memory), task.remember(ahead, turned, memory)
        obs, seen = task.observe_with(*state, action, memory), task.observe_with(*image, turned, ahead)
        torch.testing.assert_close(seen, mirror.obs(obs), rtol=0, atol=0.03)  # the G1's sides differ a little
        torch.testing.assert_close(task.reward(seen, turned), task.reward(obs, action), rtol=0, atol=0.03)
    assert abs(seen - obs).max() > 1.0


def test_the_gait_leads_behind_the_ball_then_to_its_place(field: Path) -> None:
    """In front of the ball around it, beside its line across, and behind it forward, turned into the robot's frame."""
    task = dribble.Dribble(dtype=torch.float64)
    qpos, qvel = task.reset(torch.full((4, task.num_random), 0.5, dtype=torch.float64))
    qpos[:, 19:21] = torch.tensor([2.0, 1.0])
    memory = task.begin(torch.full((4, task.num_random), 0.5, dtype=torch.float64))
    memory[:, :2] = torch.tensor([5.0, 1.0])  # along x from the ball
    qpos[:, :2] = torch.tensor([[1.6, 1.0], [1.6, 1.0], [1.6, 1.3], [2.5, 1.3]])
    qpos[1, 3:7] = torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])  # it looks along y
    obs = task.observe_with(qpos, qvel, torch.zeros(4, 12).double(), memory)
    command = obs[:, dribble.BALL + 45 : dribble.BALL + 48]
    torch.testing.assert_close(command[0], torch.tensor([0.97, 0.0, 0.0]).double(), rtol=0, atol=0.04)
    torch.testing.assert_close(command[1], torch.tensor([0.0, -0.6, -1.0]).double(), rtol=0, atol=1e-6)
    assert command[2, 1] < -0.5 and abs(command[2, 0]) < 0.1
    assert command[3, 0] == -1.0 and command[3, 1] > 0.3  # backward, away from the line
    torch.testing.assert_close(obs[1, :2], torch.tensor([0.0, -0.4]).double())
    assert not task.achieved(qpos, memory).any() and task.achieved(qpos, qpos[:, 19:21]).all()
    reward, rolls = task.reward(obs, obs), obs + torch.eye(task.obs_dim).double()[2]  # at 1 m/s
    wanted = obs[:, 6:8] - torch.tensor([1.0, 0.0]).double()
    loss = 0.5 * ((1 + wanted.square().sum(1) / 0.1).log() - (1 + obs[:, 6:8].square().sum(1) / 0.1).log())
    torch.testing.assert_close(task.reward(rolls, rolls), reward - loss)


@pytest.mark.unoptimized
def test_a_ball_rolls_and_is_kicked_as_in_mujoco(field: Path, rng: np.random.Generator) -> None:
    scene = diffsim.make(DRIBBLE, 1).scene
    qpos, n = np.tile(scene.mj_model.key_qpos[0], (8, 1)), 8
    qpos[:, 19:21] = rng.uniform((0.2, 0.05), (0.3, 0.2), (n, 2))  # at the left front leg
    qvel = np.zeros((n, scene.nv))
    qvel[:, 18:20] = rng.uniform(-1, 0.2, (n, 2))
    states = qpos, qvel, rng.uniform(-0.3, 0.3, (n, 12))
    ends, expected = step(scene, states, 40)[1], in_mujoco(scene, *states, substeps=40)[1]
    np.testing.assert_allclose(ends, expected, atol=1e-6)
    free = np.linalg.norm(qvel[:, 18:20], axis=1) - np.linalg.norm(ends[:, 18:20], axis=1)
    assert len(scene.geom_pairs) > 20 and abs(free).max() > 0.1


def test_legs_touch_in_one_robot_and_not_in_the_other() -> None:
    whole, ghost = self_contact.Whole(), self_contact.Ghost()
    assert len(whole.scene().geom_pairs) == 16 and not ghost.scene().geom_pairs
    assert whole.obs_dim == ghost.obs_dim == self_contact.G1.obs_dim - 1


def test_an_error_is_that_of_the_mean_of_the_second_half() -> None:
    """Of those that do not fall: what swings cancels, what is off for good does not."""
    off = torch.zeros(8, 4, 2).double()
    off[:4], off[4::2, 0], off[5::2, 0], off[4:, 1], off[4:, 3, 1] = 9.0, 1.0, -1.0, torch.tensor([0.3, 0.4]), 0.1
    fallen, nothing = torch.tensor([False, False, True, False]), torch.zeros(4, 0)
    steps = [Step(State(rows, nothing, nothing, nothing), nothing, nothing, fallen) for rows in off]
    task = SimpleNamespace(error=lambda qpos, qvel, memory: qpos)
    assert own_tasks.errors(task, steps) == pytest.approx({"error": 0.1, "worst error": 0.5})
    none = [step._replace(fallen=torch.ones(4, dtype=torch.bool)) for step in steps]
    assert own_tasks.errors(task, none) == {"error": "", "worst error": ""}


@pytest.mark.slow
def test_a_policy_is_judged_in_mujoco(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """One that is not trained does not get up."""
    small = "--num-envs 4 --horizon 4 --iterations 1 --eval-episodes 2 --eval-every 0 --device cpu".split()
    rpo.main(["--env", GET_UP, *small, "--run-dir", str(tmp_path / "run")])
    args = own_tasks.Args(checkpoints=(tmp_path / "run",), own=GET_UP, episodes=3, output=tmp_path, device="cpu")
    own_tasks.main(args)
    (row,) = read_csv(tmp_path / "own_tasks.csv")
    assert (row["reached"], row["seconds"], row["at the end"], row["episodes"]) == ("0", "", "0", "3")
