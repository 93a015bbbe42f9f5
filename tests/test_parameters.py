"""A robot's constants as tensors with gradients: steps and gradients are those of models rebuilt with other values."""

from __future__ import annotations

import copy
import dataclasses
import re
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scenes import (
    BOUNDED_SERVOS,
    COMPENSATED,
    CRANE,
    FISH,
    FREE_SERVOS,
    SHOULDER,
    free_states,
    parse,
    pass_limits,
    raise_ground,
    tree_scene,
)
from test_constraint import PASSES, SLOW, H, in_mujoco, mujoco_model, step, tree_states
from test_gradient import measure, weights
from test_gyroscope import several, spinning
from test_pairs import model_as_it_is, solid_states, solids, tangled, tied_states, tied_tree
from torch import Tensor

from diffsim.parameters import FIELDS, ParametricSimulator
from diffsim.robot.mjcf import load_scene
from diffsim.robot.scene import Scene
from diffsim.robot.types import SceneError
from diffsim.sim import simulator
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim.tasks.base import ASSETS

HARD, SOFT, IMPLICIT = Integration("mujoco", 3, tolerance=1e-12), Integration("soft", 8), Integration("soft", 8, True)
Values = dict[str, Any]


@pytest.fixture(autouse=True)
def enough_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulator, "PASSES", PASSES)


def changed(model: mujoco.MjModel, values: Values) -> mujoco.MjModel:
    """A copy of a model with these parameters, by MuJoCo's own names."""
    m = copy.copy(model)
    position = (m.actuator_biasprm[:, 1] != 0) & (m.actuator_biasprm[:, 1] == -m.actuator_gainprm[:, 0])
    velocity = (m.actuator_biasprm[:, 2] != 0) & (m.actuator_biasprm[:, 2] == -m.actuator_gainprm[:, 0])
    affine = m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    m.body_mass[:], m.body_ipos[:], m.body_inertia[:] = values["mass"], values["com"], values["inertia"]
    m.geom_friction[:, 0] = values["friction"]
    m.dof_damping[:], m.dof_armature[:] = values["damping"], values["armature"]
    m.dof_frictionloss[:], m.actuator_gainprm[:, 0] = values["frictionloss"], values["gain"]
    m.actuator_biasprm[position, 1] = -values["gain"][position]
    m.actuator_biasprm[affine, 2] = -values["kv"][affine]
    m.actuator_biasprm[velocity, 2] = -values["gain"][velocity]
    mujoco.mj_setConst(m, mujoco.MjData(m))
    return m


def rebuilt(scene: Scene, values: Values) -> Scene:
    other = load_scene(changed(scene.mj_model, values))
    return dataclasses.replace(other, ground_height=scene.ground_height, geom_pairs=scene.geom_pairs)


def other_values(sim: ParametricSimulator, rng: np.random.Generator) -> Values:
    """Up to a fifth more or less than in the file, where they may differ from it, centres 2 cm elsewhere."""
    result = {}
    for name, file in sim.parameters.items():
        value, free = file.numpy(), sim.adjustable(name).numpy()
        factor = rng.uniform(0.8, 1.2, value.shape)
        if name == "com":
            other = value + rng.normal(0, 0.02, value.shape)
        elif name == "inertia":  # no moment exceeds the two others
            other = 0.8 * value + 0.1 * factor * value.sum(1, keepdims=True)
        else:
            other = factor * value
        result[name] = np.where(free, other, value)
    return result


def bounded_servos(integrator: str) -> tuple[Scene, Any]:
    scene = parse(BOUNDED_SERVOS.replace("implicitfast", integrator))
    return scene, free_states(scene, 8, np.random.default_rng(1))


def soft_tree() -> tuple[Scene, Any]:
    rng = np.random.default_rng(0)
    scene = tree_scene("ball", 1)
    qpos, qvel, ctrl = free_states(scene, 4, rng)
    pass_limits(scene, qpos, rng)
    return raise_ground(scene, qpos), (qpos, qvel, ctrl)


def shoulder() -> tuple[Scene, Any]:
    """Motors about two axes of a ball joint on the world."""
    scene = parse(SHOULDER)
    return scene, free_states(scene, 4, np.random.default_rng(0))


def tied() -> tuple[Scene, Any]:
    """Every kind of equality."""
    scene = tied_tree("floating", 0)
    states = tied_states(scene, 96, np.random.default_rng(0))
    return scene, calm(scene, states, np.full(96, True))


def touching(shapes: str, cone: str) -> tuple[Scene, Any]:
    """Two robots whose parts touch in half of the states, or boxes and capsules with several contacts of a pair.

    The robots have a declared pair, exclusions and a connect.
    """
    rng = np.random.default_rng(0)
    if shapes == "robots":
        scene, states = tangled("objects", cone, 0, 96, rng)
    else:
        scene = solids(cone, 0)
        states = solid_states(scene, 96, rng)
    ends, apart = (step(each, states)[1] for each in (scene, dataclasses.replace(scene, geom_pairs=())))
    touch = abs(ends - apart).max(1) > 1e-3
    return scene, [np.concatenate(x) for x in zip(calm(scene, states, touch), calm(scene, states, ~touch), strict=True)]


def calm(scene: Scene, states: Any, which: Any) -> list[Any]:
    """Four of these states in which nothing is thrown about: there differences would be inexact."""
    ends = np.where(which, abs(step(scene, states, HARD.substeps)[1]).max(1), np.inf)
    return [x[np.argsort(ends)[:4]] for x in states]


CASES = {
    "floating": (lambda: tree_states("floating", 0, 12, np.random.default_rng(0)), HARD),
    "pyramids": (lambda: tree_states("floating", 1, 12, np.random.default_rng(0)), HARD),
    "ball": (lambda: tree_states("ball", 0, 12, np.random.default_rng(0)), HARD),
    "fixed": (lambda: tree_states("fixed", 0, 12, np.random.default_rng(0)), HARD),
    "servos": (lambda: ((scene := parse(FREE_SERVOS)), free_states(scene, 4, np.random.default_rng(0))), HARD),
    "bounded servos": (lambda: bounded_servos("implicitfast"), HARD),
    "Euler's servos": (lambda: bounded_servos("Euler"), HARD),
    "implicit servos": (lambda: bounded_servos("Euler"), IMPLICIT),
    "soft": (soft_tree, SOFT),
    "ball on the world": (shoulder, HARD),
    "tied": (tied, HARD),
    "touching": (lambda: touching("robots", "elliptic"), HARD),
    "touching pyramids": (lambda: touching("robots", "pyramidal"), HARD),
    "touching solids": (lambda: touching("solids", "elliptic"), HARD),
    "spinning": (lambda: ((scene := several("heavy")), spinning(scene, 4, np.random.default_rng(0), 5.0)), HARD),
}
TOUCHING = "touching", "touching pyramids", "touching solids"
QUICK = "ball", "Euler's servos", "soft"


def cases(*names: str) -> list[Any]:
    return [pytest.param(name, marks=[SLOW] * (name not in QUICK)) for name in names]


def parametric(name: str) -> tuple[ParametricSimulator, Scene, Any]:
    make, integration = CASES[name]
    scene, states = make()
    seconds = integration.substeps * H
    sim = ParametricSimulator(scene, len(states[0]), integration, seconds, dtype=torch.float64)
    return sim, scene, states


def tensors(values: Values, **options: Any) -> dict[str, Tensor]:
    return {name: torch.tensor(value, **options) for name, value in values.items()}


@pytest.mark.parametrize("name", cases(*CASES))
def test_gradients_are_those_of_rebuilt_models(name: str, rng: np.random.Generator) -> None:
    """Along random directions in each parameter."""
    sim, scene, states = parametric(name)
    assert sim._robot.count == sim._launcher.spec.columns.end
    values, w = other_values(sim, rng), weights(scene, rng)
    sim.parameters = leaves = tensors(values, requires_grad=True)
    start = [torch.tensor(x) for x in states]
    measure(*sim.step(*start), w).sum().backward()

    def total(values: Values) -> float:
        other = Simulator(rebuilt(scene, values), len(start[0]), sim.integration, sim.control_dt, dtype=torch.float64)
        with torch.no_grad():
            return float(measure(*other.step(*start), w).sum())

    tested = set()
    for parameter, value in values.items():
        free = sim.adjustable(parameter).numpy()
        free &= (value != 0) | (parameter == "com")
        for _ in range(2 if free.any() else 0):
            way = free * rng.normal(size=value.shape) * (1 if parameter == "com" else value)
            slope = float((leaves[parameter].grad * torch.tensor(way)).sum())
            eps = 1e-5 if parameter == "com" else 1e-4
            low2, low, high, high2 = (total(values | {parameter: value + k * eps * way}) for k in (-2, -1, 1, 2))
            expected = (8 * (high - low) - (high2 - low2)) / (12 * eps)
            assert slope == pytest.approx(expected, rel=1e-6, abs=1e-10), parameter
            tested.add(parameter)
    assert {"mass", "com", "inertia", "damping"} <= tested
    contact, two = name in ("floating", "pyramids", "ball", "fixed"), name.startswith("touching")
    assert ({"friction", "frictionloss"} <= tested) == contact and ("kv" in tested) == ("servos" in name)
    assert {"friction"} <= tested if two else {"armature", "gain"} <= tested


PARCEL = """<mujoco><worldbody><geom type="plane" size="9 9 .1"/><body name="parcel" pos="0 0 .098" {}><freejoint/>{}
    <geom type="box" size=".1 .1 .1" density="500"/><site/></body></worldbody></mujoco>"""


def test_the_centre_of_a_free_body_may_move(rng: np.random.Generator) -> None:
    """Of a parcel whose shape is centred in the file; against a compiled inertial. MuJoCo must not simplify it."""
    sim = ParametricSimulator(parse(PARCEL.format("", "")), 4, HARD, HARD.substeps * H, dtype=torch.float64)
    com = sim.parameters["com"]
    sim.parameters = {"com": com}
    com[1, 0] = 0.02
    with pytest.raises(
        ValueError, match="^com of body 'parcel' is its origin to MuJoCo, which simplifies: write <body"
    ):
        sim.parameters = {"com": com}
    if tuple(map(int, mujoco.__version__.split(".")[:2])) < (4, 0):
        return
    scene = parse(PARCEL.format('simple="false"', ""))
    sim = ParametricSimulator(scene, 4, HARD, HARD.substeps * H, dtype=torch.float64)
    com = sim.parameters["com"]
    com[1] = torch.tensor([0.02, -0.01, 0.03])
    com.requires_grad_()
    sim.parameters = {"com": com}
    mass, inertia, place = (" ".join(map(str, x)) for x in ([4.0], [4 * 0.02 / 3] * 3, com[1].tolist()))
    written = parse(PARCEL.format("", f'<inertial pos="{place}" mass="{mass}" diaginertia="{inertia}"/>'))
    states = scene.qpos0[None].repeat(4, 0), 0.1 * rng.normal(size=(4, 6)), np.zeros((4, 0))
    expected = in_mujoco(scene, *states, substeps=HARD.substeps, model=mujoco_model(written))[1]
    qvel = sim.step(*(torch.tensor(x) for x in states))[1]
    np.testing.assert_allclose(qvel.detach().numpy(), expected, rtol=1e-8, atol=1e-9)
    assert abs(expected - in_mujoco(scene, *states, substeps=HARD.substeps)[1]).max() > 1e-3
    qvel.sum().backward()
    assert bool(com.grad[1].any())


STEPPED = "floating", "pyramids", "ball", "Euler's servos", "bounded servos", "tied", *TOUCHING


@pytest.mark.parametrize("name", cases(*STEPPED))
def test_steps_are_those_of_mujocos_changed_model(name: str, rng: np.random.Generator) -> None:
    sim, scene, states = parametric(name)
    values = other_values(sim, rng)
    with torch.no_grad():
        usual = sim.step(*(torch.tensor(x) for x in states))[1].numpy()
        sim.parameters = tensors(values)
        qvel = sim.step(*(torch.tensor(x) for x in states))[1].numpy()
    expected_model = changed(scene.mj_model, values)
    make = model_as_it_is if name.startswith("touching") else mujoco_model
    model = make(dataclasses.replace(scene, mj_model=expected_model))
    _, expected, _ = in_mujoco(scene, *states, substeps=sim.integration.substeps, model=model)
    change = abs(expected - states[1]).max(1)
    np.testing.assert_array_less(abs(qvel - expected).max(1) / change, 1e-6)
    assert (abs(qvel - usual).max(1) > 1e-3 * change).all()
    for field, _ in FIELDS.values():
        np.testing.assert_allclose(getattr(sim.mj_model(), field), getattr(expected_model, field), rtol=1e-14)


def test_without_other_values_the_steps_are_those_of_a_simulator() -> None:
    sim, scene, states = parametric("Euler's servos")
    other = Simulator(scene, len(states[0]), sim.integration, sim.control_dt, dtype=torch.float64)
    start = [torch.tensor(x, requires_grad=True) for x in states]
    ends, expected = (torch.cat(each.step(*start), 1) for each in (sim, other))
    assert torch.equal(ends, expected)
    grads, others = (torch.autograd.grad(end.sin().sum(), start) for end in (ends, expected))
    assert all(torch.equal(a, b) for a, b in zip(grads, others, strict=True))


@pytest.mark.slow  # for its kernels
@pytest.mark.parametrize("name", ["floating", pytest.param("touching", marks=pytest.mark.slow)])
def test_gradients_of_blocks_are_those_of_single_robots(name: str) -> None:
    """In float32, where a thread steps several robots, of which some touch nothing; over the steps of a rollout."""
    scene, states = CASES[name][0]()
    grads = []
    for dtype, block in ((torch.float64, 1), (torch.float32, 8)):
        integration = Integration("mujoco", 1, tolerance=1e-6)
        sim = ParametricSimulator(scene, len(states[0]), integration, H, 3, dtype=dtype, block=block)
        leaves = {name: value.requires_grad_() for name, value in sim.parameters.items()}
        sim.parameters = leaves
        q, v, u = (torch.tensor(x, dtype=dtype) for x in states)
        for _ in range(3):
            q, v = sim.step(q, v, u)
        grads.append(torch.autograd.grad((q.sin().sum() + v.sin().sum()).double(), [*leaves.values()]))
    zero = {"kv"} if name == "floating" else {"kv", "gain", "frictionloss"}
    for parameter, value, expected in zip(FIELDS, *grads, strict=True):
        assert (value - expected).norm() <= 1e-3 * expected.norm(), parameter
        assert expected.norm() > 0 or parameter in zero


def test_jacobian_has_each_robots_derivatives() -> None:
    """Of two outputs after two steps, in two factors of all masses and of all dampings."""
    scene, states = bounded_servos("Euler")

    def outputs(rows: slice, x: Tensor) -> tuple[ParametricSimulator, Tensor]:
        q, v, u = (torch.tensor(part[rows]) for part in states)
        sim = ParametricSimulator(scene, len(q), HARD, 3 * H, 2, dtype=torch.float64)
        sim.parameters = {name: x[k] * sim.parameters[name] for k, name in enumerate(("mass", "damping"))}
        for _ in range(2):
            q, v = sim.step(q, v, u)
        return sim, torch.stack((q.sin().sum(1), v.sin().sum(1)), 1)

    x = torch.tensor([1.1, 0.9], dtype=torch.float64, requires_grad=True)
    sim, y = outputs(slice(None), x)
    jacobian = sim.jacobian(y, x)
    assert jacobian.shape == (8, 2, 2)
    for k in range(3):
        _, y = outputs(slice(k, k + 1), x)
        expected = torch.stack([torch.autograd.grad(value, x, retain_graph=True)[0] for value in y[0]])
        torch.testing.assert_close(jacobian[k], expected, rtol=1e-9, atol=1e-12)


def test_elements_and_which_of_them_may_differ() -> None:
    sim = ParametricSimulator(load_scene(ASSETS / "go2.xml"), 1, HARD)
    assert sim.elements("mass")[:3] == ["world", "base", "FL_hip"] and not sim.adjustable("mass")[0]
    assert sim.elements("damping")[5:7] == ["root", "FL_hip_joint"]
    assert sim.adjustable("damping").tolist() == [False] * 6 + [True] * 12
    rough = [name for name, free in zip(sim.elements("friction"), sim.adjustable("friction"), strict=True) if free]
    assert rough == ["FL", "FR", "RL", "RR"]


def test_parameters_change_between_rollouts_only() -> None:
    sim, _, states = parametric("Euler's servos")
    start = [torch.tensor(x) for x in states]
    sim.parameters = {"mass": (mass := sim.parameters["mass"].requires_grad_())}
    _, qvel = sim.step(*start)
    with pytest.raises(RuntimeError, match=r"within a rollout.*rewind\(\)"):
        sim.parameters = {}
    sim.rewind()
    sim.parameters = {"mass": 1.1 * mass.detach()}
    with pytest.raises(RuntimeError, match="overwritten"):
        qvel.sum().backward()
    assert not torch.equal(sim.step(*start)[1], qvel) and not sim.parameters["mass"].equal(mass)
    sim.parameters = {}
    assert torch.equal(sim.step(*start)[1], qvel.detach()) and sim.parameters["mass"].equal(mass)


WRONG = [  # a parameter, where and what it becomes, the message
    ("mass", 1, -1.0, "mass[1] is -1.0, must be positive"),
    ("mass", 1, 0.0, "mass[1] is 0.0, must be positive"),
    ("mass", 0, 1.0, "mass[0] is 1.0, must stay the file's value"),
    ("com", (1, 2), float("nan"), "com[1, 2] is nan, must be finite"),
    ("inertia", (2, 0), 9.0, "inertia[2] is [9.0, 0.2, 0.1]: a moment exceeds"),
    ("damping", 3, -0.5, "damping[3] is -0.5, must not be negative"),
    ("kv", 1, 1.0, "kv[1] is 1.0, must stay the file's value"),
    ("frictionloss", 1, 0.5, "parameters: frictionloss must be zero everywhere if and only if it is so in the file"),
]


def test_what_no_robot_has_is_refused_in_one_line() -> None:
    sim, scene, _ = parametric("Euler's servos")
    for name, place, number, message in WRONG:
        value = sim.parameters[name]
        value[place] = number
        with pytest.raises(ValueError, match="^" + re.escape(message)) as error:
            sim.parameters = {name: value}
        assert "\n" not in str(error.value)
    for name, value, message in (
        ("weight", sim.parameters["mass"], "unknown parameter 'weight'; choose from mass, com"),
        ("mass", torch.ones(2), "mass is (2,), must be a torch.Tensor of (5,)"),
        ("mass", [1.0] * 5, "mass is list, must be a torch.Tensor of (5,)"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            sim.parameters = {name: value}
    with pytest.raises(ValueError, match="has no option factors"):
        ParametricSimulator(scene, 1, HARD, factors=True)
    for file, what in (
        (FISH, "a fluid"),
        (COMPENSATED, "gravity compensation"),
        (CRANE, "tendons"),
    ):
        with pytest.raises(SceneError, match=f"robot: parameters are not supported with {what}"):
            ParametricSimulator(parse(file), 1, HARD)


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["floating", "bounded servos", "touching"])
def test_gradients_on_a_gpu_are_the_cpus(name: str, rng: np.random.Generator) -> None:
    cpu, scene, states = parametric(name)
    values, grads = other_values(cpu, rng), []
    for device in ("cpu", "cuda"):
        sim = ParametricSimulator(
            scene, len(states[0]), cpu.integration, cpu.control_dt, dtype=torch.float64, device=device
        )
        sim.parameters = leaves = tensors(values, requires_grad=True)
        qpos, qvel = sim.step(*(torch.tensor(x, device=device) for x in states))
        grads.append(torch.autograd.grad(qpos.sin().sum() + qvel.sin().sum(), [*leaves.values()]))
    for value, expected in zip(*grads, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-7, atol=1e-9)
