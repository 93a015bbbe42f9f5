"""Gaits: motions whose duty factor, phase, steps, cost and depth are known, and those of the shipped policies."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from learners import SCRIPTS
from numpy.typing import NDArray

import diffsim
from diffsim import Scene, load_scene
from diffsim.training import Evaluation, evaluate, evaluation, load_policy
from diffsim.view import gait
from diffsim.view.gait import Gait

Array = NDArray[np.float64]
PACKAGE = Path(diffsim.__file__).parent
DT, STRIDE = 0.01, 50  # s, frames
SETTLED = round(gait.SETTLING / DT)

# A box on two legs that slide up and down: where both are at 0, so are the lowest points of the feet.
BIPED = """
<mujoco>
  <default> <geom contype="1" conaffinity="0"/> <joint type="slide" axis="0 0 1"/> <motor gear="100"/> </default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="1"/>
    <body name="box" pos="0 0 1">
      <freejoint/> <geom type="box" size=".2 .3 .1" mass="8"/>
      <body name="right_leg"> <joint name="right"/> <geom type="sphere" pos="0 -.2 -.9" size=".1" mass="1"/> </body>
      <body name="left_leg"> <joint name="left"/> <geom type="sphere" pos="0 .2 -.9" size=".1" mass="1"/> </body>
    </body>
  </worldbody>
  <actuator> <motor joint="right"/> <motor joint="left"/> </actuator>
</mujoco>"""


@pytest.fixture(scope="module")
def biped(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("robots") / "biped.xml"
    path.write_text(BIPED)
    return load_scene(path)


def episodes(scene: Scene, qpos: Array, action: Array | None = None, lengths: list[int] | None = None) -> Evaluation:
    """An evaluation of qpos (T, n, nq)."""
    steps, n = qpos.shape[:2]
    action = np.zeros((steps, n, scene.nu)) if action is None else action
    ends = torch.tensor(lengths or [steps] * n)
    return Evaluation(torch.zeros(n), ends, None, torch.tensor(qpos), torch.tensor(action), scene, DT)


def standing(scene: Scene, steps: int, n: int = 1) -> Array:
    return np.tile(scene.qpos0, (steps, n, 1))


def steps_of(scene: Scene, duty: tuple[float, float], phase: tuple[float, float], strides: int = 20) -> Array:
    """The biped at 2 m/s; each foot is 20 mm deep for its duty factor from its phase on, and 100 mm high otherwise."""
    time = np.arange(SETTLED + strides * STRIDE)
    qpos = standing(scene, len(time))
    qpos[:, 0, 0] = 2.0 * DT * time
    for k in range(2):
        down = (time / STRIDE - phase[k] + 1e-9) % 1.0 < duty[k]
        qpos[:, 0, 7 + k] = np.where(down, -0.02, 0.1)
    return qpos


def described(scene: Scene, qpos: Array, **others: Any) -> Gait:
    found = episodes(scene, qpos, **others).gait()
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("phase", "verdict"),
    [
        (0.5, "runs on two legs in turn, right leg and left leg (phase 0.50), 2.0 strides/s"),
        (0.3, "runs unevenly on two legs, left leg 0.30 of a stride after right leg, 2.0 strides/s"),
        (0.7, "runs unevenly on two legs, left leg 0.70 of a stride after right leg, 2.0 strides/s"),
        (0.96, "hops on two legs together, 2.0 strides/s"),
    ],
)
def test_duty_factor_and_phase_of_a_known_motion(biped: Scene, phase: float, verdict: str) -> None:
    found = described(biped, steps_of(biped, (0.4, 0.2), (0.44, 0.44 + phase)))
    right, left = found.feet
    assert (right.name, left.name) == ("right_leg", "left_leg") and found.verdict == verdict
    assert (right.duty, left.duty) == pytest.approx((0.4, 0.2)) and found.trunk == 0
    assert (right.phase, left.phase) == pytest.approx((0.0, phase), abs=1e-8)
    assert left.steadiness == pytest.approx(1.0) and right.share == left.share == 0.5
    assert (right.frequency, left.frequency) == pytest.approx((2.0, 2.0))
    assert found.speed == pytest.approx(2.0) and found.stance_penetration == pytest.approx(0.02)


def test_a_walk_has_a_duty_factor_above_one_half(biped: Scene) -> None:
    found = described(biped, steps_of(biped, (0.6, 0.6), (0.0, 0.5)))
    assert found.verdict.startswith("walks on two legs in turn, right leg and left leg (phase 0.50)")


def test_hops_on_one_leg(biped: Scene) -> None:
    qpos = steps_of(biped, (0.0, 0.3), (0.0, 0.5))
    (left,) = described(biped, qpos).feet
    assert (left.name, left.share, left.phase) == ("left_leg", 1.0, 0.0)
    assert described(biped, qpos).verdict == "hops on its left leg, 2.0 strides/s"
    for start in range(SETTLED + 60, len(qpos), 10 * STRIDE):  # the other foot helps at each tenth hop
        qpos[start : start + 20, 0, 7] = -0.01
    right, left = described(biped, qpos).feet
    assert right.share == pytest.approx(2 / 22, abs=0.01) and right.share + left.share == 1
    assert described(biped, qpos).verdict == f"hops on its left leg ({left.share:.0%} of touch-downs), 2.0 strides/s"


def test_steps_without_a_rhythm_are_irregular(biped: Scene, rng: np.random.Generator) -> None:
    qpos = steps_of(biped, (0.3, 0.3), (0.0, 0.5))
    for stride in range(21):
        start = SETTLED + stride * STRIDE
        qpos[start : start + STRIDE, 0, 8] = np.roll(qpos[start : start + STRIDE, 0, 8], rng.integers(STRIDE))
    found = described(biped, qpos)
    steadiness = found.feet[1].steadiness
    assert steadiness is not None and steadiness < 0.5 and "irregularly on two legs (right leg " in found.verdict


def test_what_keeps_the_ground_or_lies_on_it(biped: Scene) -> None:
    qpos = standing(biped, 200)
    qpos[:, :, 2] = 0.99
    assert described(biped, qpos).verdict == "keeps right leg and left leg on the ground"
    qpos[:, :, 2], qpos[:, :, 7:] = 0.05, 1.0
    found = described(biped, qpos)
    assert found.feet == () and found.trunk == 1 and found.max_penetration == pytest.approx(0.05)
    assert found.verdict == "touches the ground with no foot, its trunk on the ground 100% of the time"
    qpos[:, :, 2] = 2.0
    assert described(biped, qpos).verdict == "touches the ground with no foot"
    assert described(biped, qpos).max_penetration == described(biped, qpos).stance_penetration == 0


def test_a_bounce_is_no_step() -> None:
    def landings(air: int) -> list[int]:
        contact = np.array([1] * 3 + [0] * 10 + [1] * 2 + [0] * air + [1] * 4, bool)
        return gait.touch_downs(contact, 1 / 60).tolist()

    assert landings(2) == landings(3) == [13] and landings(4) == [13, 19]


def test_only_what_lies_between_the_first_second_and_the_end_counts(biped: Scene) -> None:
    qpos = np.repeat(steps_of(biped, (0.4, 0.4), (0.0, 0.5)), 3, axis=1)
    qpos[: SETTLED - 1, :, 2] = 0.2
    qpos[600:, 1, 2] = 0.2
    lengths = [len(qpos), 600, SETTLED + 1]  # the last one is too short to count
    found = described(biped, qpos, lengths=lengths)
    assert found.max_penetration == pytest.approx(0.02) and found.trunk == 0
    assert [foot.duty for foot in found.feet] == pytest.approx([0.4, 0.4])
    assert episodes(biped, qpos, lengths=[5, SETTLED, SETTLED + 1]).gait() is None


def test_a_robot_without_ground_has_no_gait() -> None:
    scene = load_scene(PACKAGE / "assets" / "cartpole.xml")
    assert episodes(scene, standing(scene, 300)).gait() is None


# Cost and speed -------------------------------------------------------------------------------------------------------


def test_cost_of_transport_of_a_known_motion(biped: Scene) -> None:
    """Feet go up and down by 120 mm twice a second, pushed by 50 N and 100 N; 10 kg travel at 2 m/s."""
    qpos = steps_of(biped, (0.4, 0.4), (0.2, 0.5))
    action = np.tile((0.5, -3.0), (len(qpos), 1, 1))  # the second is clipped
    found = described(biped, qpos, action=action)
    power = (50.0 + 100.0) * 2 * 0.12 * 2.0  # W: down and up, 2 strides/s
    assert found.cost_of_transport == pytest.approx(power / (10.0 * 9.81 * 2.0), rel=0.01)
    qpos[:, :, 0] *= -1
    assert described(biped, qpos, action=action).cost_of_transport is None


@pytest.mark.parametrize("name", ["humanoid", "humanoid_mtu"])
def test_forces_work_along_joints_and_muscles(name: str, rng: np.random.Generator) -> None:
    """Paths are those along which, by the scene, motors and muscles push, so that power is force times rate."""
    scene = load_scene(PACKAGE / "assets" / f"{name}.xml")
    qpos = scene.qpos0 + 0.1 * rng.standard_normal((3, scene.nq))
    path, data = gait.trace(scene, qpos).path, mujoco.MjData(scene.mj_model)
    for q, row in zip(qpos, path, strict=True):
        if name == "humanoid":
            np.testing.assert_allclose(row, q[scene.qpos_adr[scene.motor_link]])
        else:
            data.qpos[:] = q
            mujoco.mj_fwdPosition(scene.mj_model, data)
            np.testing.assert_allclose(row, data.ten_length)


def test_peak_joint_speed_of_hinges_and_balls() -> None:
    """The fastest joint's, whatever the root does."""
    time = np.arange(SETTLED + 100) * DT
    for name, place in (("ant", 8), ("humanoid_mtu", 7)):
        scene = load_scene(PACKAGE / "assets" / f"{name}.xml")
        qpos = standing(scene, len(time))
        qpos[:, 0, 0], qpos[:, 0, 3], qpos[:, 0, 6] = 9.0 * time, np.cos(5.0 * time), np.sin(5.0 * time)
        if name == "ant":
            qpos[:, 0, place] = 1.0 - 3.0 * time
        else:  # 3 rad/s about the axis (0.6, 0, 0.8)
            turn = np.outer(np.sin(1.5 * time), (0.6, 0.0, 0.8))
            qpos[:, 0, place : place + 4] = np.column_stack((np.cos(1.5 * time), turn))
        assert described(scene, qpos).peak_joint_speed == pytest.approx(3.0)


# Depth ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["half_cheetah", "humanoid", "humanoid_mtu"])
def test_depth_is_that_of_mujocos_contacts(name: str, rng: np.random.Generator) -> None:
    scene = load_scene(PACKAGE / "assets" / f"{name}.xml")
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    bodies, compared = gait.contact_bodies(scene), 0
    for _ in range(20):
        qpos = scene.qpos0 + 0.2 * rng.standard_normal(scene.nq)
        qpos[1 if name == "half_cheetah" else 2] -= 0.6
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        depth = gait.trace(scene, data.qpos[None].copy()).depth[0]
        for body in np.unique(bodies):
            geoms = np.flatnonzero(model.geom_bodyid == body)
            distances = [c.dist for c in data.contact if c.geom2 in geoms or c.geom1 in geoms]
            if distances:
                compared += 1
                assert depth[bodies == body].max() == pytest.approx(-min(distances), abs=1e-9)
            else:
                assert depth[bodies == body].max() <= 0
    assert compared > 50


# The shipped policies -------------------------------------------------------------------------------------------------

FEET = {
    "hopper": ["foot"],
    "half_cheetah": ["back_foot", "front_foot"],
    "ant": ["foot_1", "foot_2", "foot_3", "foot_4"],
    "humanoid": ["right_foot", "left_foot"],
    "humanoid_mtu": ["TalusR", "TalusL"],  # with the toes of each and the lower end of the shin
}


@pytest.mark.parametrize("name", FEET)
def test_gait_of_the_shipped_policies(name: str) -> None:
    env = diffsim.make(name, num_envs=2, horizon=1, max_episode_steps=180)
    found = evaluate(env, load_policy(PACKAGE / "policies" / f"{name}.pt").network).gait()
    assert found is not None and [foot.name for foot in found.feet] == FEET[name]
    assert all(0.1 < foot.duty < 0.5 and 1.5 < foot.frequency < 5 for foot in found.feet)
    assert all(foot.share == pytest.approx(1 / len(found.feet), abs=0.1) for foot in found.feet)
    assert found.trunk == 0 and 4 < found.speed < 12 and found.cost_of_transport is not None
    assert 0.5 < found.cost_of_transport < 8 and 10 < found.peak_joint_speed < 50
    assert 0 < found.stance_penetration < found.max_penetration < 0.15
    assert found.verdict.startswith("hops on its foot" if name == "hopper" else "runs on ")


def test_an_evaluation_reports_the_gait(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(PACKAGE / "policies" / "ant.pt")
    SCRIPTS["sapo"].main(["--evaluate", path, "--eval-episodes", "2", "--device", "cpu", "--run-dir", str(tmp_path)])
    returns, finer, words = capsys.readouterr().out.splitlines()
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert returns.startswith("ant, 2 episodes") and words.startswith(f"gait: {found['gait']['verdict']}; duty factor ")
    assert finer == f"explicit with 32 substeps: return median {found['finer']['return']:.1f}, " + (
        f"{found['finer']['kept']:.1%} kept"
    )
    assert found["finer"]["kept"] == pytest.approx(found["finer"]["return"] / found["return"])
    assert found["finer"]["kept"] > evaluation.ENOUGH
    assert [foot["name"] for foot in found["gait"]["feet"]] == FEET["ant"]
    assert evaluation.kept(-2.0, -4.0) == 0.5 and evaluation.kept(-1.0, 0.0) == 1.0
