"""What is not simulated, and numbers that no robot has: refused by name, all in one message."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from scenes import FLOOR, MUSCLE, parse, pendulum, robot, tendon

from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import SceneError

MESH = """<asset><mesh name="tetra" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>"""


def cases(build: Callable[[str], str], table: dict[str, str]) -> list[tuple[str, str]]:
    """(MJCF, what its message says) of parts of robots."""
    return [(build(part), culprit) for part, culprit in table.items()]


def with_inside(part: str) -> str:
    return pendulum(inside=part)


def with_world(part: str) -> str:
    return pendulum(world=part)


def with_rest(part: str) -> str:
    return pendulum(rest=part)


def actuated(actuator: str) -> str:
    return pendulum(rest="<actuator>" + actuator.replace("name", 'joint="hinge" name') + "</actuator>")


def numeric(attributes: str) -> str:
    return pendulum(rest=f"<custom><numeric {attributes}/></custom>")


def pulled(actuator: str) -> str:
    return tendon(actuator=actuator)


REFUSED = [
    # attributes of a pendulum's joint
    *cases(
        pendulum,
        {
            'frictionloss="-1"': "joint 'hinge': frictionloss -1 is negative",
            'damping="1 2"': "hinge|damping",
            'stiffness="1 2"': "hinge|stiffness",
            'range="-1 1" solreflimit="-1 1"': "joint 'hinge': solreflimit",
            'damping="-1"': "joint 'hinge': damping is -1, must not be negative",
            'armature="-1"': "joint 'hinge': armature is -1, must not be negative",
            'stiffness="-1"': "joint 'hinge': stiffness is -1, must not be negative",
            'range="nan 1" limited="true"': "joint 'hinge': range is not finite",
            'range="1 1"': "joint 'hinge': range 1 1 is empty",
            'range="1 1" limited="true"': "range.*hinge",
            'range="1 -1"': "joint 'hinge': range 1 -1 is empty",
            'range="-1 1" solreflimit="1e-200 1"': "joint 'hinge': solreflimit is beyond",
        },
    ),
    # geoms of the pendulum
    *cases(
        with_inside,
        {
            '<geom name="rock" type="sdf" mesh="tetra"/>': "rock",
            '<geom name="foot" size="0.1" solref="-1 1"/>': "geom 'foot': solref",
            '<geom name="foot" size="0.1" friction="-1"/>': "geom 'foot': friction is -1",
            '<geom size="0.1" mass="1e30"/>': "body 'arm': the robot weighs 1e\\+30 kg",
        },
    ),
    # what the world holds
    *cases(
        with_world,
        {
            '<geom name="slope" type="plane" size="1 1 1" euler="0.1 0 0"/>': "slope",
            '<geom name="table" type="box" size="1 1 1"/>': "table",
            '<body><geom name="step" type="box" size="1 1 1"/></body>': "step",
            '<geom name="floor" type="plane" size="1 1 1"/>'
            '<geom name="second" type="plane" size="1 1 1" pos="0 0 1"/>': "floor|second",
            '<geom name="floor" type="plane" size="1 1 1"/><body name="hand" mocap="true"/>': "body 'hand': mocap",
        },
    ),
    # actuators of the pendulum
    *cases(
        actuated,
        {
            '<position name="servo" kp="-5"/>': "actuator 'servo': its stiffness .* is -5, must not be negative",
            '<velocity name="drive" kv="-2"/>': "actuator 'drive': its damping .* is -2, must not be negative",
            '<position name="soft" kp="5" timeconst="0.1"/>': "actuator 'soft': only motors .* servos .* activation",
            '<damper name="brake" kv="1" ctrlrange="0 1"/>': "actuator 'brake': only motors",
            '<general name="slow" dyntype="filter" dynprm="1"/>': "slow",
            '<motor name="weak" forcerange="-1 1"/><motor joint="hinge"/>': "'weak': forcerange .* only actuator",
            '<motor name="stiff" damping="1"/>': "stiff|damping",
            '<motor name="heavy" armature="1"/>': "heavy|armature",
            '<motor name="m" ctrlrange="1 -1"/>': "actuator 'm': ctrlrange 1 -1 is empty",
            '<motor name="m" gear="nan"/>': "actuator 'm': gear is not finite",
            '<motor name="m" ctrlrange="-1e39 1e39"/>': "actuator 'm': ctrlrange is not finite",
            '<motor name="m" gear="1e9" ctrlrange="-1e30 1e30"/>': "actuator 'm': its force is beyond single precision",
        },
    ),
    # constants
    *cases(
        numeric,
        {
            'name="k_n" data="-1"': "k_n",
            'name="k_nn" data="1"': "numeric 'k_nn': not one of .*; did you mean 'k_n'",
            'name="kn" data="1"': "numeric 'kn': not one of .*; did you mean 'k_n'",
            'name="K_T" data="1"': "numeric 'K_T': not one of .*; did you mean 'k_t'",
            'name="klimit" data="1"': "numeric 'klimit': not one of .*; did you mean 'k_limit'",
            'name="mu_" data="1"': "numeric 'mu_': not one of .*; did you mean 'mu'",
            'name="muscle_strenght" data="1"': "did you mean 'muscle_strength'",
            'name="k_n" data="1 2"': "numeric 'k_n': 1 2, must be one number",
            'name="mu" data="nan"': "numeric 'mu': nan",
            'name="k_n" data="1e300"': "numeric 'k_n': 1e\\+300, must be one number, finite",
            'name="muscle_strength" data="1e300"': "numeric 'muscle_strength': 1e\\+300, must be one number, finite",
        },
    ),
    # whatever else a file holds
    *cases(
        with_rest,
        {
            '<tendon><fixed name="string"><joint joint="hinge" coef="1"/></fixed></tendon>'
            '<actuator><motor tendon="string" gear="-1"/></actuator>': "string",
            '<option viscosity="1" wind="1 0 0"/>': "wind",
            '<option><flag actuation="disable"/></option>': "option flag actuation: ",
            '<option><flag override="enable"/></option>': "option flag override: ",
            '<option actuatorgroupdisable="2"/><actuator><motor name="m" joint="hinge" group="2"/></actuator>': (
                "actuator 'm': .*actuatorgroupdisable"
            ),
            '<actuator><adhesion name="glue" body="arm" ctrlrange="0 1"/></actuator>': "actuator 'glue': only motors",
            '<deformable><flex name="rag" dim="1" body="arm arm" vertex="0 0 0 1 0 0" element="0 1"/></deformable>': (
                "flex 'rag'"
            ),
            '<custom><text name="muscle_modle" data="linear"/></custom>': (
                "text 'muscle_modle': not one of muscle_model; did you mean 'muscle_model'"
            ),
            '<option gravity="0 0 nan"/>': "option gravity: not finite",
            '<option density="-1"/>': "option density: -1, must not be negative",
            '<option viscosity="-1"/>': "option viscosity: -1, must not be negative",
        },
    ),
    # other robots
    *cases(
        robot,
        {
            '<body><joint name="hip" type="ball" range="0 1" limited="true"/><geom size="0.1"/></body>': "hip",
            '<body><joint name="r" type="free" stiffness="1"/><geom size="0.1"/></body>': "joint 'r': .* no stiffness",
            '<body name="kite" gravcomp="nan"><freejoint/><geom size="0.1"/></body>': "body 'kite': gravcomp is not",
            '<body name="lead" gravcomp="-1"><freejoint/><geom size="0.1"/></body>': "body 'lead': gravcomp is -1",
            '<body gravcomp="1"><joint name="j" actuatorgravcomp="true" actuatorfrcrange="-1 1"/>'
            '<geom size="0.1"/></body>': "joint 'j': actuatorgravcomp within actuatorfrcrange",
            '<body name="one"><freejoint name="one"/><geom size="0.1"/></body>'
            '<body name="two"><freejoint name="two"/><geom size="0.1"/></body>': "two",
            '<body><freejoint/><geom size="0.1"/></body><body name="post"><joint/><geom size="0.1"/></body>': "post",
            '<body><joint/><geom size="0.1"/></body><body><freejoint name="loose"/><geom size="0.1"/></body>': "loose",
            '<body><geom size="0.1"/></body>': "without a joint",
            '<body><joint name="a"/><joint name="b"/><geom size="0.1" pos="1 0 0"/></body>': (
                "joint 'a', 'b': these joints together"
            ),
            '<body name="b" pos="nan 0 0"><joint/><geom size="1"/></body>': "body 'b': pos",
            '<body name="v"><freejoint/><geom size="0.1" mass="1e-12"/></body>': "body 'v': the robot weighs 1e-12 kg",
            '<body name="b"><freejoint/><geom name="g" size="0.1" mass="-1"/></body>': "negative.*'g'",
            '<body name="b"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="0 0 0"/></body>': "inertia.*'b'",
            '<body name="b"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/></body>': "inertia.*'b'",
            '<body><freejoint/><geom name="foot" size="0.1" solref="1e-200 1" priority="1"/></body>': (
                "geom 'foot': solref is beyond single precision"
            ),
            '<body><joint name="a" type="slide" axis="1 0 0"/>'
            '<joint name="b" type="slide" axis="1 0 0"/><geom size="0.1"/></body>': (
                "joint 'a', 'b': these joints together"
            ),
            '<body><joint name="a" type="slide"/><geom size=".1" mass="1e-08"/><body>'
            '<joint name="b" type="slide"/><geom size=".1" mass="1"/></body></body>': (
                "joint 'a', 'b': these joints together"
            ),
        },
    ),
    # muscles
    *cases(
        pulled,
        {
            '<motor name="pusher" tendon="string"/>': "pusher.*never push",
            '<position name="servo" tendon="string" kp="1"/>': "servo",
            f'<muscle gear="2" {MUSCLE}/>': "biceps.*gear",
            f'<muscle forcerange="-1 0" {MUSCLE}/>': "actuator 'biceps': forcerange of what pulls",
            '<muscle name="biceps" tendon="string" force="-5" lengthrange="1 2"/>': (
                "actuator 'biceps': its force follows from what it moves, and it moves nothing; give force"
            ),
        },
    ),
    (
        tendon(joint='<joint name="weak" actuatorfrcrange="-1 1"/>', actuator=f"<muscle {MUSCLE}/>"),
        "joint 'weak': actuatorfrcrange beside muscles",
    ),
    (tendon('<geom geom="g"/>', actuator=f"<muscle {MUSCLE}/>"), "string"),
    (tendon('<pulley divisor="2"/><site site="w"/><site site="a"/>', actuator=f"<muscle {MUSCLE}/>"), "string"),
    (tendon(spring='stiffness="3"'), "string.*stiffness"),
    (tendon(spring='damping="3"'), "string.*damping"),
    (tendon(joint="<freejoint/>", actuator=f"<muscle {MUSCLE}/>"), "'w'"),
    (tendon(custom='<text name="muscle_model" data="hill"/>'), "muscle_model': 'hill' is not simulated"),
    # several parts of a file
    (
        robot(
            '<body name="a"><freejoint/><geom size="0.1"/></body>',
            '<equality><weld name="glue" body1="a" body2="world"/></equality>',
        ),
        "glue",
    ),
    *(
        (
            pendulum(
                inside='<geom name="a" size="0.1"/>',
                rest=f'<contact><pair name="couple" geom1="a" geom2="floor" {numbers}/></contact>',
            ),
            f"pair 'couple': {what}",
        )
        for numbers, what in {
            'friction="1 2"': "friction 1 2 differs by direction",
            'friction="-1 -1"': "friction is -1, must not be negative",
            'solreffriction="0.1 1"': "solreffriction",
        }.items()
    ),
    (
        pendulum(
            world="",
            inside='<geom name="a" size="0.1"/>',
            rest='<worldbody><geom name="rock" size="1" contype="0"/></worldbody>'
            '<contact><pair geom1="a" geom2="rock"/></contact>',
        ),
        "geom 'rock': contact is simulated with one ground plane",
    ),
    (
        robot(
            '<body><freejoint name="root"/><geom size="0.1"/></body>',
            '<actuator><motor name="rocket" joint="root"/></actuator>',
        ),
        "rocket",
    ),
    *(
        (
            robot(
                '<body><joint name="hip" type="ball"/><geom size="0.1"/></body>',
                f'<actuator><{actuator} name="twist" joint="hip" gear="1 {second} 0"/></actuator>',
            ),
            "twist.*one axis of a ball joint",
        )
        for actuator, second in (("motor", 1), ("position", 0))
    ),
    (
        robot('<body><joint name="r" type="free" armature="1"/><geom size="0.1"/></body>', '<option density="1"/>'),
        "joint 'r': armature of a free joint in a fluid",
    ),
    (pendulum(inside='<geom name="hull" size="0.1" fluidshape="ellipsoid"/>', rest='<option density="1"/>'), "hull"),
    (pendulum(inside='<body name="fin"><geom size="0.1"/></body>', rest='<option density="1"/>'), "fin"),
    (
        pendulum(
            world='<geom name="hills" type="hfield" hfield="h"/>',
            rest='<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>',
        ),
        "geom 'hills': contact is simulated with one ground plane",
    ),
    # numbers
    *(
        (pendulum(f'{what}="{value}"'), f"joint 'hinge': {what} is not finite")
        for what in ("damping", "armature", "stiffness")
        for value in ("nan", "inf", "1e39")
    ),
    *(
        (pendulum(world=FLOOR.replace("/>", f' solmix="{value}"/>')), f"geom 'floor': solmix is {message}")
        for value, message in (("-1", "-1, must not be negative"), ("nan", "not finite"), ("inf", "not finite"))
    ),
    # too much
    (
        robot("<body><freejoint/>" + '<geom type="box" size="1 1 1" mass="1"/>' * 1251 + "</body>"),
        "contact 10008 points: at most 10000 are simulated",
    ),
    (robot("<!--" + 3_000_000 * "-" + "-->"), "robot.xml' has 3 MB, at most 2"),
]


@pytest.mark.parametrize(("mjcf", "culprit"), REFUSED, ids=[culprit for _, culprit in REFUSED])
def test_what_is_not_simulated_is_named(mjcf, culprit):
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
                'frictionloss="-1" damping="-2"',
                inside='<geom name="egg" size="1" solref="-1 1"/><geom name="can" size="1" solref="-1 1"/>'
                '<geom size="1" solref="-1 1"/>',
                rest='<option wind="1 0 0"/><actuator><position name="servo" joint="hinge" kp="-5"/></actuator>'
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


def test_many_names_are_counted():
    geoms = "".join(f'<geom name="g{k}" size="1" solref="-1 1"/>' for k in range(31))
    with pytest.raises(SceneError, match="geom 'g0', 'g1', .*'g7', and 23 more: solref") as error:
        parse(pendulum(inside=geoms))
    assert len(str(error.value)) < 200


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
