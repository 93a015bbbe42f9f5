"""Recorded trajectories: what is read, what is refused, and how a system follows them."""

from __future__ import annotations

import io
import zipfile
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
    x, u = load_demonstration(task_system("cartpole"), write(tmp_path / "a.npz", 9), 6)
    assert x.tolist() == [[0.0, 0.0, 1.0, 1.0]] * 7
    torch.testing.assert_close(torch.tanh(u), torch.full((6, 1), 0.5).double())
    bounds = np.array([[1.0], [-1.0]])  # whose atanh is infinite
    u = load_demonstration(task_system("cartpole"), write(tmp_path / "a.npz", 2, action=bounds), 2)[1]
    torch.testing.assert_close(torch.tanh(u), torch.tensor([[0.995], [-0.995]]).double())


def test_several_terrains_in_one_file(tmp_path: Path, rng: np.random.Generator) -> None:
    """Each is found by its name; of another terrain the beginning of the first is taken."""
    system, path = task_system("cartpole"), tmp_path / "plan.npz"
    ways = [(normal(rng, 7, 4), 0.1 * normal(rng, 6, 1)) for _ in range(3)]
    save_demonstration(system, ways, path, ["level", "step:5", "rough:10"])
    for name, way in zip(("level", "step:5", "rough:10"), ways, strict=True):
        for value, expected in zip(load_demonstration(system, path, 6, name, 2), way, strict=True):
            torch.testing.assert_close(value, expected)
    for beginning, count in ((None, 6), (4, 4), (9, 6)):
        x, u = load_demonstration(system, path, 6, "incline:10", beginning)
        torch.testing.assert_close(x, ways[0][0][: count + 1])
        torch.testing.assert_close(u, ways[0][1][:count])
    save_demonstration(system, ways[1:2], path)
    assert sorted(np.load(path)) == ["action", "control_dt", "qpos", "qvel"] and np.load(path)["qpos"].shape == (7, 2)
    torch.testing.assert_close(load_demonstration(system, path, 5)[0], ways[1][0][:6])
    assert len(load_demonstration(system, path, 6, "step:5", 3)[1]) == 3
    two = {"terrain": np.array(["level", "step:5"])}
    with pytest.raises(ValueError, match=r"qpos has shape \(10, 2\), must be"):
        load_demonstration(system, write(tmp_path / "a.npz", 9, **two), 6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"qpos": np.zeros((9, 2))}, r"qpos has shape \(9, 2\), must be at least \(10, 2\) for 9 steps"),
        ({"qvel": np.zeros((20, 3))}, r"qvel has shape \(20, 3\), must be at least \(10, 2\)"),
        ({"qpos": np.full((20, 2), np.nan)}, "qpos holds numbers that are not finite"),
        ({"qpos": np.full((20, 2), 1j)}, r"qpos has shape \(20, 2\) of complex128, must be .* of real numbers"),
        ({"control_dt": np.array(0.02)}, "has control steps of 0.02 s, not of 0.01667 s"),
        ({"control_dt": np.array([0.02, 0.02])}, "is not an .npz with qpos, qvel and action"),
        ({"action": np.array(["a"], dtype=object)}, "is not an .npz with qpos, qvel and action"),
    ],
)
def test_refusals(changes: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        load_demonstration(task_system("cartpole"), write(tmp_path / "a.npz", 9, **changes), 9)


def test_a_plan_is_of_its_own_control_step(tmp_path: Path) -> None:
    """Which the file tells; one that does not, of before there was a choice, has 1/60 s."""
    slow, usual, path = (
        System(diffsim.make("cartpole", 1, control_dt=0.05)),
        task_system("cartpole"),
        tmp_path / "a.npz",
    )
    way = torch.ones(10, 4).double(), torch.zeros(9, 1).double()
    save_demonstration(slow, [way], path)
    assert torch.equal(load_demonstration(slow, path, 9)[0], way[0])
    with pytest.raises(ValueError, match=r"has control steps of 0.05 s, not of 0.01667 s"):
        load_demonstration(usual, path, 9)
    with pytest.raises(ValueError, match=r"has control steps of 0.01667 s, not of 0.05 s"):
        load_demonstration(slow, write(path, 9), 9)


def test_a_header_that_asks_for_terabytes_is_refused_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, header = write(tmp_path / "a.npz", 9), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 2)})
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (parts | {"qvel.npy": header.getvalue()}).items():
            archive.writestr(name, content)
    read = np.lib.format.read_array
    monkeypatch.setattr(np.lib.format, "read_array", lambda file, **how: "qvel" in file.name or read(file, **how))
    with pytest.raises(ValueError, match=r"qvel has shape \(1000000000000, 2\) of float64, must be"):
        load_demonstration(task_system("cartpole"), path, 9)


def test_a_controller_brings_the_system_along(rng: np.random.Generator) -> None:
    """What the system can do it repeats; of what it cannot it makes a trajectory of its own nearby."""
    system = task_system("cartpole")
    actions = 0.2 * normal(rng, 20, 1)
    x, u, _ = system.rollout(system.start(), 20, lambda t, _: actions[t : t + 1])
    same_x, same_u = follow_demonstration(system, x[0], u[0], 1.0)
    torch.testing.assert_close(same_x, x)
    torch.testing.assert_close(same_u, u)
    shaken = x[0] + 0.01 * normal(rng, 21, 4)
    own, own_u = follow_demonstration(system, shaken, u[0], 1.0)
    torch.testing.assert_close(own, system.rollout(shaken[:1], 20, lambda t, _: own_u[:, t])[0])
    open_loop = system.rollout(shaken[:1], 20, lambda t, _: actions[t : t + 1])[0]
    assert (own - shaken).norm() < (open_loop - shaken).norm()
