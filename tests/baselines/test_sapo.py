"""SAPO's parts against torch's distributions, finite differences and SHAC, which it is without its additions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import sapo
import torch
from learners import SMALL, assert_derivatives, run
from torch import Tensor, nn
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

import diffsim
import shac
from diffsim.training import parse

PLAIN = ("--no-entropy", "--no-state-std", "--critics", "1", "--activation", "elu")


def build(task: str, *arguments: str, num_envs: int = 4, dtype: torch.dtype = torch.float32) -> Any:
    """The algorithm on a few environments and rollouts of eight steps; in float64 not to be optimised."""
    args = parse(sapo.Args, ["--env", task, "--horizon", "8", "--device", "cpu", *arguments])
    learner = sapo.SAPO(args, diffsim.make(task, num_envs=num_envs, seed=0, horizon=args.horizon, dtype=dtype))
    for module in vars(learner).values():
        if isinstance(module, nn.Module):
            module.to(dtype)
    return learner


@pytest.mark.parametrize("state_std", ["--state-std", "--no-state-std"])
def test_surprise_is_minus_the_log_density_of_the_squashed_gaussian(state_std: str) -> None:
    torch.manual_seed(0)
    learner = build("ant", state_std, "--population", "2", dtype=torch.float64)
    obs, noise = torch.randn(2, 5, 37, dtype=torch.float64), torch.randn(2, 5, 8, dtype=torch.float64)
    action, surprise = learner.actor(obs, noise)
    features = learner.actor.body(obs)
    log_std = learner.actor.log_std if learner.actor.spread is None else learner.actor.spread(features)
    density = TransformedDistribution(Normal(learner.actor.mean(features), log_std.exp()), TanhTransform())
    torch.testing.assert_close(surprise, -density.log_prob(action).mean(-1))
    assert (log_std.std() > 0) == (state_std == "--state-std")


def test_gradient_of_the_soft_loss_is_its_finite_difference() -> None:
    """Of two members of two critics each, through the simulator; one environment falls on the way."""
    torch.manual_seed(0)
    widths = "--actor-hidden", "16", "--critic-hidden", "16"
    learner = build("ant", "--population", "2", *widths, dtype=torch.float64)
    learner.temperature.log.data.fill_(math.log(3.0))
    env = learner.env
    qpos, qvel = env.qpos.clone(), env.qvel.clone()
    qpos[2, 2], qvel[2, 2] = 0.4, -6.0
    env.set_state(qpos, qvel)
    start, random = env.state_dict(), torch.get_rng_state()

    class Taken(Exception):
        """The loss."""

    def take(loss: Tensor) -> Tensor:
        raise Taken(loss)

    learner.actor_optimizer.gradient = take  # type: ignore[method-assign]

    def loss() -> Tensor:
        env.load_state_dict(start)
        torch.set_rng_state(random)
        torch.set_default_dtype(torch.float64)
        try:
            with pytest.raises(Taken) as taken:
                learner.iterate()
        finally:
            torch.set_default_dtype(torch.float32)
        (value,) = taken.value.args
        return value

    places = (("body.layers.0.weight", 40), ("mean.layers.0.bias", 3), ("spread.layers.0.weight", 7))
    parameters = {name: p for name, p in learner.actor.named_parameters() if p.requires_grad}
    assert_derivatives(parameters, loss, places, rel=5e-6)


def test_without_its_additions_it_is_shac() -> None:
    """Two iterations from the same weights, states and random numbers."""
    plain = build("cartpole", *PLAIN, "--target-alpha", "0.2")
    theirs = parse(shac.Args, ["--env", "cartpole", "--horizon", "8", "--device", "cpu"])
    reference = shac.SHAC(theirs, diffsim.make("cartpole", num_envs=4, seed=0, horizon=8))

    def give(ours: nn.Module, layers: list[nn.Module]) -> None:
        with torch.no_grad():
            for p, q in zip(ours.parameters(), nn.Sequential(*layers).parameters(), strict=True):
                p.copy_(q)

    actor = list(reference.actor.mean)
    give(plain.actor.body, actor[:-1])
    give(plain.actor.mean, actor[-1:])
    give(plain.critics, list(reference.critic))
    give(plain.targets, list(reference.target))
    for learner in (plain, reference):
        torch.manual_seed(3)
        learner.actor_optimizer.lr.fill_(1e-3)
        learner.critic_optimizer.lr.fill_(1e-3)
        for _ in range(2):
            learner.iterate()
    for ours, layers in ((plain.critics[0], reference.critic), (plain.policy, reference.policy)):
        for p, q in zip(ours.parameters(), layers.parameters(), strict=True):
            torch.testing.assert_close(p, q, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(plain.actor.log_std.flatten(), reference.actor.log_std, rtol=1e-4, atol=1e-5)


def test_targets_take_the_least_critic_and_the_actor_the_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sapo, "LAMBDA", 1.0)
    monkeypatch.setattr(sapo, "GAMMA", 0.5)
    learner = build("cartpole", "--no-entropy")
    with torch.no_grad():
        for p in learner.targets.parameters():
            p.zero_()
        bias = list(learner.targets.parameters())[-1]
        bias.copy_(torch.tensor([[[10.0]], [[30.0]]]))
    loss, values, fitted = sapo.actor_loss, list[Tensor](), list[Tensor]()

    def recorded(reward: Tensor, next_value: Tensor, *rest: object) -> Tensor:
        values.append(next_value)
        return loss(reward, next_value, *rest)  # type: ignore[arg-type]

    def without_reward(reward: Tensor, *rest: object) -> Tensor:
        return td_lambda(torch.zeros_like(reward), *rest)  # type: ignore[arg-type]

    td_lambda = sapo.td_lambda
    monkeypatch.setattr(sapo, "actor_loss", recorded)
    monkeypatch.setattr(sapo, "td_lambda", without_reward)
    monkeypatch.setattr(learner, "fit_critics", lambda obs, value: fitted.append(value) or value.mean())
    learner.iterate()
    assert (values[0] == 20).all()
    torch.testing.assert_close(fitted[0].view(8, 4)[0], torch.full((4,), 10 * 0.5**8))


def test_the_temperature_rises_below_the_target_entropy_and_falls_above_it() -> None:
    torch.manual_seed(0)
    for target, sign in ((5.0, 1), (-5.0, -1)):
        learner = build("cartpole", "--target-entropy", str(target), str(target))
        learner.prepare(1)
        learner.iterate()
        assert sign * learner.temperature.log.item() == pytest.approx(5e-3, rel=1e-3)


def test_the_target_entropy_is_linear() -> None:
    learner = build("ant", "--iterations", "10", "--target-entropy", "0", "-3")
    for iteration in (1, 4, 10):
        learner.prepare(iteration)
        assert learner.target_entropy.item() == pytest.approx(-0.3 * (iteration - 1))


def test_the_best_member_goes_on_with_the_samples_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    monkeypatch.setattr(sapo, "SELECTION", 0.3)
    learner = build("cartpole", "--population", "4", "--iterations", "10")
    for iteration in range(1, 6):
        learner.prepare(iteration)
        learner.iterate()
        if iteration == 3:
            best = learner.best
            before = [p.clone() for p in learner.policy.parameters()]
            assert learner.score["tied"] == 0 and (learner.actor_optimizer.vector.std(1) > 0).any()
        if iteration == 4:
            assert learner.score["tied"] == 1
    for optimizer in (learner.actor_optimizer, learner.critic_optimizer, learner.temperature_optimizer):
        assert (optimizer.vector == optimizer.vector[:, :1]).all()
    for p in learner.targets.parameters():
        assert (p.unflatten(0, (2, 4)) == p.unflatten(0, (2, 4))[:, :1]).all()
    assert 0 <= best < 4 and any(
        not torch.equal(p, q) for p, q in zip(before, learner.policy.parameters(), strict=True)
    )


def test_members_of_equal_weights_and_samples_learn_as_one() -> None:
    """With equal weights in two equal halves of the environments, each member does what one learner alone does."""
    torch.manual_seed(0)
    one, two = build("cartpole", num_envs=3), build("cartpole", "--population", "2", num_envs=6)
    noise = torch.randn(8, 3, 1)

    def tile(ours: nn.Module, theirs: nn.Module) -> None:
        for p, q in zip(ours.parameters(), theirs.parameters(), strict=True):
            alone = (q.T if q.dim() == 2 else q.unsqueeze(0)).unsqueeze(0)  # as an ensemble has it
            p.data.copy_(q.repeat_interleave(2, 0) if q.dim() == 3 else alone.expand_as(p))

    for name in ("body", "mean", "spread"):
        tile(getattr(two.actor, name), getattr(one.actor, name))
    tile(two.critics, one.critics)
    tile(two.targets, one.targets)
    state = one.env.state_dict()
    two.env.set_state(state["qpos"].repeat(2, 1), state["qvel"].repeat(2, 1))
    for learner, repeat in ((one, 1), (two, 2)):
        learner.prepare(1)
        patch = pytest.MonkeyPatch()
        patch.setattr(torch, "randn", lambda *size, repeat=repeat, **_: noise.repeat(1, repeat, 1))
        learner.iterate()
        patch.undo()
    for k in range(2):
        for p, q in zip(two.actor.deterministic(k).parameters(), one.policy.parameters(), strict=True):
            torch.testing.assert_close(p, q, rtol=1e-4, atol=1e-5)
        for c in range(2):
            for p, q in zip(two.critics[2 * c + k].parameters(), one.critics[c].parameters(), strict=True):
                torch.testing.assert_close(p, q, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "arguments",
    [" ".join(PLAIN), "--critics 3 --population 3", "--num-envs 1 --horizon 4"],
)
def test_unusual_settings_train(arguments: str, tmp_path: Path) -> None:
    words = SMALL["shac"] + ["--iterations", "3", *arguments.split()]
    modules = run(sapo, tmp_path, *words)["modules"]
    assert all(weight.isfinite().all() for weight in modules["critics"].values())
    assert modules["actor_optimizer"]["skipped"] == 0
