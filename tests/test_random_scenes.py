"""Random scenes against MuJoCo, with everything that a file may have (random_scenes.py): steps, and their gradients."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
import pytest
import torch
from random_scenes import RandomScene

from diffsim.robot.constants import constrained
from diffsim.robot.elements import control_range
from diffsim.robot.mjcf import load_scene
from diffsim.robot.pairs import with_pairs
from diffsim.robot.scene import Scene
from diffsim.robot.types import SceneError
from diffsim.sim.integration import Integration
from diffsim.sim.simulator import Simulator
from diffsim_cli.gait import trace
from diffsim_cli.report import approximations

NUMBER, STEPS = 12, 20  # states of a scene, and steps from each
# What a report tells that does not change MuJoCo's steps, or not before bodies that touch nothing are left out
HARMLESS = "Left out, with", "A control of", "Without a task's", "The ground feels"
QUICK = 43  # a structure with contact, pairs, equality, limits, servos, tendons and a ball joint
FINE, FINE_LATER, FINE_SLOPE = 1e-7, 1e-4, 1e-4  # errors after a step and after all, and of a step's gradient
BEYOND = 1e5  # rad/s or m/s, at which the simulator gives up
WIDTHS = 1e-5, 1e-6, 1e-7  # of differences; the best one counts

Array = Any


class Outcome(NamedTuple):
    """What becomes of the states of a scene (n,)."""

    first: Array  # errors of a step and
    last: Array  # of all steps, relative to the change of velocity in MuJoCo
    told: Array  # whether the simulator says that it did not converge, or is not finite
    wild: Array  # whether MuJoCo warns, or its numbers are beyond what is simulated


def load(text: str) -> tuple[Scene | None, str]:
    """The scene, whose parts touch each other as in MuJoCo; none if it is refused or approximated, and why."""
    try:
        scene = load_scene(mujoco.MjSpec.from_string(text))
        if any(line.startswith("The robot's parts") for line in approximations(scene)):
            scene = with_pairs(scene)
        constrained(scene, scene.mj_model.opt.timestep, single=False)
        told = [line for line in approximations(scene) if not line.startswith(HARMLESS)]
        return (None, f"approximated: {told[0]}") if told else (scene, "")
    except SceneError as error:
        return None, f"refused: {error}"
    except ValueError as error:  # of MuJoCo's compiler
        return None, f"invalid: {error}"


def states(scene: Scene, seed: int) -> tuple[Array, Array, Array]:
    """qpos, qvel and actions near the reference pose and farther away, the lowest point in or just over the ground."""
    m, rng, qpos = scene.mj_model, np.random.default_rng(seed), np.tile(scene.qpos0, (NUMBER, 1))
    for q in qpos:
        mujoco.mj_integratePos(m, q, rng.normal(size=m.nv) * rng.choice([0.02, 0.1, 0.4]), 1.0)
        if scene.ncontact and scene.root.up.any():
            q += scene.root.up * (trace(scene, q[None])[0].max() - rng.uniform(-0.005, 0.01))
    qvel = rng.normal(size=(NUMBER, m.nv)) * rng.choice([0.01, 0.3, 2.0], (NUMBER, 1))
    return qpos, qvel, rng.uniform(-1, 1, (NUMBER, m.nu))


def simulator(scene: Scene) -> Simulator:
    dt = scene.mj_model.opt.timestep
    return Simulator(scene, NUMBER, Integration("mujoco", 1, tolerance=1e-12), dt, 2, device="cpu", dtype=torch.float64)


def tensors(*arrays: Array) -> list[torch.Tensor]:
    return [torch.tensor(array) for array in arrays]


def outcome(scene: Scene, sim: Simulator, qpos: Array, qvel: Array, action: Array) -> Outcome:
    m, (low, high), ours = scene.mj_model, control_range(scene.mj_model), []
    q, v, u = tensors(qpos, qvel, action)
    told, first, last, wild = np.zeros(NUMBER, bool), np.zeros(NUMBER), np.zeros(NUMBER), np.zeros(NUMBER, bool)
    with torch.no_grad():
        for _ in range(STEPS):
            q, v = sim.step(q, v, u)
            ours.append((q.numpy().copy(), v.numpy().copy()))
            told |= (sim.nonfinite | (sim.unconverged > 0)).numpy()
    data, moved = mujoco.MjData(m), np.zeros(m.nv)
    for k in range(NUMBER):
        mujoco.mj_resetData(m, data)
        data.qpos, data.qvel, data.ctrl = qpos[k], qvel[k], low + (action[k] + 1) / 2 * (high - low)
        for step in range(STEPS):
            mujoco.mj_step(m, data)
            error, change = abs(ours[step][1][k] - data.qvel).max(), abs(data.qvel - qvel[k]).max() + 1e-9
            if step == 0:
                mujoco.mj_differentiatePos(m, moved, 1.0, data.qpos, ours[0][0][k])
                first[k] = max(error / change, abs(moved).max() / (m.opt.timestep * change + 1e-9))
        last[k] = error / change
        wild[k] = any(warning.number for warning in data.warning) or not abs(data.qvel).max() < BEYOND
    return Outcome(first, last, told, wild)


def slope_errors(scene: Scene, sim: Simulator, qpos: Array, qvel: Array, action: Array) -> Array:
    """Errors of a step's Jacobian (n, columns), relative to the largest number of a column, in float64."""
    m, nv = scene.mj_model, scene.nv
    jacobian = torch.cat(sim.jacobians(*tensors(qpos, qvel, action)), 2).numpy()
    best, scale, moved = np.full(jacobian.shape, np.inf), np.zeros(jacobian[:, 0].shape), np.zeros(nv)
    for width in WIDTHS:
        for column in range(jacobian.shape[2]):
            ends = []
            for side in (width, -width):
                q, v, u = qpos.copy(), qvel.copy(), action.copy()
                if column < nv:
                    for row in q:
                        mujoco.mj_integratePos(m, row, np.eye(nv)[column], side)
                else:
                    (v if column < 2 * nv else u)[:, (column - nv) % nv if column < 2 * nv else column - 2 * nv] += side
                with torch.no_grad():
                    ends.append([x.numpy().copy() for x in sim.step(*tensors(q, v, u))])
            for k in range(NUMBER):
                mujoco.mj_differentiatePos(m, moved, 2 * width, ends[1][0][k], ends[0][0][k])
                slope = np.concatenate((moved, (ends[0][1][k] - ends[1][1][k]) / (2 * width)))
                best[k, :, column] = np.minimum(best[k, :, column], abs(slope - jacobian[k, :, column]))
                scale[k, column] = max(scale[k, column], abs(slope).max())
    return best.max(1) / (scale + 1e-3 * scale.max(1, keepdims=True) + 1e-12)


def check(structure: int, numbers: int, gradients: bool = False) -> Scene | None:
    """Compare a scene with MuJoCo, if it is neither refused nor approximated; where MuJoCo warns, we must, too."""
    scene, _ = load(RandomScene(structure, numbers).text)
    if scene is not None:
        given, sim = states(scene, structure), simulator(scene)
        found = outcome(scene, sim, *given)
        calm = ~found.wild
        assert not found.told[calm].any() and found.told[found.wild].all(), found
        assert found.first[calm].max(initial=0) < FINE and found.last[calm].max(initial=0) < FINE_LATER, found
        if gradients:
            assert slope_errors(scene, sim, *given)[calm].max() < FINE_SLOPE
    return scene


def test_random_numbers_of_one_scene():
    for numbers in range(4):
        scene = check(QUICK, numbers)
        assert scene and scene.ncontact and scene.geom_pairs and scene.nball and scene.mj_model.neq and scene.nu


@pytest.mark.slow
@pytest.mark.parametrize("structure", range(24))
def test_random_scenes(structure):
    for numbers in range(3):
        check(structure, numbers, gradients=numbers == 0)
