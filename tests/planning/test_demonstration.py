"""Recorded trajectories: what is read, what is refused, and how a system follows them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from systems import normal, task_system

import diffsim
from diffsim.planning import System, follow_demonstration, load_demonstration, save_demonstration


def write(path: Path, steps: int, **changes: np.ndarray) -> Path:
    arrays = dict(qpos=np.zeros((steps + 1, 2)), qvel=np.ones((steps + 1, 2)), action=np.full((steps, 1), 0.5))
    np.savez(path, **arrays | changes)
    return path


def test_reading(tmp_path: Path) -> None:
    ((x, u),) = load_demonstration(task_system("cartpole"), write(tmp_path / "a.npz", 9), 6)
    assert x.tolist() == [[0.0, 0.0, 1.0, 1.0]] * 7
    torch.testing.assert_close(torch.tanh(u), torch.full((6, 1), 0.5).double())
    bounds = np.array([[1.0], [-1.0]])  # whose atanh is infinite
    ((_, u),) = load_demonstration(task_system("cartpole"), write(tmp_path / "a.npz", 2, action=bounds), 2)
    torch.testing.assert_close(torch.tanh(u), torch.tensor([[0.995], [-0.995]]).double())


def test_several_trajectories_in_one_file(tmp_path: Path, rng: np.random.Generator) -> None:
    system, path = task_system("cartpole"), tmp_path / "new" / "plan.npz"
    x, u = normal(rng, 3, 7, 4), 0.1 * normal(rng, 3, 6, 1)
    save_demonstration(system, x, u, path, terrain=["a", "b", "c"])
    assert np.load(path)["terrain"].tolist() == ["a", "b", "c"]
    for row, found in enumerate(load_demonstration(system, path, 5)):
        torch.testing.assert_close(found, (x[row, :6], u[row, :5]))
    assert row == 2
    save_demonstration(system, x[1], u[1], path)
    torch.testing.assert_close(load_demonstration(system, path, 6), [(x[1], u[1])])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"qpos": np.zeros((9, 2))}, r"qpos has shape \(9, 2\).*, must be at least \(10, 2\) for 9 steps"),
        ({"qvel": np.zeros((20, 3))}, r"qvel has shape \(20, 3\).*, must be at least \(10, 2\)"),
        ({"action": np.zeros((1, 2, 20, 1))}, r"action has shape \(1, 2, 20, 1\)"),
        ({"action": np.zeros((2, 9, 1))}, "qpos, qvel and action hold 1, 1, 2 trajectories"),
        ({"qpos": np.full((20, 2), np.nan)}, "qpos holds numbers that are not finite"),
        ({"qpos": np.full((20, 2), 1j)}, r"qpos has shape \(20, 2\) of complex128"),
        ({"control_dt": np.array([0.02, 0.02])}, "is not an .npz with qpos, qvel and action"),
        ({"action": np.array(["a"], dtype=object)}, "is not an .npz with qpos, qvel and action$"),
    ],
)
def test_refusals(changes: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        load_demonstration(task_system("cartpole"), write(tmp_path / "a.npz", 9, **changes), 9)


def test_a_plan_is_of_its_own_control_step(tmp_path: Path) -> None:
    """Which the file tells; one that does not, of before there was a choice, has 1/60 s."""
    path, usual = tmp_path / "a.npz", task_system("cartpole")
    slow = System(diffsim.make("cartpole", 1, control_dt=0.05))
    x, u = torch.ones(10, 4).double(), torch.zeros(9, 1).double()
    save_demonstration(slow, x, u, path)
    assert torch.equal(load_demonstration(slow, path, 9)[0][0], x)
    with pytest.raises(ValueError, match=r"has control steps of 0.05 s, not of 0.01667 s"):
        load_demonstration(usual, path, 9)
    with pytest.raises(ValueError, match=r"has control steps of 0.01667 s, not of 0.05 s"):
        load_demonstration(slow, write(path, 9), 9)


def test_a_controller_brings_the_system_along(rng: np.random.Generator) -> None:
    """What the system can do it repeats; of what it cannot it makes a trajectory of its own nearby."""
    system = task_system("cartpole")
    actions = 0.2 * normal(rng, 20, 1)
    x, u, _ = system.rollout(system.start(), 20, lambda t, _: actions[t : t + 1])
    torch.testing.assert_close(follow_demonstration(system, x[0], u[0], 1.0), (x, u))
    shaken = x[0] + 0.01 * normal(rng, 21, 4)
    own, own_u = follow_demonstration(system, shaken, u[0], 1.0)
    torch.testing.assert_close(own, system.rollout(shaken[:1], 20, lambda t, _: own_u[:, t])[0])
    open_loop = system.rollout(shaken[:1], 20, lambda t, _: actions[t : t + 1])[0]
    assert (own - shaken).norm() < (open_loop - shaken).norm()
