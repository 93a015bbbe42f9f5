"""Blocks of environments in vectors: every law as in float64, whatever the neighbours and the block's edges."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import (
    BALL,
    BAR,
    PENDULUM,
    acting_states,
    free_states,
    grounded_states,
    leg_scene,
    parse,
    run,
    small_scene,
    task_scene,
)
from test_terrain import HILLS, everywhere, hopping, pressed

from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import Integration
from diffsim.sim.options import BLOCKS
from diffsim.sim.simulator import Simulator

CONTROL_DT = 1 / 60
SEMI, IMPLICIT = (Integration("soft", 8, implicit) for implicit in (False, True))
MUJOCO = Integration("mujoco", 4, tolerance=1e-6)
_, SMALL, BLOCK = BLOCKS
COUNT = BLOCK + 1


def case(name: str, rng: np.random.Generator):
    """A scene and states of COUNT environments in which all of its laws act; most are other tests' scenes."""
    if name == "leg":
        return grounded_states(leg_scene(grounded=True), COUNT, rng)
    if name == "fish":
        scene = small_scene("fluid")
        return scene, free_states(scene, COUNT, rng)
    if name in ("ball on hills", "bar on hills"):
        scene = parse(BAR if name == "bar on hills" else BALL).with_terrain(HILLS)
        return scene, pressed(scene, everywhere(rng)[:COUNT], rng)
    if name == "hopper on hills":  # elsewhere for each
        return hopping(HILLS + np.linspace(-0.6, 0.6, COUNT)[:, None, None] * [1, 0], COUNT, rng)
    return task_scene(name), acting_states(task_scene(name), COUNT, rng)


def step(scene, states, dtype, integration, weights=None, **options):
    """State after a control step, its gradient in all that a step takes, and the simulator."""
    count = len(states[0])
    sim = Simulator(scene, count, integration, CONTROL_DT, dtype=dtype, **options)
    inputs = [torch.tensor(x, dtype=dtype, requires_grad=True) for x in states]
    rng = np.random.default_rng(0)
    if options.get("factors"):
        sim.factors = torch.tensor(rng.uniform(0.6, 1.4, (COUNT, len(FACTORS)))[:count], dtype=dtype).requires_grad_()
        inputs.append(sim.factors)
    if options.get("forces"):
        forces = rng.normal(size=(COUNT, scene.nbody, 6))[:count]
        sim.forces = torch.tensor(forces, dtype=dtype).requires_grad_()
        inputs.append(sim.forces)
    outputs = sim.step(*inputs[:3])
    gradients = torch.autograd.grad([x.sum() for x in outputs], inputs)
    return [x.detach().double() for x in (*outputs, *gradients)], sim


@pytest.mark.parametrize(
    "name, integration, options",
    [
        ("ant", SEMI, {}),
        pytest.param("hopper", SEMI, {"forces": True}, marks=pytest.mark.slow),
        pytest.param("fish", SEMI, {}, marks=pytest.mark.slow),
        pytest.param("half_cheetah", IMPLICIT, {}, marks=pytest.mark.slow),
        pytest.param("leg", SEMI, {"factors": True}, marks=pytest.mark.slow),
        pytest.param("hopper on hills", SEMI, {}, marks=pytest.mark.slow),
        pytest.param("ball on hills", IMPLICIT, {}, marks=pytest.mark.slow),
        pytest.param("ball on hills", MUJOCO, {}, marks=pytest.mark.slow),
        ("bar on hills", MUJOCO, {"factors": True}),
    ],
)
def test_laws_are_those_of_float64(name, integration, options, rng):
    scene, states = case(name, rng)
    states = tuple(x.astype(np.float32) for x in states)
    block, sim = step(scene, states, torch.float32, integration, **options)
    exact, _ = step(scene, states, torch.float64, integration, **options)
    assert not sim.nonfinite.any()
    for found, expected in zip(block, exact, strict=True):
        if not expected.numel():  # the ball has no motor
            continue
        error = (found - expected).abs().flatten(1).amax(1) / expected.abs().max()
        assert (
            error.median() < 2e-6 and error.max() < 2e-4
        )  # the largest where a contact sticks in one, slides in the other


@pytest.fixture(scope="module")
def hoppers():
    """States of the hopper beyond the second block of 16, and their step."""
    states = acting_states(task_scene("hopper"), 2 * BLOCK + 1, np.random.default_rng(1))
    return states, step(task_scene("hopper"), states, torch.float32, SEMI)[0]


@pytest.mark.parametrize("count", [2, 7, SMALL, 15, BLOCK, 17])
@pytest.mark.parametrize("last", [False, True])
def test_an_environment_does_not_depend_on_its_place_in_a_block(count, last, hoppers):
    states, expected = hoppers
    part = slice(-count, None) if last else slice(count)
    found, sim = step(task_scene("hopper"), tuple(x[part] for x in states), torch.float32, SEMI)
    assert sim.nonfinite.shape == (count,)
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y[part], rtol=0, atol=0)


def test_one_environment_is_no_block(hoppers):
    """The scalar kernel, whose sums are rounded otherwise."""
    states, expected = hoppers
    found, _ = step(task_scene("hopper"), tuple(x[:1] for x in states), torch.float32, SEMI)
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y[:1], rtol=1e-5, atol=1e-5 * y.abs().max().item())


@pytest.mark.parametrize("threads", [2, 3, 16])
def test_threads_take_whole_blocks(threads, hoppers):
    states, expected = hoppers
    for x, y in zip(step(task_scene("hopper"), states, torch.float32, SEMI, threads=threads)[0], expected, strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=0)


def test_a_gradient_that_is_not_finite_is_counted_once(hoppers):
    """And contained: it is zero, and the others are as beside a finite one."""
    states, expected = hoppers
    sim = Simulator(task_scene("hopper"), len(states[0]), SEMI, CONTROL_DT)
    inputs = [torch.tensor(x, dtype=torch.float32, requires_grad=True) for x in states]
    outputs = sim.step(*inputs)
    weights = [torch.ones_like(x) for x in outputs]
    weights[0][[5, -1], 1] = torch.nan
    gradients = torch.autograd.grad(outputs, inputs, weights)
    assert sim.nonfinite_gradients.nonzero().flatten().tolist() == [5, 2 * BLOCK]
    assert sim.nonfinite_gradients[5] == sim.nonfinite_gradients[-1] == 1
    others = [k for k in range(2 * BLOCK) if k != 5]
    for gradient, wanted in zip(gradients, expected[2:], strict=True):
        assert (gradient[[5, -1]] == 0).all()
        torch.testing.assert_close(gradient[others].double(), wanted[others], rtol=0, atol=0)


def test_sines_of_large_angles():
    """A hinge may have turned many times; beyond 8192 the error grows with the angle."""
    scene = parse(PENDULUM.replace('range="-9 9"', 'range="-1e5 1e5"'))
    angles = np.concatenate([np.linspace(-8192, 8192, 160), [0.0, 1e-30, 20000.0, -50000.0]]).astype(np.float32)[
        :, None
    ]
    states = angles, np.zeros_like(angles), np.zeros_like(angles)
    once = Integration(substeps=1)  # a second substep would start from a rounded angle
    block, exact = (run(scene, *states, dtype=dtype, integration=once)[1] for dtype in (torch.float32, torch.float64))
    near = np.abs(angles[:, 0]) <= 8192
    np.testing.assert_allclose(block[near], exact[near], rtol=1e-6, atol=1e-6 * abs(exact).max())
    np.testing.assert_allclose(block, exact, rtol=1e-5, atol=1e-5 * abs(exact).max())


@pytest.mark.parametrize("count", [1, BLOCK])
def test_a_hinge_far_off_moves_on_or_is_contained(count):
    """In float32 a substep's motion is less than a rounding there, but that of a control step is not lost."""
    scene = dataclasses.replace(parse(PENDULUM.replace('range="-9 9"', 'range="-1e9 1e9"')), gravity=np.zeros(3))
    zeros = torch.zeros(count, 1)
    for angle in (1e4, -1e4, 9e4):
        sim = Simulator(scene, count, Integration(substeps=64), CONTROL_DT)
        end, _ = sim.step(zeros + angle, zeros + 3.0, zeros)
        assert not sim.nonfinite.any()
        np.testing.assert_allclose(
            end.double() - angle, 3.0 * CONTROL_DT, atol=0.51 * np.spacing(np.float32(abs(angle)))
        )
    for angle, slowest in ((1e4, 0.03), (9e4, 0.24)):  # rad/s, as docs/numerics.md has it: a slower one stands still
        for rate in (10 * slowest, 3 * slowest, 0.9 * slowest, 0.3 * slowest):
            end = zeros + angle
            for _ in range(60):
                end, _ = sim.step(end, zeros + rate, zeros)
            moved = (end.double() - angle) / (60 * CONTROL_DT)
            assert (abs(moved - rate) < slowest).all() and (rate > slowest / 2 or (moved == 0).all())
    for angle in (1.1e5, 3e7, -2e9):  # sines of blocks are wrong from 3e7 on
        end, _ = sim.step(zeros + angle, zeros + 3.0, zeros)
        assert sim.nonfinite.all() and (end == zeros + angle).all()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"block": 4}, "block is 4, must be 1, 8 or 16"),
        ({"block": 8.0}, "block is 8.0, must be an integer of at least 1"),
        ({"block": 16, "dtype": torch.float64}, "block is 16, must be 1 on a GPU and in float64"),
    ],
)
def test_blocks_of_other_sizes_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Simulator(task_scene("hopper"), 2, **options)


@pytest.mark.slow
def test_processors_without_wide_registers(tmp_path, hoppers):
    """Compiled for the oldest processor of its kind, which has neither AVX nor a fused product and sum."""
    states, expected = hoppers
    np.savez(tmp_path / "states.npz", *states)
    code = f"""
import numpy as np, torch, warp as wp
wp.config.cpu_compiler_flags = ""
from scenes import task_scene
from test_blocks import SEMI, step
states = [x for x in np.load({str(tmp_path / "states.npz")!r}).values()]
torch.save(step(task_scene("hopper"), states, torch.float32, SEMI)[0], {str(tmp_path / "found.pt")!r})
"""
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True)
    for x, y in zip(torch.load(tmp_path / "found.pt"), expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-5 * y.abs().max().item())
        assert (x != y).any()  # rounded otherwise
