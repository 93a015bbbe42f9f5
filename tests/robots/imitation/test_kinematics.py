"""Forward kinematics and differences of rotations, against MuJoCo's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from scenes import task_scene

from diffsim_robots.imitation.kinematics import Kinematics, difference, matrix

REAL = torch.float64


def random_qpos(model: mujoco.MjModel, rng: np.random.Generator, count: int) -> np.ndarray:
    qpos = rng.normal(size=(count, model.nq))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos


@pytest.mark.parametrize("name", ["ant", "humanoid"])
def test_bodies_and_centre_of_mass(name: str, rng: np.random.Generator) -> None:
    model = task_scene(name).mj_model
    if name == "ant":  # with what our robots lack: bodies at an angle, angles that are not 0 at rest
        model = mujoco.MjModel.from_xml_path(str(task_scene(name).path))
        quat = rng.normal(size=(model.nbody - 2, 4))
        model.body_quat[2:] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        model.qpos0[7:] = rng.normal(size=model.nq - 7)
    data, kinematics = mujoco.MjData(model), Kinematics(model, "cpu", REAL)
    qpos = random_qpos(model, rng, 6)
    positions, rotations = kinematics(torch.tensor(qpos).reshape(2, 3, -1))
    centre = kinematics.centre(positions, rotations)
    assert positions.shape == (2, 3, model.nbody - 1, 3) and centre.shape == (2, 3, 3)
    for k in range(6):
        data.qpos[:] = qpos[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        i = divmod(k, 3)
        np.testing.assert_allclose(positions[i], data.xpos[1:], atol=1e-12)
        np.testing.assert_allclose(rotations[i].flatten(1), data.xmat[1:], atol=1e-12)
        np.testing.assert_allclose(centre[i], data.subtree_com[0], atol=1e-12)


@pytest.mark.parametrize("name", ["hopper", "humanoid_mtu"])
def test_other_joints_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match="needs a free root and hinges"):
        Kinematics(task_scene(name).mj_model, "cpu", REAL)


def test_difference(rng: np.random.Generator) -> None:
    quats = rng.normal(size=(2, 50, 4))
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    quats[1, 0] = quats[0, 0]
    quats[1, 1] = -quats[0, 1]
    a, b = (torch.tensor(q, requires_grad=True) for q in quats)
    found = difference(a, b)
    for k in range(50):
        expected = np.zeros(3)
        mujoco.mju_subQuat(expected, quats[1, k], quats[0, k])
        np.testing.assert_allclose(found[k].detach(), expected, atol=1e-12)
    assert found[:2].abs().max() < 1e-15
    found.sum().backward()
    assert a.grad is not None and a.grad.isfinite().all()
    assert torch.autograd.gradcheck(difference, (a[2:8], b[2:8]))
    torch.testing.assert_close(matrix(a) @ matrix(a).mT, torch.eye(3, dtype=REAL).expand(50, 3, 3))
