"""Random robots of a benchmark against MuJoCo: a handful that together ask for everything."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import rollouts
from common import RESULTS
from tables import read_csv

from diffsim.robot.mjcf import load_scene
from diffsim.sim import simulator
from diffsim_cli.report import approximations

HANDFUL = 0, 1, 2, 3, 4, 6


def test_the_handful_asks_for_everything() -> None:
    models = [mujoco.MjModel.from_xml_string(rollouts.random_robot(seed)) for seed in HANDFUL]
    for name, wanted in (("geom_type", {0, 2, 3, 6, 7}), ("geom_condim", {1, 3, 4, 6}), ("jnt_type", {0, 1, 2, 3})):
        assert {int(x) for m in models for x in getattr(m, name)} == wanted, name
    for name in ("jnt_limited", "dof_frictionloss", "actuator_forcelimited", "geom_margin"):
        assert {bool(x) for m in models for x in getattr(m, name)} == {False, True}, name
    assert {(m.opt.cone, m.opt.integrator) for m in models} == {(0, 0), (0, 3), (1, 0), (1, 3)}
    assert all((m.actuator_biasprm[:, 2] < 0).all() for m in models)  # kv


@pytest.mark.unoptimized
@pytest.mark.parametrize("seed", [pytest.param(seed, marks=[pytest.mark.slow] * (seed != 4)) for seed in HANDFUL])
def test_a_rollout_is_mujocos(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Step by step and as a whole. Where steps of the file differ, the check says why."""
    monkeypatch.setattr(simulator, "PASSES", rollouts.PASSES)
    row = rollouts.measure(seed)
    assert row["error of a step"] < 1e-8 and row["residual"] < 1e-12
    assert row["contacts"] > 0.3 and row["perturbed (m, rad)"] < 1e-6  # it touches, and is not chaotic
    assert row["error of the rollout (m, rad)"] < 1e-8
    if row["file, largest"] > 1e-8:
        told = " ".join(approximations(load_scene(mujoco.MjModel.from_xml_string(rollouts.random_robot(seed)))))
        assert "condim 4 and 6" in told or "corners of a mesh" in told
    else:
        assert row["condim"] <= 3


def test_the_page_keeps_its_word() -> None:
    rows = read_csv(RESULTS / "cpu" / "rollouts.csv")
    assert len(rows) == rollouts.Args().robots
    assert all(float(row["error of a step"]) < 1e-9 and float(row["contacts"]) > 0.3 for row in rows)


def test_meshes_become_points_and_condim_3() -> None:
    seed = HANDFUL[0]
    m = load_scene(mujoco.MjModel.from_xml_string(rollouts.random_robot(seed))).mj_model
    other = rollouts.as_simulated(rollouts.random_robot(seed), m)
    assert m.geom_condim.max() == 6 and other.geom_condim.max() == 3 and other.ngeom > m.ngeom
    meshes = other.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    assert meshes.any() and not other.geom_conaffinity[meshes].any()
    np.testing.assert_allclose(other.body_inertia, m.body_inertia)
