"""MJCF to Scene: what is read."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import reference
from scenes import (
    MUSCLE,
    SHOULDER,
    free_states,
    leg_scene,
    parse,
    pendulum,
    robot,
    tendon,
    without,
)


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


def test_box_touches_with_its_corners():
    scene = parse(robot('<body pos="0 0 1"><freejoint/><geom type="box" size="1 2 3" pos="5 0 0"/></body>'))
    assert scene.floating and scene.ncontact == 8 and scene.ground_height == 0
    assert parse(pendulum(world='<geom type="plane" size="1 1 1" pos="3 4 -0.5"/>')).ground_height == -0.5
    np.testing.assert_array_equal(scene.contact_radius, 0)
    corners = {tuple(p) for p in scene.contact_position}
    assert corners == {(5 + x, y, z) for x in (-1, 1) for y in (-2, 2) for z in (-3, 3)}


HEAP = " ".join(map(str, (np.random.default_rng(0).normal(size=(300, 3)) * [0.5, 0.3, 0.1]).round(3).flatten()))


@pytest.mark.parametrize(
    "geom, count, error",
    [
        ('type="mesh" mesh="tetra"', 4, 1e-6),
        ('type="mesh" mesh="heap"', 16, 0.25),
        ('type="cylinder" size="0.3 0.1"', 16, 1 - np.cos(np.pi / 8)),
        ('type="ellipsoid" size="0.5 0.3 0.1"', 14, 0.2),
    ],
)
def test_points_of_a_shape_are_as_deep_as_the_shape(geom, count, error, rng):
    """Relative to its height over the ground in MuJoCo, in any orientation; never deeper."""
    mesh = f'<mesh name="tetra" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/><mesh name="heap" vertex="{HEAP}"/>'
    world = '<geom type="plane" size="1 1 1" margin="9"/>'
    body = f'<body pos="0 0 3"><freejoint/><geom {geom} pos="0.1 0 0" euler="1 0 0" mass="1"/></body>'
    scene = parse(robot(body, f"<asset>{mesh}</asset>", world))
    assert scene.ncontact == count and not scene.contact_radius.any()
    data = mujoco.MjData(scene.mj_model)
    for qpos in free_states(scene, 50, rng)[0]:
        data.qpos = [0, 0, 3, *qpos[3:7]]
        mujoco.mj_forward(scene.mj_model, data)
        lowest, middle = data.contact.dist.min(), data.geom_xpos[1, 2]
        ours = reference.contacts(scene, data.qpos, np.zeros(6))[0].min()
        assert -1e-6 < ours - lowest <= error * (middle - lowest) + 1e-6


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


def test_only_what_may_touch_the_ground_touches():
    bits = '<geom type="sphere" size="0.1" contype="{}" conaffinity="{}"/>'
    for contype, conaffinity, touches in ((0, 0, 0), (2, 0, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (2, 1, 1)):
        scene = parse(robot(f"<body><freejoint/>{bits.format(contype, conaffinity)}</body>"))
        assert scene.ncontact == touches
    exclude = '<contact><exclude body1="world" body2="arm"/></contact>'
    assert parse(pendulum()).ncontact == 1 and parse(pendulum(rest=exclude)).ncontact == 0
    assert parse(pendulum(world="")).ncontact == 0
    pair = '<geom name="foot" size="0.2" contype="0" conaffinity="0"/>'
    for ends in ('geom1="foot" geom2="floor"', 'geom1="floor" geom2="foot"'):
        rest = f"<contact><pair {ends}/></contact>"
        assert parse(pendulum(inside=pair, rest=rest)).ncontact == 2
        assert parse(pendulum(inside=pair, rest=rest + '<option><flag contact="disable"/></option>')).ncontact == 0
    arm = '<body pos="0 0 2"><joint/><geom size="0.1" pos="0 0 1"/></body>'
    assert parse(robot(f'<body><geom type="box" size="1 1 1"/>{arm}</body>')).ncontact == 1  # its base is no ground
    drawn = '<geom type="cylinder" size="0.1 0.1" contype="0" conaffinity="0"/>'
    assert parse(pendulum(inside=drawn)).ncontact == 1


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


def test_muscles():
    """Segments between two links, by pairs of links."""
    scene = leg_scene()
    pelvis, thigh, shin = 0, 3, 4
    np.testing.assert_array_equal(scene.motor_link, [0, 0, shin, 0, 0])
    np.testing.assert_allclose(scene.gear, [200, 150, 7, 125, 50])
    np.testing.assert_allclose(scene.motor_bias, [200, 150, 0, 125, 50])  # N, at half the activation
    pairs = [(pelvis, thigh)] * 3 + [(pelvis, shin)] + [(thigh, shin)] * 4
    np.testing.assert_array_equal(scene.segment_link, pairs)
    np.testing.assert_array_equal(scene.segment_muscle, [0, 1, 3, 4, 1, 3, 4, 4])
    np.testing.assert_allclose(scene.segment_position[3], [[0.05, 0.1, 0.05], [-0.03, 0, -0.05]])
    assert {"muscle", "ball"} < scene.features
    bare = without(scene, "muscle")
    assert bare.features == scene.features - {"muscle"} and bare.nu == 5


def test_strength_of_muscles():
    strength = '<numeric name="muscle_strength" data="0.36"/>'
    scene = parse(tendon(actuator=f"<muscle {MUSCLE}/>", custom=strength))
    np.testing.assert_allclose([scene.gear[0], scene.motor_bias[0]], [0.9, 0.9])
    half = tendon(actuator=f'<muscle {MUSCLE} ctrllimited="true" ctrlrange="0 0.5"/>')
    np.testing.assert_allclose([parse(half).gear[0], parse(half).motor_bias[0]], [1.25, 1.25])
