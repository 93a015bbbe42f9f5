"""Gaits: motions whose numbers are known, and those of shipped policies."""

from __future__ import annotations

import csv
from pathlib import Path

import mujoco
import numpy as np
import pytest
from learners import SCRIPTS
from numpy.typing import NDArray

from diffsim import Scene, load_scene
from diffsim.tasks.base import ASSETS
from diffsim.training import evaluation
from diffsim.training.checkpoint import POLICIES
from diffsim_cli import gait

Array = NDArray[np.float64]
DT, STRIDE = 0.01, 50  # s, frames
SETTLED = round(gait.SETTLING / DT)

# A box on two legs that slide up and down, and a wheel: where all are at 0, so are the lowest points of the feet.
BIPED = """
<mujoco>
  <default> <geom contype="1" conaffinity="0"/> <joint type="slide" axis="0 0 1"/> </default>
  <actuator> <motor joint="right" ctrlrange="-100 100"/> <motor joint="left" ctrlrange="0 2"/> </actuator>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1" contype="0" conaffinity="1"/>
    <body name="box" pos="0 0 1">
      <freejoint/> <geom type="box" size=".2 .3 .1" mass="8"/>
      <body name="right_leg"> <joint name="right"/> <geom type="sphere" pos="0 -.2 -.9" size=".1" mass="1"/> </body>
      <body name="left_leg"> <joint name="left"/> <geom type="sphere" pos="0 .2 -.9" size=".1" mass="1"/> </body>
      <body name="wheel" pos="0 0 -.9">
        <joint type="hinge" axis="0 1 0"/> <geom type="sphere" size=".1" mass="1"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def biped(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("robots") / "biped.xml"
    path.write_text(BIPED)
    return load_scene(path)


def steps_of(scene: Scene, duty: tuple[float, float], phase: tuple[float, float], strides: int = 20) -> Array:
    """The biped at 2 m/s; each foot is 20 mm deep for its duty factor from its phase on, and 100 mm high otherwise."""
    time = np.arange(SETTLED + strides * STRIDE)
    qpos = np.tile(scene.qpos0, (len(time), 1))
    qpos[:, 0], qpos[:, 2] = 2.0 * DT * time, qpos[:, 2] + 0.3
    for k in range(2):
        down = (time / STRIDE - phase[k] + 1e-9) % 1.0 < duty[k]
        qpos[:, 7 + k] = np.where(down, -0.32, -0.2)
    return qpos


def measured(scene: Scene, *episodes: Array) -> gait.Gait:
    """The feet's numbers, of motions under actions of 0."""
    parts = gait.measure(scene, DT, ((qpos, np.zeros((len(qpos), scene.nu))) for qpos in episodes))
    return {part: numbers for part, numbers in parts.items() if part != "robot"}


@pytest.mark.parametrize("phase", [0.5, 0.3, 0.96])
def test_numbers_of_a_known_motion(biped: Scene, phase: float) -> None:
    feet = measured(biped, steps_of(biped, (0.4, 0.2), (0.44, 0.44 + phase)))
    assert [*feet] == ["right_leg", "left_leg"]
    right, left = feet.values()
    known = {"steps/s": 2.0, "clearance (m)": 0.1, "slip (m/s)": 2.0, "depth (m)": 0.02}
    assert right == pytest.approx(known | {"duty": 0.4}, abs=1e-6)
    assert left == pytest.approx(known | {"duty": 0.2}, abs=1e-6)
    shown = "duty 0.2, steps/s 2, clearance (m) 0.1, slip (m/s) 2, depth (m) 0.02"
    assert gait.lines(feet)[1].split(maxsplit=1) == ["left_leg", shown]


def test_numbers_of_a_robot(biped: Scene) -> None:
    """At 2 m/s its right leg is pushed down with 50 N, and goes down by 120 mm once a stride of 1 m, and up again."""
    qpos = steps_of(biped, (0.4, 0.2), (0.0, 0.5))
    action = np.full((len(qpos), 2), -0.5)
    action[:, 1] = np.where(np.arange(len(qpos)) % 2, -1.0, 0.5)  # of a weak motor
    robot = gait.measure(biped, DT, [(qpos, action)])["robot"]
    assert robot["left-right"] == pytest.approx(0.2) and robot["diagonal"] == 0.0
    assert robot["action change"] == pytest.approx(1.5 / np.sqrt(2))
    assert robot["saturated"] == pytest.approx(0.25, abs=1e-3)
    assert robot["cost of transport"] == pytest.approx(50 * 0.12 / (11 * 9.81), rel=0.05)


def test_lines_are_of_feet(biped: Scene) -> None:
    """What lies or rolls is no foot, and only four feet have diagonals."""
    qpos = steps_of(biped, (0.4, 0.2), (0.0, 0.5))
    *feet, robot = gait.lines(gait.measure(biped, DT, [(qpos, np.zeros((len(qpos), 2)))]))
    assert [line.split()[0] for line in feet] == ["right_leg", "left_leg"]
    assert robot.startswith("robot") and "left-right 0.2" in robot and "diagonal" not in robot
    qpos[:, 2], qpos[:, 7:9] = 0.995, 0.2  # on its wheel
    lying = gait.measure(biped, DT, [(qpos, np.zeros((len(qpos), 2)))])
    assert [*lying] == ["wheel", "robot"] and gait.lines(lying) == []


def test_a_wheel_that_rolls_does_not_slip(biped: Scene) -> None:
    qpos = steps_of(biped, (0.0, 0.0), (0.0, 0.0))
    qpos[:, 0], qpos[:, 2], qpos[:, 7:9] = 0.1 * DT * np.arange(len(qpos)), 0.995, 0.2
    qpos[:, 9] = qpos[:, 0] / 0.1
    (wheel,) = measured(biped, qpos).values()
    assert wheel["duty"] == 1.0 and wheel["steps/s"] == wheel["clearance (m)"] == 0.0
    assert wheel["slip (m/s)"] < 1e-4 and wheel["depth (m)"] == pytest.approx(0.005)
    qpos[:, 9] *= -1
    assert measured(biped, qpos)["wheel"]["slip (m/s)"] == pytest.approx(0.2, rel=1e-3)


def test_a_foot_that_hardly_touches_is_none(biped: Scene) -> None:
    assert measured(biped, steps_of(biped, (0.0, 0.02), (0.0, 0.5))) == {}
    assert [*measured(biped, steps_of(biped, (0.02, 0.04), (0.0, 0.5)))] == ["left_leg"]


def test_a_bounce_is_no_step() -> None:
    def landings(air: int) -> list[int]:
        return gait.touch_downs(np.array([1.0] * 3 + [0] * 10 + [1] * 2 + [-1] * air + [1] * 4), 1 / 60)

    assert landings(2) == landings(3) == [13] and landings(4) == [13, 19]


def test_only_what_lies_between_the_first_second_and_the_end_counts(biped: Scene) -> None:
    qpos = steps_of(biped, (0.4, 0.4), (0.0, 0.5))
    early = qpos.copy()
    early[: SETTLED - 1, 2] = 0.2
    assert measured(biped, early) == measured(biped, qpos)
    both = measured(biped, early, qpos[:600], qpos[: SETTLED + 1])  # the last one is too short to count
    assert both["left_leg"]["duty"] == pytest.approx(0.4)
    assert both["right_leg"]["steps/s"] == pytest.approx((19 + 9) / 15)  # it stands when they begin
    assert measured(biped, qpos[:5], qpos[: SETTLED + 1]) == {}


def test_a_robot_without_ground_has_no_gait() -> None:
    scene = load_scene(ASSETS / "cartpole.xml")
    assert measured(scene, np.tile(scene.qpos0, (300, 1))) == {}


@pytest.mark.parametrize("name", ["half_cheetah", "humanoid", "humanoid_mtu"])
def test_depth_is_that_of_mujocos_contacts(name: str, rng: np.random.Generator) -> None:
    scene = load_scene(ASSETS / f"{name}.xml")
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    bodies, compared = gait.contact_bodies(scene), 0
    for _ in range(20):
        qpos = scene.qpos0 + 0.2 * rng.standard_normal(scene.nq)
        qpos[1 if name == "half_cheetah" else 2] -= 0.6
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        depth = gait.trace(scene, data.qpos[None].copy())[0][0]
        for body in np.unique(bodies):
            geoms = np.flatnonzero(model.geom_bodyid == body)
            distances = [c.dist for c in data.contact if c.geom2 in geoms or c.geom1 in geoms]
            if distances:
                compared += 1
                assert depth[bodies == body].max() == pytest.approx(-min(distances), abs=1e-9)
            else:
                assert depth[bodies == body].max() <= 0
    assert compared > 50


def test_an_evaluation_reports_the_gait(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(POLICIES / "ant.pt")
    flags = f"--evaluate {path} --eval-episodes 2 --no-implicit --device cpu --run-dir {tmp_path}"
    SCRIPTS["rpo"].main(flags.split())
    returns, *table = capsys.readouterr().out.splitlines()
    parts = gait.Gait()
    with (tmp_path / "gait.csv").open() as file:
        for row in csv.DictReader(file):
            parts.setdefault(row["part"], {})[row["number"]] = float(row["value"])
    assert [*parts] == [*(f"foot_{k}" for k in (1, 2, 3, 4)), "robot"] and table == gait.lines(parts)
    assert returns.startswith("ant, 2 episodes")
    assert evaluation.kept(4.0, 2.0) == evaluation.kept(-2.0, -4.0) == 0.5 and evaluation.kept(0.0, 0.0) == 1.0
    assert evaluation.kept(-1.0, 0.0) == evaluation.kept(-1.0, 2.0) == float("inf")  # no share of a cost
