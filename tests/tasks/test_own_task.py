"""A user's own task: where it comes from, what it may leave out, and the one line that says what is wrong with it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from learners import ROOT
from scenes import parse as scene_of
from torch import Tensor

import diffsim
from diffsim.tasks import TASKS, Task, TaskError, find_task
from diffsim.tasks.base import ASSETS, way_forward
from diffsim.training.evaluation import fitting

EXAMPLE = ROOT / "examples" / "own_robot.xml"
TASK = """
from diffsim.tasks import Task

class {name}(Task):
    asset = "own_robot.xml"

    def observe(self, qpos, qvel, action):
        return qpos

    def reward(self, obs, action):
        return obs[..., 0]
"""


class Bare(Task):
    """All that a task must say, but for its robot."""

    def observe(self, qpos: Tensor, qvel: Tensor, action: Tensor) -> Tensor:
        return torch.cat((qpos, qvel), -1)

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        return obs[..., 0]


def write(path: Path, *names: str, more: str = "") -> str:
    path.write_text("".join(TASK.format(name=name) for name in names) + more)
    return str(path)


def line_of(error: pytest.ExceptionInfo[ValueError]) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


# Where a task comes from ----------------------------------------------------------------------------------------------


def test_a_file_with_one_task_or_with_several(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = (
        write(tmp_path / "one.py", "Only"),
        write(tmp_path / "two.py", "First", "Second", more='    name = "2nd"'),
    )
    only = find_task(one)
    assert (only.__name__, only.name, Task.name) == ("Only", "one", "task")  # the file's name, and the base unchanged
    assert find_task(f"{one}:Only") is only and find_task(only) is only and find_task("ant") is TASKS["ant"]
    assert [find_task(f"{two}:{name}").name for name in ("First", "Second")] == ["two", "2nd"]
    monkeypatch.chdir(tmp_path)
    assert find_task("one.py") is only
    (tmp_path / "helper.py").write_text("WEIGHT = 3.0\n")
    assert (
        find_task(write(tmp_path / "three.py", "Third", more="    import helper\n    name = str(helper.WEIGHT)")).name
        == "3.0"
    )


def test_a_file_that_changes_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "task.py"
    before = find_task(write(path, "Old"))
    write(path, "New", more="    episode_length = 7\n")
    assert before.__name__ == "Old" and find_task(str(path)).episode_length == 7


@pytest.mark.parametrize(
    "content, name, message",
    [
        (None, "none.py", "no such file: none.py in {cwd}; give its path, in scripts --env path/to/none.py"),
        ("x = 1\n", "task.py", "task.py defines no task, a class that extends diffsim.tasks.Task"),
        ("from diffsim.tasks.hopper import Hopper\n", "task.py", "task.py defines no task"),
        (TASK.format(name="A"), "task.py:B", "task.py has no task B: choose from task.py:A"),
        (TASK.format(name="A") + TASK.format(name="B"), "task.py",
         "task.py has several tasks: choose from task.py:A, task.py:B"),
        ("\n\nx = 1 / 0\n", "task.py", "task.py, line 3: ZeroDivisionError: division by zero"),
        ("import json\njson.loads('{')\n", "task.py", "task.py, line 2: JSONDecodeError: Expecting property name"),
        ("x = 1\ndef f(:\n", "task.py", "task.py, line 2: SyntaxError: invalid syntax"),
        ("import sys\nsys.exit(3)\n", "task.py", "task.py, line 2: SystemExit: 3"),
        ("import nowhere\n", "task.py:Any", "task.py, line 1: ModuleNotFoundError: No module named 'nowhere'"),
        (None, "anty", "unknown task 'anty': choose from cartpole, hopper, half_cheetah, ant"),
        (None, "anty", "g1, g1_track, or give a file such as my_task.py"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file(
    content: str | None, name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / "task.py").write_text(content)
    for call in (lambda: find_task(name), lambda: diffsim.make(name)):
        with pytest.raises(TaskError) as error:
            call()
        assert message.format(cwd=tmp_path) in line_of(error)


# Its robot ------------------------------------------------------------------------------------------------------------

SLED = """
<mujoco model="sled">
  <option> <flag gravity="disable"/> </option>
  <worldbody> <body> <joint type="slide"/> <geom size=".1"/> </body> </worldbody>
</mujoco>"""


def test_where_the_file_of_a_robot_is_sought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the class that names it, in the working directory, in diffsim/assets; diffsim's own only there."""
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir(), here.mkdir()
    monkeypatch.chdir(here)
    task = find_task(write(there / "task.py", "Mine"))
    with pytest.raises(TaskError) as error:
        task.load_robot()
    assert line_of(error) == f"task 'task': no robot file 'own_robot.xml' in {there} or {here}"
    for folder in (here, there):
        (folder / "own_robot.xml").write_text(SLED)
        assert task.load_robot().path == str(folder / "own_robot.xml")
    for folder in (here, there):
        (folder / "hopper.xml").write_text(SLED)
    hopper = ASSETS / "hopper.xml"
    assert TASKS["hopper"].load_robot().path == str(hopper)
    stand = "from diffsim.tasks.hopper import Hopper\nclass Stand(Hopper): pass\n"
    (there / "stand.py").write_text(stand)
    assert find_task(str(there / "stand.py")).load_robot().path == str(hopper)
    (there / "stand.py").write_text(stand + "class Sled(Stand):\n    asset = 'hopper.xml'\n")
    assert find_task(str(there / "stand.py:Sled")).load_robot().path == str(there / "hopper.xml")
    with pytest.raises(TaskError, match="task 'task' names no robot: give it an asset"):
        Bare.load_robot()


def test_a_robot_may_be_a_model_or_a_spec_which_stays_as_it_is() -> None:
    spec = mujoco.MjSpec.from_string(SLED)
    model = spec.compile()
    for asset in (spec, model):
        scene = diffsim.load_scene(asset)
        assert scene.name == "sled" and scene.mj_model is not model and not scene.gravity.any()
    assert model.opt.gravity[2] < 0

    class Mine(Bare):
        asset = model

    env = diffsim.make(Mine, num_envs=2)
    assert env.scene.nq == 1 and env.task.obs_dim == 2


# Its numbers ----------------------------------------------------------------------------------------------------------

BALLS = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 1"> <freejoint/> <geom size=".1"/>
      <body> <joint type="ball"/> <geom size=".1" pos="0 0 .3"/> </body>
    </body>
  </worldbody>
  <keyframe>
    <key name="flat" qpos="0 0 .2 1 0 0 0 1 0 0 0"/>
    {key}
  </keyframe>
</mujoco>"""
HOME = '<key name="home" qpos="1 0 .5 0 1 0 0 0 0 1 0"/>'


def fitted(kind: type[Task], scene: diffsim.Scene) -> Task:
    return kind(dtype=torch.float64).bind(scene)


def test_a_task_starts_at_the_keyframe() -> None:
    home, flat = (scene_of(BALLS.format(key=key)) for key in (HOME, ""))
    task, rand = fitted(Bare, home), torch.rand(5, 20, dtype=torch.float64)
    assert (task.num_random, task.obs_dim, task.forward_column) == (20, 20, 0)
    qpos, qvel = task.reset(rand)
    assert qpos.tolist() == [[1, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0]] * 5 and qvel.tolist() == [[0] * 9] * 5
    assert fitted(Bare, flat).reset(rand)[0][0].tolist() == [0, 0, 0.2, 1, 0, 0, 0, 1, 0, 0, 0]
    bare = scene_of(EXAMPLE.read_text())
    np.testing.assert_array_equal(fitted(Bare, bare).reset(rand[:, :10])[0][0], bare.qpos0)

    class Spread(Bare):
        spread = 0.4

    qpos, qvel = fitted(Spread, home).reset(rand)
    torch.testing.assert_close(qvel, 0.4 * (rand[:, 11:] - 0.5))
    torch.testing.assert_close(qpos[:, :3] - torch.tensor([1, 0, 0.5]), 0.4 * (rand[:, :3] - 0.5), check_dtype=False)
    for k in (3, 7):  # quaternions stay such
        turned = torch.eye(4, dtype=torch.float64)[1 if k == 3 else 2] + 0.4 * (rand[:, k : k + 4] - 0.5)
        torch.testing.assert_close(qpos[:, k : k + 4], turned / turned.norm(dim=1, keepdim=True))

    class Full(Bare):
        start, spread = tuple(range(10)), (0.0,) * 9 + (2.0,)

    qpos, qvel = fitted(Full, bare).reset(rand[:, :10])
    assert qpos[0].tolist() == [0, 1, 2, 3, 4] and qvel[0, :4].tolist() == [5, 6, 7, 8]
    torch.testing.assert_close(qvel[:, 4], 9 + 2 * (rand[:, 9] - 0.5))


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(obs_dim=9), "obs_dim is 9, must be 10 (what observe returns)"),
        (dict(obs_parts=(("height", 1), ("joints", 8))), "the sum of obs_parts is 9, must be 10 (obs_dim)"),
        (dict(num_random=9), "num_random is 9, must be 10 (nq + nv)"),
        (dict(start=(0.0,) * 9), "the length of start is 9, must be 10 (nq + nv)"),
        (dict(spread=(0.1,) * 5), "the length of spread is 5, must be 10 (nq + nv)"),
        (dict(reset=lambda self, rand: (rand[..., :4], rand[..., 5:])),
         "the width of qpos and of qvel from reset is (4, 5), must be (5, 5)"),
        (dict(observe=lambda self, qpos, qvel, action: qpos[..., 0]), "the shape of two observations is (2,), must be"),
        (dict(reward=lambda self, obs, action: obs[..., :1]), "the shape of two rewards is (2, 1), must be (2,)"),
        (dict(reward=lambda self, obs, action: obs.sum()), "the shape of two rewards is (), must be (2,)"),
        (dict(reward=lambda self, obs, action: obs[:, 0].numpy()), "reward returns ndarray, must return a torch"),
        (dict(reward=lambda self, obs, action: obs[:, 0].log()), "what reward returns for the start is not finite"),
        (dict(observe=lambda self, qpos, qvel, action: qpos / 0), "what observe returns for the start is not finite"),
        (dict(min_height=5.0), "an episode ends where it starts; obs[0] is 0, and min_height is 5.0"),
        (dict(min_height="low"), "min_height is 'low', must be a number of meters, or None"),
        (dict(forward_column=99), "forward_column is 99, must be a column of qpos, 0 to 4, or None"),
        (dict(forward_column=1.0), "forward_column is 1.0, must be a column of qpos, 0 to 4, or None"),
        (dict(min_height=float("nan")), "min_height is nan, must be a number of meters, or None"),
        (dict(episode_length=0), "episode_length is 0, must be an integer of at least 1"),
        (
            dict(terminated=lambda self, obs: obs[:, 0]),
            "what terminated returns for two observations is (torch.float32, (2,)), must be (torch.bool, (2,))",
        ),
        (dict(terminated=lambda self, obs: obs[:, 0] == 0), "an episode ends where it starts; obs[0] is 0"),
    ],
)  # fmt: skip
def test_a_number_that_does_not_fit_is_named(changes: dict[str, object], message: str) -> None:
    wrong = type("Wrong", (Bare,), changes | {"name": "wrong"})
    with pytest.raises(TaskError) as error:
        diffsim.DiffEnv(wrong(), scene_of(EXAMPLE.read_text()), 1)
    assert line_of(error).startswith(f"task 'wrong': {message}")


def test_what_is_missing_or_misspelt_is_named() -> None:
    def refused(mjcf: str = EXAMPLE.read_text(), **changes: object) -> str:
        with pytest.raises(TaskError) as error:
            diffsim.DiffEnv(type("Wrong", (Bare,), changes | {"name": "wrong"})(), scene_of(mjcf), 1)
        return line_of(error)

    assert refused(episode_lenght=5) == "task 'wrong' has 'episode_lenght': is 'episode_length' meant?"
    assert refused(terminate=lambda self, obs: obs) == "task 'wrong' has 'terminate': is 'terminated' meant?"
    for name in ("a/b", "..", 5):
        nested = type("Nested", (Bare,), {"name": name})
        with pytest.raises(TaskError, match=f"name is {name!r}, must be the name of a folder, without a slash"):
            diffsim.DiffEnv(nested(), scene_of(EXAMPLE.read_text()), 1)
    assert refused(ground=0.1) == "task 'wrong' has 'ground', which is the terrain: give it another name"
    assert refused(reward=Task.reward) == "task 'wrong' has no method 'reward'"
    assert refused(observe=Task.observe) == "task 'wrong' has no method 'observe'"
    flat = BALLS.format(key="")
    assert refused(flat, start=(0.0,) * 20) == "task 'wrong': the quaternion qpos[3:7] of the start is zero"
    others = {"rewards": 3, "rest": (), "max_height": 2.0, "walls": 1, "observe_with": Bare.observe_with}
    assert fitted(type("Mine", (Bare,), others), scene_of(EXAMPLE.read_text())).obs_dim == 10
    with pytest.raises(TypeError, match="make has no argument 'foo': choose from .*early_termination, factors, forces"):
        diffsim.make("ant", foo=1)


def test_a_policy_of_a_task_that_has_changed_since_is_refused() -> None:
    env = diffsim.make("cartpole", 1)
    for inputs, outputs in ((4, 1), (5, 2)):
        with pytest.raises(ValueError, match="not for task 'cartpole' as it is now, with 5 observations and 1 actions"):
            fitting(torch.nn.Linear(inputs, outputs), env)
    assert fitting(torch.nn.Linear(5, 1), env)


# Its actions ----------------------------------------------------------------------------------------------------------

SERVOS = """
<mujoco>
  <worldbody>
    <body> <joint name="a"/> <geom size=".1" pos="1 0 0"/>
      <body> <joint name="b" ref="30"/> <geom size=".1" pos="1 0 0"/> </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="a" kp="9" ctrlrange="-1 1"/>
    <general joint="b" gear="-2" gainprm="4" biasprm="1 -8 -1" biastype="affine"/>
    <motor name="motor" joint="a" ctrlrange="-2 2"/>
  </actuator>
  <keyframe> {keys} </keyframe>
</mujoco>"""
KEYS = '<key ctrl="9 9 9"/> <key name="home" qpos=".3 .1" ctrl="{}"/>'
STILL = (-0.5, 0.2, 0.0, 0.0)


@pytest.mark.parametrize(
    "keys, attributes, zero, width",
    [
        (KEYS.format(".8 3 -.5"), {}, (0.8, 3, -0.5), (0.2, 0.5, 0.5)),  # the keyframe's ctrl, within ctrlrange
        (KEYS.format("0 0 0"), {}, (0.3, -0.65, 0), (0.5, 0.5, 0.5)),  # a keyframe without ctrl: its pose
        ("", {}, (0, -0.25 - 4 * np.pi / 6, 0), (0.5, 0.5, 0.5)),  # no keyframe: the reference pose
        (KEYS.format(".8 3 -.5"), {"start": STILL}, (-0.5, -1.05, 0), (0.5, 0.5, 0.5)),  # another start: its pose
        (KEYS.format(".8 3 -.5"), {"action_scale": 9}, (0.8, 3, -0.5), (0.2, 9, 1.5)),
    ],
)
def test_action_zero_of_a_scaled_task_is_the_control_of_its_start(
    keys: str, attributes: dict[str, object], zero: tuple[float, ...], width: tuple[float, ...]
) -> None:
    model = mujoco.MjModel.from_xml_string(SERVOS.format(keys=keys))
    kind = type("Scaled", (Bare,), {"asset": model, "action_scale": 0.5} | attributes)
    task = kind()
    scene, (start, _) = task.scene(), kind().bind(task.load_robot()).reset(torch.full((1, 4), 0.5))
    ranges = scene.mj_model.actuator_ctrlrange
    np.testing.assert_allclose(ranges.mean(1), zero, atol=1e-12)
    np.testing.assert_allclose(ranges[:, 1] - ranges[:, 0], 2 * np.array(width))
    np.testing.assert_allclose(scene.gear, 0.5 * np.ptp(ranges, 1) * (9, -8, 1))
    touching = dataclasses.replace(task.load_robot(), geom_pairs=((0, 1),))
    assert scene.name == touching.name
    assert type("Touching", (kind,), {"load_robot": classmethod(lambda cls: touching)})().scene().geom_pairs
    if "ctrl" not in keys or "0 0 0" in keys or "start" in attributes:  # no actuator pushes there
        data = mujoco.MjData(model)
        data.qpos, data.ctrl = start[0].numpy(), ranges.mean(1)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.actuator_force, 0, atol=1e-6)


@pytest.mark.parametrize(
    "scale, ctrl, message",
    [
        (0.0, "0 0 1", "action_scale is 0.0, must be positive, or None"),
        ("1", "0 0 1", "action_scale is '1', must be positive, or None"),
        (1.0, "1 0 2", "with action_scale the start's control must lie within ctrlrange: 'servo', 'motor'"),
    ],
)
def test_an_action_scale_that_does_not_fit_is_named(scale: object, ctrl: str, message: str) -> None:
    model = mujoco.MjModel.from_xml_string(SERVOS.format(keys=KEYS.format(ctrl)))
    with pytest.raises(TaskError) as error:
        diffsim.make(type("Scaled", (Bare,), {"asset": model, "action_scale": scale, "name": "mine"}), 1)
    assert line_of(error) == f"task 'mine': {message}"


# Forward --------------------------------------------------------------------------------------------------------------

SLIDES = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 1" {turn}> {joints} <geom size=".1" mass="1"/>
      <body> <joint type="slide" axis="1 0 0" range="-1 1"/> <geom size=".1" mass="1"/> </body>
    </body>
  </worldbody>
</mujoco>"""
Z, X, Y = (f'<joint type="slide" axis="{axis}"/>' for axis in ("0 0 1", "1 0 0", "0 1 0"))


@pytest.mark.parametrize(
    "joints, turn, column",
    [
        (Z + X, "", 1),  # as of dm_control's walker
        (X + Z, "", 0),
        (Y + Z, 'euler="0 0 -90"', 0),
        ("<freejoint/>", "", 0),
        ("<joint/>", "", None),  # an arm
        (Z + Y, "", None),
    ],
)
def test_forward_is_along_x(joints: str, turn: str, column: int | None) -> None:
    text = SLIDES.format(joints=joints, turn=turn)
    assert way_forward(scene_of(text)) == column
    assert way_forward(scene_of(text.replace("<geom type", "<geom contype='0' conaffinity='0' type"))) is None


def test_the_shipped_robots_move_along_their_first_coordinate() -> None:
    found = {name: way_forward(task.load_robot()) for name, task in TASKS.items()}
    assert found == {name: None if name == "cartpole" else 0 for name in TASKS}


# Contact --------------------------------------------------------------------------------------------------------------


def test_own_tasks_have_mujocos_contact_and_the_shipped_ones_the_papers() -> None:
    class Slow(Bare):
        control_dt = 0.05

    class Own(Bare):
        substeps = 7

    class Soft(Own):
        contact = "soft"

    hard, soft = (lambda n, kind=kind: diffsim.Integration(kind, n) for kind in ("mujoco", "soft"))
    assert {name for name, task in TASKS.items() if task.contact == "mujoco"} == {"go1", "go2", "g1", "g1_track"}
    for kind, words, expected in (
        (Bare, ["default"], hard(4)),
        (Bare, ["accurate"], hard(16)._replace(tolerance=1e-5)),
        (Bare, ["default", "soft"], soft(16)),
        (Slow, ["default"], hard(12)),
        (Own, ["default"], hard(7)),
        (Own, ["default", "soft"], soft(16)),
        (Soft, ["default"], soft(7)),
        (Soft, ["default", "mujoco"], hard(4)),
    ):
        assert kind.integration(*words) == expected
    assert diffsim.DiffEnv(Bare(), scene_of(SLED), 1).sim.integration == hard(4)
