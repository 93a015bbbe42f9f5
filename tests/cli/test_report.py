"""What `python -m diffsim check` says of a file, and what a scene says of itself."""

from __future__ import annotations

import re
from contextlib import nullcontext
from pathlib import Path

import gymnasium
import pytest
from scenes import parse, pendulum, robot, tendon

from diffsim.robot.mjcf import load_scene
from diffsim_cli.commands import main
from diffsim_cli.report import approximations, report, steps_beside_mujoco

LINK = '<body pos=".2 0 0"><joint axis="0 1 0"/><geom size=".02" pos=".1 0 0" contype="0" conaffinity="0"/></body>'


def standing(root: str = "<freejoint/>", geom: str = "", option: str = "") -> str:
    return robot(f'<body pos="0 0 0.1">{root}<geom size="0.1" {geom}/></body>', f"<option {option}/>")


ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


def test_report_of_a_robot():
    text = report(load_scene(ASSETS / "hopper.xml"))
    for line in (
        "hopper: can be simulated",
        "  links      6 of one degree of freedom, base fixed",
        "  joints     4 hinge, 2 slide; 3 limited",
        "  controls   3 motors",
        "  contact    6 points, ground at z = 0 m",
        "  - The robot's parts pass through each other: 3 pairs of geoms, such as 'torso_geom' and 'leg_geom'",
    ):
        assert line in text
    assert "no ground that it may touch" in report(parse(pendulum(world="")))


def test_command(tmp_path, capsys):
    """On the contact of an own robot, MuJoCo's, unless the other one is asked for."""
    (tmp_path / "bad.xml").write_text(pendulum('damping="-1"'))
    (tmp_path / "loss.xml").write_text(pendulum('frictionloss="1"'))
    for words, answer in (
        (f"{ASSETS / 'ant.xml'}", "ant: can be simulated"),
        (f"{tmp_path / 'loss.xml'}", "loss: can be simulated"),
        (f"{tmp_path / 'loss.xml'} --contact soft", "Cannot be simulated.\n\nloss: soft contact has no frictionloss"),
        (f"{tmp_path / 'bad.xml'}", "Cannot be simulated.\n\nbad.xml: joint 'hinge': damping must not be negative"),
        (f"{tmp_path / 'nowhere.xml'}", "Cannot be simulated.\n\nrobot file "),
    ):
        refused = answer.startswith("Cannot")
        with pytest.raises(SystemExit, match="1") if refused else nullcontext():
            main(["check", *words.split()])
        out = capsys.readouterr().out
        assert out.startswith(answer)
        assert ("differs from MuJoCo's by" in out) == (not refused and "soft" not in words)


@pytest.mark.parametrize(
    "mjcf, sentence",
    [
        (pendulum(rest='<actuator><motor name="m" joint="hinge"/></actuator>'), "actuators without ctrlrange: 'm'."),
        (
            standing("<freejoint/>", 'condim="4"'),
            "Left out: torsional and rolling friction (condim 4 and 6; it is 3 here). Without it a step's ",
        ),
        (
            standing('<joint type="free" frictionloss="1"/>'),
            "Left out: frictionloss of a free joint (use <freejoint/>). Without it a step's change of velocity",
        ),
        (
            robot(
                '<body><freejoint/><geom size="0.1"/></body>'
                '<body name="post"><joint/><geom size="1" contype="0" conaffinity="0"/></body>'
            ),
            "Left out, with their actuators: bodies that touch nothing, 'post'.",
        ),
        (pendulum(world='<body name="hand" mocap="true"/>'), "Mocap bodies stay where the file has them: 'hand'."),
        (
            standing(option='noslip_iterations="9"'),
            "Left out: noslip_iterations. Without it a step's ",
        ),
        (
            standing(option='integrator="RK4"'),
            "Left out: integrator RK4, simulated as Euler. Without it a step's change of velocity",
        ),
        (
            standing(f"<freejoint/>{LINK}", option='integrator="implicit"'),
            "Left out: integrator implicit, simulated as implicitfast. Without it a step's change of velocity",
        ),
        (
            standing(option='solver="PGS" iterations="3"'),
            "Left out: a solver that may stop before it converges. Without it a step's",
        ),
        (
            standing(option='integrator="implicitfast" viscosity="1"'),
            "A fluid's drag is that of the velocity before a step; implicitfast takes the one after it.",
        ),
        (
            pendulum(
                rest='<actuator><position name="s" joint="hinge" ctrlrange="0 1"/></actuator><keyframe><key ctrl=".2"/>'
                "</keyframe>"
            ),
            "0 is the middle of a ctrlrange, not the ctrl of the file's keyframe: 0.5, not 0.2, of actuator 's'.",
        ),
        (
            pendulum(inside='<geom type="cylinder" size="1 2"/><geom type="ellipsoid" size="1 2 3"/>'),
            "points of a shape: 8 of each rim of a cylinder (the shape reaches up to 76 mm beyond), 14 of an ellipsoid",
        ),
        (
            robot('<body name="base"><geom name="a" size="1"/><body><joint/><geom name="b" size=".1"/></body></body>'),
            "the geoms 'a' and 'b', would collide in MuJoCo. Geoms of its fixed base are among them.",
        ),
        (
            robot(
                '<body><joint/><geom name="a" size="1" contype="0" conaffinity="0"/>'
                '<body><joint/><geom name="b" size="1"/></body></body>',
                '<contact><pair geom1="b" geom2="a"/></contact>',
            ),
            "The robot's parts pass through each other: the geoms 'a' and 'b', would collide in MuJoCo.",
        ),
        (
            tendon(actuator='<muscle tendon="string" force="5" lengthrange="1 2"/>'),
            "A <muscle> pulls with its activation times its maximum force, without MuJoCo's curves.",
        ),
        (
            robot(
                '<body><freejoint/><geom name="a" size="0.1"/><body><joint/><geom size="0.1"/>'
                '<body pos="0 0 1"><joint/><geom name="b" size="0.1"/></body></body></body>'
            ),
            "The robot's parts pass through each other: the geoms 'a' and 'b', would collide in MuJoCo.",
        ),
    ],
)
def test_approximations_are_told(mjcf, sentence):
    assert any(sentence in told for told in approximations(parse(mjcf)))


def test_controls_and_timestep_are_named():
    joints = "".join(f'<joint name="{axis}" type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    drives = '<motor joint="1 0 0"/><position joint="0 1 0" kp="3"/><velocity joint="0 0 1" kv="2"/>'
    text = robot(f'<body>{joints}<geom size=".1"/></body>', f'<actuator>{drives}</actuator><option timestep="0"/>')
    lines = report(parse(text)).splitlines()
    assert "  controls   1 motors, 1 position servos, 1 velocity servos" in lines
    assert any(line.startswith("  timestep   0 ms in the file, with which MuJoCo cannot step") for line in lines)
    assert "  controls   none" in report(parse(pendulum())).splitlines()


def test_a_robot_that_meets_nothing_is_not_approximated():
    assert approximations(parse(pendulum('damping="0.1"', world=""))) == ()


@pytest.mark.unoptimized
@pytest.mark.parametrize("integrator, least, most", [("implicit", 0, 1e-6), ("Euler", 0, 1e-6), ("RK4", 0.5, 100)])
def test_steps_are_compared_with_mujocos_own(integrator, least, most):
    """With the integrator of the file."""
    scene = parse(standing(geom='pos=".02 .03 0"', option=f'integrator="{integrator}" timestep="0.01"'))
    error = float(re.search(r"by (\S+) %", steps_beside_mujoco(scene))[1])
    assert least <= error < most
