"""--monitor: the replay is that of two simulators, it changes nothing of a training, and it warns once."""

import numpy as np
import pytest
import torch

import diffsim
import shac
from diffsim import Simulator
from diffsim.training import monitor, parse

FLAGS = "--env hopper --device cpu --threads 1 --num-envs 4 --horizon 4 --iterations 3 --eval-every 0".split()


class Sines(torch.nn.Module):
    def forward(self, obs):
        return torch.sin(3 * obs[:, :3])


def test_a_replay_is_what_two_simulators_make_of_the_same_actions():
    args = parse(shac.Args, FLAGS)
    env = diffsim.make("hopper", 4, seed=3, horizon=4)
    env.reset(seed=3)
    qpos, qvel = env.qpos.clone(), env.qvel.clone()
    found = monitor.Monitor(args, env).replay(Sines())
    assert torch.equal(env.qpos, qpos) and torch.equal(env.qvel, qvel)

    how, action = env.sim.integration, torch.zeros(4, 3)
    sims = [Simulator(env.scene, 4, how._replace(substeps=n * how.substeps), env.control_dt) for n in (1, 4)]
    states, rewards = [(qpos, qvel)] * 2, [0.0, 0.0]
    for _ in range(monitor.STEPS):
        action = Sines()(env.task.observe(*states[0], action))
        states = [sim.step(*state, action) for sim, state in zip(sims, states, strict=True)]
        for k, state in enumerate(states):
            rewards[k] += env.task.reward(env.task.observe(*state, action), action).sum().item()
    away = (states[0][0] - states[1][0]).double().square().mean(1).sqrt()  # hinges and slides: no quaternion
    assert found["sim/state_error"] == pytest.approx(np.median(away), rel=1e-5) and away.min() > 1e-4
    assert found["sim/return_lost"] == pytest.approx((rewards[0] - rewards[1]) / abs(rewards[0]), rel=1e-4)


def test_it_replays_on_the_steepest_ground_of_the_training(monkeypatch):
    args = parse(shac.Args, [*FLAGS, "--env", "hopper:rough=20"])
    env = diffsim.make("hopper:rough=20", 20, seed=3, horizon=4)
    monkeypatch.setattr(monitor, "STEPS", 0)
    (watch := monitor.Monitor(args, env)).replay(Sines())
    for each in watch.envs:
        np.testing.assert_array_equal(each.scene.terrain, env.scene.terrain[-16:])
        assert torch.equal(each.qpos, env.qpos[-16:])


def test_it_changes_nothing_and_warns_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(monitor, "SUSPECT", 0.0)
    weights = []
    for every in ("0", "1"):
        shac.main([*FLAGS, "--monitor", every, "--run-dir", str(tmp_path / every)])
        weights.append(torch.load(tmp_path / every / "checkpoint.pt", weights_only=True)["policy"]["weights"])
        assert capsys.readouterr().out.count("the policy learns the integrator's errors") == int(every)
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
