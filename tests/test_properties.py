"""What holds for every law: float32 is near float64, and environments of a block leave each other alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from scenes import (
    BALL,
    BAR,
    BOUNDED_SERVOS,
    acting_states,
    free_states,
    grounded_states,
    leg_scene,
    parse,
    small_scene,
    task_scene,
)
from test_constraint import enough_passes, sliding_ant  # noqa: F401
from test_pairs import linkages, solid_states, solids, tangled, tied_states, tied_tree
from test_terrain import HILLS, everywhere, hopping, pressed
from test_transmission import case
from torch import Tensor

from diffsim.robot.scene import FACTORS, Scene
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

SEMI, IMPLICIT = (Integration("soft", 8, implicit) for implicit in (False, True))
HARD = Integration("mujoco", 4, tolerance=1e-6)
SLOW, UNOPTIMIZED = pytest.mark.slow, pytest.mark.unoptimized
Made = tuple[Scene, Any]  # a scene, and qpos, qvel, ctrl in which all of its laws act
Make = Callable[[int, np.random.Generator], Made]


class Row(NamedTuple):
    make: Make  # of how many environments
    integration: Integration
    block: int = 16
    count: int = 17  # environments: the last block is not full
    given: tuple[str, ...] = ()  # which of factors and forces
    near: float = 2e-4  # the largest error of float32, relative to the largest number of any environment
    usual: float = 2e-6  # the same, of the median environment
    marks: tuple[pytest.MarkDecorator, ...] = ()


def task(name: str) -> Make:
    return lambda count, rng: (task_scene(name), acting_states(task_scene(name), count, rng))


def on_hills(mjcf: str) -> Make:
    def make(count: int, rng: np.random.Generator) -> Made:
        scene = parse(mjcf).with_terrain(HILLS)
        return scene, pressed(scene, everywhere(rng)[:count], rng)

    return make


def hoppers_on_hills(count: int, rng: np.random.Generator) -> Made:
    """Elsewhere for each."""
    return hopping(HILLS + np.linspace(-0.6, 0.6, count)[:, None, None] * [1, 0], count, rng)


def ants_in_the_air(count: int, rng: np.random.Generator) -> Made:
    """Every other one, where one pass is enough; the others slide."""
    scene, states = sliding_ant(0.3, 2.0, rng, count)
    states[0][::2, 2] += 1.0
    return scene, states


def of(make: Callable[..., Scene], states: Callable[..., Any], *arguments: object) -> Make:
    def made(count: int, rng: np.random.Generator) -> Made:
        scene = make(*arguments)
        return scene, states(scene, count, rng)

    return made


PAIRS: dict[str, Any] = dict(integration=HARD, block=8, count=9, usual=1e-5)
MANY = PAIRS | {"count": 65, "near": 1e-3}  # so that each kind of contact is among them
ROWS = {
    "ant": Row(task("ant"), SEMI),
    "hopper": Row(task("hopper"), SEMI),
    "hopper, forces": Row(task("hopper"), SEMI, given=("forces",), marks=(SLOW,)),
    "cartpole, implicit": Row(task("cartpole"), IMPLICIT, marks=(UNOPTIMIZED,)),
    "half_cheetah, implicit": Row(task("half_cheetah"), IMPLICIT, marks=(SLOW,)),
    "fluid": Row(of(small_scene, free_states, "fluid"), SEMI, marks=(SLOW,)),
    "muscles, factors": Row(
        lambda count, rng: grounded_states(leg_scene(grounded=True), count, rng),
        SEMI,
        given=("factors",),
        marks=(SLOW,),
    ),
    "hoppers on hills": Row(hoppers_on_hills, SEMI, marks=(SLOW,)),
    "ball on hills, implicit": Row(on_hills(BALL), IMPLICIT, marks=(SLOW,)),
    "hopper, constraints": Row(task("hopper"), HARD),
    "ants, constraints": Row(ants_in_the_air, HARD, block=8, count=9),
    "ball on hills, constraints": Row(on_hills(BALL), HARD, marks=(SLOW,)),
    "bar on hills, constraints, factors": Row(on_hills(BAR), HARD, given=("factors",)),
    "bounded servos": Row(of(parse, free_states, BOUNDED_SERVOS), HARD, block=8, count=9, marks=(UNOPTIMIZED,)),
    "gripper": Row(lambda count, rng: case("implicitfast", count, rng), **PAIRS, marks=(UNOPTIMIZED,)),
    "drone": Row(lambda count, rng: case("drone", count, rng), **PAIRS, marks=(SLOW, UNOPTIMIZED)),
    "four-bar": Row(lambda count, rng: linkages(rng), **PAIRS, marks=(UNOPTIMIZED,)),
    "tied tree": Row(of(tied_tree, tied_states, "floating", 0), **PAIRS, marks=(SLOW,)),
    "touching links": Row(lambda count, rng: tangled("floating", "elliptic", 0, count, rng), **PAIRS, marks=(SLOW,)),
    "boxes and capsules": Row(of(solids, solid_states, "elliptic", 0), **MANY, marks=(SLOW,)),
}


@pytest.fixture(params=[pytest.param(name, marks=row.marks) for name, row in ROWS.items()])
def row(request: pytest.FixtureRequest) -> Row:
    return ROWS[request.param]


def simulator(row: Row, scene: Scene, dtype: torch.dtype = torch.float32) -> Simulator:
    """Of float32 in blocks, or of float64 to the end."""
    how, block = row.integration, row.block
    if dtype == torch.float64:
        how, block = how._replace(tolerance=1e-11) if how.contact == "mujoco" else how, 1
    given = dict.fromkeys(row.given, True)
    return Simulator(scene, row.count, how, 1 / 60, dtype=dtype, block=block, threads=2, **given)


def step(row: Row, sim: Simulator, states: Any, order: Any = None, weights: Any = None) -> list[Tensor]:
    """Take a control step of the environments in an order; returns the state and its gradients, a row for each."""
    order, rng, leaves = np.arange(row.count) if order is None else order, np.random.default_rng(0), []
    if "factors" in row.given:
        factors = rng.uniform(0.6, 1.4, (row.count, len(FACTORS)))
        sim.factors = torch.tensor(factors[order], dtype=sim.dtype)
    if "forces" in row.given:
        forces = rng.normal(size=(row.count, sim.scene.nbody, 6))
        sim.forces = torch.tensor(forces[order], dtype=sim.dtype).requires_grad_()
        leaves.append(sim.forces)
    leaves[:0] = [torch.tensor(x[order].astype(np.float32), dtype=sim.dtype, requires_grad=True) for x in states]
    sim.rewind()
    ends = sim.step(*leaves[:3])
    gradients = torch.autograd.grad(ends, leaves, weights or [torch.ones_like(end) for end in ends])
    return [x.detach().flatten(1) for x in (*ends, *gradients)]


def test_float32_is_near_float64(row: Row, rng: np.random.Generator) -> None:
    scene, states = row.make(row.count, rng)
    sim = simulator(row, scene)
    found, exact = step(row, sim, states), step(row, simulator(row, scene, torch.float64), states)
    assert not sim.nonfinite.any() and sim.residual.max() <= row.integration.tolerance
    for value, expected in zip(found, exact, strict=True):
        if expected.numel():  # some have no motor
            error = (value - expected).abs().amax(1) / expected.abs().max()
            assert error.median() < row.usual and error.max() < row.near


def test_an_environment_does_not_depend_on_its_neighbours(row: Row, rng: np.random.Generator) -> None:
    """Bit for bit, in another place of another block, and among copies of one; some need more passes than others."""
    scene, states = row.make(row.count, rng)
    states[1][1::2] *= 10.0
    places, found = np.arange(row.count), []
    orders = places, np.roll(places, 5), places[::-1].copy(), np.full(row.count, 3)
    for order in orders:
        own_ground = scene.terrain is not None and len(scene.terrain) > 1
        sim = simulator(row, scene.with_terrain(scene.terrain[order]) if own_ground else scene)
        found.append([*step(row, sim, states, order), sim.residual.unsqueeze(1)])
    for order, values in zip(orders[1:], found[1:], strict=True):
        assert all(torch.equal(value, wanted[order]) for value, wanted in zip(values, found[0], strict=True))


NOT_FINITE = (0, -1, np.nan), (0, 0, np.nan), (1, -1, 1e30), (1, -1, -np.inf), (1, 0, np.inf), (2, -1, np.nan)


@pytest.mark.parametrize("bad", [2, -1])  # among others, and in a block that is not full
def test_what_is_not_finite_stays_in_its_environment(row: Row, bad: int, rng: np.random.Generator) -> None:
    """Which stays where it was and has no gradient; the next step is not affected."""
    scene, states = row.make(row.count, rng)
    sim, others = simulator(row, scene), np.delete(np.arange(row.count), bad)
    expected = step(row, sim, states)
    assert not sim.nonfinite.any() and all(x[bad].any() for x in expected[2:] if x.numel())
    for part, column, value in NOT_FINITE if scene.nu else NOT_FINITE[:-1]:
        changed = [x.copy() for x in states]
        changed[part][bad, column] = value
        found = step(row, sim, changed)
        assert sim.nonfinite.nonzero().flatten().tolist() == [np.arange(row.count)[bad]]
        assert all(torch.equal(x[others], y[others]) for x, y in zip(found, expected, strict=True))
        for end, start in zip(found[:2], changed, strict=False):
            np.testing.assert_array_equal(end[bad], start[bad].astype(np.float32))
        assert not any(x[bad].any() for x in found[2:]) and not sim.nonfinite_gradients.any()
    assert all(torch.equal(x, y) for x, y in zip(step(row, sim, states), expected, strict=True))


def test_a_gradient_that_is_not_finite_is_counted_once_and_stays(row: Row, rng: np.random.Generator) -> None:
    scene, states = row.make(row.count, rng)
    sim, bad = simulator(row, scene), [2, row.count - 1]
    expected = step(row, sim, states)
    weights = [torch.ones_like(x) for x in expected[:2]]
    weights[0][bad, 1] = torch.nan
    found, others = step(row, sim, states, weights=weights), np.delete(np.arange(row.count), bad)
    assert sim.nonfinite_gradients.tolist() == [int(k in bad) for k in range(row.count)]
    for value, wanted in zip(found[2:], expected[2:], strict=True):
        assert torch.equal(value[others], wanted[others]) and not value[bad].any()
