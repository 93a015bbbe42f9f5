"""benchmarks/gps_switch.py on a short example."""

from __future__ import annotations

from pathlib import Path

import gps_switch
import numpy as np
import pytest
import torch
from tables import ROOT

import diffsim


def test_the_second_half_goes_on_from_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step of the file is the simulator's, the first half is the known plan's, the second one crouches."""
    monkeypatch.setattr(gps_switch, "STEPS", 120)
    monkeypatch.setattr(gps_switch, "STARTS", 2)
    gps_switch.main(tmp_path / "switch.npz")
    made, plan = (np.load(path) for path in (tmp_path / "switch.npz", ROOT / "benchmarks/plans/walker_500.npz"))
    assert made["qpos"].shape == (121, 9) and made["action"].shape == (120, 6)
    np.testing.assert_allclose(made["qpos"][:61], plan["qpos"][:61])
    qpos, qvel, action = (torch.tensor(made[name]) for name in ("qpos", "qvel", "action"))
    sim = diffsim.make("walker", 120, dtype=torch.float64).sim
    moved = sim.step(qpos[:-1], qvel[:-1], action)
    torch.testing.assert_close(moved[0][60:], qpos[61:], rtol=0, atol=1e-6)
    assert qpos[61:, 1].min() < qpos[:61, 1].min() - 0.02
