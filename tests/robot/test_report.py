"""What `python -m diffsim check` says of a file, and what a scene says of itself."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import gymnasium
import pytest
from scenes import SOFT, parse, pendulum, robot, task_scene, tendon

from diffsim.__main__ import main
from diffsim.robot.mjcf import load_scene
from diffsim.robot.report import report

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"


def test_report_of_a_robot():
    text = report(load_scene(ASSETS / "hopper.xml"))
    for line in (
        "hopper: can be simulated",
        "  links      6 of one degree of freedom, base fixed",
        "  joints     2 slide, 4 hinge; 3 limited",
        "  controls   3 motors",
        "  contact    6 points, ground at z = 0 m",
        "default: mass, shared by 4 contact points, and solref",
        "  - The robot's parts pass through each other: 3 pairs of geoms, such as 'torso_geom' and 'leg_geom'",
        "  - One coefficient of friction, 2, serves all geoms; the file has 1 to 2.",
    ):
        assert line in text


@pytest.mark.parametrize("name", SOFT)
def test_every_task_names_its_constants(name):
    scene = task_scene(name)
    text = report(scene)
    assert "the file" in text and "default" not in text
    assert not scene.d_limit.any()


def test_command(tmp_path, capsys):
    good, bad = ASSETS / "ant.xml", tmp_path / "bad.xml"
    bad.write_text(pendulum('damping="-1"'))
    for path, code in ((good, 0), (tmp_path / "nowhere.xml", 1), (bad, 1)):
        capsys.readouterr()
        with pytest.raises(SystemExit) if code else nullcontext() as exit:
            main(["check", str(path)])
        printed = capsys.readouterr().out
        assert (exit.value.code if exit else 0) == code and ("ant: can be simulated" in printed) == (path == good)
    assert printed.startswith("Cannot be simulated.") and "joint 'hinge': damping is -1" in printed


@pytest.mark.parametrize(
    "mjcf, sentence",
    [
        (pendulum(rest='<actuator><motor name="m" joint="hinge"/></actuator>'), "actuators without ctrlrange: 'm'."),
        (pendulum(inside='<geom size="0.1" margin="0.2"/>'), "not at their margin of up to 0.2 m."),
        (pendulum('range="-1 1" margin="0.1"'), "not at their margin of up to 0.1."),
        (
            pendulum('range="-1 1" solreflimit="1e-4 1"'),
            "faster than substeps of 1/960 s can follow is slowed down: 'hinge'.",
        ),
        (pendulum('axis="0 1 0" damping="1e4"'), "joint 'hinge': semi_implicit needs 20 substeps of 1/60 s"),
        (
            pendulum(inside='<geom size="0.1" condim="1"/>', world='<geom type="plane" size="1 1 1" condim="1"/>'),
            "One coefficient of friction, 1, serves all geoms; the file has 0 to 1.",
        ),
        (pendulum(inside='<geom size="0.1" condim="4"/>'), "Torsional and rolling friction, condim 4 and 6, are left"),
        (
            pendulum(inside='<geom type="cylinder" size="1 2"/><geom type="ellipsoid" size="1 2 3"/>'),
            "points of a shape: 8 of each rim of a cylinder, 14 of an ellipsoid's surface.",
        ),
        (
            robot('<body name="base"><geom name="a" size="1"/><body><joint/><geom name="b" size=".1"/></body></body>'),
            "the geoms 'a' and 'b', would collide in MuJoCo. Geoms of its fixed base are among them.",
        ),
        (
            robot(
                '<body><joint/><geom name="a" size="1" contype="0" conaffinity="0"/></body>'
                '<body><joint/><geom name="b" size="1"/></body>',
                '<contact><pair geom1="b" geom2="a"/></contact>',
            ),
            "The robot's parts pass through each other: the geoms 'a' and 'b', would collide in MuJoCo.",
        ),
        (pendulum(inside='<geom size="0.1"/><geom size="0.05"/>'), "inside others in every pose are left out: 1."),
        (pendulum(inside='<geom size="0.1" solref="0.1 1"/>'), "One solref serves all geoms"),
        (
            robot('<body><freejoint/><geom size="0.1" solref="1e-3 1" priority="1"/></body>'),
            "The ground is softer than solref asks",
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
    assert any(sentence in told for told in parse(mjcf).approximations)


def test_a_robot_that_meets_nothing_is_not_approximated():
    assert parse(pendulum('damping="0.1"', world="")).approximations == ()


def test_a_robot_without_ground_is_told():
    assert "contact    0 points, no ground that it may touch" in report(parse(pendulum(world="")))


def test_an_undamped_robot_gets_an_integrator():
    (sentence,) = parse(pendulum(world="")).approximations
    assert "Nothing damps the joints: semi_implicit drifts in energy; the extrapolated one hardly does." == sentence


@pytest.mark.parametrize(
    "mjcf, sentence",
    [
        (
            pendulum(rest='<actuator><motor name="m" joint="hinge" ctrlrange="-1e38 1e38"/></actuator>'),
            "Actuator 'm' at full control: 6.2e+36 m/s or rad/s after a substep, 100000 at most.",
        ),
        (
            robot("<body><freejoint/>" + "".join(f'<geom pos="{x} 0 0" size="0.1"/>' for x in range(1001)) + "</body>"),
            "1001 contact points are slow: each takes part in every substep.",
        ),
    ],
)
def test_trouble_is_told_at_load(mjcf, sentence):
    """A robot that leaves the finite numbers in its first step, and a slow one."""
    with pytest.warns(UserWarning, match=sentence.replace("+", "[+]")) as told:
        scene = parse(mjcf)
    assert len(told) == 1 and "\n" not in str(told[0].message) and sentence in scene.approximations
