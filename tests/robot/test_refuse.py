"""What is not simulated, and numbers that no robot has: refused by name, all in one message."""

from __future__ import annotations

import re
import time

import numpy as np
import pytest
from scenes import FLOOR, MUSCLE, parse, pendulum, robot, tendon

from diffsim.robot.mjcf import load_scene
from diffsim.robot.types import SceneError

BALL = '<geom size="0.1"/>'
MUSCLES = f"<muscle {MUSCLE}/>"


def actuator(kind: str, attributes: str) -> str:
    return pendulum(rest=f'<actuator><{kind} name="m" joint="hinge" {attributes}/></actuator>')


def pair(numbers: str) -> str:
    rest = f'<contact><pair name="couple" geom1="a" geom2="floor" {numbers}/></contact>'
    return pendulum(inside='<geom name="a" size="0.1"/>', rest=rest)


def free(attributes: str, rest: str = "") -> str:
    return robot(f'<body><joint name="r" type="free" {attributes}/>{BALL}</body>', rest)


def ball(attributes: str, rest: str = "") -> str:
    return robot(f'<body><joint name="hip" type="ball" {attributes}/>{BALL}</body>', rest)


def slides(mass: str) -> str:
    """Two in a row, of which the first moves little."""
    body = f'<body><joint name="b" type="slide"/>{BALL}</body>'
    return robot(f'<body><joint name="a" type="slide"/><geom size=".1" mass="{mass}"/>{body}</body>')


def asset(geom: str, content: str) -> str:
    return pendulum(inside=f'<geom name="rock" {geom}/>', rest=f"<asset>{content}</asset>")


HILLS = '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>'
TETRAHEDRON = '<mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'
FIXED = '<tendon><fixed name="string"><joint joint="hinge" coef="1"/></fixed></tendon>'
CHAIN = """
<mujoco> <option integrator="Euler"/>
  <worldbody> <body> <joint name="a"/> <geom size="1"/> <body> <joint axis="1 0 0"/> <geom size="1"/>
    <body> <joint name="b"/> <geom size="1"/> </body> </body> <body> <joint name="c"/> <geom size="1"/> </body> </body>
  </worldbody>
  <tendon>
    <fixed name="t"> <joint joint="b" coef="1"/> <joint joint="a" coef="1"/> </fixed>
    <fixed name="all"> <joint joint="b" coef="1"/> <joint joint="a" coef="1"/> <joint joint="c" coef="1"/> </fixed>
  </tendon>
  <actuator> <velocity name="m" tendon="t"/> {} </actuator>
</mujoco>"""
CHAINS = '<position tendon="t" kv="1"/>', '<velocity tendon="all"/>'
RAG = '<flex name="rag" dim="1" body="arm arm" vertex="0 0 0 1 0 0" element="0 1"/>'
REFUSED = {  # what the variants of test_variants.py have not
    # joints
    "joint 'hinge': frictionloss must not be negative": pendulum('frictionloss="-1"'),
    "joint 'hinge': armature must not be negative": pendulum('armature="-1e-3"'),
    "joint 'hinge': stiffness must not be negative": pendulum('stiffness="-1"'),
    "joint 'hinge': a second number of stiffness is not simulated": pendulum('stiffness="1 2"'),
    "joint 'hip': the limit of a ball joint is not simulated": ball('range="0 1" limited="true"'),
    "joint 'r': a free joint has no stiffness here; write <freejoint/>": free('stiffness="1"'),
    "joint 'r': armature of a free joint in a fluid is not": free('armature="1"', '<option density="1"/>'),
    "joint 'j': actuatorgravcomp within actuatorfrcrange is not simulated": robot(
        f'<body gravcomp="1"><joint name="j" actuatorgravcomp="true" actuatorfrcrange="-1 1"/>{BALL}</body>'
    ),
    "joint 'weak': actuatorfrcrange together with muscles or actuators at sites is not simulated": tendon(
        joint='<joint name="weak" actuatorfrcrange="-1 1"/>', actuator=MUSCLES
    ),
    "joint 'a', 'b': they have a motion without inertia": [
        robot('<body><joint name="a"/><joint name="b"/><geom size="0.1" pos="1 0 0"/></body>'),
        robot(f'<body><joint name="a" type="slide"/><joint name="b" type="slide"/>{BALL}</body>'),
        slides("1e-8"),
    ],
    # equality
    "equality 'same': tendon is not simulated; remove it, or all of them by <flag equality=\"disable\"/>": pendulum(
        rest='<tendon><fixed name="t"><joint joint="hinge" coef="1"/></fixed></tendon>'
        '<equality><tendon name="same" tendon1="t"/></equality>'
    ),
    "equality 'mimic': solref mixes a positive with another number": pendulum(
        rest='<equality><joint name="mimic" joint1="hinge" solref="0.02 -1"/></equality>'
    ),
    # bodies and contact
    "file without a joint: there is nothing to simulate": robot(f"<body>{BALL}</body>"),
    "body 'hand': contact of a mocap body is not simulated; set contype and conaffinity to 0 if only drawn": pendulum(
        world=f'<body name="hand" mocap="true">{BALL}</body>'
    ),
    "body 'fin': in a fluid each body needs a joint; merge its geoms": pendulum(
        inside=f'<body name="fin">{BALL}</body>', rest='<option density="1"/>'
    ),
    "key 'home': qpos must be finite": pendulum(rest='<keyframe><key name="home" qpos="nan"/></keyframe>'),
    "body 'base': pos must be finite": robot(f'<body name="base" pos="nan 0 1"><freejoint/>{BALL}</body>'),
    "geom 'hull': fluidshape ellipsoid is not simulated": pendulum(
        inside='<geom name="hull" size="0.1" fluidshape="ellipsoid"/>', rest='<option density="1"/>'
    ),
    "geom 'floor': solmix must not be negative": pendulum(world=FLOOR.replace("/>", ' solmix="-1"/>')),
    "geom 'rock': contact is simulated with one ground plane only; set contype and conaffinity to 0 if only drawn": (
        pendulum(world='<geom name="rock" type="hfield" hfield="h"/>', rest=HILLS)
    ),
    "geom 'floor', 'second': contact is simulated with one": pendulum(world=FLOOR + FLOOR.replace("floor", "second")),
    "geom 'rock': its shape cannot touch the ground here; set contype": asset('type="sdf" mesh="m"', TETRAHEDRON),
    "pair 'couple': margin must be finite": pair('margin="inf"'),
    "joint 'hinge': margin must be finite": pendulum('margin="nan"'),
    "option impratio: must be positive and finite": [
        pendulum(rest=f'<option impratio="{number}"/>') for number in ("0", "-1", "nan", "inf")
    ],
    "pair 'couple': friction differs by direction; it is isotropic here": pair('friction="1 2"'),
    "pair 'couple': friction must not be negative": pair('friction="-1 -1"'),
    # actuators
    "actuator 'm': stiffness and damping of a servo must not be negative": [
        actuator("position", 'kp="-5"'),
        actuator("velocity", 'kv="-2"'),
        pendulum(rest=f'{FIXED}<actuator><position name="m" tendon="string" kp="-5"/></actuator>'),
    ],
    "actuator 'm': only motors on a hinge, a slide or one axis of a ball joint, position and velocity servos on": [
        free("", '<actuator><motor name="m" joint="r"/></actuator>'),
        ball("", '<actuator><motor name="m" joint="hip" gear="1 1 0"/></actuator>'),
        ball("", '<actuator><position name="m" joint="hip" gear="1 0 0"/></actuator>'),
    ],
    "or muscles on tendons, not dyntype filterexact": actuator("position", 'timeconst="0.1"'),
    "or muscles on tendons, not gaintype affine": actuator("general", 'gaintype="affine"'),
    "or muscles on tendons, not transmission jointinparent": pendulum(
        rest='<actuator><motor name="m" jointinparent="hinge"/></actuator>'
    ),
    "actuator 'm': forcerange is simulated of a joint's only": actuator(
        "motor", 'forcerange="-1 1"/><motor joint="hinge"'
    ),
    # tendons and muscles
    "tendon 'string': a second number of damping is not simulated": tendon(spring='damping="0 3"'),
    "tendon 'string': only fixed tendons, or spatial ones through sites, without pulleys or wrapping geoms": [
        tendon('<geom geom="g"/>', actuator=MUSCLES),
        tendon('<pulley divisor="2"/><site site="w"/><site site="a"/>', actuator=MUSCLES),
    ],
    "site 'w': a muscle of a floating robot cannot hold on to the world": tendon(
        joint="<freejoint/>", actuator=MUSCLES
    ),
    "actuator 'biceps': only <muscle> with a gear of 1 and a ctrlrange within [0, 1], or motors that pull and never": [
        tendon(actuator='<motor name="biceps" tendon="string"/>'),
        tendon(actuator='<position name="biceps" tendon="string" kp="1"/>'),
        tendon(actuator=f'<muscle gear="2" {MUSCLE}/>'),
    ],
    "actuator 'biceps': forcerange is": tendon(actuator=f'<muscle forcerange="-1 0" {MUSCLE}/>'),
    "actuator 'biceps': its force follows from what it moves, and it moves nothing; give force": tendon(
        actuator=MUSCLES.replace('force="5"', 'force="-5"')
    ),
    "actuator 'm': only motors, position and velocity servos on a fixed tendon": [
        pendulum(rest=f"{FIXED}<actuator><{kind}/></actuator>")
        for kind in (
            'muscle name="m" tendon="string" lengthrange="1 2"',
            'general name="m" tendon="string" dyntype="filter"',
        )
    ],
    "damping of tendons is simulated along one chain of joints, or with the integrator Euler": [
        CHAIN.replace("Euler", integrator).format(more)
        for integrator in ("implicitfast", "implicit")
        for more in CHAINS
    ],
    "actuator 'm': forcerange is simulated of a joint's only actuator": pendulum(
        rest=f'{FIXED}<actuator><motor tendon="string"/><motor name="m" joint="hinge" forcerange="-1 1"/></actuator>'
    ),
    "actuator 'm': only motors at a site, without refsite and forcerange": [
        pendulum(inside='<site name="s"/><site name="r"/>', rest=f'<actuator><{kind} name="m" site="s"/></actuator>')
        for kind in ("velocity", 'motor refsite="r"', 'motor forcerange="-1 1"', 'general dyntype="filter"')
    ],
    # the file
    "numeric k_n: must be one number, not negative": [
        pendulum(rest=f'<custom><numeric name="k_n" data="{data}"/></custom>') for data in ("-1", "1 2")
    ],
    "flex 'rag': deformable bodies are not simulated": pendulum(rest=f"<deformable>{RAG}</deformable>"),
    # numbers that no kernel holds
    "lower: not finite in single precision": pendulum('range="nan 1" limited="true"'),
    "stiffness: not finite in single precision": pendulum('stiffness="1e39"'),
    "gear: not finite in single precision": actuator("motor", 'gear="1e9" ctrlrange="-1e30 1e30"'),
    "mu: not finite in single precision": pendulum(rest='<custom><numeric name="mu" data="1e300"/></custom>'),
    # what MuJoCo says
    "is not a valid MJCF: Error: range[0] should be smaller than range[1]": pendulum('range="1 1" limited="true"'),
}
CASES = [
    (message, mjcf) for message, found in REFUSED.items() for mjcf in ([found] if isinstance(found, str) else found)
]


@pytest.mark.parametrize(("message", "mjcf"), CASES, ids=[message for message, _ in CASES])
def test_what_is_not_simulated_is_named(message, mjcf):
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


def test_thousands_of_bodies_and_contact_points_are_read_in_seconds():
    geoms = "".join(f'<geom pos="{x} 0 0" size="0.1"/>' for x in range(2000))
    bodies = '<body><joint type="slide"/><geom size="0.1" contype="0" conaffinity="0"/></body>' * 1000
    start = time.perf_counter()
    assert parse(robot(f"<body><freejoint/>{geoms}</body>")).ncontact == 2000
    assert parse(robot(bodies)).nv == 1000
    assert time.perf_counter() - start < 30  # all pairs one by one took minutes


@pytest.mark.parametrize("size", [1.0, 0.02], ids="links of {} m".format)
def test_long_chains_are_simulated(size):
    """Their mass matrices have small eigenvalues, though each joint moves a link."""
    link = f'<body pos="{size} 0 0"><joint axis="0 1 0"/><geom pos="{size / 2} 0 0" size="{size / 5}"/>'

    def chain(end):
        return robot(link * 300 + end + "</body>" * 300, world="")

    assert parse(chain("")).nv == 300
    twice = f'<body><joint name="a"/><joint name="b"/><geom pos="{size} 0 0" size="{size / 5}"/></body>'
    with pytest.raises(SceneError, match="joint 'a', 'b': they have a motion without inertia"):
        parse(chain(twice))


def test_what_looks_at_a_body_that_is_left_out_looks_ahead():
    """A camera and a light of a goal that touches nothing, and of a part of it; others keep what they look at."""
    looks = "".join(
        f'<{kind} pos="2 0 1" mode="targetbody" target="{target}"/>'
        for kind in ("camera", "light")
        for target in ("goal", "part", "ball")
    )
    goal = '<body name="goal"><freejoint/><geom size=".1" contype="0" conaffinity="0"/><body name="part"/></body>'
    scene = parse(robot(f'<body name="ball" pos="0 0 1"><freejoint/><geom size=".1"/></body>{goal}{looks}'))
    ball = scene.mj_model.body("ball").id
    assert scene.left_out == ("goal",) and scene.mj_model.cam_targetbodyid.tolist() == [-1, -1, ball]
    assert scene.mj_model.light_targetbodyid.tolist() == [-1, -1, ball]


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
        "geom number 33 of body 'arm'",
        "actuator 'servo'",
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
            '<option cone="elliptic"><flag warmstart="disable" energy="enable"/></option>'
            '<sensor><clock/></sensor><keyframe><key qpos="0"/></keyframe></mujoco>',
        )
    )
    assert scene.features == {"hinge", "contact"}


def test_damping_along_one_chain_is_simulated():
    """With an integrator that damps implicitly; Euler damps any number explicitly."""
    assert parse(CHAIN.replace("Euler", "implicitfast").format("")).transmissions.chain == [0]
    for more in CHAINS:
        parse(CHAIN.format(more))
