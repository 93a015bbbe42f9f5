"""What is not simulated, and numbers that no robot has: refused by name, all in one message."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest
from scenes import FLOOR, MUSCLE, parse, pendulum, robot, tendon

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import SceneError


def actuator(kind: str, attributes: str) -> str:
    return pendulum(rest=f'<actuator><{kind} name="m" joint="hinge" {attributes}/></actuator>')


def pair(numbers: str) -> str:
    rest = f'<contact><pair name="couple" geom1="a" geom2="floor" {numbers}/></contact>'
    return pendulum(inside='<geom name="a" size="0.1"/>', rest=rest)


def ball(attributes: str, rest: str = "") -> str:
    return robot(f'<body><joint name="hip" type="ball" {attributes}/><geom size="0.1"/></body>', rest)


NEGATIVE = "armature, damping, stiffness and frictionloss must not be negative"
ONE_PLANE = "contact is simulated with one ground plane only; set contype and conaffinity to 0 if only drawn"
ON_JOINT = "only motors on a hinge, a slide or one axis of a ball joint, position and velocity servos on a hinge"
ON_TENDON = "only <muscle> with a gear of 1 and a ctrlrange within [0, 1], or motors that pull and never push"
TOGETHER = "joint 'a', 'b': these joints together have a motion without inertia"
SPATIAL = "tendon 'string': only spatial tendons through sites, without pulleys or wrapping geoms"
BALL = '<geom size="0.1"/>'
REFUSED = [
    # joints
    (pendulum('frictionloss="-1"'), f"joint 'hinge': {NEGATIVE}"),
    (pendulum('damping="-1"'), f"joint 'hinge': {NEGATIVE}"),
    (pendulum('armature="-1e-3"'), f"joint 'hinge': {NEGATIVE}"),
    (pendulum('stiffness="-1"'), f"joint 'hinge': {NEGATIVE}"),
    (pendulum('damping="1 2"'), "joint 'hinge': damping and stiffness are linear here, one number each"),
    (pendulum('stiffness="1 2"'), "joint 'hinge': damping and stiffness are linear here, one number each"),
    (pendulum('range="-1 1" solreflimit="-1 1"'), "joint 'hinge': solreflimit mixes a positive with another number"),
    (ball('range="0 1" limited="true"'), "joint 'hip': the limit of a ball joint is not simulated"),
    (
        robot(f'<body><joint name="r" type="free" stiffness="1"/>{BALL}</body>'),
        "joint 'r': a free joint has no stiffness or frictionloss here",
    ),
    (
        robot(f'<body><joint name="r" type="free" armature="1"/>{BALL}</body>', '<option density="1"/>'),
        "joint 'r': armature of a free joint in a fluid is not simulated",
    ),
    (
        robot(f'<body gravcomp="1"><joint name="j" actuatorgravcomp="true" actuatorfrcrange="-1 1"/>{BALL}</body>'),
        "joint 'j': actuatorgravcomp within actuatorfrcrange is not simulated",
    ),
    (
        robot(f'<body><joint/>{BALL}</body><body><freejoint name="loose"/>{BALL}</body>'),
        "joint 'loose': one free joint, of the first moving body, is simulated",
    ),
    (
        tendon(joint='<joint name="weak" actuatorfrcrange="-1 1"/>', actuator=f"<muscle {MUSCLE}/>"),
        "joint 'weak': actuatorfrcrange beside muscles is not simulated",
    ),
    # inertia
    (robot('<body><joint name="a"/><joint name="b"/><geom size="0.1" pos="1 0 0"/></body>'), TOGETHER),
    (robot(f'<body><joint name="a" type="slide"/><joint name="b" type="slide"/>{BALL}</body>'), TOGETHER),
    (
        robot(
            '<body><joint name="a" type="slide"/><geom size=".1" mass="1e-8"/>'
            f'<body><joint name="b" type="slide"/>{BALL}</body></body>'
        ),
        TOGETHER,
    ),
    # bodies
    (robot(f"<body>{BALL}</body>"), "file without a joint: there is nothing to simulate"),
    (
        robot(f'<body><freejoint/>{BALL}</body><body name="post"><joint/>{BALL}</body>'),
        "body 'post': a second base beside a floating one",
    ),
    (pendulum(world=f'{FLOOR}<body name="hand" mocap="true"/>'), "body 'hand': mocap is not simulated"),
    (
        pendulum(inside=f'<body name="fin">{BALL}</body>', rest='<option density="1"/>'),
        "body 'fin': in a fluid each body needs a joint; merge its geoms",
    ),
    (
        pendulum(inside='<geom name="hull" size="0.1" fluidshape="ellipsoid"/>', rest='<option density="1"/>'),
        "geom 'hull': fluidshape ellipsoid is not simulated",
    ),
    # contact
    (pendulum(inside='<geom name="foot" size="1" solref="-1 1"/>'), "geom 'foot': solref mixes a positive with"),
    (pendulum(inside='<geom name="foot" size="1" friction="-1"/>'), "geom 'foot': friction and solmix must not be"),
    (pendulum(world=FLOOR.replace("/>", ' solmix="-1"/>')), "geom 'floor': friction and solmix must not be negative"),
    (
        pendulum(world='<geom name="slope" type="plane" size="1 1 1" euler="0.1 0 0"/>'),
        "geom 'slope': the ground plane must be horizontal",
    ),
    (pendulum(world='<geom name="table" type="box" size="1 1 1"/>'), f"geom 'table': {ONE_PLANE}"),
    (pendulum(world='<body><geom name="step" type="box" size="1 1 1"/></body>'), f"geom 'step': {ONE_PLANE}"),
    (pendulum(world=FLOOR + FLOOR.replace("floor", "second")), f"geom 'floor', 'second': {ONE_PLANE}"),
    (
        pendulum(
            world='<geom name="hills" type="hfield" hfield="h"/>',
            rest='<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>',
        ),
        f"geom 'hills': {ONE_PLANE}",
    ),
    (
        pendulum(
            world="",
            inside='<geom name="a" size="0.1"/>',
            rest='<worldbody><geom name="rock" size="1" contype="0"/></worldbody>'
            '<contact><pair geom1="a" geom2="rock"/></contact>',
        ),
        f"geom 'rock': {ONE_PLANE}",
    ),
    (
        pendulum(
            inside='<geom name="rock" type="sdf" mesh="m"/>',
            rest='<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>',
        ),
        "geom 'rock': its shape cannot touch the ground here; set contype",
    ),
    (pair('friction="1 2"'), "pair 'couple': friction differs by direction; it is isotropic here"),
    (pair('friction="-1 -1"'), "pair 'couple': friction must not be negative"),
    (pair('solreffriction="0.1 1"'), "pair 'couple': solreffriction is not simulated"),
    # actuators
    (actuator("position", 'kp="-5"'), "actuator 'm': stiffness and damping of a servo must not be negative"),
    (actuator("velocity", 'kv="-2"'), "actuator 'm': stiffness and damping of a servo must not be negative"),
    (actuator("position", 'kp="5" timeconst="0.1"'), f"actuator 'm': {ON_JOINT}"),
    (actuator("damper", 'kv="1" ctrlrange="0 1"'), f"actuator 'm': {ON_JOINT}"),
    (actuator("general", 'dyntype="filter" dynprm="1"'), f"actuator 'm': {ON_JOINT}"),
    (actuator("motor", 'damping="1"'), "actuator 'm': damping is not simulated"),
    (actuator("motor", 'armature="1"'), "actuator 'm': armature is not simulated"),
    (
        actuator("motor", 'forcerange="-1 1"/><motor joint="hinge"'),
        "actuator 'm': forcerange is simulated of a joint's only actuator",
    ),
    (
        actuator("motor", 'group="2"').replace("<actuator>", '<option actuatorgroupdisable="2"/><actuator>'),
        "actuator 'm': its group is in actuatorgroupdisable; remove the actuator",
    ),
    (
        pendulum(rest='<actuator><adhesion name="glue" body="arm" ctrlrange="0 1"/></actuator>'),
        f"actuator 'glue': {ON_JOINT}",
    ),
    (
        robot(f'<body><freejoint name="r"/>{BALL}</body>', '<actuator><motor name="rocket" joint="r"/></actuator>'),
        f"actuator 'rocket': {ON_JOINT}",
    ),
    (ball("", '<actuator><motor name="m" joint="hip" gear="1 1 0"/></actuator>'), f"actuator 'm': {ON_JOINT}"),
    (ball("", '<actuator><position name="m" joint="hip" gear="1 0 0"/></actuator>'), f"actuator 'm': {ON_JOINT}"),
    # tendons and muscles
    (tendon(spring='stiffness="3"'), "tendon 'string': stiffness of a tendon is not simulated"),
    (tendon(spring='damping="3"'), "tendon 'string': damping of a tendon is not simulated"),
    (tendon('<geom geom="g"/>', actuator=f"<muscle {MUSCLE}/>"), SPATIAL),
    (tendon('<pulley divisor="2"/><site site="w"/><site site="a"/>', actuator=f"<muscle {MUSCLE}/>"), SPATIAL),
    (
        pendulum(
            rest='<tendon><fixed name="string"><joint joint="hinge" coef="1"/></fixed></tendon>'
            '<actuator><motor tendon="string" gear="-1"/></actuator>'
        ),
        SPATIAL,
    ),
    (
        tendon(joint="<freejoint/>", actuator=f"<muscle {MUSCLE}/>"),
        "site 'w': a muscle of a floating robot cannot hold on to the world",
    ),
    (tendon(actuator='<motor name="m" tendon="string"/>'), f"actuator 'm': {ON_TENDON}"),
    (tendon(actuator='<position name="m" tendon="string" kp="1"/>'), f"actuator 'm': {ON_TENDON}"),
    (tendon(actuator=f'<muscle gear="2" {MUSCLE}/>'), f"actuator 'biceps': {ON_TENDON}"),
    (
        tendon(actuator=f'<muscle forcerange="-1 0" {MUSCLE}/>'),
        "actuator 'biceps': forcerange of what pulls a tendon is not simulated",
    ),
    (
        tendon(actuator=f"<muscle {MUSCLE}/>".replace('force="5"', 'force="-5"')),
        "actuator 'biceps': its force follows from what it moves, and it moves nothing; give force",
    ),
    # the file
    (pendulum(rest='<option viscosity="1" wind="1 0 0"/>'), "option wind: only a fluid at rest is simulated"),
    (pendulum(rest='<option density="-1"/>'), "option density: must not be negative"),
    (pendulum(rest='<option viscosity="-1"/>'), "option viscosity: must not be negative"),
    (pendulum(rest='<option><flag actuation="disable"/></option>'), "option flag actuation: cannot be disabled here"),
    (pendulum(rest='<option><flag override="enable"/></option>'), "option flag override: cannot be enabled here"),
    (pendulum(rest='<custom><numeric name="k_n" data="-1"/></custom>'), "numeric k_n: must be one number, not"),
    (pendulum(rest='<custom><numeric name="k_n" data="1 2"/></custom>'), "numeric k_n: must be one number, not"),
    (
        pendulum(rest='<equality><weld name="glue" body1="arm" body2="world"/></equality>'),
        "equality 'glue': equality constraints are not simulated",
    ),
    (
        pendulum(
            rest='<deformable><flex name="rag" dim="1" body="arm arm" vertex="0 0 0 1 0 0" element="0 1"/></deformable>'
        ),
        "flex 'rag': deformable bodies are not simulated",
    ),
    # numbers that no kernel holds
    (pendulum('range="nan 1" limited="true"'), "lower: not finite in single precision"),
    (pendulum('damping="inf"'), "damping: not finite in single precision"),
    (pendulum('stiffness="1e39"'), "stiffness: not finite in single precision"),
    (actuator("motor", 'gear="1e9" ctrlrange="-1e30 1e30"'), "gear: not finite in single precision"),
    (pendulum(rest='<option gravity="0 0 nan"/>'), "gravity: not finite in single precision"),
    (pendulum(rest='<custom><numeric name="mu" data="1e300"/></custom>'), "mu: not finite in single precision"),
    (robot(f'<body pos="nan 0 0"><joint/>{BALL}</body>'), "position: not finite in single precision"),
    # what MuJoCo says
    (pendulum('range="1 1" limited="true"'), "is not a valid MJCF: Error: range[0] should be smaller than range[1]"),
    (robot('<body><freejoint/><geom size="-1"/></body>'), "is not a valid MJCF: Error: size 0 must be positive"),
]


@pytest.mark.parametrize(("mjcf", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_what_is_not_simulated_is_named(mjcf, message):
    with pytest.raises(SceneError, match=re.escape(message)) as error:
        parse(mjcf)
    assert "\n" not in str(error.value) and "robot.xml" in str(error.value)


@pytest.mark.parametrize("text", ["<mujoco><worldbody>", "no xml at all", "<mujoco><bogus/></mujoco>", "", None])
def test_missing_and_broken_files(text, tmp_path):
    file = tmp_path / "robot.xml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(SceneError, match=r"robot file '.*robot.xml' (is not a valid MJCF: |does not exist)") as error:
        load_scene(file)
    assert "\n" not in str(error.value)


def test_thousands_of_contact_points_are_read_in_seconds():
    body = "<body><freejoint/>" + "".join(f'<geom pos="{x} 0 0" size="0.1"/>' for x in range(2000)) + "</body>"
    start = time.perf_counter()
    with pytest.warns(UserWarning, match="2000 contact points are slow: each takes part in every substep"):
        scene = parse(robot(body))
    assert scene.ncontact == 2000 and "2000 contact points" in scene.approximations[0]
    assert time.perf_counter() - start < 30  # all pairs one by one took minutes


def test_all_obstacles_in_one_message():
    """By element, elements with the same obstacle in one line; many names are counted."""
    geoms = "".join(f'<geom name="g{k}" size="1" solref="-1 1"/>' for k in range(31))
    with pytest.raises(SceneError) as error:
        parse(
            pendulum(
                'damping="-2"',
                inside=f'{geoms}<geom size="1" friction="-1"/>',
                rest='<option wind="1 0 0"/><actuator><position name="servo" joint="hinge" kp="-5"/></actuator>',
            )
        )
    first, *rest = str(error.value).split("\n  ")
    assert first == "robot.xml: 5 things keep it from being simulated:"
    assert [line.split(": ")[0] for line in rest] == [
        "option wind",
        "joint 'hinge'",
        "actuator 'servo'",
        "geom number 33 of body 'arm'",
        "geom 'g0', 'g1', 'g2', 'g3', 'g4', 'g5', 'g6', 'g7', and 23 more",
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
