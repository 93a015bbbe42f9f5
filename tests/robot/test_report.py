"""What `python -m diffsim check` says of a file, and what a scene says of itself."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import gymnasium
import pytest
from scenes import parse, pendulum, robot, task_scene, tendon

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
        "  - The robot's parts pass through each other: 3 pairs of geoms, such as 'torso_geom' and 'leg_geom'",
    ):
        assert line in text
    assert "constants" not in text and "no ground that it may touch" in report(parse(pendulum(world="")))


def test_the_constants_of_the_file_are_told():
    text = report(task_scene("ant"))
    assert [line.split()[:2] for line in text.split("limits\n")[1].splitlines()[:6]] == [
        *(["k_n", "4e+04"], ["k_d", "1e+04"], ["k_t", "3000"], ["mu", "0.75"], ["k_limit", "1000"], ["d_limit", "0"])
    ]


def test_command(tmp_path, capsys):
    good, bad = ASSETS / "ant.xml", tmp_path / "bad.xml"
    bad.write_text(pendulum('damping="-1"'))
    for path, code in ((good, 0), (tmp_path / "nowhere.xml", 1), (bad, 1)):
        capsys.readouterr()
        with pytest.raises(SystemExit) if code else nullcontext() as exit:
            main(["check", str(path)])
        printed = capsys.readouterr().out
        assert (exit.value.code if exit else 0) == code and ("ant: can be simulated" in printed) == (path == good)
    assert printed.startswith("Cannot be simulated.") and "joint 'hinge': damping must" in printed


@pytest.mark.parametrize(
    "mjcf, sentence",
    [
        (pendulum(rest='<actuator><motor name="m" joint="hinge"/></actuator>'), "actuators without ctrlrange: 'm'."),
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
