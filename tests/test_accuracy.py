"""Presets of accuracy, orders of convergence, extremes, and what the generated kernels leave out."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
import torch
import warp as wp
from scenes import BALL, DISTINCT, DRONE, HINGE, OSCILLATOR, acting_states, leg_scene, parse, run, task_scene, without
from test_constraint import CONES
from test_pairs import solids
from warp._src.context import ModuleBuilder

import diffsim
from diffsim.kernels.backward import backward_kernel
from diffsim.kernels.forward import forward_kernel
from diffsim.kernels.thread.division import divide
from diffsim.kernels.thread.spec import kernel_spec
from diffsim.robot.constants import constrained
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks import TASKS
from diffsim_robots.terrain import incline

SHAC_TASKS = ("cartpole", "hopper", "half_cheetah", "ant", "humanoid", "humanoid_mtu")
both_integrators = pytest.mark.parametrize("implicit", [False, True])


# Presets


HEAVY = "cartpole", "half_cheetah", "ant", "humanoid", "humanoid_mtu"  # whose kernels no other test needs


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in HEAVY)) for name in SHAC_TASKS]
)
def test_accurate_presets_are(name, rng):
    """Error after a control step, median over states in contact: a quarter of the default's, fast up to five times."""
    scene, states = task_scene(name), acting_states(task_scene(name), 16, rng)
    leaves = [torch.tensor(x) for x in states]

    def end(integration):
        return torch.cat(Simulator(scene, 16, integration, dtype=torch.float64).step(*leaves), 1)

    task = TASKS[name]
    exact = end(Integration("soft", 64 * task.substeps))
    error = {a: (end(task.integration(a)) - exact).norm(dim=1).median() for a in ("fast", "default", "accurate")}
    assert 0.15 < error["accurate"] / error["default"] < 0.3 and error["fast"] < 5 * error["default"]


def test_arguments_override_the_preset():
    def integration(**given):
        return diffsim.make("humanoid", 1, horizon=1, accuracy="fast", **given).sim.integration

    fast = TASKS["humanoid"].fast
    assert integration() == fast and integration(substeps=7) == Integration("soft", 7, implicit=True)
    assert integration(implicit=False, tolerance=1e-3) == Integration("soft", fast.substeps, False, 1e-3)
    soft, file = diffsim.make("hopper", 1, penalty={"k_n": 1e5, "k_d": 1e4}).scene, task_scene("hopper")
    assert (soft.k_n, soft.k_d, soft.k_t, soft.mu) == (1e5, 1e4, file.k_t, file.mu)
    wrong = {"'kn'.*k_n, k_d, k_t, mu, k_limit, d_limit": dict(penalty={"kn": 1e5})}
    wrong |= {f"k_n is {bad}, must be": dict(penalty={"k_n": bad}) for bad in (-1.0, float("nan"), float("inf"))}
    wrong |= {"'faster' on soft contact; .*fast, default, accurate": dict(accuracy="faster")}
    wrong |= {"'fast' on mujoco contact; .*default, accurate": dict(accuracy="fast", contact="mujoco")}
    wrong |= {"unknown contact 'hard'; choose from soft, mujoco": dict(contact="hard")}
    wrong |= {"only soft contact has an implicit integrator": dict(contact="mujoco", implicit=True)}
    for message, arguments in wrong.items():
        with pytest.raises(ValueError, match=message):
            diffsim.make("hopper", 1, **arguments)


# Order of convergence


@both_integrators
def test_order_of_a_damped_oscillator(implicit):
    """Angle, rate and the gradient of the angle, against the closed form."""
    scene, t, start = parse(OSCILLATOR), 0.5, (0.7, -2.0)
    decay, omega = 1.0, np.sqrt(40.0 - 1.0)
    wave = np.exp(-decay * t) * np.array([np.cos(omega * t), np.sin(omega * t) / omega])
    slopes = [wave[0] + decay * wave[1], wave[1]]  # of the angle in the initial angle and rate
    exact = np.array(
        [np.dot(slopes, start), -40 * wave[1] * start[0] + (wave[0] - decay * wave[1]) * start[1], *slopes]
    )

    def simulated(substeps):
        leaves = [torch.tensor([[x]], dtype=torch.float64, requires_grad=True) for x in start]
        sim = Simulator(scene, 1, Integration("soft", substeps, implicit), t, dtype=torch.float64)
        q, v = sim.step(*leaves, torch.zeros(1, 1, dtype=torch.float64))
        return np.array([q.item(), v.item(), *(g.item() for g in torch.autograd.grad(q, leaves))])

    errors = [abs(simulated(n) - exact) for n in (256, 512, 1024)]
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 1, atol=0.1)


@both_integrators
def test_order_of_contact_and_friction(implicit):
    """A ball that rolls and slips in the ground, touching all the time: from the changes as the step is halved."""
    scene = parse(BALL)
    depth = scene.mass[0] * 9.81 / scene.k_n
    qpos = np.array([[0.0, 0.0, 0.1 - 1.2 * depth, 1.0, 0.0, 0.0, 0.0]])
    qvel = np.array([[0.02, -0.01, 0.0, 0.3, 0.1, -0.2]])
    ctrl, settings = np.zeros((1, 0)), [Integration("soft", n, implicit) for n in (256, 512, 1024, 2048)]
    ends = [np.concatenate(run(scene, qpos, qvel, ctrl, control_dt=0.05, integration=s), 1)[0] for s in settings]
    changes = [np.linalg.norm(a - b) for a, b in zip(ends, ends[1:], strict=False)]
    np.testing.assert_allclose(np.log2(np.array(changes[:-1]) / changes[1:]), 1, atol=0.1)


# Extremes


def extreme(scene, qpos, qvel, kind):
    """The scene and states, one thing driven to an extreme."""
    height = 2 if scene.floating else 1
    if kind == "stiff":
        scene = dataclasses.replace(scene, k_n=1e3 * scene.k_n, k_d=1e2 * scene.k_d)
    elif kind == "slippery":
        scene = dataclasses.replace(scene, mu=0.0, k_d=0.0)
    elif kind == "sticky":
        scene = dataclasses.replace(scene, mu=10.0, k_t=1e6)
    elif kind in ("light", "heavy"):
        mass, inertia = scene.mass.copy(), scene.inertia.copy()
        mass[-1], inertia[-1] = (x[-1] * (1e-4 if kind == "light" else 1e4) for x in (mass, inertia))
        scene = dataclasses.replace(scene, mass=mass, inertia=inertia)
    elif kind == "fast":
        qvel[:, 0] = 1e3
    elif kind == "spinning":
        qvel[:, -2:] = 1e3
    elif kind == "buried":
        qpos[:, height] -= 1.0
    elif kind == "falling":
        qvel[:, height] = -44.0  # after 100 m
    elif kind == "far":
        qpos[:, 0] = 5e4  # m; from 1e5 on an environment is contained
    return scene, qpos, qvel


KINDS = ("stiff", "slippery", "sticky", "light", "heavy", "fast", "spinning", "buried", "falling", "far")


@pytest.mark.parametrize(
    "name, integration",
    [
        ("hopper", Integration()),
        ("ant", Integration()),
        pytest.param("ant", Integration(implicit=True), marks=pytest.mark.slow),
        ("ant", Integration("mujoco")),
    ],
)
def test_extremes_stay_finite_or_contained(name, integration, rng):
    """Under motors that flip at every control step. What is not contained moved and kept its energy within reason."""
    for kind in KINDS:
        qpos, qvel, _ = acting_states(task_scene(name), 4, rng)
        scene, qpos, qvel = extreme(task_scene(name), qpos, qvel, kind)
        sim = Simulator(scene, 4, integration, horizon=12)
        leaves = [torch.tensor(x, dtype=torch.float32, requires_grad=True) for x in (qpos, qvel)]
        ctrl = torch.ones(4, scene.nu, requires_grad=True)
        (q, v), contained = leaves, torch.zeros(4, dtype=torch.bool)
        for k in range(12):
            q, v = sim.step(q, v, ctrl * (-1) ** k)
            contained |= sim.nonfinite
            assert q.isfinite().all() and v.isfinite().all(), kind
        gradients = torch.autograd.grad(q.sum() + v.sum(), [*leaves, ctrl])
        assert all(g.isfinite().all() for g in gradients), kind
        # A joint that turns at 1,000 rad/s passes its limit by a radian in a substep: only there may the numbers end.
        assert not contained.any() or kind == "spinning", kind
        if not contained.any():
            assert all((g != 0).any() for g in gradients), kind
            assert sim.nonfinite_gradients.sum() == 0, kind


def test_actions_beyond_the_range_are_those_at_its_end():
    ends = []
    for size in (1.0, 1e6, float("inf")):
        env = diffsim.make("ant", num_envs=2, seed=0, horizon=4)
        actions = [torch.full((2, 8), size * (-1) ** k, requires_grad=True) for k in range(4)]
        total = sum(env.step(action)[1].sum() for action in actions)
        gradients = torch.autograd.grad(total, actions)
        assert all(g.isfinite().all() and (size == 1 or (g == 0).all()) for g in gradients)
        ends.append(env.qpos.detach())
    assert torch.equal(ends[0], ends[1]) and torch.equal(ends[0], ends[2])


# Corners


def one_sided(scene, states, weights, eps=1e-6, **options):
    """Derivatives (2, n) of a weighted sum of the state after a control step in its n inputs, from above and below."""
    sizes = np.cumsum([x.shape[1] for x in states])
    sign, n = np.array([1.0, -1.0]), sizes[-1]
    offsets = sign[:, None, None, None] * eps * np.arange(3)[:, None] * np.eye(n)[:, None, :]  # (2, n, 3, n)
    rows = (np.concatenate(states, 1) + offsets).reshape(-1, n)
    q, v = run(scene, *np.split(rows, sizes[:-1], 1), **options)
    values = (np.concatenate([q, v], 1) @ weights).reshape(2, n, 3)
    return sign[:, None] * (values @ [-1.5, 2.0, -0.5]) / eps


def gradient(scene, states, weights, **options):
    leaves = [torch.tensor(x, requires_grad=True) for x in states]
    q, v = Simulator(scene, 1, dtype=torch.float64, **options).step(*leaves)
    total = torch.cat([q, v], 1) @ torch.tensor(weights)
    return np.concatenate([g[0].numpy() for g in torch.autograd.grad(total.sum(), leaves)])


def check_one_sided(scene, states, weights, skip=(), **options):
    """Every entry of the gradient is the derivative from one side or the other; returns how many sides differ."""
    value, sides = gradient(scene, states, weights, **options), one_sided(scene, states, weights, **options)
    assert np.isfinite(value).all() and (value != 0).any()
    value, sides = (np.delete(x, list(skip), -1) for x in (value, sides))
    scale = 1e-5 * (1 + abs(value).max())
    assert (abs(value - sides).min(0) < scale).all()
    return (abs(sides[0] - sides[1]) > 10 * scale).sum()


QUATERNION = range(3, 7)  # its length is not a coordinate; test_gradient.py has differences along and across it


@both_integrators
def test_corners_of_contact_have_one_sided_gradients(implicit):
    """Exact touch with and without approach, exactly no slip, and exactly where friction saturates."""
    scene, weights = parse(BALL), np.cos(np.arange(13.0))
    options = dict(integration=Integration("soft", 1, implicit))

    def ball(depth, *velocity):
        return [
            np.array([[0.0, 0.0, 0.1 - depth, 1, 0, 0, 0]]),
            np.array([[*velocity, 0.0, 0.0, 0.0]]),
            np.zeros((1, 0)),
        ]

    depth = 1e-3
    saturated = scene.mu * scene.k_n * depth / scene.k_t
    assert check_one_sided(scene, ball(0.0, 0.0, 0.0, -1.0), weights, QUATERNION, **options) > 0
    check_one_sided(scene, ball(0.0, 0.0, 0.0, 0.0), weights, QUATERNION, **options)
    check_one_sided(scene, ball(depth, 0.0, 0.0, 0.0), weights, QUATERNION, **options)
    assert check_one_sided(scene, ball(depth, saturated, 0.0, 0.0), weights, QUATERNION, **options) > 0


@both_integrators
def test_limit_exactly_met_has_a_one_sided_gradient(implicit):
    scene = parse(HINGE)
    for bound in (scene.lower[1], scene.upper[1]):
        states = [np.array([[x]]) for x in (bound, 0.0, 0.0)]
        options = dict(integration=Integration("soft", 1, implicit))
        assert check_one_sided(scene, states, np.array([1.0, 2.0]), **options) > 0


def test_cartpole_upright_and_hanging():
    """The task too, whose angle is wrapped at pi: finite, and the slope of one side."""
    for angle in (0.0, np.pi, -np.pi):
        env = diffsim.make("cartpole", num_envs=1, dtype=torch.float64)
        qpos = torch.tensor([[0.3, angle]], dtype=torch.float64, requires_grad=True)
        env.set_state(qpos, torch.zeros(1, 2, dtype=torch.float64))
        _, reward, *_ = env.step(torch.zeros(1, 1, dtype=torch.float64))
        (slope,) = torch.autograd.grad(reward.sum(), qpos)
        assert slope.isfinite().all()
        assert abs(slope[0, 1]) < 0.1 if angle == 0 else 5 < abs(slope[0, 1]) < 7  # 2 pi, next to the jump


# Only what a scene requires


def source(scene, **optional):
    """Warp's C++ of the scene's forward and backward kernel, which is not compiled."""
    wp.init()
    spec, text = kernel_spec(scene, divide(scene), wp.float64, implicit=False, env_last=False, **optional), ""
    for build in (forward_kernel, backward_kernel):
        module = build(spec).module
        text += ModuleBuilder(module, module.resolve_options(wp.config)).codegen("cpu")
    return re.sub(r"//.*", "", text)  # comments quote the Python source, branches that are not taken included


def unset(text):
    """Statements of Warp's C++ that read a number which only a branch before them sets.

    Warp computes a named constant where a function has it first, and reads it from there on: also after the branch.
    """
    found, sets, branch = [], {}, ()
    for number, line in enumerate(map(str.strip, text.splitlines())):
        line = re.sub(r"^wp::assign\((var_\d+), (.*)\);", r"\1 = \2;", line)
        is_set = re.match(r"(const [\w:]+ )?(var_\d+) = ", line)
        value = line[is_set.end() :] if is_set else line
        if line == "{" and not branch:
            sets, branch = {}, (number,)  # a function's body
        for name in re.findall(r"\bvar_\d+\b", value) if "wp::where(" not in line and branch else ():
            if name in sets and not any(branch[: len(other)] == other for other in sets[name]):
                found.append(line)
        if is_set:
            sets.setdefault(is_set[2], []).append(branch[: 1 if is_set[1] else None])
        if line.startswith("}"):
            branch = branch[:-1]
        if line.endswith("{") and line != "{" and branch:
            branch += (number,)
    return found


def test_what_a_branch_leaves_unset_is_found():
    code = "static void f(wp::float64 var_x)\n{\nif (var_0) {\nvar_1 = 1e-15;\n}\nvar_2 = wp::max(var_x, var_1);\n}\n"
    assert unset(code) == ["var_2 = wp::max(var_x, var_1);"]
    for mended in (code.replace("if (var_0) {\n", "").replace("}\nvar_2", "var_2"), code.replace("max", "where")):
        assert unset(mended) == []


@pytest.mark.parametrize("name", ["ant", "go2", "hills", "varied", "drone", *CONES])
def test_kernels_read_what_is_set(name):
    hopper, options = task_scene("hopper"), {"varied": name == "varied", "constrained": name in CONES}
    scenes = {"hills": hopper.with_terrain(incline(10.0)), "varied": hopper, "drone": parse(DRONE)}
    scenes |= {cone: constrained(solids(cone, 0), 1e-3) for cone in CONES}
    text = source(scenes[name] if name in scenes else task_scene(name), **options)
    assert text.count("wp::where(") > 3 and unset(text) == []


CODE = {  # what the code of a feature, and of no other, does: it reads fields of the model, or calls functions
    "contact": r"\(var_m\)\.(k_n|k_d|k_t|mu|contact_\w+)\b",
    "limit": r"\(var_m\)\.(k_limit|d_limit|lower|upper)\b",
    "stiffness": r"\(var_m\)\.(stiffness|spring_ref)\b",
    "damping": r"\(var_m\)\.damping\b",
    "slide": r"\(var_m\)\.slide\b",
    "hinge": r"\bsin\(",
    "motor": r"\(var_m\)\.motor_slot\b",
    "ball": r"\(var_m\)\.(ball_\w+|qpos_adr|inboard|outboard)\b",
    "muscle": r"\(var_m\)\.(pair_\w+|segment_\w+)\b",
    "drag": r"\(var_m\)\.drag_\w+\b",
    "floating": r"\bquat_(?!t\b)\w+\(",  # or a ball; every ball here is on a floating base
    "terrain": r"\(var_m\)\.(terrain|carrier_along)\b|\bnearest_of_each",
    "varied": r"\bblocks__locals__read_\d+\(var_factors\b",
    "forced": r"\badd_forces|\(var_m\)\.body_com\b",
    "tendon": r"\(var_m\)\.tendon_\w+\b",
    "site": r"\(var_m\)\.site_\w+\b",
}


@pytest.mark.parametrize("name", [*DISTINCT, "cartpole", "go2", "bare", "leg", "hills", "varied", "forced", "drone"])
def test_kernels_hold_the_code_of_the_features_and_no_other(name):
    hopper, options = task_scene("hopper"), {name: True} if name in ("varied", "forced") else {}
    scenes = {"leg": leg_scene(grounded=True), "bare": without(hopper, "contact", "limit", "damping")}
    scenes |= {"hills": hopper.with_terrain(incline(10.0)), "varied": hopper, "forced": hopper, "drone": parse(DRONE)}
    scene = scenes[name] if name in scenes else task_scene(name)
    text = source(scene, **options)
    for feature, pattern in CODE.items():
        assert bool(re.search(pattern, text)) == (feature in (*scene.features, *options)), feature
