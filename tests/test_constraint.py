"""MuJoCo's own contact, joint limits and dry friction: against MuJoCo, and their gradients against differences."""

from __future__ import annotations

import copy
import re
from itertools import product

import mujoco
import numpy as np
import pytest
import reference
import torch
from scenes import (
    BALL,
    BAR,
    BOUNDED_SERVOS,
    COMPENSATED,
    FREE_SERVOS,
    acting_states,
    free_states,
    leg_scene,
    parse,
    pass_limits,
    pendulum,
    raise_ground,
    random_tree,
    robot,
    task_scene,
    unit,
)
from test_gradient import differences, gradients, weights
from test_terrain import HILLS, everywhere, hopping, pressed

import diffsim
from diffsim.kernels.mujoco import ground
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import FACTORS
from diffsim.robot.types import SceneError
from diffsim.sim import simulator
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.training.checkpoint import POLICIES, load_policy
from diffsim_cli.gait import trace
from diffsim_robots.terrain import incline

ROBOTS = ("hopper", "half_cheetah", "ant", "humanoid")
BASES = "floating", "fixed", "planar", "ball"
SLOW = pytest.mark.slow  # for its kernels, which no other test needs
QUICK_TREES = ("floating", 0), ("floating", 1), ("fixed", 0), ("ball", 1)  # of both cones
TREES = [
    pytest.param(*each, marks=[pytest.mark.unoptimized] * (each[0] != "floating") + [SLOW] * (each not in QUICK_TREES))
    for each in product(BASES, range(3))
]
H = 1 / 240  # s, of a substep
USUAL, PASSES, TOLERANCE = simulator.PASSES, 60, 1e-11  # the latter two: to rounding
STATES = {"satisfied": 0, "quadratic": 1, "linear_neg": 2, "linear_pos": 3, "cone": 4}  # MuJoCo's mjtConstraintState


def constrained_tree(base, seed):
    """A random tree (scenes.py) of capsules and spheres that asks for every kind of constraint in every way.

    Seed 1 has pyramidal cones.
    """
    rng = np.random.default_rng(100 + seed)

    def solref():
        time, ratio, stiffness, damping = rng.uniform((0.01, 0.5, -2000, -100), (0.05, 1.5, -100, -10))
        return f"{time} {ratio}" if rng.random() < 0.7 else f"{stiffness} {damping}"

    def solimp():
        ends = rng.uniform((0.5, 0.9, 0.005, 0.2), (0.9, 0.97, 0.05, 0.8))
        return " ".join(map(str, (*ends, rng.choice([1, 2, 2, 3.5]))))

    def joint(found):
        text = f'{found[0]} frictionloss="{rng.uniform(0.2, 3)}" solreffriction="{solref()}" '
        text += f'solimpfriction="{solimp()}" '
        limit = f'margin="{rng.uniform(0, 0.1)}" solreflimit="{solref()}" solimplimit="{solimp()}"'
        return text if "ball" in found[0] else text + limit

    def geom(found):
        friction, mix, margin = rng.uniform((0.2, 0.5, 0), (1.5, 2, 0.03))
        kind = f'condim="{rng.choice([1, 3, 3])}" priority="{rng.choice([0, 1])}" solmix="{mix}" margin="{margin}"'
        return f'{found[0]} friction="{friction}" {kind} solref="{solref()}" solimp="{solimp()}"'

    text = random_tree(base, seed).replace('type="box"', 'type="capsule"')
    text = re.sub(r'<joint name="joint\d+" type="\w+"', joint, text)
    text = re.sub(r'<geom type="(sphere|capsule)"', geom, text)
    text = text.replace('<geom type="plane"', '<geom type="plane" margin="0.01" friction="0.6" condim="1"')
    cone = "pyramidal" if seed == 1 else "elliptic"
    return parse(text.replace("<option ", f'<option cone="{cone}" impratio="{rng.uniform(0.5, 5)}" '))


def kinds_of_states(seed):
    """MuJoCo's kinds of states of such a tree's constraints."""
    return {kind for name, kind in STATES.items() if name != "cone" or seed != 1}


def tree_states(base, seed, count, rng):
    """Such a tree, and random states with contacts, half of them nearly at rest."""
    scene = constrained_tree(base, seed)
    qpos, qvel, ctrl = free_states(scene, count, rng)
    pass_limits(scene, qpos, rng)
    qvel[::2] *= 0.05
    if scene.floating:
        qpos[:, 2] -= [reference.contacts(scene, *state)[0].min() + 0.02 for state in zip(qpos, qvel, strict=True)]
        return scene, (qpos, qvel, ctrl)
    return raise_ground(scene, qpos), (qpos, qvel, ctrl)


def mujoco_model(scene):
    """The robot's model with a solver that converges."""
    m = copy.copy(scene.mj_model)
    m.opt.timestep = H
    m.opt.iterations, m.opt.tolerance, m.opt.ls_iterations, m.opt.ls_tolerance = 200, 0, 100, 1e-10
    if len(ground := np.flatnonzero(m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)):
        m.geom_pos[ground, 2] = scene.ground_height
    m.geom_contype[:], m.geom_conaffinity[:] = 1, 0  # the robot's parts pass through each other
    m.geom_contype[ground], m.geom_conaffinity[ground] = 0, 1
    return m


def in_mujoco(scene, qpos, qvel, ctrl, steps=1, substeps=1, model=None):
    """qpos, qvel after control steps of MuJoCo's, and the set of its constraints' states."""
    m = model or mujoco_model(scene)
    low, high = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, [-1.0, 1.0]).T
    data, ends, kinds = mujoco.MjData(m), [], set()
    for q, v, u in zip(qpos, qvel, np.broadcast_to(ctrl, (steps, *np.shape(ctrl)[-2:])).swapaxes(0, 1), strict=True):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel = q, v
        for action in u:
            data.ctrl = low + (action + 1) / 2 * (high - low)
            mujoco.mj_step(m, data, substeps)
        kinds |= set(data.efc_state.tolist())
        ends.append((data.qpos.copy(), data.qvel.copy()))
    return *map(np.array, zip(*ends, strict=True)), kinds


@pytest.fixture(autouse=True)
def enough_passes(monkeypatch):
    monkeypatch.setattr(simulator, "PASSES", PASSES)


def step(scene, states, substeps=1, tolerance=TOLERANCE, onset=0.0, **options):
    """qpos, qvel and the residual after a control step."""
    options = {"dtype": torch.float64} | options
    factors = options.pop("factors", None)
    integration, given = Integration("mujoco", substeps, tolerance=tolerance, onset=onset), factors is not None
    sim = Simulator(scene, len(states[0]), integration, substeps * H, factors=given, **options)
    sim.factors = factors if given else sim.factors
    with torch.no_grad():
        ends = sim.step(*(torch.as_tensor(x, dtype=options["dtype"]) for x in states))
    return *(x.double().numpy() for x in ends), sim.residual.double().numpy()


def check_step(scene, states, enough, model=None, **options):
    _, qvel, residual = step(scene, states, **options)
    _, expected, kinds = in_mujoco(scene, *states, model=model)
    error = abs(qvel - expected).max(1) / abs(expected - states[1]).max(1)
    converged = residual < 1e-10
    assert converged.mean() >= enough
    assert error[converged].max() < 1e-8
    return kinds


def test_a_free_joints_damping_is_implicit_as_mujocos(rng):
    """So hard that an explicit step would blow up, as a default for all joints reaches the free one too."""
    default = '<default> <joint damping="8000" armature=".002"/> </default> <option'
    scene = parse(COMPENSATED.replace("<option", default).replace('armature="0.7" damping="0.4"', ""))
    states = free_states(scene, 8, rng)
    assert 8000 * H / scene.mass.sum() > 1 and scene.base_damping[0] == 8000
    check_step(scene, states, 1.0)


@pytest.mark.parametrize(
    "name", ["hopper", "ant", *(pytest.param(name, marks=SLOW) for name in ("half_cheetah", "humanoid"))]
)
def test_task_steps_are_mujocos(name, rng):
    """Pressed into the ground and beyond limits, at rest and in motion; joint damping included."""
    scene = task_scene(name)
    assert check_step(scene, acting_states(scene, 64, rng), 1.0) >= {
        STATES[k] for k in ("satisfied", "quadratic", "cone")
    }


@pytest.mark.parametrize("base, seed", TREES)
def test_tree_steps_are_mujocos(base, seed, rng):
    """solref of both forms, solimp, margins, impratio, priorities, frictionless geoms, dry friction on every joint."""
    scene, states = tree_states(base, seed, 32, rng)
    assert check_step(scene, states, 1.0) == kinds_of_states(seed)


@pytest.mark.unoptimized
def test_pairs_and_meshes_touch_as_in_mujoco(rng):
    """A <pair> has its own friction, time constants, impedance and margin; a frictionless mesh touches beside it."""
    numbers = 'condim="3" friction="0.4 0.4" solref="-900 -40" solimp="0.7 0.95 0.01 0.4 2" margin="0.03"'
    scene = parse(
        robot(
            '<body><freejoint/><geom name="foot" size="0.1" contype="0" conaffinity="0" friction="2"/>'
            '<body pos="0.3 0 0"><joint axis="0 1 0" damping="0.1"/><geom type="mesh" mesh="tetra" mass="1"/>'
            "</body></body>",
            '<asset><mesh name="tetra" vertex="0 0 0 .3 0 0 0 .2 0 0 0 .2"/></asset>'
            f'<contact><pair geom1="foot" geom2="floor" {numbers}/></contact>',
            '<geom name="floor" type="plane" size="1 1 1" condim="1" priority="1"/>',
        )
    )
    qpos, qvel, ctrl = free_states(scene, 64, rng)
    qpos[:, 2] -= [reference.contacts(scene, *state)[0].min() + 0.02 for state in zip(qpos, qvel, strict=True)]
    qpos[:, 2] += 0.04 * rng.random(64)
    check_step(scene, (qpos, 0.3 * qvel, ctrl), 1.0)


IMPLICIT = 'integrator="implicitfast"/>'
EXPLICIT = 'integrator="Euler"> <flag eulerdamp="disable"/> </option>'


@pytest.mark.parametrize(
    "option", ['integrator="Euler"/>', *(pytest.param(x, marks=SLOW) for x in (IMPLICIT, EXPLICIT))]
)
@pytest.mark.parametrize("mjcf", [pytest.param(FREE_SERVOS, marks=SLOW), BOUNDED_SERVOS])
def test_servos_are_damped_as_the_integrator_does(mjcf, option, rng):
    """Euler takes joints' dampers implicitly, implicitfast those of servos, too, but where a force is at a bound."""
    scene = parse(mjcf.replace(IMPLICIT, option))
    states = free_states(scene, 32, rng)
    check_step(scene, states, 1.0)
    check_gradients(scene, states, rng, enough=1.0)


@pytest.mark.parametrize("name", ["hopper", "ant"])
def test_control_steps_stay_with_mujoco(name, rng):
    """A hundred, of four substeps, of a trained policy's actions."""
    env = diffsim.make(name, 4, seed=0, dtype=torch.float64, contact="mujoco", tolerance=TOLERANCE, threads=1)
    policy = load_policy(POLICIES / f"{name}.pt").network.double()
    obs = env.reset(seed=0)[0]
    start, actions = [x.numpy().copy() for x in (env.qpos, env.qvel)], []
    sim, (qpos, qvel) = env.sim, (env.qpos.clone(), env.qvel.clone())
    with torch.no_grad():
        for _ in range(100):
            actions.append(policy(obs).clamp(-1, 1))
            qpos, qvel = sim.step(qpos, qvel, actions[-1])
            obs = env.task.observe(qpos, qvel, actions[-1])
    expected = in_mujoco(env.scene, *start, np.array([a.numpy() for a in actions]), steps=100, substeps=4)
    assert abs(qpos.numpy() - expected[0]).max() < 1e-3


def random_robot(cone, integrator, seed):
    """A trunk on four joints' chains of a box, a capsule and two spheres, with servos of both kinds."""
    rng = np.random.default_rng(seed)

    def part(kind, joint="", inside=""):
        size, angles, place = rng.uniform(0.03, 0.08, 3), rng.uniform(-180, 180, 3), rng.uniform(-0.15, 0.15, 3)
        axis, loss, friction, margin = (
            rng.normal(size=3),
            rng.uniform(0.05, 0.3),
            rng.uniform(0.2, 1.2),
            rng.choice([0, 0.01]),
        )
        numbers = [" ".join(map(str, x)) for x in (size, angles, place, axis)]
        joint = f'<joint {joint} axis="{numbers[3]}" frictionloss="{loss}"/>' if joint else "<freejoint/>"
        geom = f'condim="{rng.choice([1, 3]) if inside == "" else 3}" friction="{friction}" margin="{margin}"'
        geom = f'<geom type="{kind}" size="{numbers[0]}" euler="{numbers[1]}" mass="{rng.uniform(0.2, 1)}" {geom}/>'
        return f'<body pos="{numbers[2]}">{joint}{geom}{inside}</body>'

    tree = part("capsule", 'name="a"', part("sphere", 'name="b" type="slide" range="-0.02 0.02"'))
    tree = part("box", "", tree + part("box", 'name="c"', part("sphere", 'name="d"')))
    kp, kv = rng.uniform(5, 30, 4), rng.uniform(0.2, 2, 4)
    bounds = 'forcerange="-2 2"', "", "", 'forcerange="-1 3"'
    servos = [
        f'<position joint="{j}" kp="{p}" kv="{v}" {b}/>' for j, p, v, b in zip("abcd", kp, kv, bounds, strict=True)
    ]
    return f"""<mujoco><option cone="{cone}" integrator="{integrator}" impratio="{rng.choice([1, 5])}"/>
    <default> <geom contype="0"/> <joint damping="0.1" armature="0.01" range="-25 25"/> <position ctrlrange="-1 1"/>
    </default> <worldbody> <geom type="plane" size="0 0 1" contype="1" friction="{rng.uniform(0.2, 1)}"/> {tree}
    </worldbody> <actuator> {"".join(servos)} </actuator> </mujoco>"""


CONES, INTEGRATORS = ("pyramidal", "elliptic"), ("Euler", "implicitfast")


@pytest.mark.parametrize(
    "cone, integrator",
    [pytest.param(*each, marks=[SLOW] * (each != ("pyramidal", "Euler"))) for each in product(CONES, INTEGRATORS)],
)
def test_random_robots_move_as_in_mujoco(cone, integrator, rng):
    """Over 20 steps of files as they are; their gradients are those of differences."""
    for seed in range(6):
        scene, n = parse(random_robot(cone, integrator, seed)), 16
        qpos, qvel, ctrl = free_states(scene, n, rng)
        qpos[:, 7:] *= 0.3
        qpos[:, 2] += trace(scene, qpos)[0].max(1) - rng.uniform(0, 0.01, n)
        states = qpos, 0.3 * qvel, ctrl
        end_qpos, end_qvel, residual = step(scene, states, substeps=20)
        expected, velocity, kinds = in_mujoco(scene, *states, substeps=20)
        assert residual.max() < 1e-10 and STATES["linear_neg"] in kinds
        assert abs(end_qpos - expected).max() < 1e-8 and abs(end_qvel - velocity).max() < 1e-6
    check_gradients(scene, [x[:8] for x in states], rng)


# Terrain


@pytest.mark.parametrize(
    "name", ["sphere", "margin", "bar", *(pytest.param(name, marks=SLOW) for name in ("hopper", "ant"))]
)
def test_an_incline_is_mujocos_tilted_plane(name, rng):
    """At rest and sliding, up and down and across the slope, and within a margin above it."""
    ball = {"sphere": BALL, "margin": BALL.replace('size="0.1"', 'size="0.1" margin="0.03"'), "bar": BAR}
    flat = parse(ball[name]) if name in ball else task_scene(name)
    scene = flat.with_terrain(incline(20.0, start=-50.0))
    qpos, qvel, ctrl = acting_states(flat, 64, rng)
    up, along = (2, 0) if scene.floating else (1, 0)
    qpos[:, along] = rng.uniform(-3, 3, 64)
    for _ in range(3):
        qpos[:, up] -= [reference.contacts(scene, *state)[0].min() + 0.01 for state in zip(qpos, qvel, strict=True)]
    qpos[:, up] += rng.uniform(0, 0.05, 64) * (name == "margin")
    m = mujoco_model(scene)
    ground = np.flatnonzero(m.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    turn = np.radians(-20.0) / 2
    m.geom_sameframe[ground], m.geom_quat[ground] = 0, [np.cos(turn), 0, np.sin(turn), 0]
    m.geom_pos[ground] = [-50.0, 0, 0]
    ones = {"factors": torch.ones(64, len(FACTORS), dtype=torch.float64)} if name == "bar" else {}  # as below
    kinds = check_step(scene, (qpos, qvel, ctrl), 1.0, m, **ones)
    assert kinds >= {STATES["quadratic"], STATES["satisfied" if name == "bar" else "cone"]}


def test_faces_and_edges_are_mujocos_box(rng):
    """A ball on top, beside and at both edges of a box on the plane."""
    profile = np.array([[-1, 0], [0, 0], [0, 0.5], [1, 0.5], [1, 0], [2, 0]])
    scene, n = parse(BALL).with_terrain(profile), 64
    depth, turn, side = rng.uniform(0, 0.02, n), rng.uniform(0, np.pi / 2, n), np.resize([-1, 1], n)
    turn[:10], turn[10:20] = 0, np.pi / 2
    reach = 0.1 - depth
    qpos, qvel = np.zeros((n, 7)), rng.normal(size=(n, 6)) * np.resize([0.02, 0.02, 1, 1], n)[:, None]
    qpos[:, 0] = 0.5 + side * (0.5 + reach * np.cos(turn))
    qpos[:, 2] = 0.5 + reach * np.sin(turn)
    qpos[:10, 2], qpos[10:20, 0] = 0.3, 0.4
    qpos[-5:, 0], qpos[-5:, 2], qpos[:, 3:] = -0.4, 0.09, unit(rng.normal(size=(n, 4)))
    box = '<geom type="box" size="0.5 9 0.25" pos="0.5 0 0.25" contype="0" conaffinity="1"/>'
    m = mujoco_model(parse(BALL))
    with_box = mujoco.MjModel.from_xml_string(BALL.replace("<body pos", f"{box}<body pos"))
    for name in "cone timestep iterations tolerance ls_iterations ls_tolerance".split():
        setattr(with_box.opt, name, getattr(m.opt, name))
    check_step(scene, (qpos, qvel, np.zeros((n, 0))), 1.0, with_box)


@pytest.mark.parametrize(
    "name, varied",
    [
        pytest.param(*each, marks=[SLOW] * (each not in (("sphere", False), ("bar", True))))
        for each in product(("sphere", "bar", "hopper"), (False, True))
    ],
)
def test_gradients_on_hills_are_those_of_differences(name, varied, rng):
    """On slopes and ridges, in valleys and at a wall, all of which turn the frame of the contact."""
    if name == "hopper":
        scene, states = hopping(HILLS, 16, rng)
    else:
        scene = parse(BAR if name == "bar" else BALL).with_terrain(HILLS)
        states = pressed(scene, everywhere(rng), rng)
    factors = {"factors": rng.uniform(0.7, 1.4, (len(states[0]), len(FACTORS)))} if varied else None
    check_gradients(scene, states, rng, factors, enough=0.8)


def test_a_level_terrain_is_the_plane(rng):
    scene = parse(BALL)
    level = np.stack([np.linspace(-9, 9, 40), np.zeros(40)], 1)
    states = acting_states(scene, 32, rng)
    for value, expected in zip(step(scene.with_terrain(level), states), step(scene, states), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-10, atol=1e-10)


# Gradients


def check_gradients(scene, states, rng, optional=None, enough=0.5, onset=0.0):
    """Against differences, in the states where Newton's method has converged, and does in their neighbourhood."""
    integration, w = Integration("mujoco", 4, tolerance=TOLERANCE, onset=onset), weights(scene, rng)
    given = {name: torch.tensor(x) for name, x in (optional or {}).items()}
    beside = [[x + scale * rng.normal(size=x.shape) for x in states] for scale in (0.0, 1e-7, 1e-6, 1e-5)]
    residual = np.max([step(scene, near, substeps=4, onset=onset, **given)[2] for near in beside], axis=0)
    sim = {"integration": integration, "control_dt": 4 * H}
    kept = residual < 1e-10
    assert kept.mean() >= enough
    states = [x[kept] for x in states]
    optional = {name: x[kept] for name, x in (optional or {}).items()}
    values = gradients(scene, states, w, optional=optional, **sim)
    # Short steps drown in the solver's rounding, long ones cross from zone to zone: one size must agree.
    expected = [differences(scene, states, w, optional, scale, **sim) for scale in (1.0, 10.0, 100.0)]
    for name, value, *slopes in zip(("qpos", "qvel", "ctrl"), values, *expected, strict=True):
        if slopes[0].size:
            wrong = [np.linalg.norm(value.reshape(s.shape) - s, axis=-1) / np.linalg.norm(s, axis=-1) for s in slopes]
            assert np.min(wrong, axis=0).max() < 1e-6, f"gradient with respect to {name}: {np.min(wrong, axis=0)}"


@pytest.mark.parametrize(
    "base, seed, varied",
    [
        pytest.param(*each, marks=[SLOW] * (each[0] != "floating" or each[1:] == (1, True)))
        for each in [*product(BASES, (0, 1), (False,)), *product(("floating", "planar"), (0, 1), (True,))]
    ],
)
def test_tree_gradient_is_that_of_differences(base, seed, varied, rng):
    """In every zone of every law; also with factors of friction, time constants, mass and motors."""
    n = 16 if seed == 0 else 32
    scene, states = tree_states(base, seed, n, rng)
    assert in_mujoco(scene, *states)[2] == kinds_of_states(seed)
    states = [x[:16] for x in states] if varied else states
    check_gradients(scene, states, rng, {"factors": rng.uniform(0.7, 1.4, (16, len(FACTORS)))} if varied else None)


@pytest.mark.parametrize("name", ["hopper", "sphere", *(pytest.param(name, marks=SLOW) for name in ("ant", "ball"))])
def test_jacobians_are_mujocos(name, rng):
    """Of one substep, as mjd_transitionFD has them; its actions are in the units of the control range."""
    if name == "ball":
        scene, states = tree_states(name, 0, 32, rng)
    else:
        scene = parse(BALL) if name == "sphere" else task_scene(name)
        states = acting_states(scene, 32, rng)
    m, (qpos, qvel, ctrl) = mujoco_model(scene), states
    for k in scene.quaternion_adr:
        qpos[:, k : k + 4] /= np.linalg.norm(qpos[:, k : k + 4], axis=1, keepdims=True)
    how = Integration("mujoco", 1, tolerance=TOLERANCE)
    sim = Simulator(scene, 32, how, H, dtype=torch.float64)
    found = torch.cat(sim.jacobians(*map(torch.tensor, states)), dim=2)
    converged, data, errors = np.flatnonzero(sim.residual < 1e-10), mujoco.MjData(m), []
    low, high = np.where(m.actuator_ctrllimited[:, None], m.actuator_ctrlrange, [-1.0, 1.0]).T
    for k in converged:
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.ctrl = qpos[k], qvel[k], low + (ctrl[k] + 1) / 2 * (high - low)
        A, B = np.zeros((2 * m.nv, 2 * m.nv)), np.zeros((2 * m.nv, m.nu))
        mujoco.mjd_transitionFD(m, data, 1e-7, True, A, B, None, None)
        expected = np.hstack((A, B * (high - low) / 2))
        errors.append(np.linalg.norm(found[k].numpy() - expected) / np.linalg.norm(expected))
    assert len(converged) >= 30 and np.quantile(errors, 0.9) < 1e-6


def test_few_passes_have_a_gradient_of_usual_size(rng, monkeypatch):
    """The adjoint is that of the last pass, so it does not grow where Newton's method is on its way."""
    scene, states = tree_states("floating", 0, 32, rng)
    w, sizes = weights(scene, rng), []
    for passes in (2, 4, PASSES):
        monkeypatch.setattr(simulator, "PASSES", passes)
        integration = Integration("mujoco", 16)
        parts = gradients(scene, states, w, integration=integration, control_dt=16 * H)
        sizes.append(np.linalg.norm(np.concatenate(parts, axis=1), axis=1))
    monkeypatch.setattr(simulator, "PASSES", 2)
    assert step(scene, states)[2].max() > 0.1  # not converged, and by 4 passes neither
    assert max(size.max() for size in sizes) < 10 * np.median(sizes), [size.max() for size in sizes]


@pytest.mark.slow
def test_muscle_gradient_is_that_of_differences(rng):
    scene = leg_scene(grounded=True)
    qpos, qvel, ctrl = free_states(scene, 8, rng)
    check_gradients(raise_ground(scene, qpos), (qpos, 0.1 * qvel, ctrl), rng)


def test_robot_without_damping(rng):
    """It has no second solve: a ball that flies, rolls, slides or lies, in MuJoCo and by differences."""
    scene = parse(BALL)
    qpos, qvel = np.zeros((16, 7)), rng.normal(size=(16, 6)) * np.linspace(0, 2, 16)[:, None]
    qpos[:, 3], qpos[:, 2] = 1.0, rng.uniform(0.09, 0.102, 16)
    check_step(scene, (qpos, qvel, np.zeros((16, 0))), 1.0)
    check_gradients(scene, (qpos, qvel, np.zeros((16, 0))), rng, enough=1.0)


def test_a_ball_at_rest_has_the_gradient_of_differences():
    """Also in the uppermost millimetre, where a contact that has just begun would be."""
    how = Integration("mujoco", 1, tolerance=TOLERANCE)
    sim = Simulator(parse(BALL), 3, how, 0.002, dtype=torch.float64)

    def speeds(z):
        qpos = torch.tensor(sim.scene.qpos0).repeat(3, 1).index_copy(1, torch.tensor([2]), z[:, None])
        qvel = torch.tensor([[0.0], [0.1], [0.0]], dtype=torch.float64) * torch.eye(6, dtype=torch.float64)[2]
        return sim.step(qpos, qvel, torch.zeros(3, 0, dtype=torch.float64))[1][:, 2]

    z = torch.tensor([0.0995, 0.0995, 0.0985], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(speeds(z).sum(), z)
    still = z.detach()
    torch.testing.assert_close(slope, (speeds(still + 1e-7) - speeds(still - 1e-7)) / 2e-7, rtol=1e-4, atol=0)
    assert (slope < -1).all()


def test_a_slope_turns_gradients_of_landings():
    """Without gravity a ball meets it as it meets the plane, seen by an observer who is turned."""
    scene, n, angle = parse(BALL.replace("<worldbody>", '<option gravity="0 0 0"/> <worldbody>')), 32, np.radians(20.0)
    slope = scene.with_terrain([[0.0, 0.0], [1.0, np.tan(angle)]])
    turn = torch.tensor([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    start = torch.tensor([[0.0, 0, 0, 1, 0, 0.3, -1]]).double().repeat(n, 1)
    start[:, 2] = torch.linspace(0.13, 0.2, n)
    weights = torch.linspace(-1, 1, 6).double()

    def gradient(scene, turn):
        sim = Simulator(scene, n, Integration("mujoco", 16), 1 / 60, 4, dtype=torch.float64)
        leaf = start.clone().requires_grad_()
        place, still, velocity = leaf.split((3, 1, 3), 1)
        none = torch.zeros(n, 3).double()
        qpos = torch.cat((place @ turn.T, still, none), 1)
        qvel = torch.cat((velocity @ turn.T, none), 1)
        for _ in range(4):
            qpos, qvel = sim.step(qpos, qvel, none[:, :0])
        ends = torch.cat((qpos[:, :3] @ turn, qvel[:, :3] @ turn), 1)
        return torch.autograd.grad((ends * weights).sum(), leaf)[0][:, [0, 1, 2, 4, 5, 6]]

    expected = gradient(scene, torch.eye(3).double())
    torch.testing.assert_close(gradient(slope, turn), expected, rtol=1e-6, atol=1e-6)


# Tolerance


def sliding_ant(friction, speed, rng, count=32, cone="elliptic"):
    """An ant on ground of that friction, and states in which it slides, or hits the ground at that speed."""
    model = mujoco.MjModel.from_xml_path(task_scene("ant").path)
    model.geom_friction[:, 0], model.opt.cone = friction, CONES.index(cone)
    scene = load_scene(model)
    qpos, qvel, ctrl = acting_states(scene, count, rng)
    qvel[:, :2] += speed * rng.normal(size=(count, 2))
    qvel[:, 2] -= speed * rng.random(count)
    return scene, (qpos, qvel, ctrl)


@pytest.mark.parametrize("cone", ["elliptic", pytest.param("pyramidal", marks=SLOW)])  # random robots have pyramids
@pytest.mark.parametrize("friction, speed", [(0.3, 2.0), (0.05, 2.0), (1.0, 10.0)])
def test_slips_and_impacts_converge_to_mujocos(friction, speed, cone, rng, monkeypatch):
    """With the default's tolerance and at most as many passes."""
    scene, states = sliding_ant(friction, speed, rng, cone=cone)
    _, expected, kinds = in_mujoco(scene, *states)
    assert (STATES["cone"] in kinds) == (cone == "elliptic")
    with monkeypatch.context() as usual:
        usual.setattr(simulator, "PASSES", USUAL)
        _, qvel, residual = step(scene, states, tolerance=Integration().tolerance)
    assert residual.max() <= Integration().tolerance
    assert (abs(qvel - expected).max(1) / abs(expected - states[1]).max(1)).max() < 1e-3
    check_gradients(scene, [x[:8] for x in states], rng, enough=0.9)


THROWN = """<mujoco><option timestep="0.002" cone="elliptic" iterations="2000" tolerance="0" ls_iterations="500"
ls_tolerance="1e-14"/><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 .5"><freejoint/>
<geom type="sphere" size=".2" mass="{root}"/><body pos="0 0 -.25"><joint axis="0 1 0" range="-60 60"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".03" mass="{link}" friction="{friction}"/><body pos="0 0 -.2">
<joint axis="1 0 0" range="-30 30"/><geom type="sphere" size=".05" mass="{link}" friction="{friction}"/>
</body></body></body></worldbody></mujoco>"""
MASSES = (1.0, 1.0), (1e2, 1e-2), (1e4, 1e-4), (1e5, 1e-4), (1e-4, 1e-4), (3e5, 3e5)  # kg, of root and of links


@pytest.mark.slow
@pytest.mark.parametrize("root, link, friction", [*((*m, 1.0) for m in MASSES), (1.0, 1.0, 0.0), (1.0, 1.0, 100.0)])
@pytest.mark.parametrize("speed, depth", [(1.0, 0.01), (10.0, 0.05), (100.0, 0.1), (1000.0, 0.3)])  # m/s, rad/s; m
def test_light_and_heavy_links_are_thrown_into_the_ground_as_in_mujoco(
    root, link, friction, speed, depth, rng, monkeypatch
):
    """None is contained. Of the largest velocity and its change, errors are small in float64, solved to the end, and in
    float32 to the default tolerance."""
    scene, states = parse(THROWN.format(root=root, link=link, friction=friction)), []
    model, data = scene.mj_model, mujoco.MjData(scene.mj_model)
    for _ in range(16):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv) * ([0] * 3 + [0.1] * 5), 1.0)
        data.qpos[7:] = rng.uniform(-0.7, 0.7, 2)
        mujoco.mj_kinematics(model, data)
        lowest = min(data.geom_xpos[1, 2] - 0.2, data.geom_xpos[3, 2] - 0.05)
        data.qpos[2] -= lowest + rng.uniform(0, depth)
        data.qvel[:] = rng.normal(size=model.nv) * speed
        start = data.qpos.copy(), data.qvel.copy()
        mujoco.mj_step(model, data)
        states.append((*start, data.qvel.copy()))
    qpos, qvel, expected = (np.stack(parts) for parts in zip(*states, strict=True))
    scale = abs(expected).max(1) + abs(expected - qvel).max(1)
    exact = Integration("mujoco", 1, tolerance=1e-13)
    for dtype, how, passes, enough in (
        (torch.float64, exact, 300, 1e-9),
        (torch.float32, Integration("mujoco", 1), USUAL, 1e-2),
    ):
        monkeypatch.setattr(simulator, "PASSES", passes)
        sim = Simulator(scene, 16, how, 0.002, dtype=dtype)
        _, after = sim.step(*(torch.tensor(x).to(dtype) for x in (qpos, qvel)), torch.zeros(16, 0, dtype=dtype))
        assert not sim.nonfinite.any()
        assert (abs(after.double().numpy() - expected).max(1) / scale).max() < enough


def test_violent_states_on_stiff_ground_converge_to_mujocos(rng, monkeypatch):
    """A quadruped deep in a ground of impedance 0.9999 and impratio 100, with dry friction and limits."""
    scene, n = diffsim.make("go2", 1).scene, 1024
    qpos, turn = np.tile(scene.qpos0, (n, 1)), 0.3 * rng.normal(size=(n, 4))
    qpos[:, :3] += 0.03 * rng.normal(size=(n, 3))
    qpos[:, 3:7] = (qpos[:, 3:7] + turn) / np.linalg.norm(qpos[:, 3:7] + turn, axis=1, keepdims=True)
    qpos[:, 7:] += 0.1 * rng.normal(size=(n, scene.nq - 7))
    states = qpos, 2 * rng.normal(size=(n, scene.nv)), rng.uniform(-1, 1, (n, scene.nu))
    states = [x.astype(np.float32).astype(float) for x in states]
    monkeypatch.setattr(simulator, "PASSES", 200)
    _, solved, residual = step(scene, states)
    assert residual.max() < 1e-10
    change = abs(solved - states[1]).max(1)
    _, expected, kinds = in_mujoco(scene, *(x[:64] for x in states))
    assert {STATES["cone"], STATES["linear_neg"]} <= kinds
    assert (abs(solved[:64] - expected).max(1) / change[:64]).max() < 1e-7
    how = Integration()
    monkeypatch.setattr(simulator, "PASSES", USUAL)
    for dtype, block, enough in ((torch.float64, 1, 0.999), (torch.float32, 8, 0.97)):
        _, qvel, residual = step(scene, states, tolerance=how.tolerance, dtype=dtype, block=block)
        error, converged = abs(qvel - solved).max(1) / change, residual <= how.tolerance
        assert converged.mean() >= enough
        assert np.quantile(error[converged], 0.99) < 5e-3 and error[converged].max() < 0.1


def test_gradient_at_the_tolerance_is_near_that_of_the_solution(rng):
    scene, states = sliding_ant(0.3, 2.0, rng)
    w, parts = weights(scene, rng), []
    for tolerance in (1e-4, TOLERANCE):
        how = Integration("mujoco", 1, tolerance=tolerance)
        parts.append(np.concatenate(gradients(scene, states, w, integration=how, control_dt=H), axis=1))
    error = np.linalg.norm(parts[0] - parts[1], axis=1) / np.linalg.norm(parts[1], axis=1)
    assert 0 < error.max() < 1e-2


def test_contacts_of_an_earlier_rollout_leave_no_trace(rng):
    """Of which the checkpoint holds longer lists where fewer feet touch now."""
    scene, states = sliding_ant(0.3, 2.0, rng, 64)
    states[0][:32, 2] -= 0.2  # all feet
    states[0][32:, 3:7] += 0.2 * rng.normal(size=(32, 4))

    def gradients_after(*orders):
        sim = Simulator(scene, 64, Integration("mujoco", 1), H, dtype=torch.float64)
        for order in orders:
            sim.rewind()
            start = [torch.tensor(x[order], requires_grad=True) for x in states]
            grads = torch.autograd.grad(torch.cat(sim.step(*start), 1).square().sum(), start)
        return torch.cat(grads, 1)

    order = np.arange(64)
    assert torch.equal(gradients_after(order, np.roll(order, 32)), gradients_after(np.roll(order, 32)))


def test_steps_that_do_not_converge_are_counted(monkeypatch):
    """Each environment's, whose last pass is not enough; statistics take the count and begin anew."""
    monkeypatch.setattr(simulator, "PASSES", 1)
    env = diffsim.make("ant", 8, seed=0, contact="mujoco", threads=1)
    env.reset(seed=0)
    action = torch.zeros(8, env.scene.nu)
    wrong = sum((env.step(action), env.sim.residual > env.sim.integration.tolerance)[1].int() for _ in range(20))
    assert wrong.sum() > 0 and torch.equal(env.sim.unconverged, wrong.int())
    assert env.take_statistics()["unconverged"] == wrong.sum() and not env.sim.unconverged.any()


def test_steps_that_have_no_room_for_a_contact_are_counted(monkeypatch):
    """And no others: those are MuJoCo's."""
    monkeypatch.setattr(ground, "MOST_CONTACTS", 4)
    monkeypatch.setattr(ground, "SHARES", (4, 4))
    feet = "".join(f'<geom type="sphere" size=".05" pos="{0.1 * k} {0.1 * (k % 2)} 0"/>' for k in range(6))
    scene = parse(robot(f'<body name="comb"> <freejoint/> {feet} </body>'))
    turns = np.linspace(-0.031, 0.031, 13)
    qpos, rest = np.zeros((13, 7)), np.zeros((13, 6))
    qpos[:, 2], qpos[:, 3], qpos[:, 5] = 0.045, np.cos(turns / 2), np.sin(turns / 2)
    numbers = (qpos[:, 2:3] - np.arange(6) * 0.1 * np.sin(turns)[:, None] < 0.05).sum(1)
    _, qvel, residual = step(scene, (qpos, rest, np.zeros((13, 0))))
    expected = in_mujoco(scene, qpos, rest, np.zeros((13, 0)))[1]
    assert {3, 4, 5, 6} < set(numbers.tolist())
    assert ((residual > 1e-4) == (numbers > 4)).all()
    np.testing.assert_allclose(qvel[numbers <= 4], expected[numbers <= 4], rtol=1e-8, atol=1e-8)


# Single precision, metrics, bad input


@pytest.mark.parametrize(
    "scene, integration, why",
    [
        (pendulum(), Integration("mujoco", 4, tolerance=0), "tolerance is 0, must lie between 0 and 1"),
        (
            pendulum('frictionloss="1"'),
            Integration(),
            "soft contact has no frictionloss .joint 'hinge'.; choose MuJoCo's contact",
        ),
        (
            pendulum('range="-.1 .1" margin=".2"'),
            Integration("mujoco", 4),
            "margins of the limits of joint 'hinge' meet",
        ),
        (pendulum(rest='<option><flag diagexact="enable"/></option>'), Integration("mujoco", 4), "diagexact"),
    ],
)
def test_bad_input_is_named(scene, integration, why):
    with pytest.raises(ValueError, match=why) as error:
        Simulator(parse(scene), 1, integration)
    assert "\n" not in str(error.value)


def test_frictionless_contact_and_friction_of_zero():
    """Both slide as in MuJoCo, which takes friction of zero for 1e-5."""
    for kind in ('condim="1"', 'friction="0"'):
        body = f'<body><freejoint/><geom type="sphere" size="0.1" {kind}/></body>'
        ground = f'<geom type="plane" size="1 1 1" {kind}/>'
        scene, pyramidal = (
            parse(robot(body, f'<option cone="{cone}"/>', ground)) for cone in ("elliptic", "pyramidal")
        )
        states = np.array([[0, 0, 0.0999, 1.0, 0, 0, 0]]), np.array([[1.0, 0, 0, 0, 0, 0]]), np.zeros((1, 0))
        _, qvel, _ = step(scene, states)
        np.testing.assert_allclose(qvel, in_mujoco(scene, *states)[1], atol=1e-9)
        assert qvel[0, 0] > 0.9999
    with pytest.raises(
        SceneError, match="robot: geom number 1: so little friction .* too stiff for float32; take condim"
    ):
        step(pyramidal, states, dtype=torch.float32)


@pytest.mark.unoptimized
@pytest.mark.parametrize(("dtype", "enough"), [(torch.float64, 1e-9), pytest.param(torch.float32, 1e-5, marks=SLOW)])
def test_a_turntable_in_the_ground_turns_as_in_mujoco(dtype, enough):
    """A link that turns about its centre of mass has an inverse weight of zero."""
    body = '<body><joint axis="0 0 1"/><geom size="0.1"/><body pos="0.3 0 0.3"><joint axis="0 1 0"/>'
    body += '<geom type="capsule" size="0.02 0.1" contype="0" conaffinity="0"/></body></body>'
    scene = parse(robot(body, world='<geom type="plane" size="1 1 1" pos="0 0 -0.08"/>'))
    assert scene.mj_model.body_invweight0[1, 0] == 0
    states = np.array([[0.4, 0.3]]), np.array([[2.0, -1.0]]), np.zeros((1, 0))
    sim_qvel = step(scene, states, dtype=dtype, tolerance=1e-6 if dtype == torch.float32 else TOLERANCE)[1]
    np.testing.assert_allclose(sim_qvel, in_mujoco(scene, *states)[1], atol=enough)


def test_float32_keeps_the_zone_of_a_deep_contact(monkeypatch) -> None:
    """Feet deep in the ground are so stiff that rounding moves a contact over the edge of its cone. The gradient takes
    the zone in which the step was solved: with another one it was up to 1e5 times too large."""
    monkeypatch.setattr(simulator, "PASSES", USUAL)
    task = diffsim.TASKS["go2"]
    scene, n = task.load_robot(), 512
    how = task.integration("default")._replace(tolerance=1e-6)  # so that rounding is what differs
    rng = torch.Generator().manual_seed(0)
    noise = lambda *size: torch.rand(*size, generator=rng, dtype=torch.float64) * 2 - 1  # noqa: E731
    qpos = torch.tensor(scene.mj_model.key_qpos[0]).repeat(n, 1)
    qpos[:, 2] += 0.03 * noise(n)
    qpos[:, 7:] += 0.2 * noise(n, 12)
    qvel, ctrl, weights = 1.0 * noise(n, scene.nv), noise(n, scene.nu), noise(n, scene.nv)
    found = []
    for dtype, block in ((torch.float64, 1), (torch.float32, 8)):
        sim = Simulator(scene, n, how, task.control_dt, dtype=dtype, threads=1, block=block)
        leaf = qvel.to(dtype).requires_grad_()
        end = sim.step(qpos.to(dtype), leaf, ctrl.to(dtype))[1]
        found.append(torch.autograd.grad((end * weights.to(dtype)).sum(), leaf)[0].double())
    assert (sim.residual < how.tolerance).double().mean() > 0.98
    error = (found[1] - found[0]).norm(dim=1) / found[0].norm(dim=1)
    assert error.median() < 3e-3 and error.max() < 1
