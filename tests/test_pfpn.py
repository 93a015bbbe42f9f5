"""PFPN's policy against closed forms and quadrature, PPO and SAC against the other scripts and known optima."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pfpn_sac
import pytest
import sac_baseline
import torch
from learners import assert_resumes, read_progress, run
from problems import assert_soft_updates
from torch import Tensor
from torch.distributions import Categorical, MixtureSameFamily, Normal

import diffsim
import pfpn
import ppo_baseline
from diffsim.training import ClippedAdam, load_policy, parse

each_script = pytest.mark.parametrize("script", [pfpn, pfpn_sac], ids=["ppo", "sac"])
BATCH, M, N = 7, 3, 5  # states, actions, particles


def parameters(*batch: int) -> list[Tensor]:
    """Logits, locations and log standard deviations of a mixture, at random."""
    torch.manual_seed(0)
    shapes = ((*batch, M, N), (M, N), (M, N))
    logits, loc, log_std = (torch.randn(shape, dtype=torch.float64) for shape in shapes)
    return [logits.requires_grad_(), (0.6 * loc).requires_grad_(), (0.3 * log_std - 1).requires_grad_()]


# The mixture ----------------------------------------------------------------------------------------------------------


def test_density_and_its_gradient_are_those_of_torchs_mixture() -> None:
    logits, loc, log_std = inputs = parameters(BATCH)
    u = torch.randn(BATCH, M, dtype=torch.float64)
    components = Normal(loc.expand(BATCH, M, N), log_std.exp().expand(BATCH, M, N))
    expected = MixtureSameFamily(Categorical(logits=logits), components).log_prob(u)
    density = pfpn.Mixture(*inputs).log_prob(u)
    torch.testing.assert_close(density, expected.sum(-1))
    own, torchs = (torch.autograd.grad(x.sum(), inputs, retain_graph=True) for x in (density, expected))
    torch.testing.assert_close(own, torchs, rtol=1e-10, atol=1e-12)
    slope = torch.log1p(-torch.tanh(u).square())
    torch.testing.assert_close(pfpn_sac.Mixture(*inputs).log_prob(u), (expected - slope).sum(-1))


@each_script
def test_density_far_from_every_particle_is_finite_as_is_its_gradient(script: Any) -> None:
    inputs = [x.detach().float().requires_grad_() for x in parameters()]
    density = script.Mixture(*inputs).log_prob(torch.full((M,), 60.0))
    assert density.isfinite() and all(g.isfinite().all() for g in torch.autograd.grad(density, inputs))


@pytest.mark.parametrize(
    "sample",
    [pfpn.Mixture.sample, pfpn_sac.Mixture.sample, pfpn_sac.straight_through, pfpn_sac.implicit],
    ids=["ppo", "sac", "gumbel", "implicit"],
)
def test_draws_follow_the_density(sample: Callable[[Any], Any]) -> None:
    """Kolmogorov and Smirnov's distance of 100,000 draws of each action, which do not depend on each other."""
    logits, loc, log_std = parameters()
    kind = pfpn.Mixture if sample is pfpn.Mixture.sample else pfpn_sac.Mixture
    with torch.no_grad():
        mixture = kind(logits.expand(100_000, M, N), loc, log_std)
        draws, again = (x if isinstance(x, Tensor) else x.u for x in (sample(mixture), sample(mixture)))
        u = draws.sort(0).values
        z = (u.unsqueeze(-1) - loc) / log_std.exp()
        cumulative = (logits.softmax(-1) * torch.special.ndtr(z)).sum(-1)
        rank = (torch.arange(100_000) / 100_000).unsqueeze(-1)
        assert (cumulative - rank).abs().max() < 0.006
        assert (torch.corrcoef(torch.cat((draws, again), 1).T) - torch.eye(2 * M)).abs().max() < 0.02


def test_bins_count_as_the_nearest() -> None:
    logits = parameters(BATCH)[0][:, :1]
    bins = pfpn.Bins(logits, torch.linspace(-1, 1, N).expand(1, N), torch.full((1, N), -math.inf))
    u = bins.sample()
    index = ((u + 1) / 2 * (N - 1)).round().long()
    torch.testing.assert_close(u, -1 + 2 * index.double() / (N - 1))
    expected = logits.log_softmax(-1).squeeze(1).gather(1, index).squeeze(1)
    torch.testing.assert_close(bins.log_prob(u + 0.1), expected)
    assert all(g.isfinite().all() for g in torch.autograd.grad(bins.log_prob(u).sum() + bins.entropy().sum(), logits))


@pytest.mark.parametrize("std", ["state", "own"])
def test_the_deviation_of_a_gaussian_depends_on_the_state_or_not(std: str) -> None:
    args = parse(pfpn.Args, f"--device cpu --policy gaussian --std {std}".split())
    own, features = pfpn.HEADS[args.policy](args, 4, M), torch.randn(20, 4)
    before = own(features).log_std.detach().clone()
    assert before.abs().max() < 0.2
    mixture = own(features[:1])
    mixture.log_prob(mixture.loc.detach().squeeze(-1) + 10.0).sum().backward()  # in this state it has to widen
    with torch.no_grad():
        for name, parameter in own.named_parameters():
            parameter += 0.0 if "linear" in name else 1e-3 * parameter.grad
        change = (own(features).log_std - before).expand(20, M, 1)
    assert change[0].min() > 0 and (change.std(0).max() < 1e-6) == (std == "own")


@pytest.mark.parametrize("log_std", [-2.0, 0.0])
@pytest.mark.parametrize("policy", ["pfpn", "gaussian", "gmm", "discrete"])
def test_the_first_actions_have_the_deviation_that_is_asked_for(policy: str, log_std: float) -> None:
    args = parse(pfpn.Args, f"--device cpu --policy {policy} --initial-log-std {log_std}".split())
    torch.manual_seed(0)
    draws = pfpn.HEADS[args.policy](args, 4, M)(torch.zeros(20_000, 4)).sample()
    torch.testing.assert_close(draws.std(0).log(), torch.full((M,), log_std), rtol=0, atol=0.15)


def test_entropy_is_of_the_weights_or_of_the_gaussian() -> None:
    logits, loc, log_std = parameters(BATCH)
    entropy = pfpn.Mixture(logits, loc, log_std).entropy()
    torch.testing.assert_close(entropy, Categorical(logits=logits).entropy().sum(-1))
    gaussian = pfpn.Mixture(logits[..., :1], loc[:, :1], log_std[:, :1])
    torch.testing.assert_close(gaussian.entropy(), Normal(0, log_std[:, :1].exp()).entropy().sum().expand(1)[0])


# Gradients of samples -------------------------------------------------------------------------------------------------


def test_straight_through_gradient() -> None:
    """Eq. 25: of locations and scales that of the chosen one; of logits the gaps times the gradient of the choice."""
    inputs = parameters()
    torch.manual_seed(5)
    u = pfpn_sac.straight_through(pfpn_sac.Mixture(*inputs)).u
    torch.manual_seed(5)
    noise = torch.randn(M, dtype=torch.float64).unsqueeze(-1)
    scores = inputs[0].log_softmax(-1) - torch.empty(M, N, dtype=torch.float64).exponential_().log()
    each, x = (inputs[1] + inputs[2].exp() * noise).detach(), scores.softmax(-1)
    hot = torch.nn.functional.one_hot(scores.argmax(-1), N).double()
    torch.testing.assert_close(u, (hot * each).sum(-1))
    action = torch.tanh(u)
    gradients = torch.autograd.grad(action.sum(), inputs)
    gap = torch.tanh(each) - action.detach().unsqueeze(-1)
    torch.testing.assert_close(gradients[0], torch.autograd.grad((gap * x).sum(), inputs[0])[0])
    slope = (1 - action.square()).unsqueeze(-1) * hot
    torch.testing.assert_close(gradients[1:], (slope, slope * inputs[2].exp() * noise))
    torch.testing.assert_close(gradients[0].sum(-1), torch.zeros(M, dtype=torch.float64))


def test_the_implicit_gradient_of_several_actions_has_no_bias() -> None:
    """Of the mean of a curved function of the action, against quadrature; the straight-through one points elsewhere."""
    logits, loc, log_std = inputs = parameters()
    torch.manual_seed(0)
    grid = torch.linspace(-12, 12, 20_001, dtype=torch.float64)[:, None].expand(-1, M)
    density = pfpn_sac.Mixture(*inputs).log_density(grid).exp()

    def curved(u: Tensor) -> Tensor:
        return torch.cos(4 * torch.tanh(u)).sum(-1)

    exact = torch.autograd.grad((torch.cos(4 * torch.tanh(grid)) * density).sum() * 24 / 20_000, inputs)
    cosines = {}
    for sample in (pfpn_sac.implicit, pfpn_sac.straight_through):
        drawn = sample(pfpn_sac.Mixture(logits.expand(400_000, M, N), loc, log_std))
        parts = [drawn.u] if drawn.other is None else [drawn.u, drawn.other]
        found = torch.autograd.grad(torch.stack([curved(u).mean() for u in parts]).sum(), inputs)
        cosines[sample] = [
            torch.cosine_similarity(a.flatten(), b.flatten(), 0) for a, b in zip(exact, found, strict=True)
        ]
        if sample is pfpn_sac.implicit:
            torch.testing.assert_close(found, exact, rtol=0.05, atol=0.01)
    assert min(cosines[pfpn_sac.implicit]) > 0.995 and cosines[pfpn_sac.straight_through][0] < 0.8


OF_AN_ACTION: dict[str, Callable[[Tensor], Tensor]] = {
    "linear": lambda a: a,
    "quadratic": torch.square,
    "two peaks": lambda a: sum((-50 * (a - peak).square()).exp() for peak in (-0.25, 0.75)),  # type: ignore[return-value]
    "sine": lambda a: torch.sin(3 * a),
}


def one_action(case: str) -> list[Tensor]:
    """Logits, locations and log standard deviations (1, n): many narrow particles of unequal weight, or two."""
    torch.manual_seed(0)
    n, deviation = {"35 of 0.03": (35, 0.03), "35 of 0.01": (35, 0.01), "2 of 0.2": (2, 0.2)}[case]
    loc = torch.tensor([[-1.0, 1.0]]).double() if n == 2 else pfpn_sac.spread(1, n)[0].double()
    logits = 3 * torch.randn(1, n, dtype=torch.float64) if n > 2 else torch.tensor([[0.3, -0.3]]).double()
    return [x.requires_grad_() for x in (logits, loc, torch.full_like(loc, math.log(deviation)))]


@pytest.mark.parametrize("function", [*OF_AN_ACTION, "entropy"])
@pytest.mark.parametrize("case", ["35 of 0.03", "35 of 0.01", "2 of 0.2"])
def test_the_implicit_gradient_is_that_of_quadrature(case: str, function: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its mean over all that it draws, with empty places between narrow particles; to 1e-6 of the gradient's norm."""
    logits, loc, log_std = inputs = one_action(case)
    n, points = logits.shape[1], 2001 if logits.shape[1] > 2 else 20_001
    noise = torch.linspace(-9, 9, points, dtype=torch.float64)
    index, count = torch.arange(n).repeat_interleave(points), n * points  # each normal number of each component
    chance = (logits.detach().softmax(-1)[0, :, None] * (-noise.square() / 2).exp()).flatten()
    chance /= chance.sum()
    evenly = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    monkeypatch.setattr(pfpn_sac.Mixture, "choose", lambda _: index[:, None, None])
    monkeypatch.setattr(torch, "randn_like", lambda _: noise.repeat(n)[:, None])
    monkeypatch.setattr(torch, "rand_like", lambda _: evenly[:, None])
    u, log_prob, other = pfpn_sac.implicit(pfpn_sac.Mixture(logits.expand(count, 1, n), loc, log_std))
    assert other is not None

    grid = torch.linspace(-12, 12, 400_001, dtype=torch.float64)[:, None]
    mixture = pfpn_sac.Mixture(*inputs)
    density = mixture.log_density(grid).exp()
    if function == "entropy":
        mean, exact = chance @ log_prob, density * (mixture.log_density(grid) - pfpn_sac.log_slope(grid))
    else:
        f = OF_AN_ACTION[function]
        mean = chance @ f(torch.tanh(u[:, 0])) + f(torch.tanh(other[:, 0])).mean()
        exact = density * f(torch.tanh(grid))
    found = torch.autograd.grad(mean, inputs)
    for own, expected in zip(found, torch.autograd.grad(exact.sum() * 24 / 400_000, inputs), strict=True):
        assert (own - expected).norm() < 1e-6 * expected.norm() + 1e-14


def test_the_implicit_gradient_is_bounded_where_few_actions_are_drawn() -> None:
    """Between two narrow particles F is the left one's weight, and of two actions one in two is drawn evenly."""
    logits, loc = torch.zeros(1, 2, 2, dtype=torch.float64, requires_grad=True), torch.tensor([[-1.0, 1.0]]).double()
    mixture = pfpn_sac.Mixture(logits, loc.expand(2, 2), torch.full_like(loc, -4.0).expand(2, 2))
    (slope,) = torch.autograd.grad(pfpn_sac.shift(mixture, torch.zeros(1, 2, dtype=torch.float64)).sum(), logits)
    torch.testing.assert_close(slope, 4 * torch.tensor([[[-0.25, 0.25]] * 2]).double())


# Resampling -----------------------------------------------------------------------------------------------------------


def head(*arguments: str, script: Any = pfpn) -> tuple[Any, Any, ClippedAdam, Tensor]:
    """A policy head in float64, its resampling, an optimizer that has moments, and features of states."""
    flags = "--env ant --device cpu --particles 6 --resampling-interval 1 --resampling-noise 0"
    args = parse(script.Args, [*flags.split(), *arguments])
    torch.manual_seed(0)
    own = script.HEADS[args.policy](args, 4, M).double()
    with torch.no_grad():
        for parameter in own.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    resampling, optimizer = script.Resampling(args, own).double(), ClippedAdam(own, 1.0, lr=1e-3)
    features = torch.randn(50, 4, dtype=torch.float64)
    optimizer.exp_avg.normal_()
    optimizer.exp_avg_sq.uniform_()
    return own, resampling, optimizer, features


def kill(own: Any, places: list[tuple[int, int]], bias: float = -1e4) -> None:
    for k, i in places:
        own.linear.weight.data.view(M, 6, 4)[k, i] = 0
        own.linear.bias.data.view(M, 6)[k, i] = bias


DEAD = [(0, 1), (0, 2), (0, 3), (0, 4), (2, 0), (2, 5)]


@pytest.mark.parametrize(
    ("script", "flags"), [(pfpn, ""), (pfpn, "--resampling uniform"), (pfpn_sac, "")], ids=["ppo", "uniform", "sac"]
)
def test_resampling_leaves_the_policy_as_it_is(script: Any, flags: str) -> None:
    """The theorem (Eq. 10), with several dead particles on one target; what is not involved stays bitwise."""
    own, moving, optimizer, features = head(*flags.split(), script=script)
    kill(own, DEAD)
    u = 2 * torch.randn(50, M, dtype=torch.float64)
    before = own(features)
    moving.record(before)
    parameters = own.linear.weight, own.linear.bias, own.loc, own.log_std
    views = [x.data.view(M, 6, -1) for x in parameters]
    moments = [moment.view(M, 6, -1) for x in parameters for moment in optimizer.moments(x)]
    old, old_moments = ([x.clone() for x in each] for each in (views, moments))
    metrics = moving.end_iteration(own, optimizer)
    after = own(features)
    assert (after.log_prob(u) - before.log_prob(u)).abs().max() < 1e-10
    assert metrics["particles/moved"] == 6 and metrics["particles/dead_mean"].item() == pytest.approx(6 / 18)

    dead = torch.zeros(M, 6, dtype=torch.bool)
    dead[tuple(zip(*DEAD, strict=True))] = True
    assert after.log_weight.exp().amax(0)[dead].min() > 1e-3  # alive again
    target = (views[2] == views[2].transpose(1, 2)) & ~dead.unsqueeze(1)  # equal locations
    copies = (target & dead.unsqueeze(-1)).sum(1)
    assert (target.sum(-1) == 1).all() and copies.sum() == 6 and copies.max() >= 3
    alone = ~dead & (copies == 0)
    assert alone.any() and all(torch.equal(x[alone], was[alone]) for x, was in zip(views, old, strict=True))
    for moment, was in zip(moments, old_moments, strict=True):
        assert not moment[dead].any() and was[dead].any() and torch.equal(moment[~dead], was[~dead])
    assert not moving.seen.any()


@each_script
def test_targets_are_drawn_by_weight_and_copies_land_around_them(script: Any) -> None:
    own, moving, optimizer, features = head("--particles", "400", "--resampling-noise", "0.5", script=script)
    weight, bias = own.linear.weight.data.view(M, 400, 4), own.linear.bias.data.view(M, 400)
    weight.zero_()
    bias.fill_(-1e4)
    bias[:, :3] = torch.tensor([0.6, 0.3, 0.1], dtype=torch.float64).log()
    own.loc.data[:, :3] = torch.tensor([-0.9, 0.0, 0.9], dtype=torch.float64)
    own.log_std.data.fill_(-3)
    moving.record(own(features))
    moving.end_iteration(own, optimizer)
    target = own.loc[:, 3:].round().long() + 1
    counts = torch.stack([torch.bincount(row, minlength=3) for row in target]).sum(0)
    expected = torch.tensor([0.6, 0.3, 0.1]) * 397 * M
    assert ((counts - expected).square() / expected).sum() < 14  # chi square, 2 degrees of freedom, p < 0.001
    shift, width = own.loc[:, 3:] - torch.tensor([-0.9, 0.0, 0.9])[target], 0.5 * math.exp(-3)
    assert shift.abs().max() <= width and shift.std().item() == pytest.approx(width / math.sqrt(3), rel=0.1)


@pytest.mark.parametrize(
    ("script", "case", "flags", "dead"),
    [
        (pfpn, "not due", "--resampling-interval 3", 6),
        (pfpn, "nothing recorded", "", 0),
        (pfpn, "none dead", "", 0),
        (pfpn, "switched off", "--resampling none", 6),
        (pfpn_sac, "not due", "--resampling-interval 3", 6),
        (pfpn_sac, "nothing recorded", "", 0),
    ],
)
def test_nothing_is_moved(script: Any, case: str, flags: str, dead: int) -> None:
    own, moving, optimizer, features = head(*flags.split(), script=script)
    if case != "none dead":
        kill(own, DEAD)
    if case != "nothing recorded":
        moving.record(own(features))
    state = [*own.parameters(), optimizer.exp_avg, optimizer.exp_avg_sq]
    before = [x.clone() for x in state]
    metrics = moving.end_iteration(own, optimizer)
    assert all(torch.equal(x, was) for x, was in zip(state, before, strict=True))
    assert moving.moved == 0 and bool(moving.seen.any()) == (case == "not due")
    assert [metrics[f"particles/dead_{by}"].item() for by in ("mean", "max")] == pytest.approx([dead / 18] * 2)


@pytest.mark.parametrize(("by", "moved"), [("mean", 2), ("max", 1)])
def test_what_makes_a_particle_dead(by: str, moved: int) -> None:
    """By its largest weight (Eq. 8) it is alive if it has weight in one of the recorded states, of any rollout."""
    own, moving, optimizer, features = head("--dead-by", by, "--resampling-interval", "2")
    kill(own, [(0, 1), (2, 3)])
    features[:, 0] = 0.0
    features[7, 0] = 1.0  # the state where particle 3 of action 2 has weight
    own.linear.weight.data.view(M, 6, 4)[2, 3, 0] = 1e4
    for part in (features, features[10:]):
        moving.record(own(part))
        metrics = moving.end_iteration(own, optimizer)
    assert metrics["particles/dead_mean"].item() == pytest.approx(2 / 18)
    assert metrics["particles/dead_max"].item() == pytest.approx(1 / 18)
    assert moving.moved == moved


# Problems -------------------------------------------------------------------------------------------------------------


class Problem:
    """Environments without simulator: a reward of state and action; the action is the next state."""

    device, episode_length = torch.device("cpu"), 10**9
    scene = SimpleNamespace(nu=1)
    task = SimpleNamespace(obs_dim=1, actor_dim=None)

    def __init__(self, num_envs: int, reward: Callable[[Tensor, Tensor], Tensor], steps: int = 1) -> None:
        self.num_envs, self.reward, self.steps, self.t = num_envs, reward, steps, 0
        self.x = torch.zeros(num_envs, 1)

    def detach(self) -> Tensor:
        self.t, self.x = 0, torch.zeros(self.num_envs, 1)
        return self.x

    def step(self, action: Tensor) -> tuple[Any, ...]:
        self.t += 1
        reward, self.x = self.reward(self.x, action).squeeze(1), action
        no = torch.zeros(self.num_envs, dtype=torch.bool)
        terminated = ~no if self.t % self.steps == 0 else no
        return self.x, reward, terminated, no, {"final_obs": action}


def build(kind: Any, flags: str, reward: Callable[[Tensor, Tensor], Tensor], envs: int = 256, steps: int = 1) -> Any:
    shared = f"--env ant --device cpu --horizon {steps} --hidden 1".split()
    args = parse((pfpn if kind is pfpn.PPO else pfpn_sac).Args, [*shared, *flags.split()])
    return kind(args, Problem(envs, reward, steps))


def solve(learner: Any, iterations: int) -> Any:
    for _ in range(iterations):
        learner.iterate()
    return learner


PEAKS = (-0.25, 0.75)


def distance(action: Tensor) -> Tensor:
    return torch.minimum((action - PEAKS[0]).abs(), (action - PEAKS[1]).abs())


def masses(actor: pfpn.Actor) -> tuple[float, float]:
    """The shares of actions within 0.15 of each peak."""
    action = actor(torch.zeros(20_000, 1))[0].sample()
    left, right = (((action - peak).abs() < 0.15).double().mean().item() for peak in PEAKS)
    return left, right


def ppo_bandit(flags: str) -> Any:
    torch.manual_seed(1)
    flags = f"--minibatch-size 256 --epochs 4 --lr 3e-3 --lr-bounds 3e-3 3e-3 --entropy-coef 0 --std own {flags}"
    return build(pfpn.PPO, flags, lambda _, action: 1 / (distance(action) + 0.1))


def test_ppo_bandit_with_two_peaks() -> None:
    """Figure 11: particles cover both peaks, a Gaussian one of them."""
    found = {}
    for policy in ("pfpn", "gaussian"):
        learner = ppo_bandit(f"--policy {policy}")
        if policy == "gaussian":
            learner.actor.head.log_std.data.fill_(-1)
        solve(learner, 120)
        found[policy] = masses(learner.actor)
        assert distance(learner.policy(torch.zeros(1, 1))).item() < 0.15
    assert min(found["pfpn"]) > 0.2 and sum(found["pfpn"]) > 0.98
    assert max(found["gaussian"]) > 0.9 and min(found["gaussian"]) < 0.01


def test_ppo_bandit_stays_on_both_peaks_with_entropy() -> None:
    """Without the bonus one of the equal peaks has less than 0.02 by then. Particles have been moved."""
    learner = solve(ppo_bandit("--hidden 16 --entropy-coef 0.2"), 80)
    assert min(masses(learner.actor)) > 0.2 and learner.resampling.moved > 0


def test_sac_bandit_has_its_soft_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """The policy proportional to exp(r / alpha), which has two peaks of unequal height."""
    flags = "--horizon 8 --num-envs 16 --minibatch-size 128 --critic-hidden 64 --particles 15"
    flags += " --lr 4e-3 --temperature-lr 1e-9 --buffer-size 5000"
    monkeypatch.setattr(pfpn_sac, "TAU", 0.05)

    def reward(_: Tensor, action: Tensor) -> Tensor:
        return 2 * (action + 0.6).square() - 2 * torch.cos(5 * (action + 0.6))

    torch.manual_seed(1)
    actor = solve(build(pfpn_sac.SAC, flags, reward, 16), 110).actor
    a = torch.linspace(-0.9995, 0.9995, 2000).unsqueeze(-1)
    density = actor(torch.zeros(1, 1)).log_prob(torch.atanh(a)).softmax(0).detach()
    assert (density - reward(a, a).squeeze(-1).softmax(0)).abs().sum() / 2 < 0.12


def test_sac_targets_and_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = build(pfpn_sac.SAC, "--hidden 8 --critic-hidden 8", lambda _, action: action, 4)

    def act(obs: Tensor) -> tuple[Tensor, Tensor]:
        u = (mixture := learner.actor(obs)).sample()
        return torch.tanh(u), mixture.log_prob(u)

    assert_soft_updates(learner, (learner.optimizer, learner.temperature_optimizer), monkeypatch, act=act)


def test_skipped_updates_are_those_of_all_optimizers() -> None:
    flags = "--num-envs 8 --critic-hidden 4 --minibatch-size 8 --buffer-size 64"
    learner = build(pfpn_sac.SAC, flags, lambda _, action: action, 8, steps=3)
    learner.temperature_optimizer.skip_norm = 0.0
    assert learner.iterate()["grad/skipped"] == 3


def test_locations_beyond_the_bounds_are_drawn_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pfpn, "BOUND_COEF", 1e4)
    learner = ppo_bandit("")
    loc = learner.actor.head.loc.data
    loc.copy_(torch.linspace(-2, 2, 35))
    before = loc.clone()
    solve(learner, 1)
    assert (loc.abs() < before.abs())[before.abs() > 1.1].all()


# Runs -----------------------------------------------------------------------------------------------------------------

SMALL = "--env cartpole --device cpu --threads 1 --quiet --num-envs 4 --horizon 8 --minibatch-size 32 --epochs 2"
SMALL += " --hidden 8 --eval-episodes 1 --resampling-interval 1 --dead 0.999 --lr 0.03"


@each_script
def test_a_run_resumes_bitwise_with_its_particles(script: Any, tmp_path: Path) -> None:
    """Of a threshold so high that particles are moved on the way. Its deterministic policy stands alone."""
    own = "" if script is pfpn else "--buffer-size 100"
    flags = f"{SMALL} {own} --particles 8 --iterations 6"
    whole = assert_resumes(script, tmp_path, flags, 3)
    last = {name: float(value or "nan") for name, value in read_progress(tmp_path / "whole")[-1].items()}
    assert last["particles_moved"] == whole["modules"]["resampling"]["moved"] > 0
    actor = script.Actor(parse(script.Args, flags.split()), diffsim.make("cartpole", 1))
    actor.load_state_dict(whole["modules"]["actor"])
    obs = torch.randn(20, 5)
    mixture = actor(actor.normalizer(obs))
    mixture, squash = (mixture[0], torch.clone) if script is pfpn else (mixture, torch.tanh)
    expected = squash(mixture.loc[0][mixture.log_weight.argmax(-1)])
    torch.testing.assert_close(load_policy(tmp_path / "whole" / "checkpoint.pt").network(obs), expected)


@pytest.mark.parametrize(("script", "policy"), [(pfpn, "gmm"), (pfpn, "discrete"), (pfpn_sac, "gaussian")])
def test_other_policies_train(script: ModuleType, policy: str, tmp_path: Path) -> None:
    checkpoint = run(script, tmp_path, *f"{SMALL} --particles 8 --iterations 2 --policy {policy}".split())
    assert all(float(row["grad_skipped"]) == 0 for row in read_progress(tmp_path))
    action = load_policy(tmp_path / "checkpoint.pt").network(torch.randn(50, 5))
    assert action.shape == (50, 1) and action.isfinite().all()
    if policy == "discrete":
        bins = torch.linspace(-1, 1, 8)
        assert (action - bins).abs().amin(1).max() < 1e-6
        torch.testing.assert_close(checkpoint["modules"]["actor"]["head.likeliest.loc"][0], bins)


def test_a_gaussian_is_trained_as_by_ppo_baseline(tmp_path: Path) -> None:
    """The same random numbers give the same weights, up to rounding: the order of sums differs."""
    flags = "--env cartpole --device cpu --quiet --num-envs 16 --horizon 32 --iterations 3 --eval-episodes 1"
    flags += " --minibatch-size 100 --epochs 2 --entropy-coef 0.01 --lr-bounds 3e-4 3e-4"
    theirs = run(ppo_baseline, tmp_path / "theirs", *flags.split())
    ours = run(pfpn, tmp_path / "ours", *f"{flags} --policy gaussian --std own".split())
    weights = [list(checkpoint["policy"]["weights"].values()) for checkpoint in (ours, theirs)]
    torch.testing.assert_close(*weights, rtol=1e-3, atol=2e-5)


SAME = {"steps": "horizon", "updates_per_step": "epochs", "batch_size": "minibatch_size"}
CONSTANTS = {"target_kl": "TARGET_KL", "clip_coef": "CLIP", "value_coef": "VALUE_COEF", "bound_coef": "BOUND_COEF"}
CONSTANTS |= {"max_grad_norm": "MAX_GRAD_NORM"}


@pytest.mark.parametrize("env", ["cartpole", "humanoid_mtu"])
@pytest.mark.parametrize(("script", "baseline"), [(pfpn, ppo_baseline), (pfpn_sac, sac_baseline)])
def test_settings_are_those_of_the_baselines(script: Any, baseline: Any, env: str) -> None:
    flags = ["--env", env, "--device", "cpu"]
    own, theirs = (vars(parse(each.Args, flags)) for each in (script, baseline))
    other = {SAME.get(name, name): value for name, value in theirs.items()}
    own |= {name: vars(script).get(constant) for name, constant in CONSTANTS.items() if name in other}
    shared = other.keys() & own.keys() - {"run_dir", "eval_every", "save_every", "initial_log_std"}  # of another policy
    assert len(shared) > 20 and {name: own[name] for name in shared} == {name: other[name] for name in shared}
