"""Policies act alike in this simulator and in MuJoCo where both solve the same equations."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import transfer
import worlds
from scenes import with_motors
from torch import Tensor

import diffsim
from diffsim import Integration, Simulator
from diffsim.training import evaluate, load_policy
from diffsim.training.checkpoint import POLICIES
from diffsim.training.errors import UsageError

DT = 1 / 60


def states(name: str, n: int) -> tuple[diffsim.DiffEnv, Tensor, Tensor]:
    env = diffsim.make(name, n, seed=3, dtype=torch.float64)
    return env, env.qpos.clone(), env.qvel.clone()


def test_the_worlds_agree_where_nothing_touches() -> None:
    """In flight and within the joints' ranges both solve the same equations, with the same motors at the same times."""
    env, qpos, qvel = states("hopper", 3)
    qpos[:, 1], qpos[:, 3:] = 5.0, torch.tensor([-0.5, -0.5, 0.0])
    here = Simulator(env.scene, 3, Integration(substeps=64), DT, dtype=torch.float64)
    ends = []
    for world in (worlds.Here(here), worlds.MuJoCo(env.scene, 3, DT)):
        q, v, drawn = qpos, qvel, torch.Generator().manual_seed(0)
        for _ in range(5):
            q, v, lost = world.step(q, v, 0.2 * torch.rand(3, 3, generator=drawn).double() - 0.1)
            assert not lost.any()
        ends.append(q)
    moved = (ends[0] - qpos)[:, 3:].abs().max()
    assert moved > 0.01 and (ends[0] - ends[1]).abs().max() < 0.03 * moved


def test_episodes_here_are_those_of_an_evaluation() -> None:
    policy = load_policy(POLICIES / "hopper.pt").network
    env = diffsim.make("hopper", 3, max_episode_steps=40)
    expected = evaluate(env, policy)
    start = worlds.starts(env, torch.float64)
    motion = worlds.episodes(worlds.Here(env.sim), worlds.in_double(env), policy, start, steps=40)
    assert motion.returns == pytest.approx(expected.returns.numpy(), rel=1e-4)
    assert motion.lengths.tolist() == [40] * 3 and not motion.fallen.any()
    assert transfer.speed(motion, DT, 0) == pytest.approx(expected.speed, rel=0.02)  # which leaves the last step out


def test_an_episode_ends_with_a_fall_and_a_world_that_is_lost_stays_as_it_was() -> None:
    env, qpos, qvel = states("hopper", 3)
    qpos[1, 1:3], qvel[2, 0] = torch.tensor([-0.6, 1.5]), 2e5  # lies above the ground; faster than any robot
    for world in (worlds.MuJoCo(env.scene, 3, DT), worlds.Here(env.sim)):
        start = worlds.State(qpos, qvel, torch.zeros(3, 3).double(), torch.zeros(3, 0))
        motion = worlds.episodes(world, env.task, lambda obs: torch.zeros(len(obs), 3), start, steps=5)
        assert motion.fallen.tolist() == [False, True, True] and motion.lengths.tolist() == [5, 1, 1]
        assert (motion.qpos[-1, 2] == qpos[2].numpy()).all() and np.isfinite(motion.qpos).all()


def test_friction_is_that_of_the_file_times_a_factor() -> None:
    scene = diffsim.make("ant", 1, penalty={"mu": 0.3}).scene  # of the training, not of the file
    world = worlds.MuJoCo(scene, 1, DT, 1.5)
    assert world.model.geom_friction[:, 0] == pytest.approx(1.5 * 0.75)
    assert world.substeps == 16 and world.substeps * world.model.opt.timestep == pytest.approx(DT)
    assert worlds.MuJoCo(diffsim.make("walker", 1).scene, 1, DT).substeps == 17  # of 1 ms at most
    assert worlds.MuJoCo(scene, 1, DT, 1.5, own_friction=True).model.geom_friction[:, 0] == pytest.approx(1.5)


def test_the_same_law_differs_from_the_file_in_cones_and_steps_alone() -> None:
    scene = diffsim.make("hopper", 1, contact="mujoco").scene
    own, same = (worlds.MuJoCo(scene, 1, DT, 1.0, True, substeps) for substeps in (None, 4))
    assert (own.substeps, same.substeps) == (16, 4) and same.model.opt.timestep == pytest.approx(DT / 4)
    assert (own.model.opt.cone, same.model.opt.cone) == (
        mujoco.mjtCone.mjCONE_PYRAMIDAL,
        mujoco.mjtCone.mjCONE_ELLIPTIC,
    )
    file = mujoco.MjModel.from_xml_path(scene.path)
    assert (own.model.geom_friction == file.geom_friction).all() and own.model.opt.timestep == file.opt.timestep


def test_another_file_of_the_robot_is_driven_as_the_task_s(tmp_path: Path) -> None:
    """Actuators in another order, and motors in place of servos: the robot moves as on its own file."""
    env = diffsim.make("go2", 2, seed=1)
    spec, path = with_motors(env.scene.path), tmp_path / "motors.xml"
    path.write_text(spec.to_xml())
    start, drawn, ends = worlds.starts(env, torch.float64), torch.Generator().manual_seed(0), list[Tensor]()
    actions = 2 * torch.rand(10, 2, env.scene.nu, generator=drawn).double() - 1
    for world in (
        worlds.MuJoCo(env.scene, 2, env.control_dt, own_friction=True),
        worlds.OtherFile(env, 2, None, 1.0),
        worlds.OtherFile(env, 2, path, 1.0),
    ):
        q, v = start.qpos, start.qvel
        for action in actions:
            q, v, lost = world.step(q, v, action)
            assert not lost.any()
        ends.append(q)
    moved = (ends[0] - start.qpos).abs().max()
    assert moved > 0.1 and torch.allclose(ends[1], ends[0], atol=1e-9)
    assert (ends[2] - ends[0]).abs().max() < 0.05 * moved
    for servo in spec.actuators[3:5]:
        spec.delete(servo)
    with pytest.raises(UsageError, match="no such file: .*nothing.xml"):
        worlds.OtherFile(env, 2, tmp_path / "nothing.xml", 1.0)
    spec.compile()
    path.write_text(spec.to_xml())
    with pytest.raises(UsageError, match=r"motors\.xml: no actuator of the joints \w+, \w+$"):
        worlds.OtherFile(env, 2, path, 1.0)
