"""What is not simulated, and numbers that no robot has: refused by name, all in one message."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scenes import MUSCLE, parse, pendulum, robot, tendon

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import SceneError

FLOOR = '<geom name="floor" type="plane" size="1 1 1"/>'
MESH = """<asset><mesh name="tetra" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>"""
REFUSED = {
    "mesh in contact": (pendulum(inside='<geom name="hull" type="mesh" mesh="tetra"/>', rest=MESH), "hull"),
    "ellipsoid in contact": (pendulum(inside='<geom name="egg" type="ellipsoid" size="1 2 3"/>'), "egg"),
    "cylinder in contact": (pendulum(inside='<geom name="can" type="cylinder" size="1 2"/>'), "can"),
    "tilted ground": (pendulum(world='<geom name="slope" type="plane" size="1 1 1" euler="0.1 0 0"/>'), "slope"),
    "ground that is a box": (pendulum(world='<geom name="table" type="box" size="1 1 1"/>'), "table"),
    "two grounds": (
        pendulum(world=FLOOR + '<geom name="second" type="plane" size="1 1 1" pos="0 0 1"/>'),
        "floor|second",
    ),
    "equality": (
        robot(
            '<body name="a"><freejoint/><geom size="0.1"/></body>',
            '<equality><weld name="glue" body1="a" body2="world"/></equality>',
        ),
        "glue",
    ),
    "motor on a fixed tendon": (
        pendulum(
            rest='<tendon><fixed name="string"><joint joint="hinge" coef="1"/></fixed></tendon>'
            '<actuator><motor tendon="string" gear="-1"/></actuator>'
        ),
        "string",
    ),
    "muscle around a geom": (tendon('<geom geom="g"/>', actuator=f"<muscle {MUSCLE}/>"), "string"),
    "muscle on a pulley": (
        tendon('<pulley divisor="2"/><site site="w"/><site site="a"/>', actuator=f"<muscle {MUSCLE}/>"),
        "string",
    ),
    "elastic tendon": (tendon(spring='stiffness="3"'), "string.*stiffness"),
    "tendon with a damper": (tendon(spring='damping="3"'), "string.*damping"),
    "muscle that pushes": (tendon(actuator='<motor name="pusher" tendon="string"/>'), "pusher.*never push"),
    "position actuator on a tendon": (tendon(actuator='<position name="servo" tendon="string" kp="1"/>'), "servo"),
    "muscle with a gear": (tendon(actuator=f'<muscle gear="2" {MUSCLE}/>'), "biceps.*gear"),
    "muscle on the world beside a floating base": (tendon(joint="<freejoint/>", actuator=f"<muscle {MUSCLE}/>"), "'w'"),
    "unknown model of muscles": (tendon(custom='<text name="muscle_model" data="rubber"/>'), "rubber.*linear, hill"),
    "Hill-type model of a plain actuator": (
        tendon(
            actuator='<motor name="rope" tendon="string" gear="-1" ctrlrange="0 1" ctrllimited="true"/>',
            custom='<text name="muscle_model" data="hill"/>',
        ),
        "rope.*<muscle>",
    ),
    "contact pair": (
        pendulum(
            inside='<geom name="a" size="0.1"/>',
            rest='<contact><pair name="couple" geom1="a" geom2="floor"/></contact>',
        ),
        "couple",
    ),
    "position actuator": (pendulum(rest='<actuator><position name="servo" joint="hinge" kp="5"/></actuator>'), "servo"),
    "velocity actuator": (pendulum(rest='<actuator><velocity name="drive" joint="hinge"/></actuator>'), "drive"),
    "motor with a filter": (
        pendulum(rest='<actuator><general name="slow" joint="hinge" dyntype="filter" dynprm="1"/></actuator>'),
        "slow",
    ),
    "motor with a force range": (
        pendulum(rest='<actuator><motor name="weak" joint="hinge" forcerange="-1 1"/></actuator>'),
        "weak",
    ),
    "motor on a free joint": (
        robot(
            '<body><freejoint name="root"/><geom size="0.1"/></body>',
            '<actuator><motor name="rocket" joint="root"/></actuator>',
        ),
        "rocket",
    ),
    "joint with a force range": (pendulum('actuatorfrcrange="-1 1"'), "hinge"),
    "motor with damping": (
        pendulum(rest='<actuator><motor name="stiff" joint="hinge" damping="1"/></actuator>'),
        "stiff|damping",
    ),
    "motor with armature": (
        pendulum(rest='<actuator><motor name="heavy" joint="hinge" armature="1"/></actuator>'),
        "heavy|armature",
    ),
    "ball joint with a limit": (
        robot('<body><joint name="hip" type="ball" range="0 1" limited="true"/><geom size="0.1"/></body>'),
        "hip",
    ),
    "motor on a ball joint about a slanted axis": (
        robot(
            '<body><joint name="hip" type="ball"/><geom size="0.1"/></body>',
            '<actuator><motor name="twist" joint="hip" gear="1 1 0"/></actuator>',
        ),
        "twist.*one axis of a ball joint",
    ),
    "free joint with damping": (robot('<body><joint name="r" type="free" damping="1"/><geom size="0.1"/></body>'), "r"),
    "free joint with armature": (
        robot('<body><joint name="r" type="free" armature="1"/><geom size="0.1"/></body>'),
        "r",
    ),
    "dry friction": (pendulum('frictionloss="1"'), "hinge"),
    "damping polynomial": (pendulum('damping="1 2"'), "hinge|damping"),
    "stiffness polynomial": (pendulum('stiffness="1 2"'), "hinge|stiffness"),
    "gravity compensation": (robot('<body name="kite" gravcomp="1"><freejoint/><geom size="0.1"/></body>'), "kite"),
    "two floating bodies": (
        robot(
            '<body name="one"><freejoint name="one"/><geom size="0.1"/></body>'
            '<body name="two"><freejoint name="two"/><geom size="0.1"/></body>'
        ),
        "two",
    ),
    "fixed beside floating": (
        robot('<body><freejoint/><geom size="0.1"/></body><body name="post"><joint/><geom size="0.1"/></body>'),
        "post",
    ),
    "floating beside fixed": (
        robot('<body><joint/><geom size="0.1"/></body><body><freejoint name="loose"/><geom size="0.1"/></body>'),
        "loose",
    ),
    "wind": (pendulum(rest='<option viscosity="1" wind="1 0 0"/>'), "wind"),
    "ellipsoid in a fluid": (
        pendulum(inside='<geom name="hull" size="0.1" fluidshape="ellipsoid"/>', rest='<option density="1"/>'),
        "hull",
    ),
    "welded in a fluid": (
        pendulum(inside='<body name="fin"><geom size="0.1"/></body>', rest='<option density="1"/>'),
        "fin",
    ),
    "no joint": (robot('<body><geom size="0.1"/></body>'), "without a joint"),
    "negative penalty": (pendulum(rest='<custom><numeric name="k_n" data="-1"/></custom>'), "k_n"),
    # flags and options
    **{
        f"flag {flag}": (pendulum(rest=f'<option><flag {flag}="{state}"/></option>'), f"option flag {flag}: ")
        for flag, state in (("actuation", "disable"), ("override", "enable"))
    },
    "actuators of a disabled group": (
        pendulum(
            rest='<option actuatorgroupdisable="2"/><actuator><motor name="m" joint="hinge" group="2"/></actuator>'
        ),
        "actuator 'm': .*actuatorgroupdisable",
    ),
    # elements
    "adhesion": (
        pendulum(rest='<actuator><adhesion name="glue" body="arm" ctrlrange="0 1"/></actuator>'),
        "actuator 'glue': only motors",
    ),
    "deformable body": (
        pendulum(
            rest='<deformable><flex name="rag" dim="1" body="arm arm" vertex="0 0 0 1 0 0" element="0 1"/></deformable>'
        ),
        "flex 'rag'",
    ),
    "mocap body": (pendulum(world=FLOOR + '<body name="hand" mocap="true"/>'), "body 'hand': mocap"),
    "height field": (
        pendulum(
            world='<geom name="hills" type="hfield" hfield="h"/>',
            rest='<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>',
        ),
        "geom 'hills': contact is simulated with one ground plane",
    ),
    "two joints that do the same": (
        robot('<body><joint name="a"/><joint name="b"/><geom size="0.1" pos="1 0 0"/></body>'),
        "joint 'a', 'b': these joints together",
    ),
    # contact
    **{
        f"condim {n}": (
            pendulum(inside=f'<geom name="foot" size="0.1" condim="{n}"/>'),
            f"geom 'foot': condim {n}: .*condim 3",
        )
        for n in (4, 6)
    },
    "frictionless beside others": (
        pendulum(
            inside='<geom name="ice" size="0.1" condim="1"/>', world='<geom type="plane" size="1 1 1" condim="1"/>'
        ),
        "geom 'ice': condim 1",
    ),
    "solref of mixed signs": (pendulum(inside='<geom name="foot" size="0.1" solref="-1 1"/>'), "geom 'foot': solref"),
    "solreflimit of mixed signs": (pendulum('range="-1 1" solreflimit="-1 1"'), "joint 'hinge': solreflimit"),
    # names
    **{
        f"numeric {name}": (
            pendulum(rest=f'<custom><numeric name="{name}" data="1"/></custom>'),
            f"numeric '{name}': not one of .*; did you mean '{meant}'",
        )
        for name, meant in (("k_nn", "k_n"), ("kn", "k_n"), ("K_T", "k_t"), ("klimit", "k_limit"), ("mu_", "mu"))
    },
    "numeric muscle_strenght": (
        pendulum(rest='<custom><numeric name="muscle_strenght" data="1"/></custom>'),
        "did you mean 'muscle_strength'",
    ),
    "text muscle_modle": (
        pendulum(rest='<custom><text name="muscle_modle" data="hill"/></custom>'),
        "text 'muscle_modle': not one of muscle_model; did you mean 'muscle_model'",
    ),
    # numbers
    "numeric with two numbers": (
        pendulum(rest='<custom><numeric name="k_n" data="1 2"/></custom>'),
        "numeric 'k_n': 1 2, must be one number",
    ),
    "numeric that is not a number": (
        pendulum(rest='<custom><numeric name="mu" data="nan"/></custom>'),
        "numeric 'mu': nan",
    ),
    **{
        f"{what} {value}": (pendulum(f'{what}="{value}"'), f"joint 'hinge': {what} is {message}")
        for what in ("damping", "armature", "stiffness")
        for value, message in (
            ("-1", "-1, must not be negative"),
            *((value, "not finite") for value in ("nan", "inf", "1e39")),
        )
    },
    "position that is not a number": (
        robot('<body name="b" pos="nan 0 0"><joint/><geom size="1"/></body>'),
        "body 'b': pos",
    ),
    "range that is not a number": (pendulum('range="nan 1" limited="true"'), "joint 'hinge': range is not finite"),
    "empty range": (pendulum('range="1 1"'), "joint 'hinge': range 1 1 is empty"),
    "range of a limited joint without length": (pendulum('range="1 1" limited="true"'), "range.*hinge"),
    "range the wrong way round": (pendulum('range="1 -1"'), "joint 'hinge': range 1 -1 is empty"),
    "ctrlrange the wrong way round": (
        pendulum(rest='<actuator><motor name="m" joint="hinge" ctrlrange="1 -1"/></actuator>'),
        "actuator 'm': ctrlrange 1 -1 is empty",
    ),
    "gear that is not a number": (
        pendulum(rest='<actuator><motor name="m" joint="hinge" gear="nan"/></actuator>'),
        "actuator 'm': gear is not finite",
    ),
    "negative friction": (
        pendulum(inside='<geom name="foot" size="0.1" friction="-1"/>'),
        "geom 'foot': friction is -1",
    ),
    "gravity that is not a number": (pendulum(rest='<option gravity="0 0 nan"/>'), "option gravity: not finite"),
    "negative density": (pendulum(rest='<option density="-1"/>'), "option density: -1, must not be negative"),
    "negative viscosity": (pendulum(rest='<option viscosity="-1"/>'), "option viscosity: -1, must not be negative"),
    "mass of a planet": (pendulum(inside='<geom size="0.1" mass="1e30"/>'), "body 'arm': the robot weighs 1e\\+30 kg"),
    "mass of a virus": (
        robot('<body name="v"><freejoint/><geom size="0.1" mass="1e-12"/></body>'),
        "body 'v': the robot weighs 1e-12 kg",
    ),
    "negative mass": (
        robot('<body name="b"><freejoint/><geom name="g" size="0.1" mass="-1"/></body>'),
        "negative.*'g'",
    ),
    "inertia without a body": (
        robot('<body name="b"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="0 0 0"/></body>'),
        "inertia.*'b'",
    ),
    "impossible inertia": (
        robot('<body name="b"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/></body>'),
        "inertia.*'b'",
    ),
    **{
        f"solmix {value}": (
            pendulum(world=f'<geom name="floor" type="plane" size="1 1 1" solmix="{value}"/>'),
            f"geom 'floor': solmix is {message}",
        )
        for value, message in (("-1", "-1, must not be negative"), ("nan", "not finite"), ("inf", "not finite"))
    },
    "solref of nearly 0": (
        robot('<body><freejoint/><geom name="foot" size="0.1" solref="1e-200 1" priority="1"/></body>'),
        "geom 'foot': solref is beyond single precision",
    ),
    "solreflimit of nearly 0": (
        pendulum('range="-1 1" solreflimit="1e-200 1"'),
        "joint 'hinge': solreflimit is beyond",
    ),
    "ctrlrange beyond single precision": (
        pendulum(rest='<actuator><motor name="m" joint="hinge" ctrlrange="-1e39 1e39"/></actuator>'),
        "actuator 'm': ctrlrange is not finite",
    ),
    "force beyond single precision": (
        pendulum(rest='<actuator><motor name="m" joint="hinge" gear="1e9" ctrlrange="-1e30 1e30"/></actuator>'),
        "actuator 'm': its force is beyond single precision",
    ),
    **{
        f"{name} beyond single precision": (
            pendulum(rest=f'<custom><numeric name="{name}" data="1e300"/></custom>'),
            f"numeric '{name}': 1e\\+300, must be one number, finite",
        )
        for name in ("k_n", "muscle_strength")
    },
    "muscle whose force follows from nothing": (
        tendon(actuator='<muscle name="biceps" tendon="string" force="-5" lengthrange="1 2"/>'),
        "actuator 'biceps': its force follows from what it moves, and it moves nothing; give force",
    ),
    "two slides on one axis": (
        robot(
            '<body><joint name="a" type="slide" axis="1 0 0"/><joint name="b" type="slide" axis="1 0 0"/>'
            '<geom size="0.1"/></body>'
        ),
        "joint 'a', 'b': these joints together have a motion without inertia",
    ),
    "parallel slides of next to no mass": (
        robot(
            "".join(
                f'<body><joint name="{j}" type="slide"/><geom size=".1" mass="{m}"/>'
                for j, m in (("a", 1e-8), ("b", 1))
            )
            + "</body></body>"
        ),
        "joint 'a', 'b': these joints together have a motion without inertia",
    ),
    "more contact points than are simulated": (
        robot("<body><freejoint/>" + '<geom type="box" size="1 1 1" mass="1"/>' * 1251 + "</body>"),
        "contact 10008 points: at most 10000 are simulated",
    ),
    "a file that takes minutes": (robot("<!--" + 3_000_000 * "-" + "-->"), "robot.xml' has 3 MB, at most 2"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_not_simulated_is_named(what):
    mjcf, culprit = REFUSED[what]
    with pytest.raises(SceneError, match=culprit) as error:
        parse(mjcf)
    assert "\n" not in str(error.value) and "robot.xml" in str(error.value)


@pytest.mark.parametrize("mjcf", [pendulum('frictionloss="1"'), pendulum()])
def test_names_in_another_encoding_are_refused(mjcf, tmp_path):
    file = tmp_path / "robot.xml"
    file.write_bytes(mjcf.replace('"hinge"', '"h\xfcfte"').encode("latin-1"))
    with pytest.raises(SceneError, match="robot.xml: names must be in UTF-8, and 'hüfte' is not") as error:
        load_scene(file)
    assert "\n" not in str(error.value)


def test_thousands_of_contact_points_are_read_in_seconds():
    body = "<body><freejoint/>" + "".join(f'<geom pos="{x} 0 0" size="0.1"/>' for x in range(2000)) + "</body>"
    start = time.perf_counter()
    with pytest.warns(UserWarning, match="2000 contact points are slow"):
        assert parse(robot(body)).ncontact == 2000
    assert time.perf_counter() - start < 30  # all pairs one by one took minutes


def test_all_obstacles_in_one_message():
    """By element, elements with the same obstacle in one line."""
    with pytest.raises(SceneError) as error:
        parse(
            pendulum(
                'frictionloss="1" damping="-2"',
                inside='<geom name="egg" type="ellipsoid" size="1 2 3"/><geom name="can" type="cylinder" size="1 2"/>'
                '<geom type="cylinder" size="1 2"/>',
                rest='<option wind="1 0 0"/><actuator><position name="servo" joint="hinge" kp="5"/></actuator>'
                '<custom><numeric name="k_nn" data="1"/></custom>',
            )
        )
    first, *rest = str(error.value).split("\n  ")
    assert first == "robot.xml: 6 things keep it from being simulated:"
    assert [line.split(": ")[0] for line in rest] == [
        "joint 'hinge'",
        "numeric 'k_nn'",
        "option wind",
        "joint 'hinge'",
        "actuator 'servo'",
        "geom 'egg', 'can', number 4 of body 'arm'",
    ]


@pytest.mark.parametrize(
    "flag, changes",
    {
        "gravity": dict(gravity=[0, 0, 0]),
        "contact": dict(ncontact=0),
        "limit": dict(upper=[np.inf, np.inf]),
        "spring": dict(stiffness=[0, 0]),
        "damper": dict(damping=[0, 0]),
        "constraint": dict(ncontact=0, upper=[np.inf, np.inf]),
    }.items(),
)
def test_disabled_flags_are_obeyed(flag, changes):
    joint = 'damping="1" stiffness="2" range="-1 1"'
    scene = parse(pendulum(joint, rest=f'<option><flag {flag}="disable"/></option>'))
    plain = dict(gravity=[0, 0, -9.81], ncontact=1, upper=[np.inf, 1], stiffness=[0, 2], damping=[0, 1])
    for name, value in (plain | changes).items():
        np.testing.assert_array_equal(getattr(scene, name), value, err_msg=name)


def test_what_a_flag_switches_off_is_no_obstacle():
    weld = '<equality><weld body1="arm" body2="world"/></equality>'
    off = '<flag equality="disable" frictionloss="disable" spring="disable" damper="disable"/>'
    scene = parse(pendulum('frictionloss="1"', rest=f'{weld}<option viscosity="1">{off}</option>'))
    assert scene.features == {"hinge", "contact"}  # without springs and dampers MuJoCo has no drag either
    parse(pendulum(rest='<equality><weld body1="arm" body2="world" active="false"/></equality>'))


def test_what_has_no_effect_is_no_obstacle():
    """MuJoCo's numerical methods, drawings, sensors, keyframes, other names, tendons without force."""
    scene = parse(
        tendon(
            more='<geom geom="g"/>',
            custom='<numeric name="init_qpos" data="0 0"/><numeric name="max_contact_points" data="5"/>'
            '<text name="author" data="me"/>',
        ).replace(
            "</mujoco>",
            '<option cone="elliptic"><flag warmstart="disable" energy="enable" eulerdamp="disable"/></option>'
            '<sensor><clock/></sensor><keyframe><key qpos="0"/></keyframe></mujoco>',
        )
    )
    assert scene.features == {"hinge", "contact"}
