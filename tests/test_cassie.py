"""examples/cassie.py, whose robot has legs that are closed chains: on a likeness of it, and on Menagerie's file."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import own_tasks
import pytest
import test_constraint
import torch
from cassie import Cassie
from learners import ROOT, refusal
from own_quadruped import play
from tables import read_csv
from test_constraint import H, check_gradients, in_mujoco, step
from test_pairs import needs_drift

import diffsim
import rpo
from diffsim.robot.constants import constrained
from diffsim.training import load_policy
from diffsim_cli.commands import main as diffsim_main

enough_passes = test_constraint.enough_passes

EXAMPLE = str(ROOT / "examples" / "cassie.py")
FILE = Path("mujoco_menagerie", "agility_cassie", "scene.xml")
# Cassie's joints in its order; frames of hips, knees and all below have z to the right in both legs.
LEG = """
<body pos="0 {y} 0" xyaxes="0 0 -1 0 1 0"> <joint name="{side}-hip-roll"/> <geom size=".05"/>
<body pos="0 0 -.05" xyaxes="0 0 1 0 1 0"> <joint name="{side}-hip-yaw"/> <geom size=".05"/>
<body pos="0 0 -.05" xyaxes="0 0 -1 1 0 0"> <joint name="{side}-hip-pitch"/> <geom size=".06"/>
  <body name="{side}-rod" pos="0 0 {z}" xyaxes=".9 -.2 {tilt} .2 .9 0"> <joint name="{side}-achilles-rod" type="ball"/>
    <geom type="capsule" fromto="0 0 0 .4 0 0" size=".01"/> </body>
  <body pos=".1 -.1 0"> <joint name="{side}-knee"/> <geom type="capsule" fromto="0 0 0 .1 0 0" size=".03"/>
  <body pos=".1 0 0"> <joint name="{side}-shin" stiffness="500"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
  <body pos=".3 0 0"> <joint name="{side}-tarsus"/> <geom type="capsule" fromto="0 0 0 .3 .1 0" size=".03"/>
    <body name="{side}-heel" pos="0 .02 0"> <joint name="{side}-heel-spring" stiffness="500"/>
      <geom type="capsule" fromto="0 0 0 -.08 0 0" size=".02"/> </body>
    <body pos=".1 -.03 0"> <joint name="{side}-foot-crank"/> <geom type="capsule" fromto="0 0 0 0 -.05 0" size=".01"/>
      <body name="{side}-plantar" pos="0 -.05 0"> <joint name="{side}-plantar-rod"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".01"/> </body> </body>
    <body name="{side}-foot" pos=".3 .1 0"> <joint name="{side}-foot"/>
      <geom type="capsule" fromto="0 -.1 0 0 .1 0" size=".03"/> </body>
  </body> </body> </body>
</body> </body> </body>"""
SIDES = [dict(side=side, y=sign * 0.15, z=sign * 0.05, tilt=sign * 0.1) for side, sign in (("left", 1), ("right", -1))]
TIED = """<connect body1="{side}-plantar" body2="{side}-foot" anchor=".2 0 0"/>
  <connect body1="{side}-rod" body2="{side}-heel" anchor=".4 0 0"/>"""
DRIVEN = "hip-roll", "hip-yaw", "hip-pitch", "knee", "foot"
MOTORS = [f'<motor name="{{side}}-{j}" joint="{{side}}-{j}" gear="20" ctrlrange="-5 5"/>' for j in DRIVEN]
LIKENESS = f"""
<mujoco model="likeness"> <option timestep="0.002"/>
  <default> <geom conaffinity="0" density="2000"/> <joint armature=".02" damping="1"/>
    <equality solref=".01 1"/> </default>
  <worldbody> <geom type="plane" size="0 0 1" conaffinity="1"/>
    <body pos="0 0 .879"> <freejoint/> <geom type="box" size=".1 .15 .1"/>
      {"".join(LEG.format(**s) for s in SIDES)} </body>
  </worldbody>
  <equality> {"".join(TIED.format(**s) for s in SIDES)} </equality>
  <actuator> {"".join(motor.format(**s) for s in SIDES for motor in MOTORS)} </actuator>
  <keyframe> <key name="home"/> </keyframe>
</mujoco>"""


@pytest.fixture(params=["likeness", "menagerie"])
def folder(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a working directory with the file; that of MuJoCo Menagerie where the repository's root has it."""
    (folder := tmp_path / str(request.param)).mkdir()
    if request.param == "menagerie":
        if not (ROOT / FILE).is_file():
            pytest.skip(f"there is no {FILE}")
        shutil.copytree((ROOT / FILE).parent, folder / FILE.parent)
    else:
        (folder / FILE).parent.mkdir(parents=True)
        (folder / FILE).write_text(LIKENESS)
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.unoptimized
@torch.no_grad()
@pytest.mark.parametrize("folder", ["likeness"], indirect=True)
def test_the_image_moves_like_the_robot(folder: Path) -> None:
    """Although the frames of bodies, with rods on ball joints among them, are turned. Cassie's legs differ a little."""
    env = diffsim.make(EXAMPLE, 5, horizon=1, dtype=torch.float64, accuracy="accurate")
    task, mirror, sim = env.task, env.task.mirror, env.sim
    state, image = (env.qpos, env.qvel), (mirror.qpos(env.qpos), mirror.qvel(env.qvel))
    memory = task.begin(torch.rand(5, env.scene.nq + env.scene.nv, dtype=torch.float64, generator=env.generator))
    ahead = torch.cat((memory[:, :1], (memory[:, 1:2] + 0.5) % 1, memory[:, 2:]), dim=1)
    for action in 2 * torch.rand(5, 5, 10, dtype=torch.float64, generator=env.generator) - 1:
        turned = mirror.action(action)
        state, image = sim.step(*state, action), sim.step(*image, turned)
        memory, ahead = task.remember(memory, action, memory), task.remember(ahead, turned, memory)
        obs, seen = task.observe_with(*state, action, memory), task.observe_with(*image, turned, ahead)
        torch.testing.assert_close(seen, mirror.obs(obs), rtol=0, atol=1e-6)
        rewards = task.reward(seen, turned), task.reward(obs, action)
        torch.testing.assert_close(*rewards, rtol=0, atol=1e-6)
    assert abs(mirror.obs(obs) - obs).max() > 0.1


@pytest.mark.parametrize("folder", ["likeness"], indirect=True)
def test_the_error_is_that_of_speed_and_course(folder: Path) -> None:
    task = Cassie(dtype=torch.float64)
    memory = task.begin(torch.tensor([0.7, *(0.0,) * 66], dtype=torch.float64)).expand(2, -1)
    qvel = torch.zeros(2, 32, dtype=torch.float64)
    qvel[:, :3] = torch.tensor([[0.7, 0.0, 3.0], [0.5, -0.1, 3.0]])
    error = task.error(torch.zeros(2, 35), qvel, memory)
    torch.testing.assert_close(error, torch.tensor([[0.0, 0.0], [-0.2, -0.1]]).double(), rtol=0, atol=1e-7)


@pytest.mark.unoptimized
@needs_drift
def test_a_rollout_is_that_of_mujoco(folder: Path, rng: np.random.Generator) -> None:
    """With servos on the motors and feet on the ground, over 100 substeps."""
    env = diffsim.make(EXAMPLE, 6, dtype=torch.float64)
    states = env.qpos.numpy(), env.qvel.numpy(), rng.uniform(-0.3, 0.3, (6, 10))
    qpos, qvel, residual = step(env.scene, states, 100)
    expected, velocity, _ = in_mujoco(env.scene, *states, substeps=100)
    assert residual.max() < 1e-10 and {"point_rows"} < constrained(env.scene, H).features
    np.testing.assert_allclose(qpos, expected, atol=1e-8)
    np.testing.assert_allclose(qvel, velocity, atol=1e-6)


@pytest.mark.slow
def test_its_gradients_are_those_of_differences(folder: Path, rng: np.random.Generator) -> None:
    env = diffsim.make(EXAMPLE, 6, dtype=torch.float64)
    ctrl = rng.uniform(-0.3, 0.3, (6, 10))
    qpos, qvel, _ = step(env.scene, (env.qpos.numpy(), env.qvel.numpy(), ctrl), 100)
    check_gradients(env.scene, (qpos, qvel, ctrl), rng)


@pytest.mark.slow
def test_a_policy_moves_in_mujoco_as_here(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """After an iteration of training, exported, with the time step of MuJoCo's file. It is judged there, too."""
    pytest.importorskip("onnxruntime")
    small = (
        "--num-envs 4 --horizon 4 --iterations 1 --eval-episodes 2 --eval-every 0 --device cpu --run-dir run".split()
    )
    rpo.main(["--env", EXAMPLE, *small])
    diffsim_main(["export", "run/checkpoint.pt", "cassie.onnx", "--env", EXAMPLE])
    substeps = round(Cassie.control_dt / Cassie.load_robot().mj_model.opt.timestep)
    env = diffsim.make(EXAMPLE, 1, substeps=substeps, stochastic_init=False)
    policy, (obs, _) = load_policy("run/checkpoint.pt").network, env.reset()
    with torch.no_grad():
        for _ in range(15):
            obs, *_ = env.step(policy(obs))
    distance = play("cassie.onnx", Cassie(), seconds=0.3)
    assert distance == pytest.approx(env.qpos[0, 0].item(), abs=1e-3) and abs(distance) > 1e-3
    args = own_tasks.Args(checkpoints=(Path("run"),), own=EXAMPLE, episodes=2, output=folder, device="cpu")
    own_tasks.main(args)
    (row,) = read_csv(folder / "own_tasks.csv")
    assert row["episodes"] == "2" and (row["error"] == "") == (float(row["fallen"]) == 1.0)
    assert "prepare" in refusal(lambda: own_tasks.main(dataclasses.replace(args, file=FILE)), capsys)
