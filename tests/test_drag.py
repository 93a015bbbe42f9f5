"""A fluid's drag: against MuJoCo, the plain reference, closed forms and central differences."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import reference
import torch
from scenes import acceleration, free_states, parse, run
from test_gradient import check_gradients

from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator

# A free box of three unlike sides, two more on hinges about unlike axes, one of them on a slide besides. It is fast in
# its fluid, so that both parts of the law count. A planar root, and the implicit integrator, are the swimmer's in
# test_dynamics.py and test_gradient.py.
FISH = """
<mujoco>
  <option density="300" viscosity="2" gravity="0.3 -0.2 -9.81"/>
  <default> <geom contype="0" conaffinity="0"/> </default>
  <worldbody>
    <body>
      <freejoint/> <geom type="box" size="0.2 0.1 0.05" euler="10 20 30" pos="0.1 0.02 0.03" density="400"/>
      <body pos="0.3 0 0.1">
        <joint name="a" axis="0.2 1 0.1" damping="0.1"/> <geom type="box" size="0.1 0.05 0.2" density="400"/>
        <body pos="0 0.1 0.2">
          <joint axis="0 0 1" type="slide"/> <joint name="b" axis="1 0 0.3"/>
          <geom type="capsule" size="0.05 0.2" euler="40 0 0" density="400"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator> <motor joint="a" gear="5"/> <motor joint="b" gear="5"/> </actuator>
</mujoco>"""


def states_of(scene, rng):
    qpos, qvel, ctrl = free_states(scene, 8, rng)
    return qpos, 2 * qvel, ctrl


def test_accelerations_are_mujocos(rng):
    scene = parse(FISH)
    model, data, states = scene.mj_model, mujoco.MjData(scene.mj_model), states_of(scene, rng)
    for state, qacc in zip(zip(*states, strict=True), acceleration(scene, *states), strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = state
        mujoco.mj_forward(model, data)
        assert np.abs(data.qfrc_fluid).min() > 1e-3
        np.testing.assert_allclose(qacc, data.qacc, rtol=1e-8, atol=1e-8 * np.abs(data.qacc).max())


def test_steps_are_the_references(rng):
    scene, integration = parse(FISH), Integration(substeps=4)
    states = states_of(scene, rng)
    q, v = run(scene, *states, integration=integration)
    for e, state in enumerate(zip(*states, strict=True)):
        expected = reference.step(scene, *state, 1 / 60, integration)
        np.testing.assert_allclose(q[e], expected[0], atol=1e-10)
        np.testing.assert_allclose(v[e], expected[1], atol=1e-10)


def test_gradient_is_that_of_differences(rng):
    scene = parse(FISH)
    check_gradients(scene, states_of(scene, rng), rng, integration=Integration(substeps=8))


def test_gradient_at_rest_is_the_viscous_one(rng):
    """|v| v has slope 0 at 0, so a body at rest feels viscosity only, and no division by zero."""
    fish, (qpos, _, ctrl) = parse(FISH), (torch.tensor(x) for x in states_of(parse(FISH), rng))
    slopes = {}
    for density, viscosity in ((300.0, 2.0), (0.0, 2.0), (300.0, 0.0), (1e-300, 0.0)):
        scene = dataclasses.replace(fish, density=density, viscosity=viscosity)
        sim = Simulator(scene, 8, Integration(substeps=1), dtype=torch.float64)
        qvel = torch.zeros(8, scene.nv, dtype=torch.float64, requires_grad=True)
        (slopes[density, viscosity],) = torch.autograd.grad(sim.step(qpos, qvel, ctrl)[1].sin().sum(), qvel)
    torch.testing.assert_close(slopes[300.0, 2.0], slopes[0.0, 2.0], rtol=1e-12, atol=0)
    torch.testing.assert_close(slopes[300.0, 0.0], slopes[1e-300, 0.0], rtol=1e-12, atol=0)
    assert not torch.allclose(slopes[0.0, 2.0], slopes[300.0, 0.0], rtol=0.1)
