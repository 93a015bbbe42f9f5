"""Rows of MuJoCo's constraints between two bodies: against MuJoCo, and their gradients against differences."""

from __future__ import annotations

import copy
import dataclasses
import re
from itertools import count, product

import mujoco
import numpy as np
import pytest
import test_constraint
import torch
from scenes import FLOOR, free_states, parse, pendulum, random_tree, robot, unit
from test_constraint import CONES, STATES, H, check_gradients, in_mujoco, mujoco_model, step
from test_gradient import gradients, weights

from diffsim.robot import types
from diffsim.robot.constants import constrained
from diffsim.robot.pairs import first_contacts, room_of, with_pairs
from diffsim.robot.scene import FACTORS
from diffsim.robot.shapes import as_primitives
from diffsim.robot.types import SceneError
from diffsim.sim import simulator
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim_cli.report import approximations, report

enough_passes = test_constraint.enough_passes
SLOW = pytest.mark.slow  # for its kernels, which no other test needs
TANGLED = "floating", "fixed", "objects"
ROOTS = "floating", "fixed", "planar", "ball"
BASES = ["floating", *(pytest.param(base, marks=SLOW) for base in ROOTS[1:])]
VERSION = tuple(map(int, mujoco.__version__.split(".")[:2]))
# Of which MuJoCo has added dJ/dt v to connect and weld
needs_drift = pytest.mark.skipif(VERSION < (3, 7), reason="MuJoCo before 3.7 leaves dJ/dt v out of connect and weld")
needs_manifolds = pytest.mark.skipif(VERSION < (4, 0), reason="MuJoCo before 4 has other contacts of boxes")


def tied_tree(base, seed):
    """A random tree (scenes.py) with every kind of equality, between its bodies and to the world."""
    rng = np.random.default_rng(500 + seed)
    text, number = random_tree(base, seed).replace('type="box"', 'type="capsule"'), count()
    text = re.sub(r"<body pos", lambda found: f'<body name="b{next(number)}" pos', text)
    bodies = [f"b{k}" for k in range(next(number))]
    joints = [name for name, kind in re.findall(r'<joint name="(joint\d+)" type="(\w+)"', text) if kind != "ball"]

    def words(*values):
        return " ".join(map(str, values))

    def law():
        time, ratio, stiffness, damping = rng.uniform((0.01, 0.5, -2000, -100), (0.05, 1.5, -100, -10))
        ends = rng.uniform((0.5, 0.9, 0.05, 0.2), (0.9, 0.97, 2, 0.8))
        solref = words(time, ratio) if rng.random() < 0.7 else words(stiffness, damping)
        return f'solref="{solref}" solimp="{words(*ends, rng.choice([1, 2, 2, 3.5]))}"'

    def place(n):
        return words(*(0.3 * rng.normal(size=n)))

    (a, b), (c, d), (e, f) = (rng.choice(names, 2, replace=False) for names in (joints, bodies, bodies))
    rows = f"""
    <joint joint1="{a}" joint2="{b}" polycoef="{words(*(0.5 * rng.normal(size=5)))}" {law()}/>
    <joint joint1="{rng.choice(joints)}" polycoef="0.1 0 0 0 0" {law()}/>
    <connect body1="{c}" body2="{d}" anchor="{place(3)}" {law()}/> <connect body1="{c}" anchor="{place(3)}" {law()}/>
    <weld body1="{f}" {law()}/> <weld body1="{e}" body2="{f}" torquescale="{rng.uniform(0.3, 2)}" anchor="{place(3)}"
    relpose="{place(3)} {place(4)}" {law()}/> <joint joint1="{a}" active="false"/>"""
    return parse(text.replace("</mujoco>", f"<equality> {rows} </equality> </mujoco>"))


def tied_states(scene, number, rng):
    qpos, qvel, ctrl = free_states(scene, number, rng)
    return qpos, 0.3 * qvel, ctrl


@needs_drift
@pytest.mark.parametrize("base, seeds", [("floating", 1), *(pytest.param(base, 10, marks=SLOW) for base in ROOTS)])
def test_trees_step_as_in_mujoco(base, seeds, rng):
    """Far from where their constraints would be satisfied, in motion."""
    errors = []
    for seed in range(seeds):
        scene = tied_tree(base, seed)
        states = free_states(scene, 8, rng)
        qvel, expected = step(scene, states)[1], in_mujoco(scene, *states)[1]
        errors.append(abs(qvel - expected).max(1) / abs(expected - states[1]).max(1))
    assert np.max(errors) < 1e-6 and np.median(errors) < 1e-10
    assert {"joint_rows", "point_rows", "turn_rows"} < constrained(scene, H).features and scene.pairs is None


@pytest.mark.parametrize("base", BASES)
def test_tree_gradient_is_that_of_differences(base, rng):
    """Where the constraints do not throw the bodies about: there differences would be inexact."""
    scene = tied_tree(base, 0)
    states = tied_states(scene, 96, rng)
    calm = np.argsort(abs(step(scene, states, 4)[1]).max(1))[:6]
    check_gradients(scene, [x[calm] for x in states], rng)


HALF_TURN = """
<mujoco> <worldbody>
  <body name="a" pos="0 0 1"> <joint axis="0 1 0" damping=".1"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" contype="0" conaffinity="0"/> </body>
  <body name="b" pos=".4 0 1"> <freejoint/> <geom type="box" size=".05 .03 .02" contype="0" conaffinity="0"/> </body>
</worldbody>
<equality> <weld body1="a" body2="b" relpose=".4 0 0 1 0 0 0" torquescale=".7"/> </equality> </mujoco>"""


def half_turns(number, rng, beside):
    """States with the bodies of the weld turned against each other by pi - beside, about axes of all directions."""
    scene = parse(HALF_TURN)
    axes = unit(np.concatenate([np.eye(3), rng.normal(size=(number - 3, 3))]))
    turns = 0.5 * (np.pi - beside) * np.ones((number, 1))
    qpos = np.column_stack(
        [np.zeros(number), np.tile([0.4, 0, 1], (number, 1)), np.cos(turns), np.sin(turns) * axes]
    ).astype(np.float32)
    return scene, (
        qpos.astype(float),
        rng.normal(size=(number, scene.nv)).astype(np.float32) * 0.1,
        np.zeros((number, 0)),
    )


@needs_drift
@pytest.mark.unoptimized
@pytest.mark.parametrize("dtype, enough", [(torch.float64, 1e-10), (torch.float32, 1e-3)])
def test_a_weld_turned_by_half_a_turn_pulls_as_in_mujoco(dtype, enough, rng):
    tolerance = {} if dtype == torch.float64 else {"tolerance": 1e-4}
    for beside in (0.0, 1e-9, 1e-7, -1e-6, 1e-5, -1e-4, 1e-3, 1e-2):
        scene, states = half_turns(16, rng, beside)
        expected = in_mujoco(scene, *states)[1]
        change = abs(expected - states[1]).max(1)
        found = step(scene, states, dtype=dtype, **tolerance)[1]
        assert (abs(found - expected).max(1) / change).max() < enough


@pytest.mark.unoptimized
def test_gradient_of_a_weld_turned_by_half_a_turn_is_that_of_differences(rng):
    """Also in float32, in which it is near that of float64."""
    for beside in (0.0, 1e-6):
        scene, states = half_turns(6, rng, beside)
        check_gradients(scene, states, rng)
        check_single_precision(scene, states, rng)


def check_single_precision(scene, states, rng):
    """Compare gradients of float32 with those of float64."""
    w = weights(scene, rng)
    exact, rounded = (
        gradients(
            scene, states, w, integration=Integration("mujoco", 2, tolerance=tolerance), control_dt=2 * H, dtype=dtype
        )
        for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-4))
    )
    for one, other in zip(exact, rounded, strict=True):
        assert np.linalg.norm(one - other) <= 1e-3 * np.linalg.norm(one)


# An arm and a box on a fixed box, which it pushes, a ball tied to the arm, a bar welded to the world and to a slide
FAR_AWAY = """
<mujoco> <option cone="{cone}"/>
  <worldbody> <geom type="plane" size="9 9 .1"/>
    <geom type="box" size=".3 .3 .05" pos="{x} {y} .05"/>
    <body name="arm" pos="{x} {y} .2"> <joint axis="0 1 0" damping=".1"/> <joint axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 .2 0 -.05" size=".02" contype="2" conaffinity="2"/> </body>
    <body pos="{near} {y} .149"> <freejoint/> <geom type="box" size=".05 .05 .05" conaffinity="3"/> </body>
    <body name="ball" pos="{x} {y} .5"> <freejoint/> <geom size=".03" contype="0" conaffinity="0"/> </body>
    <body name="bar" pos="{near} {y} .6"> <freejoint/> <geom type="capsule" size=".02 .1" contype="0"/> </body>
    <body name="slide" pos="{x} {y} .7"> <joint type="slide" axis="0 1 0" stiffness="9"/>
      <geom size=".03" contype="0"/> </body>
  </worldbody>
  <equality> <connect body1="arm" body2="ball" anchor="0 0 .3"/> <weld body1="world" body2="bar"/>
    <weld body1="slide" body2="bar" torquescale=".2"/> </equality> </mujoco>"""


def far_away(cone, rng, number, x=100.0, y=-70.0):
    """Such trees near their reference pose, in numbers of float32."""
    scene = with_pairs(parse(FAR_AWAY.format(cone=cone, x=x, y=y, near=x + 0.21)))
    qpos, qvel = scene.qpos0 + 0.01 * rng.normal(size=(number, scene.nq)), 0.2 * rng.normal(size=(number, scene.nv))
    return scene, [x.astype(np.float32).astype(float) for x in (qpos, qvel, np.zeros((number, 0)))]


@needs_manifolds
@pytest.mark.unoptimized
@pytest.mark.parametrize("cone", ["elliptic", pytest.param("pyramidal", marks=SLOW)])
def test_trees_far_from_the_origin_step_as_in_mujoco(cone, rng):
    """In float32, with contact and equality between them and with the world, as accurately as at the origin."""
    for x, y in ((0.0, 0.0), (20.0, -5.0), (100.0, -70.0)):
        scene, states = far_away(cone, rng, 24, x, y)
        expected = in_mujoco(scene, *states, model=model_as_it_is(scene))[1]
        change = abs(expected - states[1]).max(1)
        for dtype, tolerance, enough in ((torch.float64, 1e-12, 1e-9), (torch.float32, 1e-4, 1e-3)):
            found = step(scene, states, tolerance=tolerance, dtype=dtype)[1]
            assert (abs(found - expected).max(1) / change).max() < enough, (x, y, dtype)


@pytest.mark.unoptimized
@pytest.mark.parametrize("cone", ["elliptic", pytest.param("pyramidal", marks=SLOW)])
def test_gradient_far_from_the_origin_is_that_of_differences(cone, rng):
    scene, states = far_away(cone, rng, 48)
    check_gradients_of_touching(scene, states, rng)
    check_single_precision(scene, [x[:8] for x in states], rng)


# A crank and a rocker, whose coupler closes the loop at sites, and a gripper whose fingers mirror each other.
FOUR_BAR = """
<mujoco> <option timestep="0.002"/> <default> <geom contype="0" conaffinity="0"/> </default>
  <worldbody>
    <body name="crank"> <joint name="crank" axis="0 1 0"/> <geom type="capsule" fromto="0 0 0 0 0 .1" size=".01"/>
      <body pos="0 0 .1"> <joint axis="0 1 0"/> <geom type="capsule" fromto="0 0 0 .3 0 .05" size=".01"/>
        <site name="coupler" pos=".3 0 .05"/> </body> </body>
    <body pos=".3 0 0"> <joint axis="0 1 0" damping=".01"/> <geom type="capsule" fromto="0 0 0 0 0 .15" size=".01"/>
      <site name="rocker" pos="0 0 .15"/>
      <body pos="0 0 .2"> <joint name="left" type="slide" axis="0 1 0" range="0 .05"/> <geom size=".02" pos="0 .05 0"/>
      </body> <body pos="0 0 .2"> <joint name="right" type="slide" axis="0 -1 0"/> <geom size=".02" pos="0 -.05 0"/>
      </body> </body>
  </worldbody>
  <actuator> <motor joint="crank" ctrlrange="-.1 .1"/> <position joint="left" kp="20" kv="1" ctrlrange="0 .05"/>
  </actuator>
  <equality> <connect site1="coupler" site2="rocker"/> <joint joint1="right" joint2="left"/> </equality>
</mujoco>"""


def linkages(rng):
    """Nine in motion, not quite closed, some of whose fingers are beyond a limit."""
    scene = parse(FOUR_BAR)
    qpos, qvel = 0.03 * rng.normal(size=(9, scene.nq)), 0.1 * rng.normal(size=(9, scene.nv))
    return scene, (qpos, qvel, rng.uniform(-1, 1, (9, 2)))


@pytest.mark.unoptimized
@needs_drift
def test_a_four_bar_linkage_turns_as_in_mujoco(rng):
    """Over 100 substeps, and its loop stays closed."""
    scene, states = linkages(rng)
    qpos, qvel, residual = step(scene, states, 100)
    expected, velocity, _ = in_mujoco(scene, *states, substeps=100)
    assert residual.max() < 1e-10 and abs(qpos[:, 0]).max() > 0.3
    np.testing.assert_allclose(qpos, expected, atol=1e-8)
    np.testing.assert_allclose(qvel, velocity, atol=1e-6)
    np.testing.assert_allclose(qpos[:, 3], qpos[:, 4], atol=1e-3)


@pytest.mark.unoptimized
def test_tendons_pull_between_trees_far_from_the_origin(rng):
    """Motors on tendons from the world to an arm and a free body."""
    tendons = "".join(
        f'<spatial name="{name}"> {"".join(f"<site site={site!r}/>" for site in sites)} </spatial>'
        for name, sites in (("long", "wab"), ("short", "bw"))
    )
    scene = parse(f"""
    <mujoco> <worldbody> <site name="w" pos="80 -9 1.5"/>
      <body pos="80 -9 1"> <joint axis="0 1 0" damping=".1"/> <site name="a" pos=".3 0 .02"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" contype="0" conaffinity="0"/> </body>
      <body pos="80.5 -9 1"> <freejoint/> <geom type="box" size=".1 .05 .03"/> <site name="b" pos=".05 0 .03"/> </body>
    </worldbody> <tendon> {tendons} </tendon>
    <actuator> <motor tendon="long" gear="-3" ctrlrange="0 1"/> <motor tendon="short" gear="-2" ctrlrange="0 1"/>
    </actuator> </mujoco>""")
    qpos, qvel = scene.qpos0 + 0.05 * rng.normal(size=(12, scene.nq)), 0.5 * rng.normal(size=(12, scene.nv))
    states = [x.astype(np.float32).astype(float) for x in (qpos, qvel, rng.uniform(-1, 1, (12, scene.nu)))]
    expected = in_mujoco(scene, *states, model=model_as_it_is(scene))[1]
    change = abs(expected - states[1]).max(1)
    for dtype, tolerance, enough in ((torch.float64, 1e-12, 1e-10), (torch.float32, 1e-4, 1e-3)):
        found = step(scene, states, tolerance=tolerance, dtype=dtype)[1]
        assert (abs(found - expected).max(1) / change).max() < enough
    check_gradients(scene, [x[:6] for x in states], rng)


@SLOW
def test_gradient_of_a_four_bar_linkage_is_that_of_differences(rng):
    scene, states = linkages(rng)
    qpos, qvel, _ = step(scene, states, 100)
    check_gradients(scene, (qpos, qvel, states[2]), rng)


# Contact


def law(rng):
    """Random attributes of a contact between two geoms."""
    solref = f"{rng.uniform(0.01, 0.05)} {rng.uniform(0.5, 1.5)}" if rng.random() < 0.7 else "-900 -40"
    ends = " ".join(map(str, rng.uniform((0.5, 0.9, 0.005, 0.2), (0.9, 0.97, 0.05, 0.8))))
    return f'condim="{rng.choice([1, 3, 3])}" solref="{solref}" solimp="{ends} {rng.choice([1, 2, 3.5])}"'


def tangle(base, cone, seed):
    """A robot of links whose spheres and capsules overlap each other, its fixed base, another robot or the ground.

    Two geoms have a <pair>, two bodies are excluded, and two are tied.
    """
    rng, number = np.random.default_rng(900 + seed), count(1)

    def words(*values):
        return " ".join(map(str, values))

    def geom():
        place = f'pos="{words(*(0.05 * rng.normal(size=3)))}" euler="{words(*rng.uniform(-180, 180, 3))}"'
        mixed = f'friction="{rng.uniform(0.2, 1.5)}" solmix="{rng.uniform(0.5, 2)}" priority="{rng.choice([0, 0, 1])}"'
        kind, size, name = (
            rng.choice(["sphere", "capsule", "capsule"]),
            words(*rng.uniform(0.05, 0.12, 2)),
            next(number),
        )
        margin = rng.choice([0, 0.01])
        return f'<geom name="g{name}" type="{kind}" size="{size}" {place} {mixed} {law(rng)} margin="{margin}"/>'

    def body(depth, joint):
        parts = "".join(body(depth + 1, "") for _ in range((2, 1, 1, 0)[depth]))
        joint = joint or f'<joint axis="{words(*rng.normal(size=3))}" damping="0.1" range="-60 60"/>'
        shape, name = geom(), next(number)
        return f'<body name="b{name}" pos="{words(*(0.12 * rng.normal(size=3)))}">{joint}{shape}{parts}</body>'

    tree = body(0, "" if base == "fixed" else "<freejoint/>")
    if base == "objects":
        tree += body(2, "<freejoint/>")
    if base == "fixed":
        tree = f'<body name="root">{geom()}{tree}</body>'
    geoms, bodies = re.findall(r'"(g\d+)"', tree), re.findall(r'"(b\d+)"', tree)
    pair = f'<pair geom1="{geoms[-1]}" geom2="{geoms[0]}" friction="0.3 0.3" {law(rng)} margin="0.02"/>'
    return parse(
        f'<mujoco><option cone="{cone}" impratio="{rng.uniform(0.5, 3)}"/> <worldbody>'
        f'<geom type="plane" size="1 1 1" pos="0 0 -0.15" {law(rng)}/> {tree} </worldbody>'
        f'<contact> {pair} <exclude body1="{bodies[0]}" body2="{bodies[3]}"/> </contact>'
        f'<equality> <connect body1="{bodies[2]}" body2="{bodies[-1]}" anchor="0 0 0.05"/> </equality> </mujoco>'
    )


def tangled(base, cone, seed, number, rng):
    """Such a robot, and states in some of which nothing touches."""
    scene = with_pairs(tangle(base, cone, seed))
    qpos, qvel, ctrl = free_states(scene, number, rng)
    for joint in np.flatnonzero(scene.mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        qpos[:, scene.mj_model.jnt_qposadr[joint] :][:, :3] = 0.05 * rng.normal(size=(number, 3))
    return scene, (qpos, 0.3 * qvel, ctrl)


def model_as_it_is(scene):
    m = copy.copy(scene.mj_model)
    m.opt.timestep, m.opt.iterations, m.opt.tolerance, m.opt.ls_iterations, m.opt.ls_tolerance = H, 200, 0, 100, 1e-10
    return m


MODELS = model_as_it_is, mujoco_model  # in the latter the robot's parts pass through each other

# Each has kernels of its own
TANGLES = [("floating", "elliptic", 1), *(pytest.param(*each, 10, marks=SLOW) for each in product(TANGLED, CONES))]


@needs_drift
@pytest.mark.parametrize("base, cone, seeds", TANGLES)
def test_robots_that_touch_themselves_step_as_in_mujoco(base, cone, seeds, rng):
    """With friction of both cones and without, margins, mixed and declared parameters, on the ground and tied."""
    errors = []
    for seed in range(seeds):
        scene, states = tangled(base, cone, seed, 16, rng)
        qvel, residual = step(scene, states)[1:]
        expected = in_mujoco(scene, *states, model=model_as_it_is(scene))[1]
        assert residual.max() < 1e-10 and abs(expected - in_mujoco(scene, *states)[1]).max() > 1e-3
        errors.append(abs(qvel - expected).max(1) / abs(expected - states[1]).max(1))
    assert np.max(errors) < 1e-6 and np.median(errors) < 1e-10
    assert "geoms_rows" in constrained(scene, H).features


def check_gradients_of_touching(scene, states, rng, onset=0.0):
    """Compare gradients with differences in the six calmest states in which something touches."""
    ends, apart = (in_mujoco(scene, *states, substeps=4, model=make(scene))[1] for make in MODELS)
    touches = abs(ends - apart).max(1) > 1e-3
    calm = np.argsort(np.where(touches, abs(ends).max(1), np.inf))[:6]
    assert touches[calm].all()
    check_gradients(scene, [x[calm] for x in states], rng, onset=onset)


@pytest.mark.parametrize("base, cone, seeds", TANGLES)
def test_gradient_through_contact_is_that_of_differences(base, cone, seeds, rng):
    """Where nothing is thrown about, as above."""
    for seed in range(min(3, seeds)):
        scene, states = tangled(base, cone, seed, 96, rng)
        check_gradients_of_touching(scene, states, rng)


@SLOW
@needs_drift
@pytest.mark.parametrize("cone", CONES)
def test_factors_act_on_contact_between_bodies(cone, rng):
    """Those of friction and stiffness as in MuJoCo with other constants; gradients are those of differences."""
    scene, states = tangled("objects", cone, 0, 64, rng)
    m, factors = model_as_it_is(scene), np.ones((64, len(FACTORS)))
    factors[:, [FACTORS.index("k_n"), FACTORS.index("mu")]] = 1.3, 0.6
    m.geom_friction[:], m.pair_friction[:] = 0.6 * m.geom_friction, 0.6 * m.pair_friction
    for solref in (m.geom_solref, m.pair_solref):
        time, stiffness = (solref > 0).all(1), (solref < 0).all(1)
        solref[time, 0] /= np.sqrt(1.3)
        solref[stiffness] *= 1.3, np.sqrt(1.3)
    expected, usual = (in_mujoco(scene, *states, model=model)[1] for model in (m, model_as_it_is(scene)))
    found = step(scene, states, factors=torch.tensor(factors))[1]
    change = abs(expected - states[1]).max(1)
    np.testing.assert_array_less(abs(found - expected).max(1), 1e-6 * change)
    slides = abs(usual - expected).max(1) > 1e-3 * change
    calm = np.argsort(np.where(slides, abs(found).max(1), np.inf))[:6]  # as above
    assert slides[calm].all()
    check_gradients(scene, [x[calm] for x in states], rng, {"factors": rng.uniform(0.7, 1.4, (6, len(FACTORS)))})


def marbles(cone, seed):
    """A box and two spheres, all free, which touch the box only."""
    rng, bodies = np.random.default_rng(seed), ""
    for kind, masks in (("box", (2, 0)), ("sphere", (0, 2)), ("sphere", (0, 2))):
        size, place, turn = (
            " ".join(map(str, x)) for x in rng.uniform((0.04, -0.05, -180), (0.12, 0.05, 180), (3, 3)).T
        )
        geom = f'type="{kind}" size="{size}" pos="{place}" euler="{turn}" contype="{masks[0]}" conaffinity="{masks[1]}"'
        bodies += f"<body> <freejoint/> <geom {geom}/> </body>"
    return parse(f'<mujoco><option cone="{cone}"/><worldbody> {bodies} </worldbody></mujoco>')


def marble_states(scene, number, rng):
    qpos, qvel, ctrl = free_states(scene, number, rng)
    qpos.reshape(number, 3, 7)[..., :3] = 0.1 * rng.normal(size=(number, 3, 3))
    return qpos, 0.3 * qvel, ctrl


@pytest.mark.unoptimized
@pytest.mark.parametrize("cone", ["elliptic", pytest.param("pyramidal", marks=SLOW)])
def test_spheres_touch_boxes_as_in_mujoco(cone, rng):
    """At faces, edges and corners, and with their centres inside."""
    depths = []
    for seed in range(10):
        scene = marbles(cone, seed)
        states, model = marble_states(scene, 32, rng), model_as_it_is(scene)
        expected, found = in_mujoco(scene, *states, model=model)[1], step(scene, states)[1]
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)
        data = mujoco.MjData(model)
        for qpos in states[0]:
            data.qpos = qpos
            mujoco.mj_fwdPosition(model, data)
            depths += [-contact.dist / model.geom_size[max(contact.geom), 0] for contact in data.contact]
    assert min(depths) < 0.2 and max(depths) > 1.2  # in radii


@SLOW
@pytest.mark.parametrize("cone", CONES)
def test_gradient_of_spheres_on_boxes_is_that_of_differences(cone, rng):
    scene = marbles(cone, 9)
    check_gradients(scene, marble_states(scene, 8, rng), rng)


def crawler(cone, step='type="box" size=".1 .5 .05"', rod='type="capsule" size=".03 .2"', rest=""):
    """A body on four legs over stairs, one of whose steps is tilted, a fixed ball, a fixed rod and the ground."""
    steps = "".join(
        f'<geom {step} pos="{0.2 * k} 0 {0.05 * k}" euler="0 {10 * (k == 3)} 0" name="step {k}"/>' for k in range(-2, 4)
    )
    legs = "".join(
        f"""<body pos="{x} {y} 0"> <joint axis="0 1 0" range="-60 60"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.15" size=".02" contype="2" conaffinity="2"/>
        <geom pos="0 0 -.18" size=".03" friction=".8"/> </body>"""
        for x in (-0.15, 0.15)
        for y in (-0.1, 0.1)
    )
    return parse(f"""<mujoco> <option cone="{cone}"/> <worldbody> <geom type="plane" size="1 1 1"/>
        {steps} <geom size=".1" pos="-.2 .1 .2"/>
        <body pos=".1 .2 .2"> <geom {rod} euler="90 0 20" contype="3" conaffinity="3" name="rod"/> </body>
        <body> <freejoint/> <geom type="box" size=".1 .1 .03" contype="0" conaffinity="0"/> {legs} </body>
        </worldbody>{rest}</mujoco>""")


def crawler_states(scene, n, rng):
    """Random states of it in most of which it touches the stairs."""
    qpos, qvel, ctrl = free_states(scene, n, rng)
    qpos[:, :3] = rng.uniform((-0.3, -0.2, 0.15), (0.4, 0.2, 0.4), (n, 3))
    qpos[:, 3:7] = np.array([1, 0, 0, 0]) + 0.2 * rng.normal(size=(n, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos, 0.3 * qvel, ctrl


@pytest.mark.parametrize("cone", ["elliptic", pytest.param("pyramidal", marks=SLOW)])
def test_fixed_geoms_are_touched_as_in_mujoco(cone, rng):
    """Without `with_pairs` by a robot whose parts do not touch each other."""
    scene, n = crawler(cone), 64
    states, touched, whole = crawler_states(scene, n, rng), 0, with_pairs(scene)
    cases = [(scene, apart_from_itself(scene))] + [(whole, model_as_it_is(scene))] * (cone == "pyramidal")
    for each, model in cases:
        expected, found = in_mujoco(scene, *states, model=model)[1], step(each, states)[1]
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)
        touched = (abs(found - in_mujoco(scene, *states)[1]).max(1) > 1e-3).sum()  # with the ground alone
    assert "ground at z = 0 m, 36 pairs of geoms" in report(scene)
    assert len(scene.geom_pairs) == 4 * 6 + 4 + 8 and len(whole.geom_pairs) == 36 + 12 and touched > n / 2
    check_gradients(scene, [x[:6] for x in states], rng)


def test_other_fixed_shapes_are_touched_as_boxes_and_capsules(rng):
    """Written out by hand; the robot's own and those of a fixed base become capsules, as above."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    chamfered = np.r_[corners * (1 / 8, 0.5, 1 / 32), corners * (3 / 32, 0.5, 1 / 16)]
    mesh = f'<asset><mesh name="step" vertex="{" ".join(map(str, chamfered.ravel()))}"/></asset>'
    scene = crawler("elliptic", 'type="mesh" mesh="step"', 'type="cylinder" size=".03 .2"', mesh)
    written = crawler("elliptic", 'type="box" size=".125 .5 .0625"', 'type="capsule" size=".03 .17"')
    states = crawler_states(scene, 64, rng)
    found, expected = (step(scene, states)[1], in_mujoco(written, *states, model=apart_from_itself(written))[1])
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)
    assert scene.geom_pairs == written.geom_pairs
    assert abs(expected - in_mujoco(scene, *states, model=apart_from_itself(scene))[1]).max() > 1e-2
    (told,) = (line for line in approximations(scene) if "Fixed" in line)
    *steps, rod = re.findall(r"'([\w -]+)' as a (\w+) \([a-z ]*([\d.]+) mm\)", told)
    assert sorted(name for name, *_ in steps) == [f"step {k}" for k in (-1, -2, 0, 1, 2, 3)]
    assert {kind for _, kind, _ in steps} == {"box"} and rod[:2] == ("rod", "capsule")
    assert float(steps[0][2]) == pytest.approx(1000 / 32 / 2**0.5, rel=0.05)
    assert float(rod[2]) == pytest.approx(30 * (2**0.5 - 1), rel=0.05)


@pytest.mark.parametrize(
    ("shape", "fixed", "elsewhere"),
    [
        ('type="cylinder" size=".05 .3"', "capsule", "capsule"),
        ('type="cylinder" size=".5 .02"', "box", "capsule"),
        ('type="cylinder" size=".3 .1"', "box", "capsule"),
        ('type="mesh" mesh="wedge"', "box", "capsule"),
        ('type="cylinder" size=".06 .06"', "sphere", "sphere"),
        ('type="ellipsoid" size=".1 .2 .1"', "capsule", "capsule"),
        ('type="mesh" mesh="plate"', "box", "capsule"),
        ('type="box" size=".1 .2 .3"', "box", "box"),
    ],
)
def test_what_stands_for_a_shape(shape, fixed, elsewhere):
    """A box where it is nearer or the shape is flat, of obstacles only."""
    plate = '<mesh name="plate" vertex="0 0 0 1 0 0 0 1 0 1 1 0 0 0 .1 1 0 .1 0 1 .1 1 1 .1"/>'
    wedge = '<mesh name="wedge" vertex="0 0 0 1 0 0 0 .4 0 0 0 .1 1 0 .1 0 .4 .1"/>'
    arm = f'<body pos="3 0 0"> <geom {shape}/> <body> <joint/> <geom {shape} mass="1"/> </body> </body>'
    m = as_primitives(parse(robot(f"{arm} <geom {shape}/>", f"<asset>{plate}{wedge}</asset>", "")).mj_model)
    kinds = [mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in m.geom_type]
    assert kinds == [fixed, elsewhere, elsewhere]


def test_fixed_shapes_that_would_overlap_at_the_start_are_left_out():
    """Of balls beside and above a round table."""
    balls = "".join(
        f'<body pos=".45 .45 {z}"> <joint type="slide"/> <geom name="ball {z}" size=".05"/> </body>' for z in (0, 1)
    )
    scene = parse(robot(f'{balls} <geom name="table" type="cylinder" size=".5 .02"/>', "", ""))
    first, second, table = (scene.mj_model.geom(name).id for name in ("ball 0", "ball 1", "table"))
    assert {frozenset(pair) for pair in scene.geom_pairs} == {frozenset((first, second)), frozenset((second, table))}
    sentence = "Left out, because such shapes overlap at the start: contact of the geoms 'table' and 'ball 0'."
    assert sentence in approximations(scene)


# A hand of two links on a table with a drawer, a door in a frame, and a second hand
KITCHEN = """
<mujoco> <default> <geom density="100"/> </default> <worldbody>
  <body name="table"> <geom name="top" type="box" size=".3 .3 .02" pos="0 0 -.05"/>
    <body name="hand"> <joint type="slide" axis="0 1 0"/> <joint type="slide" axis="1 0 0"/>
      <geom name="palm" size=".1"/>
      <body name="finger"> <joint axis="0 0 1"/> <geom name="finger" type="capsule" fromto="0 0 0 .3 0 0" size=".04"/>
        <body name="tip" pos=".3 0 0"> <joint axis="0 0 1"/> <geom name="tip" size=".05"/> </body> </body> </body>
    <body name="drawer" pos="0 .3 .1"> <joint type="slide" axis="0 1 0" damping="2"/>
      <geom name="drawer" type="box" size=".2 .02 .1"/> </body> </body>
  <body name="frame" pos=".5 .3 0"> <geom name="frame" size=".03"/>
    <body name="leaf"> <joint axis="0 0 1" damping=".2"/>
      <geom name="leaf" type="box" size=".1 .02 .3" pos="-.1 0 0"/> </body> </body>
  <body name="other" pos=".1 -.2 0"> <joint type="slide" axis="0 1 0"/> <geom name="other" size=".08"/> </body>
  </worldbody> <contact> <exclude body1="drawer" body2="other"/> </contact> </mujoco>"""


def test_doors_drawers_and_second_arms_touch_as_in_mujoco(rng):
    """Without `with_pairs`; a robot's own parts, of one tree with its fixed base, do not."""
    scene = parse(KITCHEN)
    m, bodies = scene.mj_model, ("hand", "finger", "tip")
    found = {frozenset(m.geom(geom).name for geom in pair) for pair in scene.geom_pairs}
    hand, rest = ("palm", "finger", "tip"), ("drawer", "leaf", "other", "frame")
    expected = {frozenset(pair) for pair in product(hand, rest)} | {
        frozenset(pair)
        for pair in [("drawer", "leaf"), ("drawer", "frame"), ("leaf", "other"), ("frame", "other")]
        + [("top", "leaf"), ("top", "other")]
    }
    assert found == expected
    spec, n = mujoco.MjSpec.from_string(KITCHEN), 48
    for part, base in [("tip", "hand"), *product((*bodies, "drawer"), ["table"]), ("leaf", "frame")]:
        spec.add_exclude(bodyname1=part, bodyname2=base)
    own = model_as_it_is(parse(spec.to_xml()))
    qpos, qvel = 0.1 * rng.normal(size=(n, scene.nq)), 0.3 * rng.normal(size=(n, scene.nv))
    states = qpos, qvel, np.zeros((n, 0))
    expected, found = in_mujoco(scene, *states, model=own)[1], step(scene, states)[1]
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)
    alone = step(dataclasses.replace(scene, geom_pairs=()), states)[1]
    assert (abs(found - alone).max(1) > 1e-3).sum() > n / 2


def apart_from_itself(scene):
    """The file's model, whose moving geoms touch fixed ones only."""
    m, moves = model_as_it_is(scene), scene.mj_model.body_weldid[scene.mj_model.geom_bodyid] > 0
    m.geom_conaffinity[moves] = 0
    return m


def solids(cone, seed):
    """Two boxes and a capsule, all free, and a capsule that slides beside that one; all of them touch each other."""
    rng = np.random.default_rng(seed)

    def geom(kind):
        size, place = (" ".join(map(str, x)) for x in (rng.uniform(0.04, 0.12, 3), 0.02 * rng.normal(size=3)))
        turn = "0 0 0" if kind == "capsule" else "10 20 30"
        friction, margin = rng.uniform(0.2, 1.5), rng.choice([0, 0.01])
        shape = f'type="{kind}" size="{size}" pos="{place}" euler="{turn}"'
        return f'<geom {shape} friction="{friction}" margin="{margin}" {law(rng)}/>'

    slide = '<joint type="slide" damping="1" axis="{}"/>'.format
    beside = f'<body> {slide("1 .3 0")} <geom size=".02" contype="0" conaffinity="0"/> <body> {slide(".2 0 1")}'
    shapes = geom("box"), geom("box"), f"{geom('capsule')} {beside} {geom('capsule')} </body> </body>"
    bodies = "".join(f"<body> <freejoint/> {shape} </body>" for shape in shapes)
    option = f'<option cone="{cone}" impratio="{rng.uniform(0.5, 3)}"/>'
    return parse(f"<mujoco> {option} <worldbody> {bodies} </worldbody> </mujoco>")


def solid_states(scene, number, rng):
    """Random states of theirs in which most of them overlap."""
    (qpos, qvel, ctrl), m = free_states(scene, number, rng), scene.mj_model
    for adr, kind in zip(m.jnt_qposadr, m.jnt_type, strict=True):
        place = qpos[:, adr : adr + (3 if kind == mujoco.mjtJoint.mjJNT_FREE else 1)]
        place[:] = 0.1 * rng.normal(size=place.shape)
    return qpos, 0.3 * qvel, ctrl


@needs_manifolds
@pytest.mark.parametrize("cone", ["elliptic", pytest.param("pyramidal", marks=SLOW)])
def test_boxes_and_capsules_touch_as_in_mujoco(cone, rng):
    """At faces and edges, ends and corners, with several contacts of a pair."""
    errors, numbers = [], set()
    for seed in range(10):
        scene = solids(cone, seed)
        states, model = solid_states(scene, 32, rng), model_as_it_is(scene)
        (_, qvel, residual), expected = step(scene, states), in_mujoco(scene, *states, model=model)[1]
        assert residual.max() < 1e-10
        errors.append(abs(qvel - expected).max(1) / (1e-3 + abs(expected - states[1]).max(1)))
        data = mujoco.MjData(model)
        for qpos in states[0]:
            data.qpos = qpos
            mujoco.mj_fwdPosition(model, data)
            pairs, contacts = np.unique(data.contact.geom, axis=0, return_counts=True)
            numbers |= {(*sorted(model.geom_type[pair].tolist()), n) for pair, n in zip(pairs, contacts, strict=True)}
    capsule, box = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_BOX)
    assert numbers >= {(box, box, n) for n in range(1, 7)} | {
        (capsule, box, 1),
        (capsule, box, 2),
        (capsule, capsule, 2),
    }
    assert np.max(errors) < 1e-6 and np.median(errors) < 1e-10


@needs_manifolds
@pytest.mark.parametrize("cone", ["elliptic", pytest.param("pyramidal", marks=SLOW)])
def test_gradient_through_several_contacts_is_that_of_differences(cone, rng):
    """Where nothing is thrown about, as above."""
    for seed in range(3):
        scene = solids(cone, seed)
        states = solid_states(scene, 96, rng)
        check_gradients_of_touching(scene, states, rng)


PLATE = 'type="box" size=".2 .1 .05"'
# Shapes on a plate of that size, at the height where they touch it, exactly along one of its sides or ends
FLUSH = {
    "boxes": [
        (PLATE, f"{x} {y} .0998", turn)
        for x, y in ((0.05, 0), (-0.05, 0), (-0.2, 0), (0, 0.1), (0, -0.1))
        for turn in (0, 180)
    ]
    + [(f'type="box" size="{size}"', ".1 0 .0898", turn) for size in (".1 .1 .04", ".1 .03 .04") for turn in (0, 90)],
    "capsules": [
        (f'type="capsule" fromto="{-a} {y} 0 {b} {y} 0" size=".04"', ".02 0 .0898", 0)
        for a, b in ((0.4, 0.4), (0.4, 0.3), (0.1, 0.1), (0.1, 0.5), (0.22, 0.1))
        for y in (0, 0.1, -0.1)
    ],
    "spheres": [('size=".06"', place, 0) for place in ("0 0 0", ".1 0 0", ".2 .1 .1", ".2 0 .05")],
}


@needs_manifolds
@pytest.mark.unoptimized
@pytest.mark.parametrize("kind", FLUSH)
def test_flush_shapes_touch_as_in_mujoco(kind, rng):
    """Where several faces, edges or corners are equally near."""
    for shape, place, turn in FLUSH[kind]:
        upper = f'<body pos="{place}" euler="0 0 {turn}"> <freejoint/> <geom {shape}/> </body>'
        scene = parse(
            f"<mujoco> <worldbody> <body> <freejoint/> <geom {PLATE}/> </body> {upper} </worldbody> </mujoco>"
        )
        states = np.tile(scene.qpos0, (4, 1)), 0.05 * rng.normal(size=(4, scene.nv)), np.zeros((4, 0))
        expected = in_mujoco(scene, *states, model=model_as_it_is(scene))[1]
        change = abs(expected - states[1]).max(1)
        np.testing.assert_array_less(abs(step(scene, states)[1] - expected).max(1), 1e-6 * change, f"{shape} {place}")


@pytest.mark.unoptimized
@pytest.mark.parametrize("where", ["reference pose", "keyframe"])
def test_capsules_that_a_turned_body_makes_parallel_touch_twice(where, rng):
    qpos = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0.0995, 0.5**0.5, 0, 0.5**0.5, 0])
    turn = 'euler="0 90 0"' if where == "reference pose" else ""
    key = "" if turn else f'<keyframe> <key qpos="{" ".join(map(str, qpos))}"/> </keyframe>'
    logs = f"""<body> <freejoint/> <geom type="capsule" fromto="-.3 0 0 .3 0 0" size=".05"/> </body>
    <body pos="0 0 .0995" {turn}> <freejoint/> <geom type="capsule" size=".05 .3"/> </body>"""
    scene = parse(f"<mujoco> <worldbody> {logs} </worldbody> {key} </mujoco>")
    states = np.tile(qpos, (4, 1)), 0.05 * rng.normal(size=(4, scene.nv)), np.zeros((4, 0))
    expected = in_mujoco(scene, *states, model=model_as_it_is(scene))[1]
    change = abs(expected - states[1]).max(1)
    np.testing.assert_array_less(abs(step(scene, states)[1] - expected).max(1), 1e-6 * change)


def slippery(boxes, friction, option=""):
    """A pile of boxes, of which the third is turned and heavy."""
    bodies = "".join(
        f'<body pos="{0.02 * k} 0 {0.199 * k + 0.098}" euler="0 0 {20 * (k == 2)}"> <freejoint/>'
        f'<geom type="box" size=".1 .1 .1" friction="{friction}" density="{1000 + 4000 * (k == 2)}"/> </body>'
        for k in range(boxes)
    )
    return parse(f"<mujoco> {option} <worldbody> {FLOOR} {bodies} </worldbody> </mujoco>")


@needs_manifolds
@pytest.mark.unoptimized
@pytest.mark.parametrize("boxes", [2, pytest.param(3, marks=SLOW)])
def test_slippery_boxes_slide_as_in_mujoco(boxes, rng, monkeypatch):
    """With pyramids, whose normals are the stiffer the less friction there is, and within 30 passes."""
    monkeypatch.setattr(simulator, "PASSES", 30)
    for friction, option in ((0.02, ""), (0.05, ""), (0.02, '<option gravity="3 1 -9.81" impratio="5"/>'), (0.002, "")):
        scene = slippery(boxes, friction, option)
        states = np.tile(scene.qpos0, (32, 1)), 0.1 * rng.normal(size=(32, scene.nv)), np.zeros((32, 0))
        states = [x.astype(np.float32).astype(float) for x in states]
        expected = in_mujoco(scene, *states, model=model_as_it_is(scene))[1]
        change = abs(expected - states[1]).max(1)
        for dtype, tolerance, enough in ((torch.float64, 1e-12, 1e-8), (torch.float32, 1e-4, 3e-3)):
            if dtype == torch.float64 or (friction > 0.01 and not option):
                _, found, residual = step(scene, states, tolerance=tolerance, dtype=dtype)
                assert residual.max() < tolerance
                assert (abs(found - expected).max(1) / change).max() < enough, (friction, dtype)


@needs_manifolds
@pytest.mark.slow
@pytest.mark.unoptimized
def test_gradient_of_slippery_boxes_is_that_of_differences(rng):
    scene = slippery(2, 0.01)
    qpos = scene.qpos0 + 0.003 * rng.normal(size=(6, scene.nq))  # without edges on each other
    check_gradients(scene, (qpos, 0.1 * rng.normal(size=(6, scene.nv)), np.zeros((6, 0))), rng)


@needs_manifolds
@SLOW
def test_a_stack_of_boxes_rests_as_in_mujoco():
    """Of equal ones, exactly one on the other, and a turned one, a second after they fell on each other."""
    bodies = "".join(
        f'<body pos="{0.01 * (k == 3)} 0 {0.1 * k + 0.05}" euler="0 0 {turn}"> <freejoint/> '
        '<geom type="box" size=".05 .05 .05"/> </body>'
        for k, turn in enumerate((0, 0, 0, 30))
    )
    scene = parse(robot(bodies))
    states = scene.qpos0[None], np.zeros((1, scene.nv)), np.zeros((1, 0))
    qpos, qvel, residual = step(scene, states, 240)
    expected = in_mujoco(scene, *states, substeps=240, model=model_as_it_is(scene))
    assert residual.max() < 1e-10 and abs(qvel).max() < 0.02
    np.testing.assert_allclose(qpos, expected[0], atol=1e-5)
    np.testing.assert_allclose(qpos.reshape(4, 7)[:, 2], scene.qpos0.reshape(4, 7)[:, 2], atol=2e-3)


@pytest.mark.unoptimized
def test_other_shapes_touch_as_their_capsules(rng):
    """Which MuJoCo has in their place here."""
    arms = ""
    for k, kind in enumerate(("box", "cylinder", "ellipsoid", "mesh", "sphere", "capsule")):
        geom = f'type="{kind}" ' + (
            'mesh="tetra" mass="1"' if kind == "mesh" else 'size="0.1 0.06 0.2" pos="0.02 0 0.1"'
        )
        place = f"{0.35 * np.cos(k)} {0.35 * np.sin(k)} 0"
        arms += f'<body pos="{place}"> <joint axis="1 2 3" damping="1"/> <geom {geom}/> </body>'
    mesh = '<asset><mesh name="tetra" vertex="0 0 0 .3 0 0 0 .2 0 0 0 .2"/></asset>'
    scene = with_pairs(parse(robot(arms, mesh, "")))
    states = rng.uniform(-2, 2, (32, 6)), 0.3 * rng.normal(size=(32, 6)), np.zeros((32, 0))
    _, expected, kinds = in_mujoco(scene, *states, model=as_primitives(model_as_it_is(scene)))
    assert approximations(scene) == ("Shapes that touch others as capsules: 3 (surfaces differ by up to 105 mm).",)
    assert len(scene.geom_pairs) == 15 and STATES["quadratic"] in kinds
    np.testing.assert_allclose(step(scene, states)[1], expected, rtol=1e-8, atol=1e-8)
    plates = '<body pos="0 0 {}"> <joint/> <geom type="cylinder" size=".2 .01"/> </body>'
    assert not with_pairs(parse(robot(plates.format(0) + plates.format(0.1), "", ""))).geom_pairs  # capsules overlap


@SLOW
def test_contacts_beyond_the_bound_are_told(rng, monkeypatch):
    """Steps that lack one count as unconverged, and no others; they have the deepest ones."""
    scene, states = tangled("fixed", "elliptic", 0, 64, rng)
    model, pairs = model_as_it_is(scene), {(min(pair), max(pair)) for pair in scene.geom_pairs}
    data, touching = mujoco.MjData(model), []
    for qpos in states[0]:
        data.qpos = qpos
        mujoco.mj_fwdPosition(model, data)
        ends = [(min(pair), max(pair)) for pair in data.contact.geom.tolist()]
        depth = {pair: -contact.dist for pair, contact in zip(ends, data.contact, strict=True) if pair in pairs}
        touching.append(sorted(depth, key=depth.get))
    numbers = np.array([len(each) for each in touching])
    monkeypatch.setattr(types, "MOST_ROOM", 2)
    _, qvel, residual = step(scene, states)
    assert ((residual > 1e-4) == (numbers > 2)).all() and 2 in numbers
    for k in np.flatnonzero(numbers > 2).tolist():
        alone = dataclasses.replace(scene, geom_pairs=tuple(sorted(touching[k][-2:])))
        expected = step(alone, [x[k : k + 1] for x in states])[1]
        np.testing.assert_allclose(qvel[k], expected[0], rtol=1e-8, atol=1e-8)
    assert any(each[0] != max(each) for each in touching if len(each) > 2)


def wall(rows, columns):
    """Bricks that stand on each other."""
    bricks = "".join(
        f'<body pos="{0.41 * column + 0.2 * (row % 2)} {0.001 * (-1) ** column} {0.0499 + 0.0998 * row}"> <freejoint/> '
        '<geom type="box" size=".2 .1 .05"/> </body>'
        for row, column in product(range(rows), range(columns))
    )
    return parse(robot(bricks))


@pytest.mark.parametrize("rows, columns", [(2, 2), pytest.param(4, 4, marks=SLOW)])
def test_there_is_room_for_the_contacts_of_a_wall(rows, columns, rng, monkeypatch):
    """Its contacts at the start are more than the room that other scenes have, which is not enough for them."""
    monkeypatch.setattr(types, "LEAST_ROOM", 4)
    scene = wall(rows, columns)
    number = first_contacts(scene)
    assert number > (64 if rows == 4 else 4) and room_of(scene) >= 2 * number
    assert not [line for line in approximations(scene) if "deepest" in line]
    states = scene.qpos0[None].repeat(4, 0), 0.02 * rng.normal(size=(4, scene.nv)), np.zeros((4, 0))
    expected = in_mujoco(scene, *states, model=model_as_it_is(scene))[1]
    qvel, residual = step(scene, states)[1:]
    np.testing.assert_allclose(qvel, expected, rtol=1e-8, atol=1e-8)
    assert residual.max() < 1e-10
    monkeypatch.setattr(types, "MOST_ROOM", number - 1)
    assert f"Of the {number} contacts between bodies at the start only the {number - 1} deepest act." in report(scene)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", ["tied", "tangled", "solid"])
def test_rows_on_a_gpu_are_the_cpus(kind, rng):
    scene = tied_tree("floating", 0)
    states, found = tied_states(scene, 40, rng), []
    if kind == "tangled":
        scene, states = tangled("floating", "elliptic", 0, 40, rng)
    if kind == "solid":
        scene = solids("elliptic", 0)
        states = solid_states(scene, 40, rng)
    for device in ("cpu", "cuda"):
        integration = Integration("mujoco", 2, tolerance=1e-11)
        sim = Simulator(scene, 40, integration, 2 * H, dtype=torch.float64, device=device)
        leaves = [torch.tensor(x, device=device, requires_grad=True) for x in states]
        ends = sim.step(*leaves)
        grads = torch.autograd.grad(ends[1].sin().sum(), leaves, allow_unused=True)
        found.append([x.detach().cpu() for x in (*ends, *grads) if x is not None and x.numel()])
    for value, expected in zip(*found, strict=True):
        scale = expected.abs().amax(1, keepdim=True).clamp(min=1.0)
        torch.testing.assert_close(value / scale, expected / scale, rtol=0.0, atol=1e-7)


def test_what_rows_between_bodies_do_not_have_is_named():
    scene = parse(pendulum(rest='<equality><joint name="lock" joint1="hinge"/></equality>'))
    with pytest.raises(SceneError, match=r"soft contact has no equality constraints \('lock'\); choose MuJoCo's"):
        Simulator(scene, 1, Integration())
    with pytest.raises(ValueError, match="threads_per_env is 2, must be 1 with rows between two bodies"):
        Simulator(scene, 1, Integration("mujoco", 4), division=(2, 1))
    with pytest.raises(SceneError, match="soft contact has no contact between bodies; choose MuJoCo's contact"):
        Simulator(with_pairs(tangle("fixed", "elliptic", 0)), 1, Integration())
    far = parse(pendulum(rest='<equality><joint name="lock" joint1="hinge" solref="1e-30 1e-30"/></equality>'))
    far.mj_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_REFSAFE)
    with pytest.raises(SceneError, match="equality 'lock': its solref, solimp, .* is out of range"):
        Simulator(far, 1, Integration("mujoco", 4))
