"""Terrain: contact with a piecewise-linear ground, against the plane, tilted gravity, NumPy and differences."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
import reference
import torch
from scenes import BALL, PENDULUM, acting_states, parse, run, task_scene, unit
from test_gradient import check_gradients

import diffsim
from diffsim.robot.profile import TerrainError
from diffsim.robot.scene import FACTORS, Scene
from diffsim.sim.elevation import Elevation
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim_cli import render
from diffsim_cli.drive import web
from diffsim_cli.render import slabs
from diffsim_robots.terrain import LENGTH, LEVEL, incline, rough, step, uneven
from diffsim_robots.variation import Variation

IMPLICIT = Integration("soft", 8, implicit=True)  # of the ball; the hopper is explicit, so that two kernels do for all
# A valley, a ridge, a wall and a short segment; a ball of 0.1 m fits between all of them.
HILLS = np.array([[-1.0, 0.2], [0.0, 0.0], [1.0, 0.4], [2.0, 0.1], [2.5, 0.1], [2.5, 0.5], [3.0, 0.5], [3.25, 0.6]])
PLANE = np.array([[0.0, 0.0], [1.0, 0.0]])


@pytest.fixture(scope="module")
def ball() -> Scene:
    return parse(BALL).with_terrain(HILLS)


def pressed(scene: Scene, x: np.ndarray, rng: np.random.Generator):
    """Balls at these x, up to 3 cm deep in the ground; every other one nearly at rest."""
    qpos = np.zeros((len(x), 7))
    for row, along in zip(qpos, x, strict=True):
        z, depth = 2.0, rng.uniform(0, 0.03)
        while (d := reference.clearance(scene.terrain[0], np.array([along, z]), 0.1)[0]) > -depth:
            z -= max(d + depth, 1e-4)
        row[:3] = along, rng.normal(), z
    qpos[:, 3:] = unit(rng.normal(size=(len(x), 4)))
    qvel = rng.normal(size=(len(x), 6))
    qvel[::2] *= 0.02
    return qpos, qvel, np.zeros((len(x), 0))


def everywhere(rng: np.random.Generator) -> np.ndarray:
    """Places on the hills, most of them near a vertex."""
    return np.concatenate([rng.uniform(-1.5, 3.5, 8), *(rng.uniform(x - 0.05, x + 0.05, 3) for x in HILLS[:, 0])])


def hopping(vertices: np.ndarray, count: int, rng: np.random.Generator):
    """Hoppers with joints beyond their limits, all over the hills, 1 cm deep in the ground."""
    qpos, qvel, ctrl = acting_states(task_scene("hopper"), count, rng)
    scene = task_scene("hopper").with_terrain(vertices)
    qpos[:, 0] = rng.uniform(-1.0, 3.5, count)
    for _ in range(3):
        qpos[:, 1] -= [reference.contacts(scene, *state)[0].min() + 0.01 for state in zip(qpos, qvel, strict=True)]
    return scene, (qpos, qvel, ctrl)


def check_steps(scene, states, integration, tolerance=1e-9):
    ends = run(scene, *states, integration=integration)
    for e, start in enumerate(zip(*states, strict=True)):
        profile = e % len(scene.terrain)
        for value, end in zip(ends, reference.step(scene, *start, 1 / 60, integration, profile=profile), strict=True):
            np.testing.assert_allclose(value[e], end, rtol=tolerance, atol=tolerance)


# Contact --------------------------------------------------------------------------------------------------------------


def test_steps_of_a_ball_are_the_references(ball, rng):
    states = pressed(ball, everywhere(rng), rng)
    check_steps(ball, states, IMPLICIT)
    normals = np.array([reference.clearance(HILLS, q[[0, 2]], 0.1)[1] for q in states[0]])
    runs = np.diff(HILLS, axis=0)
    slopes = np.stack([-runs[:, 1], runs[:, 0]], 1) / np.linalg.norm(runs, axis=1, keepdims=True)
    between = ~np.isclose(normals[:, None], slopes, atol=1e-6).all(2).any(1)
    assert between.sum() > 3  # in valleys and on ridges


def test_steps_of_the_hopper_are_the_references(rng):
    """Each on a profile of its own."""
    profiles = np.stack([HILLS + [0.1 * k, 0.0] for k in range(8)])
    scene, states = hopping(HILLS, 8, rng)
    check_steps(scene.with_terrain(profiles), states, Integration(substeps=8))


def test_gradients_of_a_ball_are_those_of_differences(ball, rng):
    """On slopes and ridges, in valleys and at the wall."""
    check_gradients(ball, pressed(ball, everywhere(rng), rng), rng, integration=IMPLICIT)


def test_gradients_of_the_hopper_are_those_of_differences(rng):
    scene, states = hopping(HILLS, 16, rng)
    check_gradients(scene, states, rng, integration=Integration(substeps=8))


def test_spikes_high_steps_and_narrow_notches_stay_finite(rng):
    """Nothing fits into the notches; gradients are finite, too."""
    x = np.repeat(np.arange(0.0, 4.0, 0.04), 2)
    walls = np.stack([x, np.resize([0.0, 0.3, 0.3, 0.0], len(x))], 1)
    needles = np.stack([np.arange(0, 4, 0.01), np.resize([0.0, 0.5], 400)], 1)
    for vertices in (np.concatenate([[[-1.0, 0.0]], walls, [[5.0, 0.0]]]), needles):
        scene = parse(BALL).with_terrain(vertices)
        qpos = np.zeros((64, 7))
        qpos[:, 0], qpos[:, 2], qpos[:, 3] = rng.uniform(-1, 5, 64), rng.uniform(-0.5, 1.0, 64), 1.0
        qvel = 5 * rng.normal(size=(64, 6))
        sim = Simulator(scene, 64, IMPLICIT, horizon=8, dtype=torch.float64)
        q, v = (torch.tensor(a, requires_grad=True) for a in (qpos, qvel))
        a, b = q, v
        for _ in range(8):
            a, b = sim.step(a, b, torch.zeros(64, 0, dtype=torch.float64))
            assert not sim.nonfinite.any()
        slopes = torch.autograd.grad(a.sum() + b.sum(), (q, v))
        assert all(slope.isfinite().all() for slope in slopes) and not sim.nonfinite_gradients.any()


def test_the_twin_and_the_drawn_boxes_are_where_mujoco_has_them(rng):
    """Distances of spheres that do not touch."""
    spec = mujoco.MjSpec()
    for size, centre, rotation in slabs(HILLS):
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, rotation.ravel())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=centre, quat=quat)
    spec.worldbody.add_body(mocap=True).add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    for x in np.linspace(-1.5, 3.5, 41):
        z = np.interp(x, HILLS[:, 0], HILLS[:, 1]) + rng.uniform(0.12, 0.4)
        data.mocap_pos[0] = x, 0.3, z
        mujoco.mj_kinematics(model, data)
        found = min(mujoco.mj_geomDistance(model, data, k, model.ngeom - 1, 5.0, None) for k in range(model.ngeom - 1))
        expected = reference.clearance(HILLS, np.array([x, z]), 0.1)[0]
        assert expected <= 0 or abs(found - expected) < 1e-6


# Tasks ----------------------------------------------------------------------------------------------------------------


def hoppers(terrain, count=2, **arguments):
    return diffsim.make("hopper", count, dtype=torch.float64, terrain=terrain, seed=0, substeps=8, **arguments)


def test_heights_are_those_over_the_ground():
    """Of the start, the observation, the reward and the end."""
    env, flat = hoppers(np.stack([incline(-20.0), incline(10.0)])), hoppers(None)
    torch.testing.assert_close(env.reset(seed=1)[0], flat.reset(seed=1)[0])  # level where episodes start
    torch.testing.assert_close(env.qpos, flat.qpos)
    qpos = flat.qpos.clone()
    qpos[:, 0] = 6.0
    there = qpos.clone()
    there[:, 1] += 5 * torch.tensor([-20.0, 10.0]).double().deg2rad().tan()  # were z its height, one would have fallen
    obs = env.set_state(there, flat.qvel)
    torch.testing.assert_close(obs, flat.set_state(qpos, flat.qvel))
    assert not env.step(torch.zeros(2, 3).double())[2].any()

    raised = hoppers(incline(10.0, start=-3.0))
    obs, _ = raised.reset(seed=1)
    torch.testing.assert_close(obs, flat.reset(seed=1)[0])
    slope = np.tan(np.radians(10.0))
    torch.testing.assert_close(raised.qpos[:, 1], flat.qpos[:, 1] + slope * (flat.qpos[:, 0] + 3.0))
    assert (raised.qpos[:, 1] > 0.4).all()


def test_the_elevation_is_that_of_the_profile(rng):
    for scene in (task_scene("hopper"), task_scene("ant")):
        elevation = Elevation(scene.with_terrain(HILLS), "cpu", torch.float64)
        qpos = torch.tensor(rng.uniform(-2.0, 4.0, (5, 7, scene.nq)))
        x = qpos[..., 0].numpy()
        ends = 0.2 - 0.2 * (x + 1), 0.6 + 0.4 * (x - 3.25)
        expected = np.select([x < -1, x > 3.25], ends, np.interp(x, HILLS[:, 0], HILLS[:, 1]))
        np.testing.assert_allclose(elevation.height(qpos), expected, atol=1e-12)
        up = 2 if scene.floating else 1
        assert torch.equal(elevation.lift(qpos)[..., up], qpos[..., up] + elevation.height(qpos))
        torch.testing.assert_close(elevation.lower(elevation.lift(qpos)), qpos)
        assert torch.autograd.gradcheck(elevation.lower, qpos[0].requires_grad_())


def test_heights_at_several_places(rng):
    """Of each environment's own profile, and with dimensions before."""
    profiles = uneven(15.0, 3, seed=4)
    elevation = Elevation(task_scene("ant").with_terrain(profiles), "cpu", torch.float64)
    x = rng.uniform(-5, 5, (2, 3, 4))
    expected = [[np.interp(x[k, e], *profiles[e].T) for e in range(3)] for k in range(2)]
    np.testing.assert_allclose(elevation.at(torch.tensor(x)), expected, atol=1e-12)


def test_feet_of_a_joystick_task_are_seen_over_the_ground_below_them():
    """A Go2 whose hind feet stand 10 cm higher than its front feet, or the other way round."""
    flat, there = (
        diffsim.make("go2", 2, dtype=torch.float64, seed=1, terrain=ground) for ground in (None, step(-0.1, 0.05))
    )
    for turn, front, hind in (((1.0, 0, 0, 0), 0.1, 0.0), ((0, 0, 0, 1.0), 0.0, 0.1)):
        qpos = flat.qpos.clone()
        qpos[:, 3:7] = torch.tensor(turn)
        seen = [env.set_state(qpos, flat.qvel)[:, -8:-4] for env in (flat, there)]
        torch.testing.assert_close(seen[1] - seen[0], torch.tensor([front, front, hind, hind]).double().expand(2, 4))


def test_an_option_makes_uneven_ground():
    env = diffsim.make("hopper:rough=12", 3, seed=5)
    np.testing.assert_array_equal(env.scene.terrain, uneven(12.0, 3, 5))
    assert diffsim.make("hopper", 3, seed=5).scene.terrain is None
    profile = step(0.1)  # which is given takes its place
    np.testing.assert_array_equal(diffsim.make("hopper:rough=12", 3, terrain=profile).scene.terrain, profile[None])
    for name, count, seed, message in (
        ("hopper:rough=12", 0, 5, "num_envs is 0, must be an integer of at least 1"),
        ("hopper:rough=12", 3, 2.5, "seed is 2.5, must be one integer"),
        ("hopper:rough=95", 3, 5, "'rough=95': the steepest slope must be above 0 and at most 45 degrees"),
    ):
        with pytest.raises(ValueError, match=message):
            diffsim.make(name, count, seed=seed)


@pytest.mark.parametrize("name", ["hopper:rough=20", "hopper:friction=0.5:1.5"])
def test_gradient_of_a_window_with_options_is_that_of_differences(name, rng):
    """On slopes, away from the level start, and where each environment has its own friction; the robots touch ground.

    Of a weighted sum of observations and rewards with respect to all actions and velocities.
    """
    factors = "friction" in name
    env = diffsim.make(name, 3, seed=3, horizon=3, dtype=torch.float64, contact="soft", factors=factors, forces=factors)
    env.early_termination = False
    if factors:
        Variation(env, 5).set(1)
        assert len(env.sim.factors[:, FACTORS.index("mu")].unique()) == 3
    qpos, nu, nv = env.qpos.clone(), env.scene.nu, env.scene.nv
    if env.task.ground is not None:
        qpos[:, 0] = torch.linspace(4.0, 12.0, 3)
        qpos = env.task.ground.lift(qpos)
        slope = env.task.ground.lift(qpos + 1e-3 * torch.eye(env.scene.nq)[0]) - env.task.ground.lift(qpos)
        assert (slope[:, 1].abs() > 1e-5).all()
    env.set_state(qpos, env.qvel)
    with torch.no_grad():
        for _ in range(15):
            env.step(torch.zeros(3, nu).double())
    qpos, weights = env.qpos.clone(), torch.tensor(rng.normal(size=(3, env.task.obs_dim)))

    def total(x):
        env.reset(seed=1)
        env.set_state(qpos, x[:, :nv])
        result = torch.zeros(3).double()
        for action in x[:, nv:].split(nu, 1):
            _, reward, _, _, info = env.step(action)
            assert not info["nonfinite"].any()
            result = result + reward + (weights * info["final_obs"]).sum(1)
        return result

    x = torch.cat((env.qvel, torch.tensor(rng.uniform(-0.6, 0.6, (3, 3 * nu)))), 1).requires_grad_()
    (gradient,) = torch.autograd.grad(total(x).sum(), x)
    expected, x = torch.zeros_like(x), x.detach()
    with torch.no_grad():
        for column, step_ in enumerate(1e-6 * torch.eye(x.shape[1]).double()):
            expected[:, column] = (total(x + step_) - total(x - step_)) / 2e-6
    assert ((gradient - expected).norm(dim=1) < 1e-6 * expected.norm(dim=1)).all()


def test_environments_that_share_a_task_have_their_own_ground():
    """Be there fewer of them, or none of it."""
    first = diffsim.make("go2", 3, dtype=torch.float64, seed=1, terrain=step(0.3, -5.0))
    hill = first.scene.with_terrain(uneven(20.0, 4))
    flat = first.scene.with_terrain([[-9.0, 0.0], [9.0, 0.0]])
    several = [diffsim.DiffEnv(first.task, scene, n, dtype=torch.float64) for scene, n in ((hill, 4), (flat, 1))]
    for env, height in zip((first, *several), (0.3, 0.0, 0.0), strict=True):
        qpos = first.qpos[:1].repeat(env.num_envs, 1)
        seen = env.set_state(qpos, torch.zeros_like(first.qvel[:1]).repeat(env.num_envs, 1))
        torch.testing.assert_close(env.task.named(seen)["height"][:, 0], qpos[:, 2] - height)


# Generated profiles ---------------------------------------------------------------------------------------------------


def test_generated_profiles():
    np.testing.assert_allclose(incline(-45.0, start=2.0), [[1, 0], [2, 0], [3, -1]], atol=1e-12)
    np.testing.assert_allclose(step(-0.3), [[0, 0], [1, 0], [1, -0.3], [2, -0.3]])
    profile = rough(7, segment=2.0, degrees=15.0, length=20.0, start=3.0)
    x, z = profile.T
    assert profile.shape == (13, 2)
    np.testing.assert_allclose(x, [2.0, *np.arange(3.0, 24.0, 2.0), 24.0])
    angles = np.degrees(np.arctan(np.diff(z) / np.diff(x)))
    assert angles[0] == angles[-1] == 0 and 5 < abs(angles).max() < 15
    assert np.array_equal(profile, rough(7, 2.0, 15.0, 20.0, 3.0)) and not np.array_equal(
        profile, rough(8, 2.0, 15.0, 20.0, 3.0)
    )
    profiles = uneven(20.0, 4, seed=-3)
    x, z = np.moveaxis(profiles, 2, 0)
    assert (z[abs(x) <= LEVEL] == 0).all()
    np.testing.assert_allclose([-x.min(), x.max()], LENGTH + LEVEL + 1)
    angles = np.degrees(np.arctan(np.diff(z) / np.diff(x)))
    np.testing.assert_allclose(abs(angles).max(1), [5, 10, 15, 20], rtol=0.08)  # profile by profile
    assert (abs(angles).max(1) < [5, 10, 15, 20]).all() and abs(angles.mean()) < 3
    assert len(np.unique(z[:, -1])) == len(np.unique(z[:, 0])) == 4
    assert np.array_equal(profiles, uneven(20.0, 4, -3)) and not np.array_equal(profiles, uneven(20.0, 4, 4))
    for make, message in (
        (lambda: uneven(95.0, 1), "degrees is 95.0, must lie between -90 and 90"),
        (lambda: incline(90.0), "degrees is 90.0, must lie between -90 and 90"),
        (lambda: step(0.0), "height is 0.0, must be finite and not 0"),
        *(
            (lambda w=w: rough(0, *w), f"length is {w[2]}, must be 1 to 10000 segments of {w[0]}")
            for w in ((0.0, 10.0, 50.0), (4.0, 10.0, 1.0), (1e-300, 10.0, 50.0), (np.nan, 10.0, 50.0))
        ),
        *((lambda s=s: rough(s), f"seed is {s}, must be an integer of at least 0") for s in (1.5, np.inf, np.nan, -1)),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    for profile in (incline(1.0, start=np.inf), step(1.0, start=np.inf), rough(0, start=np.nan)):
        with pytest.raises(TerrainError):
            task_scene("hopper").with_terrain(profile)


# Input and pictures ---------------------------------------------------------------------------------------------------


ASCEND = "must have a smaller x than the next one, or begin a wall, one alone and not at an end"
WRONG = (
    ("hills", "must be numbers in an array"),
    ([[0, 0], [1]], "must be numbers in an array"),
    ([0.0, 1.0], "has shape (2,), must be (K, 2) or (environments, K, 2) with K of 2 or more"),
    ([[0.0, 0.0]], "has shape (1, 2), must be"),
    (np.zeros((0, 3, 2)), "has shape (0, 3, 2), must be"),
    ([[0, 0], [1, np.nan]], "vertex 1 (1, nan) must be finite"),
    ([PLANE, PLANE[::-1]], f"vertex 0 of environment 1 (1, 0) {ASCEND}"),
    ([[0, 0], [2, 5], [1, 0]], f"vertex 1 (2, 5) {ASCEND}"),
    ([[0, 0], [1, 2], [1, 2], [2, 0]], f"vertex 1 (1, 2) {ASCEND}"),
    ([[0, 0], [0, 1], [2, 0]], f"vertex 0 (0, 0) {ASCEND}"),
    ([[0, 0], [1, 1], [1, 0]], f"vertex 1 (1, 1) {ASCEND}"),
    ([[0, 0], [1, 1], [1, 3], [1, 2], [2, 0]], f"vertex 2 (1, 3) {ASCEND}"),
)


def test_wrong_terrain_is_refused():
    for vertices, message in WRONG:
        with pytest.raises(TerrainError, match=re.escape(message)):
            task_scene("hopper").with_terrain(vertices)


def test_what_cannot_have_a_terrain_says_so():
    with pytest.raises(TerrainError, match="robot touches no ground, so it has no terrain"):
        parse(PENDULUM).with_terrain(PLANE)
    with pytest.raises(ValueError, match="terrain has 2 profiles, must have 1 or one for each of 3"):
        diffsim.make("hopper", 3, terrain=[PLANE, PLANE])
    with pytest.raises(ValueError, match="hopper has no terrain"):
        Elevation(task_scene("hopper"), "cpu", torch.float64)


def test_pictures_show_it(opengl):
    scene = task_scene("hopper").with_terrain(HILLS)
    page = web.describe(scene, np.zeros((2, scene.nq)), 1 / 60)
    np.testing.assert_allclose(page["ground"], HILLS, atol=1e-3)
    profiles = np.stack([HILLS, HILLS + [0.0, 0.4]])
    with render.Renderer(scene.with_terrain(profiles), 160, 120) as renderer:
        low, high = (renderer.draw(np.zeros(scene.nq), profile=k) for k in range(2))
    assert (low != high).any(-1).mean() > 0.1
