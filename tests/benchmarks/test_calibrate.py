"""The calibration of contact and limits to recorded motion."""

from __future__ import annotations

from pathlib import Path

import calibrate
import numpy as np
import pytest
import torch
from learners import refusal

import diffsim

TRUE = {"k_n": 0.6, "k_d": 1.5, "k_t": 1.8, "mu": 0.7, "mass": 1.3}  # times what the fit begins with
INTEGRATION = {"integrator": "implicit", "substeps": 8, "contact": "firm"}


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hoppers under smooth random actions, on a ground and of a mass that the fit does not know."""
    env = diffsim.make("hopper", 20, seed=0, factors=True, **INTEGRATION)
    for name, factor in TRUE.items():
        env.sim.factors[:, calibrate.FACTORS.index(name)] = factor
    generator, action = torch.Generator().manual_seed(0), torch.zeros(20, 3)
    qpos, qvel, ctrl = [env.qpos], [env.qvel], []
    with torch.no_grad():
        for _ in range(60):
            action = (0.7 * action + 0.5 * torch.randn(20, 3, generator=generator)).clamp(-1, 1)
            q, v = env.sim.step(qpos[-1], qvel[-1], action)
            qpos.append(q)
            qvel.append(v)
            ctrl.append(action)
    path = tmp_path_factory.mktemp("recording") / "walk.npz"
    states = {"qpos": qpos, "qvel": qvel, "ctrl": ctrl}
    np.savez(path, **{name: torch.stack(rows, 1).numpy() for name, rows in states.items()})
    return path


def test_constants_of_a_known_ground_are_found(walk: Path) -> None:
    args = calibrate.Args(recording=walk, env=("hopper",), fit=tuple(TRUE), substeps=8, segments=128, iterations=80)
    rows = calibrate.fit(args, "hopper", calibrate.read(walk, "hopper"))
    scene = diffsim.make("hopper", 1, contact="firm").scene
    for row, (name, factor) in zip(rows, TRUE.items(), strict=True):
        begin = getattr(scene, name) if name != "mass" else 1.0
        assert row["constant"] == name and row["before"] == begin
        assert row["after"] == pytest.approx(factor * begin, rel=0.15), name
        assert row[calibrate.LAST] < 0.3 * row[f"{calibrate.LAST}, before"]


def test_recordings_that_do_not_fit_are_refused(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with np.load(walk) as file:
        good = dict(file)
    cases = {
        "holds no qvel": ({k: good[k] for k in ("qpos", "ctrl")}, "is no .npz of qpos, qvel and ctrl"),
        "of an ant": (good | {"qpos": np.zeros((20, 61, 15))}, "qpos has shape (20, 61, 15), must be (20, 61, 6)"),
        "one row short": (good | {"qvel": good["qvel"][:, :-1]}, "qvel has shape (20, 60, 6), must be (20, 61, 6)"),
        "nan": (good | {"ctrl": good["ctrl"] * np.nan}, "ctrl holds numbers that are not finite"),
        "too short": ({k: v[:, : 12 - (k == "ctrl")] for k, v in good.items()}, "no episode is long enough"),
    }
    for name, (arrays, message) in cases.items():
        path = tmp_path / f"{name}.npz"
        np.savez(path, **arrays)
        args = calibrate.Args(recording=path, env=("hopper",))
        assert message in refusal(lambda args=args: calibrate.main(args), capsys)
    (tmp_path / "text.npz").write_text("hello")
    for path, message in ((tmp_path / "none.npz", "no such recording"), (tmp_path / "text.npz", "is no .npz")):
        assert message in refusal(lambda path=path: calibrate.read(path, "hopper"), capsys)
    assert "give one of a checkpoint" in refusal(lambda: calibrate.main(calibrate.Args()), capsys)
    args = calibrate.Args(recording=walk)
    assert "--recording needs the --env of one task" in refusal(lambda: calibrate.main(args), capsys)
