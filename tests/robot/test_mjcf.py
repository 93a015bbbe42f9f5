"""MJCF to Scene: what is read."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import reference
from scenes import (
    MUSCLE,
    free_states,
    parse,
    pendulum,
    robot,
    tendon,
)

from diffsim.robot.mjcf import load_scene


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


def test_bodies_beside_a_robot_that_touch_nothing_are_left_out():
    """The robot moves as beside them in MuJoCo; a body that can touch something, or is tied to the robot, stays."""
    ghost = '<geom size="0.1" contype="0" conaffinity="0"/>'
    post = f'<body name="post" pos="0 0 9"><joint name="unused"/>{ghost}<body><joint/>{ghost}</body></body>'
    leg = '<body pos="0.2 0 0"><joint name="hip" axis="0 1 0"/><geom size="0.05" pos="0.2 0 0"/></body>'
    actuators = '<motor name="idle" joint="unused"/><motor name="drive" joint="hip" gear="3"/>'
    rest = f'<actuator>{actuators}</actuator><sensor><jointpos joint="unused"/></sensor>'
    rest += '<keyframe><key qpos="0 0 0.0999 1 0 0 0 0.1 5 6 1 2 3 1 0 0 0" ctrl="0.2 0.7"/></keyframe>'
    ball = f'<body name="target"><freejoint/>{ghost}</body>'
    text = robot(f'<body><freejoint/><geom size="0.1"/>{leg}</body>{post}{ball}', rest)
    scene, full = parse(text), mujoco.MjModel.from_xml_string(text)
    assert scene.left_out == ("post", "target") and (scene.nq, scene.nv, scene.nu) == (8, 7, 1)
    np.testing.assert_array_equal(scene.mj_model.key_qpos[0], full.key_qpos[0, :8])
    data, rest_of = mujoco.MjData(full), mujoco.MjData(scene.mj_model)
    mujoco.mj_resetDataKeyframe(full, data, 0)
    mujoco.mj_resetDataKeyframe(scene.mj_model, rest_of, 0)
    mujoco.mj_step(full, data, 20)
    mujoco.mj_step(scene.mj_model, rest_of, 20)
    np.testing.assert_allclose(rest_of.qvel, data.qvel[:7], atol=1e-8)
    assert load_scene(mujoco.MjSpec.from_string(text)).left_out == scene.left_out
    solid = text.replace(ghost, '<geom size="0.1"/>')
    tied = text.replace("</mujoco>", '<tendon><fixed><joint joint="unused" coef="1"/></fixed></tendon></mujoco>')
    for each in (parse(solid), parse(tied), load_scene(full)):  # of a model nothing can be removed
        assert each.left_out == () and not each.floating and (each.nq, each.nv) == (full.nq, full.nv)
        np.testing.assert_array_equal(each.qpos_adr[1:7], [0, 1, 2, 3, 4, 5])
    assert len(parse(solid).geom_pairs) == 8 and load_scene(full).geom_pairs == ()


def test_a_mocap_body_that_touches_nothing_stays():
    goal = '<body name="goal" mocap="true"><geom size="0.1" contype="0" conaffinity="0"/></body>'
    scene = parse(pendulum(world=f'<geom type="plane" size="1 1 1"/>{goal}'))
    assert scene.ncontact == 1 and scene.left_out == () and scene.nv == 1


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


def test_strength_of_muscles():
    strength = '<numeric name="muscle_strength" data="0.36"/>'
    scene = parse(tendon(actuator=f"<muscle {MUSCLE}/>", custom=strength))
    np.testing.assert_allclose([scene.gear[0], scene.motor_bias[0]], [0.9, 0.9])
    half = tendon(actuator=f'<muscle {MUSCLE} ctrllimited="true" ctrlrange="0 0.5"/>')
    np.testing.assert_allclose([parse(half).gear[0], parse(half).motor_bias[0]], [1.25, 1.25])
