"""MJCF to Scene: what is read, and what is refused by name."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import reference
from scenes import BALL, SHOULDER, free_states, leg_scene, parse, task_scene, tree_scene

from diffsim.mjcf import load_scene
from diffsim.scene import PENALTY_DEFAULTS, SceneError

FLOOR = '<geom name="floor" type="plane" size="1 1 1"/>'


def robot(body: str, rest: str = "", world: str = FLOOR) -> str:
    return f'<mujoco><compiler angle="radian"/><worldbody>{world}{body}</worldbody>{rest}</mujoco>'


def pendulum(joint: str = "", inside: str = "", rest: str = "", world: str = FLOOR) -> str:
    """A sphere on a hinge."""
    body = f'<body name="arm"><joint name="hinge" {joint}/><geom type="sphere" size="0.1" pos="0 0 -1"/>{inside}</body>'
    return robot(body, rest, world)


def test_welded_bodies_are_merged():
    scene = parse(
        robot("""
        <body>
          <joint axis="0 1 0"/> <inertial pos="1 0 0" mass="1" diaginertia="0.1 0.2 0.25"/>
          <body pos="0 0 2" quat="0 1 0 0">
            <inertial pos="3 0 1" mass="3" diaginertia="0.3 0.4 0.5"/>
            <geom type="sphere" size="0.1" pos="0 1 0"/>
          </body>
        </body>""")
    )
    assert scene.nlink == 2 and scene.mass[1] == 4
    # The welded body's centre of mass is (3, 0, 1) in the link's frame, so the two lie (2, 0, 1) apart.
    np.testing.assert_allclose(scene.com[1], [2.5, 0, 0.75])
    apart = np.array([2.0, 0.0, 1.0])
    steiner = 1 * 3 / (1 + 3) * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    np.testing.assert_allclose(scene.inertia[1], np.diag([0.4, 0.6, 0.75]) + steiner)
    np.testing.assert_allclose(scene.contact_position, [[0, -1, 2]], atol=1e-15)


def test_body_with_several_joints_becomes_links_in_a_row():
    scene = parse(
        robot("""
        <body pos="0 0 3" quat="0.6 0 0.8 0">
          <joint type="slide" axis="2 0 0" pos="0.1 0.2 0.3"/>
          <joint type="hinge" axis="0 1 0" pos="0.4 0 0" ref="0.3"/>
          <geom type="sphere" size="0.1" pos="0 0 1"/>
          <body pos="1 0 0"> <joint axis="0 0 1"/> <geom type="sphere" size="0.2"/> </body>
        </body>""")
    )
    assert scene.nlink == 4 and not scene.floating
    np.testing.assert_array_equal(scene.parent, [0, 0, 1, 2])
    np.testing.assert_array_equal(scene.slide, [False, True, False, False])
    np.testing.assert_allclose(scene.axis[1:], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(scene.joint_ref, [0, 0, 0.3, 0])
    np.testing.assert_array_equal(scene.qpos0, [0, 0.3, 0])
    assert scene.mass[0] == scene.mass[1] == 0 and (scene.mass[2:] > 0).all()
    np.testing.assert_allclose(scene.position[2:], [[0.3, -0.2, -0.3], [0.6, 0, 0]])


def test_ball_joint_becomes_three_links():
    scene = parse(SHOULDER)
    np.testing.assert_array_equal(scene.ball, [-1, 0, 1, 2, -1])
    np.testing.assert_array_equal(scene.parent, [0, 0, 1, 2, 3])
    np.testing.assert_array_equal(scene.qpos_adr[1:], [0, 1, 2, 4])
    np.testing.assert_array_equal(scene.axis[1:4], np.eye(3))
    np.testing.assert_array_equal(scene.mass, [0, 0, 0, 1.5, 1])
    np.testing.assert_array_equal(scene.armature[1:4], 0.05)
    np.testing.assert_array_equal(scene.motor_link, [2, 3])
    np.testing.assert_allclose(scene.gear, [5, -6])
    np.testing.assert_allclose(scene.motor_bias, [0, -6])
    assert (scene.nq, scene.nv, scene.nball) == (5, 4, 1)
    assert scene.features == {"ball", "slide", "stiffness", "damping", "motor"}


@pytest.mark.parametrize("base", ["floating", "fixed", "planar", "ball"])
def test_links_are_where_mujoco_has_them(base, rng):
    """Centres of mass of the bodies and of the spheres that touch the ground, in random poses."""
    scene = tree_scene(base, 3)
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    spheres = 0
    for qpos in free_states(scene, 5, rng)[0]:
        data.qpos = qpos
        mujoco.mj_forward(model, data)
        links = reference.kinematics(scene, qpos, np.zeros(scene.nv))
        whole = sum(m * (x.position + x.rotation @ c) for m, x, c in zip(scene.mass, links, scene.com, strict=True))
        np.testing.assert_allclose(whole / scene.mass.sum(), data.subtree_com[0], atol=1e-12)
        found = {
            tuple(np.round([*(links[i].position + links[i].rotation @ c), r], 9))
            for i, c, r in zip(scene.contact_link, scene.contact_position, scene.contact_radius, strict=True)
        }
        expected = set()
        for g in range(1, model.ngeom):
            axes, size = data.geom_xmat[g].reshape(3, 3), model.geom_size[g]
            offsets = {
                mujoco.mjtGeom.mjGEOM_SPHERE: [np.zeros(3)],
                mujoco.mjtGeom.mjGEOM_CAPSULE: [axes[:, 2] * size[1], -axes[:, 2] * size[1]],
                mujoco.mjtGeom.mjGEOM_BOX: [
                    axes @ (size * (i, j, k)) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)
                ],
            }[mujoco.mjtGeom(model.geom_type[g])]
            radius = 0.0 if len(offsets) == 8 else size[0]
            expected |= {tuple(np.round([*(data.geom_xpos[g] + o), radius], 9)) for o in offsets}
        assert found <= expected
        spheres += len(found)
    assert spheres > 0


def test_box_touches_with_its_corners():
    scene = parse(robot('<body pos="0 0 1"><freejoint/><geom type="box" size="1 2 3" pos="5 0 0"/></body>'))
    assert scene.floating and scene.ncontact == 8
    np.testing.assert_array_equal(scene.contact_radius, 0)
    corners = {tuple(p) for p in scene.contact_position}
    assert corners == {(5 + x, y, z) for x in (-1, 1) for y in (-2, 2) for z in (-3, 3)}


def test_spheres_inside_another_are_dropped():
    """Inside on the same link, or on a hinge whose parent has the same sphere there; a shifted or larger one stays."""
    scene = parse(
        robot("""
        <body>
          <freejoint/>
          <geom type="sphere" size="0.5"/> <geom type="capsule" fromto="0 0 0 1 0 0" size="0.1"/>
          <body pos="1 0 0">
            <joint axis="0 1 0"/> <geom type="capsule" fromto="0 0 0 1 0 0" size="0.1"/>
            <body pos="1 0 0"> <joint axis="0 1 0"/> <geom type="capsule" fromto="0 0 0 1 0 0" size="0.2"/> </body>
            <body pos="1 0 0"> <joint type="slide"/> <geom type="sphere" size="0.1"/> </body>
          </body>
        </body>""")
    )
    spheres = np.column_stack([scene.contact_link, scene.contact_position, scene.contact_radius])
    # The forearm's end (link 1, x = 1, r = 0.1) lies in the larger one of link 2; that on the slide may leave.
    expected = [[0, 0, 0, 0, 0.5], [0, 1, 0, 0, 0.1], [2, 0, 0, 0, 0.2], [2, 1, 0, 0, 0.2], [3, 0, 0, 0, 0.1]]
    np.testing.assert_allclose(spheres[np.lexsort(spheres.T[::-1])], expected, atol=1e-12)


@pytest.mark.parametrize(
    "name, count",
    {"cartpole": 0, "hopper": 6, "half_cheetah": 16, "ant": 13, "humanoid": 35, "humanoid_mtu": 88}.items(),
)
def test_contact_spheres_of_the_tasks(name, count):
    assert task_scene(name).ncontact == count


def test_only_what_may_touch_the_ground_touches():
    bits = '<geom type="sphere" size="0.1" contype="{}" conaffinity="{}"/>'
    for contype, conaffinity, touches in ((0, 0, 0), (2, 0, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (2, 1, 1)):
        scene = parse(robot(f"<body><freejoint/>{bits.format(contype, conaffinity)}</body>"))
        assert scene.ncontact == touches
    exclude = '<contact><exclude body1="world" body2="arm"/></contact>'
    assert parse(pendulum()).ncontact == 1 and parse(pendulum(rest=exclude)).ncontact == 0
    assert parse(pendulum(world="")).ncontact == 0
    drawn = '<geom type="cylinder" size="0.1 0.1" contype="0" conaffinity="0"/>'
    assert parse(pendulum(inside=drawn)).ncontact == 1


def test_ground_height():
    assert parse(BALL).ground_height == 0
    assert parse(pendulum(world='<geom type="plane" size="1 1 1" pos="3 4 -0.5"/>')).ground_height == -0.5


def test_joint_and_motor_numbers():
    scene = parse(
        pendulum(
            'armature="0.1" damping="0.2" stiffness="0.3" springref="0.4" range="-0.5 0.6" axis="0 3 4"',
            rest='<actuator><motor joint="hinge" gear="10" ctrlrange="-1 2" ctrllimited="true"/>'
            '<motor joint="hinge" gear="-3"/></actuator>',
        )
    )
    numbers = [getattr(scene, n)[1] for n in ("armature", "damping", "stiffness", "spring_ref", "lower", "upper")]
    assert numbers == [0.1, 0.2, 0.3, 0.4, -0.5, 0.6]
    np.testing.assert_allclose(scene.axis[1], [0, 0.6, 0.8])
    # ctrl in [-1, 1] over [-1, 2]: 1.5 ctrl + 0.5; an unlimited motor takes it as it is.
    np.testing.assert_array_equal(scene.motor_link, [1, 1])
    np.testing.assert_allclose(scene.gear, [15, -3])
    np.testing.assert_allclose(scene.motor_bias, [5, 0])


def test_unlimited_joint_has_infinite_bounds():
    scene = parse(pendulum())
    assert scene.lower[1] == -np.inf and scene.upper[1] == np.inf and "limit" not in scene.features


def test_penalty_constants():
    scene = parse(pendulum())
    assert {name: getattr(scene, name) for name in PENALTY_DEFAULTS} == PENALTY_DEFAULTS
    given = {name: 10.0 + i for i, name in enumerate(PENALTY_DEFAULTS)}
    numerics = "".join(f'<numeric name="{name}" data="{value}"/>' for name, value in given.items())
    scene = parse(pendulum(rest=f"<custom>{numerics}<numeric name='other' data='5'/></custom>"))
    assert {name: getattr(scene, name) for name in PENALTY_DEFAULTS} == given


def test_muscles():
    """Segments between two links, by pairs of links; the rest of a path has a constant length."""
    scene = leg_scene("hill")
    pelvis, thigh, shin = 0, 3, 4
    np.testing.assert_array_equal(scene.motor_link, [0, 0, shin, 0, 0])
    np.testing.assert_allclose(scene.gear, [200, 150, 7, 125, 50])
    np.testing.assert_allclose(scene.motor_bias, [200, 150, 0, 125, 50])  # N, at half the activation
    pairs = [(pelvis, thigh)] * 3 + [(pelvis, shin)] + [(thigh, shin)] * 4
    np.testing.assert_array_equal(scene.segment_link, pairs)
    np.testing.assert_array_equal(scene.segment_muscle, [0, 1, 3, 4, 1, 3, 4, 4])
    np.testing.assert_allclose(scene.segment_position[3], [[0.05, 0.1, 0.05], [-0.03, 0, -0.05]])
    np.testing.assert_allclose(scene.hill[:, 0], [0, np.hypot(0.02, 0.15), np.nan, np.hypot(0.06, 0.1), 0])
    assert {"muscle", "hill", "ball"} < scene.features and "hill" not in leg_scene("linear").features
    bare = scene.without("muscle")
    assert bare.features == scene.features - {"muscle", "hill"} and bare.nu == 5


def test_strength_of_muscles():
    strength = '<numeric name="muscle_strength" data="0.36"/>'
    scene = parse(tendon(actuator=f"<muscle {MUSCLE}/>", custom=strength))
    np.testing.assert_allclose([scene.gear[0], scene.motor_bias[0], scene.hill[0, -1]], [0.9, 0.9, 1.8])
    half = tendon(actuator=f'<muscle {MUSCLE} ctrllimited="true" ctrlrange="0 0.5"/>')
    np.testing.assert_allclose([parse(half).gear[0], parse(half).motor_bias[0]], [1.25, 1.25])


MUSCLE = 'name="biceps" tendon="string" force="5" lengthrange="1 2"'


def tendon(more: str = "", spring: str = "", joint: str = "<joint/>", actuator: str = "", custom: str = "") -> str:
    """A string from the world's site w to the body's site b."""
    body = (
        f'<site name="w"/><body>{joint}<geom name="g" size="0.1"/><site name="a" pos="1 0 0"/><site name="b"/></body>'
    )
    path = f'<spatial name="string" {spring}><site site="w"/><site site="a"/>{more}<site site="b"/></spatial>'
    return robot(body, f"<tendon>{path}</tendon><actuator>{actuator}</actuator><custom>{custom}</custom>")


MESH = """<asset><mesh name="tetra" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>"""
UNSUPPORTED = {
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
    "fixed tendon": (
        pendulum(rest='<tendon><fixed name="string"><joint joint="hinge" coef="1"/></fixed></tendon>'),
        "string",
    ),
    "tendon around a geom": (tendon('<geom geom="g"/>'), "string"),
    "pulley": (tendon('<pulley divisor="2"/><site site="a"/>'), "string"),
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
    "no joint": (robot('<body><geom size="0.1"/></body>'), "no joint"),
    "negative penalty": (pendulum(rest='<custom><numeric name="k_n" data="-1"/></custom>'), "k_n"),
}


@pytest.mark.parametrize("what", UNSUPPORTED)
def test_what_is_not_simulated_is_named(what):
    mjcf, culprit = UNSUPPORTED[what]
    with pytest.raises(SceneError, match=culprit) as error:
        parse(mjcf)
    assert "\n" not in str(error.value) and "robot.xml" in str(error.value)


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(SceneError, match="nowhere.xml"):
        load_scene(tmp_path / "nowhere.xml")
    with pytest.raises(SceneError):
        load_scene(tmp_path)
    for text in ("<mujoco><worldbody>", "no xml at all", "<mujoco><worldbody><bogus/></worldbody></mujoco>", ""):
        broken = tmp_path / "broken.xml"
        broken.write_text(text)
        with pytest.raises(SceneError, match="broken.xml") as error:
            load_scene(broken)
        assert "\n" not in str(error.value)
