"""MBPO's parts against torch's distributions, closed forms, the simulator, and problems whose optimum is known."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mbpo
import pytest
import torch
from learners import assert_resumes, read_progress
from problems import Problem, assert_soft_updates, assert_squashed_gaussian, assert_system_controlled
from test_scripts import Waits
from torch import Tensor

import diffsim
from diffsim.learning.replay import Transition
from diffsim.planning import System
from diffsim.training import parse

FLAGS = (
    "--env ant --device cpu --hidden 16 --model-hidden 16 16 --num-envs 4 --steps 4 --batch-size 32 --seed-steps 0 "
    "--branches 8 --rollout-lengths 1 3 --model-batch-size 16 --buffer-size 5000"
)


def build(*arguments: str, env: Any = None) -> mbpo.MBPO:
    args = parse(mbpo.Args, [*FLAGS.split(), *arguments])
    return mbpo.MBPO(args, env or diffsim.make("ant", num_envs=4, seed=0, horizon=4))


# Models ---------------------------------------------------------------------------------------------------------------


def test_each_model_has_its_own_output_within_the_bounds() -> None:
    torch.manual_seed(0)
    models = build().models
    with torch.no_grad():
        for weight in models.ensemble.parameters():
            weight.mul_(10.0)  # to reach the bounds
    obs, action = torch.randn(7, 30, 37), torch.rand(7, 30, 8)
    mean, log_var = models(obs, action)
    for e in range(7):
        expected, raw = models.ensemble[e](torch.cat((obs[e], action[e]), 1)).chunk(2, -1)
        torch.testing.assert_close(mean[e], expected, rtol=1e-4, atol=1e-4)
        inside = (raw > -8) & (raw < -1)  # where the bounds are far
        assert inside.any() and (log_var[e] - raw)[inside].abs().max() < 0.4
    assert log_var.max() <= 0.5 + 1e-3 and log_var.min() >= -10 - 1e-3
    assert log_var.max() > 0.3 and log_var.min() < -9.5


def test_elites_predict_and_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the weights of all but the elites NaN, and each elite's mean its own constant."""
    monkeypatch.setattr(mbpo, "ELITES", 2)
    learner = build()
    models = learner.models
    models.elites.copy_(torch.tensor([5, 2]))
    last = models.ensemble.layers[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(math.nan)
        last.bias[[5, 2], :, 38:] = -100.0  # log variance: at its lower bound
        last.bias[5, :, :38], last.bias[2, :, :38] = 3.0, 4.0
        models.least.fill_(-20.0)
        models.target.mean.copy_(torch.arange(38.0))
        models.target.std.fill_(2.0)
    change, reward = models.predict(torch.randn(6, 37), torch.rand(6, 8))
    own = torch.tensor([6.0, 6.0, 6.0, 8.0, 8.0, 8.0])
    torch.testing.assert_close(change, own.unsqueeze(1) + torch.arange(37.0), atol=2e-3, rtol=0)
    torch.testing.assert_close(reward, own + 37.0, atol=2e-3, rtol=0)


def learner_of(flags: str) -> mbpo.MBPO:
    torch.manual_seed(0)
    common = "--hidden 32 32 --model-hidden 32 32 --num-envs 20 --steps 8 --batch-size 128 --actor-lr 3e-3"
    common += " --gamma 0.9 --temperature-lr 1e-12 --model-updates 20"
    common += " --model-batch-size 64 --branches 50"
    learner = build(*common.split(), *flags.split(), env=Problem(20))
    learner.model_optimizer.lr.fill_(3e-3)
    for _ in range(10):
        learner.explore()
    return learner


def test_a_linear_system_is_identified() -> None:
    """Its two coefficients, its noise, its cost; and the error on held-out transitions is the noise's share."""
    learner = learner_of("--model-updates 60")
    for _ in range(15):
        learner.explore()
        found = learner.fit()
    models = learner.models
    x, a = (z.flatten().unsqueeze(1) for z in torch.meshgrid(*[torch.linspace(-0.8, 0.8, 9)] * 2, indexing="ij"))
    seen = learner.actor.normalizer(x)
    mean, log_var = models(seen.expand(7, -1, -1), a.expand(7, -1, -1))
    for e in models.elites:
        change, reward = models.target.inverse(mean[e]).T
        fit = torch.linalg.lstsq(torch.cat((x, a, torch.ones_like(x)), 1), change.unsqueeze(1)).solution.flatten()
        assert fit.tolist() == pytest.approx([-0.2, 1.0, 0.0], abs=0.06)
        assert (reward + (x.square() + a.square()).squeeze(1)).abs().mean() < 0.08
        noise = (0.5 * log_var[e, :, 0]).exp() * models.target.std[0]
        assert noise.mean().item() == pytest.approx(0.3, rel=0.12)
    assert found["models/holdout_mse"].item() == pytest.approx(0.09 / models.target.var[0].item(), rel=0.2)
    assert found["models/holdout_reward_mse"] < 0.02
    change, _ = models.predict(torch.zeros(5000, 1), torch.zeros(5000, 1))
    assert change.std().item() == pytest.approx(0.3, rel=0.12)


def test_the_best_on_held_out_transitions_become_elites(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mbpo, "ELITES", 3)
    learner = learner_of("--model-updates 40")
    for _ in range(5):
        learner.fit()
    last, step = learner.models.ensemble.layers[-1], learner.model_optimizer.step

    def spoiling(gradient: Tensor) -> Tensor:
        norm = step(gradient)
        with torch.no_grad():
            last.bias[[0, 2, 3, 6], :, :2] = 3.0
        return norm

    monkeypatch.setattr(learner.model_optimizer, "step", spoiling)
    learner.fit()
    assert sorted(learner.models.elites.tolist()) == [1, 4, 5]


def test_held_out_environments_are_not_learnt_from() -> None:
    """Two of twenty are held out; the others' transitions alone reach what the models and SAC learn from."""
    env = diffsim.make("cartpole", num_envs=20, seed=0, horizon=4)
    learner = build("--env", "cartpole", "--num-envs", "20", env=env)
    start = env.detach().clone()
    learner.explore()
    assert learner.unseen.count == 8 and learner.real.count == 72 == learner.actor.normalizer.count * 0.9
    torch.testing.assert_close(learner.unseen.rows[:2, :5], start[:2])
    torch.testing.assert_close(learner.real.rows[:18, :5], start[2:])
    rows = learner.real.split(learner.real.rows[:72])
    changes = torch.cat((rows.next_obs - rows.obs, rows.reward.unsqueeze(1)), 1)
    torch.testing.assert_close(learner.models.target.mean, changes.mean(0), rtol=1e-4, atol=1e-4)


# Rollouts -------------------------------------------------------------------------------------------------------------


def test_rollouts_branch_from_real_states_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Real states are -1; each step adds 1; what passes 2 has failed; the length rises over half of the iterations."""
    learner = learner_of("--rollout-lengths 2 6 --iterations 8 --retain 1")
    learner.real.rows[:, 0] = -1.0
    learner.env.task.terminated = lambda obs: obs[:, 0] > 2.5
    monkeypatch.setattr(learner.models, "predict", lambda obs, action: (torch.ones(250, 1), action[:, 0]))
    for fits, length, states in ((0, 2, [-1, 0]), (1, 3, [-1, 0, 1]), (4, 6, [-1, 0, 1, 2]), (9, 6, [-1, 0, 1, 2])):
        learner.models.fits.fill_(fits)
        assert learner.imagine()["models/rollout_length"] == length
        rows = learner.imagined.split(learner.imagined.rows)
        assert len(rows.obs) == 6 * 250 and sorted(set(rows.obs.flatten().tolist())) == states
        counts = [(rows.obs == state).sum().item() for state in states]
        assert counts[0] >= counts[1] >= counts[-1] > 0 and counts[0] == 250 * -(-6 // len(states))
        torch.testing.assert_close(rows.next_obs, rows.obs + 1)
        torch.testing.assert_close(rows.terminated, (rows.obs == 2).squeeze(1).float())
        torch.testing.assert_close(rows.reward, rows.action.squeeze(1))


def test_an_update_has_its_share_of_real_transitions(monkeypatch: pytest.MonkeyPatch) -> None:
    learner, seen = learner_of("--real-ratio 0.25 --updates 1"), list[Transition]()
    learner.real.rows[:, 2], learner.imagined.rows[:, 2] = 1.0, 2.0
    learner.imagined.count.fill_(100)
    monkeypatch.setattr(learner, "update_critics", lambda batch, *_: (seen.append(batch), {})[1])
    learner.update()
    assert seen[0].reward.tolist() == [1.0] * 32 + [2.0] * 96


# Samples around real transitions --------------------------------------------------------------------------------------


@pytest.mark.parametrize("env", ["cartpole", "ant"])
def test_enhanced_steps_are_those_of_the_simulator_to_second_order(env: str) -> None:
    """Simulated anew from where they begin, the error falls fourfold when the distance halves; in float64."""
    torch.manual_seed(0)
    made = diffsim.make(env, num_envs=6, seed=0)
    for _ in range(30):
        made.step(0.5 * torch.randn(6, made.scene.nu))
    system = System(made, threads=1)
    x, action = torch.cat((made.qpos, made.qvel), 1).double(), torch.rand(6, made.scene.nu).double() - 0.5
    errors = []
    for scale in (2e-4, 1e-4):
        torch.manual_seed(1)
        start, pushed, end, finite = mbpo.nearby(system, x, action, 3, scale)
        assert finite.all() and pushed.abs().max() < 1
        again = system.rollout(start.flatten(0, 1), 1, lambda *_, u=pushed: u.flatten(0, 1).atanh())[0][:, 1]
        errors.append(system.difference(end.flatten(0, 1), again).norm(dim=1))
        distance = (pushed - action).norm(dim=-1)
        assert 0.2 * scale < distance.mean() < 3 * scale * made.scene.nu and (start - x).norm(dim=-1).min() > 0
        assert errors[-1].max() < 1e-2 * system.difference(again, x.repeat(3, 1)).norm(dim=1).max()
    ratios = errors[0] / errors[1]
    assert ratios.median().item() == pytest.approx(4, rel=0.1), ratios


def test_enhanced_transitions_are_observed_and_rewarded_as_the_task_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """At no distance they are the real ones, the observed last action included; at some, near them."""
    monkeypatch.setattr(mbpo, "ENHANCE_SCALE", 1e-9)
    learner = build("--sample-enhance", "2")
    env = learner.env
    for _ in range(2):
        learner.explore()
    real = learner.real.split(learner.real.rows[:72])
    blocks = [part.view(8, 9, -1) for part in real]  # of a step: 3 real, then twice 3 around them
    for part in blocks:
        torch.testing.assert_close(part[:, 3:6], part[:, :3], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(part[:, 6:], part[:, :3], rtol=1e-3, atol=1e-3)
    assert (blocks[0][1:, 3:, -8:].abs().amax(-1) > 0).all() and env.task.observe_action

    torch.manual_seed(0)
    state = torch.cat((env.qpos, env.qvel), 1)[1:].clone()
    obs, action = env.detach()[1:], torch.rand(3, 8)
    learner.args.sample_enhance = 50
    monkeypatch.setattr(mbpo, "ENHANCE_SCALE", 0.1)
    near = mbpo.enhance(learner, state, Transition(obs, action, *[torch.zeros(3)] * 3))
    spread = near.action.view(50, 3, 8).atanh() - action.atanh()
    assert spread.std().item() == pytest.approx(0.1, rel=0.1)
    torch.testing.assert_close(near.obs[:, -8:], obs[:, -8:].repeat(50, 1))
    torch.testing.assert_close(near.next_obs[:, -8:], near.action)
    torch.testing.assert_close(near.reward, env.task.reward(near.next_obs, near.action))
    assert (near.obs.view(50, 3, 37).mean(0) - obs).abs().max() < 0.1 and near.obs[:, :29].std(0).min() > 0


def test_an_enhanced_transition_that_falls_has_failed() -> None:
    learner = build("--sample-enhance", "2")
    env = learner.env
    qpos, qvel = env.qpos[1:].clone(), env.qvel[1:].clone()
    qpos[0, 2], qvel[0, 2] = 0.28, -6.0
    obs = env.task.observe(qpos, qvel, torch.zeros(3, 8))
    near = mbpo.enhance(learner, torch.cat((qpos, qvel), 1), Transition(obs, torch.zeros(3, 8), *[torch.zeros(3)] * 3))
    assert near.terminated.tolist() == [1, 0, 0] * 2


# SAC ------------------------------------------------------------------------------------------------------------------


def test_density_is_that_of_the_squashed_gaussian() -> None:
    assert_squashed_gaussian(build().actor)


def test_targets_and_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = build()
    assert_soft_updates(learner, (learner.actor_optimizer, learner.temperature_optimizer), monkeypatch)


def test_a_linear_quadratic_system_is_controlled(monkeypatch: pytest.MonkeyPatch) -> None:
    """From rollouts of the models alone, which have learnt from random actions."""
    monkeypatch.setattr(mbpo, "TAU", 0.05)
    learner = learner_of("--real-ratio 0 --updates 10 --model-updates 80")
    learner.temperature["log"].data.fill_(math.log(0.1))
    for _ in range(10):
        learner.explore()
        learner.fit()
    for _ in range(80):
        learner.imagine()
        learner.update()
    assert_system_controlled(learner.policy)


# Runs -----------------------------------------------------------------------------------------------------------------


def test_nothing_captured_waits_for_the_device() -> None:
    """Every part of an iteration becomes a CUDA graph, the Jacobians included."""
    learner, places = build("--sample-enhance", "2", "--updates", "2", "--model-updates", "2"), list[str]()
    parts = (learner.explore, learner.collect, learner.fit, learner.imagine, learner.update)
    for part in parts:
        part()
    with Waits(places):
        for part in parts:
            part()
    assert all(place.startswith('env.py: if self.device.type == "cpu"') for place in places) and places


def test_a_run_resumes_bitwise_with_its_buffers(tmp_path: Path) -> None:
    flags = "--env cartpole --num-envs 4 --steps 8 --seed-steps 16 --batch-size 16 --hidden 16 --model-hidden 16 "
    flags += "--model-updates 3 --updates 3 --branches 8 --buffer-size 300 --iterations 8 --quiet "
    flags += "--sample-enhance 2 --model-batch-size 16 --eval-episodes 2 --device cpu --threads 1"
    whole = assert_resumes(mbpo, tmp_path, flags, 5)
    sizes = [len(whole["modules"][name]["_extra_state"]) for name in ("real", "unseen", "imagined")]
    assert sizes == [300, 30, 800]
    first, *_, last = read_progress(tmp_path / "part")
    assert first["losses_critic"] == "" and float(last["models_holdout_mse"]) > 0 and last["models_train_nll"]
