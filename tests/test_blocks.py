"""Blocks of environments in vectors, of any size and at their edges; what holds in them is in test_properties.py."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import (
    PENDULUM,
    acting_states,
    parse,
    run,
    task_scene,
)

from diffsim.sim.integration import Integration
from diffsim.sim.options import BLOCKS
from diffsim.sim.simulator import Simulator

CONTROL_DT = 1 / 60
SEMI = Integration("soft", 8)
_, SMALL, BLOCK = BLOCKS


def step(states, **options):
    """State of hoppers after a control step, and its gradient."""
    sim = Simulator(task_scene("hopper"), len(states[0]), SEMI, CONTROL_DT, **options)
    inputs = [torch.tensor(x, dtype=torch.float32, requires_grad=True) for x in states]
    outputs = sim.step(*inputs)
    gradients = torch.autograd.grad([x.sum() for x in outputs], inputs)
    return [x.detach() for x in (*outputs, *gradients)]


@pytest.fixture(scope="module")
def hoppers():
    """States of the hopper beyond the second block of 16, and their step."""
    states = acting_states(task_scene("hopper"), 2 * BLOCK + 1, np.random.default_rng(1))
    return states, step(states)


@pytest.mark.parametrize("count", [2, 7, SMALL, 15, BLOCK, 17])
@pytest.mark.parametrize("last", [False, True])
def test_an_environment_does_not_depend_on_its_place_in_a_block(count, last, hoppers):
    states, expected = hoppers
    part = slice(-count, None) if last else slice(count)
    for x, y in zip(step([x[part] for x in states]), expected, strict=True):
        torch.testing.assert_close(x, y[part], rtol=0, atol=0)


def test_one_environment_is_no_block(hoppers):
    """The scalar kernel, whose sums are rounded otherwise."""
    states, expected = hoppers
    for x, y in zip(step([x[:1] for x in states]), expected, strict=True):
        torch.testing.assert_close(x, y[:1], rtol=1e-5, atol=1e-5 * y.abs().max().item())


@pytest.mark.parametrize("threads", [2, 3, 16])
def test_threads_take_whole_blocks(threads, hoppers):
    states, expected = hoppers
    for x, y in zip(step(states, threads=threads), expected, strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=0)


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
from test_blocks import step
states = [x for x in np.load({str(tmp_path / "states.npz")!r}).values()]
torch.save(step(states), {str(tmp_path / "found.pt")!r})
"""
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parent, check=True)
    for x, y in zip(torch.load(tmp_path / "found.pt"), expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=1e-5 * y.abs().max().item())
        assert (x != y).any()  # rounded otherwise
