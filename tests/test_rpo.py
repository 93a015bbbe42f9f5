"""RPO against SHAC, which it is with one epoch of one minibatch; its surrogate against finite differences."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from learners import assert_derivatives, run
from torch import Tensor
from torch.distributions import Independent, Normal, kl_divergence

import diffsim
import rpo
import shac
from diffsim.training import parse

SMALL = ("--horizon", "8", "--device", "cpu", "--num-envs", "6")
WIDTHS = ("--actor-hidden", "16", "--critic-hidden", "16")
ONCE = ("--epochs", "1", "--minibatches", "1")


def build(module: Any, task: str, *arguments: str) -> Any:
    torch.manual_seed(0)
    args = parse(module.Args, ["--env", task, *SMALL, *arguments])
    env = diffsim.make(task, num_envs=6, seed=0, horizon=args.horizon)
    learner = (module.RPO if module is rpo else module.SHAC)(args, env)
    learner.actor_optimizer.lr.fill_(1e-2)
    learner.critic_optimizer.lr.fill_(1e-2)
    return learner


def batch(samples: int = 40, actions: int = 3, dtype: torch.dtype = torch.float64) -> tuple[rpo.Batch, Tensor]:
    """Samples at random, and the deviation of the policy that took them."""
    torch.manual_seed(1)
    parts = (torch.randn(samples, n, dtype=dtype) for n in (5, actions, actions, actions, 1))
    return rpo.Batch(*parts), torch.rand(actions, dtype=dtype) + 0.5


@pytest.mark.parametrize("module", [rpo, shac])
def test_a_task_may_ask_for_small_actions_at_first(module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its `initial_gain` multiplies the last weights; hidden layers and critic stay as they are."""
    plain = build(module, "cartpole", *WIDTHS)
    monkeypatch.setattr(diffsim.TASKS["cartpole"], "initial_gain", 0.25)
    small = build(module, "cartpole", *WIDTHS)
    last, hidden = ([learner.actor.mean[k] for learner in (small, plain)] for k in (-1, 0))
    torch.testing.assert_close(last[0].weight, 0.25 * last[1].weight, rtol=0, atol=0)
    assert not last[0].bias.any() and last[1].bias.all() and torch.equal(hidden[0].weight, hidden[1].weight)


# One epoch of one minibatch -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bound", ["distance", "ratio", "none"])
@pytest.mark.parametrize("task", ["cartpole", "ant"])
def test_one_step_is_shac(task: str, bound: str) -> None:
    """The same gradient as one taken through the simulator to the weights, and the same step; the same critic."""
    alike = "--target-alpha", "0.2", "--critic-iterations", "3", *WIDTHS
    ours, theirs = build(rpo, task, *alike, *ONCE, "--bound", bound), build(shac, task, *alike)
    before = ours.actor_optimizer.vector.clone()
    assert torch.equal(before, theirs.actor_optimizer.vector)
    for learner in (ours, theirs):
        torch.manual_seed(3)
        learner.iterate()
    mine, other = ours.actor_optimizer, theirs.actor_optimizer
    scale = other.exp_avg.abs().max().item()
    torch.testing.assert_close(mine.exp_avg, other.exp_avg, rtol=1e-4, atol=1e-5 * scale)
    above = other.exp_avg.abs() > 1e-3 * scale  # Adam's first step is the sign of the gradient, of rounding elsewhere
    assert above.sum() > 0.5 * len(above)
    torch.testing.assert_close(mine.vector[above], other.vector[above], rtol=0, atol=1e-6)
    assert (mine.vector - before)[above].abs().min() > 9e-3
    torch.testing.assert_close(ours.actor.log_std, theirs.actor.log_std, rtol=0, atol=1e-6)
    assert torch.equal(ours.critic_optimizer.vector, theirs.critic_optimizer.vector)
    for p, q in zip(ours.target.parameters(), theirs.target.parameters(), strict=True):
        assert torch.equal(p, q)


# The surrogate --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bound", ["distance", "none"])
def test_gradient_of_the_surrogate_is_its_finite_difference(bound: str) -> None:
    """Of a policy that has moved, so that some actions are beyond the bound; its value is the sum over the others."""
    b, old_std = batch()
    weight = (0.3 * torch.randn(5, 3, dtype=torch.float64)).requires_grad_()
    log_std = (old_std.log() + 0.1).requires_grad_()

    def loss() -> Tensor:
        return rpo.surrogate(bound, 0.3, b, b.mean + b.obs @ weight, log_std.exp(), old_std)[0]

    places = (("weight", 0), ("weight", 7), ("log_std", 1))
    assert_derivatives({"weight": weight, "log_std": log_std}, loss, places, rel=1e-6)


def test_a_sample_that_moved_far_the_right_way_moves_no_further() -> None:
    """And one that moved the wrong way comes back: its gradient is that of the rollout, as within the bound."""
    b, old_std = batch(4, 1)
    gradient = torch.tensor([[2.0], [2.0], [2.0], [2.0]], dtype=torch.float64)  # J falls to the left
    shift = torch.tensor([[-0.2], [-0.4], [0.2], [0.4]], dtype=torch.float64) * old_std
    mean = (b.mean + shift).requires_grad_()
    change, beyond = rpo.surrogate("distance", 0.3, b._replace(gradient=gradient), mean, old_std, old_std)
    (slope,) = torch.autograd.grad(change, mean)
    assert slope.flatten().tolist() == [2.0, 0.0, 2.0, 2.0]
    assert beyond.item() == 0.5


def test_the_ratio_weights_the_gradient_and_ends_it() -> None:
    """Of actions that stay where they are: the policy that passes through them has other noise."""
    b, old_std = batch()
    mean = (b.mean + 0.6 * torch.randn_like(b.mean)).requires_grad_()
    std = (1.1 * old_std).requires_grad_()
    u = b.mean + old_std * b.eps
    old, new = (Independent(Normal(m.detach(), s.detach()), 1) for m, s in ((b.mean, old_std), (mean, std)))
    ratio = (new.log_prob(u) - old.log_prob(u)).exp().unsqueeze(-1)
    within = (ratio >= 0.2) & (ratio <= 2.0)
    assert (ratio < 0.2).any() and (ratio > 2.0).any() and within.double().mean() > 0.3
    change, beyond = rpo.surrogate("ratio", 0.2, b, mean, std, old_std)
    slopes = torch.autograd.grad(change, (mean, std))
    expected = ratio * within * b.gradient
    torch.testing.assert_close(slopes[0], expected)
    torch.testing.assert_close(slopes[1], (expected * (u - mean.detach()) / std.detach()).sum(0))
    assert beyond.item() == pytest.approx(1 - within.double().mean().item())


def test_divergence_is_that_of_torch() -> None:
    b, old_std = batch()
    mean, std = b.mean + 0.3 * b.eps, 1.2 * old_std
    old, new = (Independent(Normal(m, s), 1) for m, s in ((b.mean, old_std), (mean, std)))
    torch.testing.assert_close(rpo.kl_divergence(b.mean, old_std, mean, std), kl_divergence(old, new).mean())


# PPO's loss beside it -------------------------------------------------------------------------------------------------


def test_ppos_loss_is_its_gradient_while_the_ratio_is_within_the_clip() -> None:
    """And ends where a sample has gained enough; one that has lost as much comes back."""
    b, old_std = batch()
    mean = (b.mean + 0.3 * torch.randn_like(b.mean)).requires_grad_()
    std = (1.1 * old_std).requires_grad_()
    u = b.mean + old_std * b.eps
    old, new = (Independent(Normal(m, s), 1) for m, s in ((b.mean, old_std), (mean, std)))
    ratio = (new.log_prob(u) - old.log_prob(u)).exp().unsqueeze(-1)
    ended = ((b.advantage > 0) & (ratio > 1.2)) | ((b.advantage < 0) & (ratio < 0.8))
    assert 5 < ended.sum() < 35
    expected = torch.autograd.grad(-(ratio * b.advantage).masked_fill(ended, 0.0).sum() / 40, (mean, std))
    loss = rpo.ppo_loss(b, mean, std, old_std)
    for slope, other in zip(torch.autograd.grad(loss, (mean, std)), expected, strict=True):
        torch.testing.assert_close(slope, other)
    torch.testing.assert_close(rpo.ppo_loss(b, b.mean, old_std, old_std), -b.advantage.mean())


def test_gradients_and_advantages_beside_each_other_have_size_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """However large the rewards are."""
    learner, seen = build(rpo, "ant", *WIDTHS, "--mix", "0.3"), list[tuple[rpo.Batch, Tensor]]()
    fit = learner.fit_actor
    monkeypatch.setattr(learner, "fit_actor", lambda b, std: seen.append((b, std)) or fit(b, std))
    learner.iterate()
    ((b, std),) = seen
    sizes = (b.gradient * b.gradient.shape[:2].numel() * std).square().sum(-1)
    assert sizes.mean().item() == pytest.approx(1.0, rel=1e-4)
    assert b.advantage.mean().abs() < 1e-5 and b.advantage.std().item() == pytest.approx(1.0, rel=1e-4)


def test_ppos_loss_moves_the_actor_where_the_simulator_says_nothing() -> None:
    """Without a gradient, actions that did better than expected become likelier; with weight 0 nothing moves."""
    learner, b, old_std, _ = fitted("--epochs", "1")
    b = b._replace(gradient=torch.zeros_like(b.gradient), advantage=b.eps.sign())
    learner.actor_optimizer.lr.fill_(1e-3)
    moves = []
    for learner.args.mix in (0.0, 0.3):
        start = learner.actor.mean(b.obs).detach()
        learner.actor_optimizer.exp_avg.zero_(), learner.actor_optimizer.exp_avg_sq.zero_()
        learner.fit_actor(b._replace(mean=start), learner.actor.log_std.detach().exp())
        moves.append(((learner.actor.mean(b.obs) - start) * b.advantage).mean().item())
    assert moves[0] == 0.0 and moves[1] > 0


def test_entropy_widens_the_deviation() -> None:
    wide, plain = (fitted("--bound", "ratio", "--entropy-coef", coef)[0].actor.log_std.item() for coef in ("1", "0"))
    assert wide > plain + 0.02


# Several epochs -------------------------------------------------------------------------------------------------------


def fitted(*arguments: str) -> tuple[Any, rpo.Batch, Tensor, dict[str, Tensor]]:
    """A learner whose actor took its epochs on one rollout's samples, all of which want the same large move."""
    learner = build(rpo, "cartpole", *WIDTHS, "--epochs", "30", *arguments)
    obs = torch.randn(8, 6, 5)
    learner.actor_optimizer.lr.fill_(1e-3)
    old_std = learner.actor.log_std.detach().exp()
    with torch.no_grad():
        mean = learner.actor.mean(obs)
    b = rpo.Batch(obs, mean, torch.randn(8, 6, 1), torch.full((8, 6, 1), 1.0), torch.zeros(8, 6, 1))
    return learner, b, old_std, learner.fit_actor(b, old_std)


def test_the_bound_holds_over_many_epochs() -> None:
    """Without it the same actions move on and on."""
    moves = []
    for bound in ("distance", "none"):
        learner, b, old_std, metrics = fitted("--bound", bound, "--trust", "0.3")
        moves.append(((learner.actor.mean(b.obs) - b.mean) / old_std).mean().item())
        assert metrics["losses/approx_kl"] > 0
    assert -1.0 < moves[0] < -0.2 and moves[1] < 3 * moves[0]


def test_the_divergence_holds_the_policy_back() -> None:
    kl = [fitted("--bound", "none", "--kl-coef", coef)[3]["losses/approx_kl"].item() for coef in ("0", "10", "1000")]
    assert kl[0] > 1.5 * kl[1] > 1.5 * kl[2]


@pytest.mark.parametrize("flags", [(), ("--symmetric",)])
def test_the_deviation_moves_once_per_rollout(flags: tuple[str, ...]) -> None:
    learner = build(rpo, "ant", *WIDTHS, "--epochs", "5", "--critic-iterations", "1", *flags)
    before = learner.actor.log_std.detach().clone()
    learner.iterate()
    step = (learner.actor.log_std - before).abs()
    assert step.max().item() <= 1.001e-2 and step.min().item() > 0  # Adam's first step is the learning rate
    assert math.isfinite(learner.actor_optimizer.exp_avg.sum()) and learner.actor_optimizer.step_count == 20


@pytest.mark.parametrize(
    "arguments",
    [
        "--num-envs 1 --horizon 4 --minibatches 1 --bound ratio --kl-coef 0.1",
        "--num-envs 5 --horizon 5 --minibatches 3 --epochs 1 --bound none",
        "--num-envs 2 --contact soft --implicit --substeps 2 --threads 1",
    ],
)
def test_unusual_settings_train(arguments: str, tmp_path: Path) -> None:
    words = "--env", "cartpole", *arguments.split(), "--iterations", 3, "--eval-episodes", 1, "--device", "cpu"
    modules = run(rpo, tmp_path, *words)["modules"]
    assert modules["actor_optimizer"]["skipped"] == 0
    assert all(weight.isfinite().all() for part in ("actor", "critic") for weight in modules[part].values())


def test_on_mujocos_contact_rollouts_are_shorter() -> None:
    soft, firm = (parse(rpo.Args, f"--env ant --device cpu --contact {c}".split()) for c in ("soft", "mujoco"))
    assert (soft.horizon, soft.num_envs) == (32, 64) and (firm.horizon, firm.num_envs, firm.trust) == (8, 256, 0.2)
    begun = parse(rpo.Args, "--env humanoid --device cpu --contact mujoco".split())  # softly, and PPO's loss helps
    assert (begun.horizon, begun.num_envs, begun.onset, begun.mix) == (32, 64, (0.02, 0.002), 0.3)


def test_minibatches_have_the_gradient_of_all_samples_on_average() -> None:
    learner, b, old_std, _ = fitted("--minibatches", "2")
    optimizer, taken = learner.actor_optimizer, list[Tensor]()

    def keep(gradient: Tensor) -> Tensor:
        taken.append(gradient)
        return gradient.norm()

    def change(part: rpo.Batch) -> Tensor:
        mean, std = learner.actor.mean(part.obs), learner.actor.log_std.exp()
        return rpo.surrogate("distance", learner.args.trust, part, mean, std, old_std)[0]

    whole = optimizer.gradient(change(b))
    optimizer.step, learner.args.epochs = keep, 1
    learner.fit_actor(b, old_std)
    assert len(taken) == 2
    torch.testing.assert_close(torch.stack(taken).mean(0), whole)
