"""The robot's fingerprint in a checkpoint: it changes with what is simulated, and a change is told once."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest
import torch
from learners import run

import bptt
from diffsim import load_scene
from diffsim.tasks.base import ASSETS
from diffsim.training.checkpoint import POLICIES
from diffsim.training.provenance import fingerprint
from diffsim_cli import commands

pytestmark = pytest.mark.unoptimized
ROBOT = """<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="cart" pos="0 0 1">
      <joint name="rail" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <geom name="box" type="sphere" size=".1" mass="1" rgba="1 0 0 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="rail" gear="10" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
TASK = """import torch
from diffsim.tasks import Task

class Cart(Task):
    asset, episode_length = "cart.xml", 5

    def observe(self, qpos, qvel, action):
        return torch.cat((qpos, qvel), dim=-1)

    def reward(self, obs, action):
        return -obs[..., 0] ** 2
"""
CHANGES = {'gear="10"': 'gear="11"', 'mass="1"': 'mass="1.001"', 'range="-1 1" l': 'range="-1 2" l', '".1"': '".2"'}
SAME = {'name="box"': 'name="other"', "1 0 0 1": "0 1 0 1", "<mujoco>": "<!-- a comment --><mujoco>"}
TOLD = "script.py: the robot's file has changed since the training\n"


def compiled(text: str) -> str:
    return fingerprint(load_scene(mujoco.MjModel.from_xml_string(text)))


def test_a_fingerprint_is_of_what_is_simulated() -> None:
    found = {compiled(ROBOT), *(compiled(ROBOT.replace(*change)) for change in CHANGES.items())}
    assert len(found) == 1 + len(CHANGES)
    assert {compiled(ROBOT.replace(*change)) for change in SAME.items()} == {compiled(ROBOT)}
    gravity = '<mujoco><option gravity="0 0 -9"/>'
    assert compiled(ROBOT.replace("<mujoco>", gravity)) != compiled(ROBOT)
    assert len({fingerprint(load_scene(path)) for path in ASSETS.glob("*.xml") if path.stem != "stage"}) == 11


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    """A run's directory, of a task whose robot is beside it."""
    (tmp_path / "cart.xml").write_text(ROBOT)
    (tmp_path / "cart.py").write_text(TASK)
    flags = "--num-envs 2 --horizon 4 --iterations 9 --eval-episodes 1 --device cpu --quiet".split()
    run(bptt, tmp_path / "run", "--env", tmp_path / "cart.py", *flags, stop_after=1)
    return tmp_path / "run"


def test_a_changed_robot_is_told_once_and_the_same_one_never(
    trained: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    own, path = str(trained.parent / "cart.py"), str(trained / "checkpoint.pt")

    def errors(*words: str) -> str:
        capsys.readouterr()
        monkeypatch.setattr("sys.argv", ["script.py"])
        commands.main([*words]) if words[0] == "export" else bptt.main([*words])
        return "".join(line for line in capsys.readouterr().err.splitlines(True) if not line.startswith("compiling"))

    exported = str(trained.parent / "policy.pt")
    commands.main(["export", path, exported])
    evaluation = "--evaluate", exported, "--env", own, "--run-dir", str(trained.parent / "evaluation")
    to_onnx = "export", exported, str(trained.parent / "policy.onnx"), "--env", own
    assert errors(*evaluation) == errors(*to_onnx) == ""
    changed = ROBOT.replace('gear="10"', 'gear="11"')
    (trained.parent / "cart.xml").write_text(changed)
    assert errors(*evaluation) == TOLD
    assert errors(*to_onnx) == TOLD.replace("script.py", "diffsim")
    assert errors("--resume", path, "--iterations", "3") == TOLD
    assert errors("--resume", path, "--iterations", "4") == ""  # that robot is the trained one now
    state = torch.load(path)
    assert state["robot"] == compiled(changed)
    del state["robot"]
    torch.save(state, path)
    (trained.parent / "cart.xml").write_text(ROBOT)
    assert errors("--evaluate", path) == ""  # written before there were fingerprints


def test_a_packaged_robot_that_changes_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = torch.load(POLICIES / "cartpole.pt")
    own = {"robot": fingerprint(load_scene(ASSETS / "cartpole.xml"))}
    for robot, told in (({}, False), (own, False), ({"robot": "0" * 16}, True)):
        torch.save(state | robot, path := tmp_path / "policy.pt")
        commands.main(["export", str(path), str(tmp_path / "policy.onnx")])
        assert ("diffsim: the robot's file has changed" in capsys.readouterr().err) == told
