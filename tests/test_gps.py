"""Guided policy search: the estimator against closed forms, the search's parts, and the script as its users run it."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learners import assert_refuses, assert_same, read_progress, run
from planning.systems import normal
from torch import Tensor

import diffsim
import gps
from diffsim.planning import LinearGaussian, System, save_demonstration
from diffsim.planning.policy import GaussianPolicy
from diffsim.training import Evaluation, evaluate, load_policy, parse
from diffsim.training.checkpoint import load, restore
from diffsim.training.evaluation import make_env
from diffsim_cli.watch import make_policy_env
from gps import phi

SMALL = (
    "--env cartpole --horizon 30 --pretraining 40 --hidden 8 --guiding-samples 8 --samples 4 --active 16 "
    "--iterations 4 --lbfgs-iterations 5 --eval-every 2 --eval-episodes 3 --quiet"
).split()
TINY = [*SMALL, *"--horizon 8 --pretraining 5 --iterations 2 --eval-episodes 1".split()]


environment = cache(diffsim.make)


def make_search(env: str, flags: str = "") -> gps.Search:
    args = parse(gps.Args, ["--env", env, "--device", "cpu", *flags.split()])
    return gps.Search(args, environment(env, 1, control_dt=args.control_dt, substeps=args.substeps))


# Importance sampling


def randomise(policy: GaussianPolicy, rng: np.random.Generator) -> tuple[GaussianPolicy, Tensor]:
    nu, inputs = len(policy.sigma), len(policy.observed)
    policy.obs_mean, policy.obs_std = normal(rng, inputs), 1 + normal(rng, inputs).abs()
    policy.u_std, policy.sigma = torch.full((nu,), 2.0).double(), torch.full((nu,), 0.5).double()
    policy.theta = normal(rng, len(policy.theta))
    return policy, policy.theta


def a_set(rng: np.random.Generator, m: int = 15, T: int = 9, n: int = 3) -> tuple[Tensor, ...]:
    return normal(rng, m, T, 11), normal(rng, m, T, 3), normal(rng, m, T), 0.3 * normal(rng, m, n, T).cumsum(2) - 5


@pytest.mark.parametrize("w_r", [0.0, 1e-2, 3.0])
def test_gradient_of_phi_is_that_of_appendix_a(w_r: float, rng: np.random.Generator) -> None:
    """And of central differences."""
    policy, theta = randomise(make_search("hopper", "--hidden 5").network, rng)
    obs, u, reward, log_q = a_set(rng)
    u = policy.mean(theta, obs) + 0.6 * u  # likely enough under the policy that no product underflows
    sources = torch.arange(len(u)) % log_q.shape[1]
    mixture = gps.Samples(obs, obs, u, reward, sources, log_q).log_mixture

    def objective(theta: Tensor) -> Tensor:
        return phi(policy.log_prob(theta, obs, u), mixture, reward, w_r)

    leaf = theta.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(objective(leaf), leaf)

    ratio = (policy.log_prob(theta, obs, u).cumsum(1) - mixture).exp()
    weight = ratio / ratio.sum(0)
    xi = reward - (weight * reward).sum(0) + w_r
    c = (weight * xi).flip(1).cumsum(1).flip(1)
    mean = policy.mean(leaf, obs)
    errors = c.unsqueeze(-1) * (u - mean.detach()) / policy.sigma**2
    (appendix,) = torch.autograd.grad((errors * mean).sum(), leaf)
    assert (gradient - appendix).norm() / appendix.norm() < 1e-10

    S = gps.Samples(obs, obs, u, reward, sources, log_q)
    value = policy.sparse(lambda log_pi: phi(log_pi, mixture, reward, w_r), leaf, S)
    torch.testing.assert_close(value.detach(), objective(theta), rtol=1e-14, atol=0)
    torch.testing.assert_close(torch.autograd.grad(value, leaf)[0], gradient, rtol=1e-10, atol=1e-13)

    direction, eps = normal(rng, len(theta)), 1e-5
    direction /= direction.norm()
    slope = (objective(theta + eps * direction) - objective(theta - eps * direction)) / (2 * eps)
    assert slope.item() == pytest.approx((gradient @ direction).item(), rel=1e-6)
    expected = (weight * reward).sum() + w_r * ratio.mean(0).log().sum()
    assert objective(theta).item() == pytest.approx(expected.item(), rel=1e-12)


def test_mixture_is_of_prefixes() -> None:
    """Not a product of per-step mixtures: with components this unlike the two are many nats apart."""
    per_step = torch.tensor([[[0.0, -20.0, 0.0], [5.0, 5.0, 5.0], [-20.0, 0.0, -20.0]]] * 2, dtype=torch.float64)
    expected = [[math.log((math.exp(a) + math.exp(b)) / 2) for a, b in ((0, -20), (-20, -20), (-20, -40))]] * 2
    nothing = per_step[:, :, :0]  # none of the samples comes from the distribution between the two
    S = gps.Samples(nothing, nothing, nothing, nothing, torch.tensor([2, 0]), per_step.cumsum(2))
    torch.testing.assert_close(S.log_mixture, torch.tensor(expected, dtype=torch.float64))


# The search


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("trained")
    run(gps, directory, *SMALL)
    return directory


@pytest.fixture
def checkpoint(trained: Path) -> dict[str, Any]:
    return torch.load(trained / "checkpoint.pt", weights_only=True)


@pytest.fixture
def search(trained: Path) -> gps.Search:
    state = load(trained / "checkpoint.pt", "gps")
    search = gps.Search(gps.Args(**state["args"]), environment("cartpole", 1))
    restore(search, state)
    return search


@pytest.fixture(scope="module")
def rows(trained: Path) -> list[dict[str, str]]:
    return read_progress(trained)


def test_reward_of_the_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gps, "TARGETS", {"hopper": (1.5, 1.2, 10.0, 1.0), "ant": (1.0, 0.5, 10.0, 0.1)})
    search = make_search("hopper", "--action-cost 0.01")
    x = torch.zeros(12, dtype=torch.float64)
    x[1], x[2], x[6] = 0.1, 0.2, 2.0
    u = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
    expected = -(0.01 * 5.25 + 0.5**2 + 10 * (1.25 + 0.1 - 1.2) ** 2 + 0.2**2)
    assert search.rollouts.reward(x, u).item() == pytest.approx(expected)
    search = make_search("ant", "--demonstration none.npz --action-cost 0.01")
    x, u = search.system.start()[0], torch.ones(8, dtype=torch.float64)
    x[15], turn = 3.0, 4 * x[4:7].square().sum().item()
    expected = -(0.01 * 8 + 2.0**2 + 10 * (x[2].item() - 0.5) ** 2 + 0.1 * turn)
    assert search.rollouts.reward(x, u).item() == pytest.approx(expected)
    native = make_search("cartpole", "--action-cost 0.01")
    x, u = native.system.start(), torch.ones(1, 1, dtype=torch.float64)
    torch.testing.assert_close(native.rollouts.reward(x, u), native.system.reward(x, u) - 0.01)


def test_policy_does_not_look_at_the_action_before(rng: np.random.Generator) -> None:
    search = make_search("ant", "--demonstration none.npz --hidden 5")
    policy, theta = randomise(search.network, rng)
    policy.obs_mean[29:] = 0.0  # as in all that it is fitted to
    obs = normal(rng, 4, 37)
    other = obs.clone()
    other[:, 29:] += 1.0
    network = search.policy
    assert torch.equal(network(other), network(obs))
    obs[:, 29:] = 0.0
    torch.testing.assert_close(network(obs), policy.mean(theta, obs).tanh())


@pytest.mark.parametrize("bounds, start", [((1e-6, 1e-2), 1e-4), ((0.0, 0.0), 0.0)])
def test_schedule_of_the_regulariser(
    bounds: tuple[float, float], start: float, search: gps.Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lines 10 to 16: a better policy is kept, and w_r falls; otherwise w_r grows, and the best is sampled again.

    What is better is confirmed with all samples of the best one.
    """
    search.args.regularizer_bounds, search.w_r, best = bounds, start, search.network.theta
    monkeypatch.setattr(search, "optimise", lambda S: (search.network.theta + 1e-3, {}))
    seen, compared = [], list[bool]()

    def estimate(theta: Tensor, active: Tensor) -> tuple[bool, dict[str, float]]:
        own = (search.S.samples.source == search.best).nonzero().flatten()
        compared.append(bool(torch.isin(own, active).all()))
        return better, {}

    monkeypatch.setattr(search, "estimate", estimate)
    for better in (True, True, True, False, False, False, False, False, False, True):
        metrics, drawn = search.iterate(1), search.rollouts.control_steps
        assert metrics["gps/accepted"] == better and (compared[-1] or not better)
        assert metrics["gps/regularizer"] == pytest.approx(seen[-1] if seen else start)
        best = best + 1e-3 if better else best
        torch.testing.assert_close(search.network.theta, best)
        torch.testing.assert_close(search.S.generators[search.best], (best,))
        seen.append(search.w_r)
    assert drawn == search.rollouts.control_steps
    expected = [1e-5, 1e-6, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-2, 1e-2, 1e-3]
    np.testing.assert_allclose(seen, expected if start else 0.0)


@pytest.mark.parametrize("lasts", [True, False])
def test_a_better_policy_lasts_beyond_the_horizon(
    lasts: bool, search: gps.Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --beyond 3: what is better by Eq. 2 is refused if its return over three horizons is lower."""
    search.args.beyond, best = 3, search.network.theta
    monkeypatch.setattr(search, "optimise", lambda S: (best + 1e-3, {}))
    monkeypatch.setattr(search, "estimate", lambda theta, active: (True, {}))
    monkeypatch.setattr(search.rollouts, "endurance", lambda theta: float(torch.equal(theta, best) != lasts))
    assert search.iterate(1)["gps/accepted"] == lasts
    assert torch.equal(search.network.theta, best) != lasts


def test_endurance_is_the_return_of_longer_and_noisier_trajectories(
    search: gps.Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 3 horizons with 3 times the noise, the same each time; the search's own random numbers are left alone."""
    search.args.beyond, rollouts, seen = 3, search.rollouts, list[Tensor]()
    roll_out, state = rollouts.roll_out, rollouts.rng.get_state()

    def watch(theta: Tensor, noise: Tensor, start: Tensor) -> gps.Samples:
        seen.append(noise)
        return roll_out(theta, noise, start)

    monkeypatch.setattr(rollouts, "roll_out", watch)
    first, again = (rollouts.endurance(search.network.theta) for _ in range(2))
    assert first == again and torch.equal(*seen) and seen[0].shape == (4, 90, 1)
    assert 2.5 < seen[0].std() < 3.5 and torch.equal(rollouts.rng.get_state(), state)


def test_guides_reproduce_the_plan(rows: list[dict[str, str]]) -> None:
    """Their mean return is within 1 % of the plan's, and they spread by less."""
    mean, std, plan = (float(rows[0][f"gps_{name}"]) for name in ("guides", "guides_std", "plan"))
    assert abs(mean - plan) < 0.01 * abs(plan) and 0 < std < 0.01 * abs(plan)


def test_a_diverged_step_earns_a_floor_below_all_of_the_guides(search: gps.Search) -> None:
    """As far below their worst step as that one is below the best."""
    worst, top = search.sample_guides().reward.aminmax()
    assert search.rollouts.floor == pytest.approx((2 * worst - top).item()) and worst < top
    x, finite = search.guides[0].x[None], torch.arange(30)[None] < 20
    reward = search.rollouts.measure(x, search.guides[0].u[None], finite).reward
    assert ((reward == search.rollouts.floor) == ~finite).all()


def test_line_7_ends_above_both_of_its_starts(search: gps.Search) -> None:
    S, theta = search.S.samples.pick(search.choose(16, 4)), search.network.theta
    value, top = search.objective(S.log_mixture, S.reward / search.scale), S.returns.argmax()
    fitted = search.network.fit(theta, S.obs[top], S.u[top], search.args.lbfgs_iterations)
    end, metrics = search.optimise(S)
    before, imitated, after = (value(search.network.log_prob(t, S.obs, S.u)).item() for t in (theta, fitted, end))
    assert after == pytest.approx(metrics["gps/phi"], rel=1e-9)
    assert after > max(before, imitated)


def test_active_set(search: gps.Search) -> None:
    """All guiding samples, the newest of the best policy, and a planted sample of high weight."""
    other = search.network.theta + 0.01
    planted = int(search.S.append(search.rollouts.draw(other, len(search.S.generators)), (other,))[-1])
    S = search.S.samples
    log_q = S.log_q.clone()
    log_q[planted] -= 1e3
    search.S.samples = S._replace(log_q=log_q)
    chosen = set(search.choose(16, 4).tolist())
    guiding, own = (S.source == 0).nonzero().flatten(), (S.source == search.best).nonzero().flatten()[-4:]
    assert {planted, *guiding.tolist(), *own.tolist()} <= chosen and len(chosen) == 16


def test_adapted_guides_leave_room_for_the_best_policys_own_samples(search: gps.Search) -> None:
    """Otherwise nothing in S_k says what it earns, and no proposal looks better than the adapted guides' returns."""
    adapted = search.guides[0]._replace(u=search.guides[0].u + 0.1)
    S = search.S
    for _ in range(3):
        S.append(
            search.rollouts.measure(*adapted.sample(search.system, search.rollouts.noise(6)), len(S.generators)),
            adapted,
        )
    source, chosen = S.samples.source, set(search.choose(16, 4).tolist())
    own = (source == search.best).nonzero().flatten()[-4:]
    assert {*own.tolist(), *(source == 0).nonzero().flatten().tolist()} <= chosen
    search.best = S.keep(search.choose(24, 12), search.best)  # of 24 + 18
    assert (S.samples.source == 0).sum() == 8 and (S.samples.source == search.best).sum() >= 4
    torch.testing.assert_close(S.generators[search.best], (search.network.theta,))


def test_densities_of_the_set_are_those_of_its_generators(search: gps.Search) -> None:
    """After all appending and pruning, and each sample was more likely where it came from than it is elsewhere."""
    S = search.S.samples
    assert len(S.u) <= 48
    for j, generator in enumerate(search.S.generators):
        torch.testing.assert_close(S.log_q[:, j], search.S.log_density(generator, S), rtol=1e-9, atol=1e-9)
    own = S.log_q[torch.arange(len(S.u)), S.source, -1]
    assert (own >= S.log_q[:, :, -1].median(1).values).double().mean() > 0.9
    torch.testing.assert_close(search.S.generators[search.best], (search.network.theta,))


# The script


def test_resume_continues_exactly(trained: Path, tmp_path: Path, checkpoint: dict[str, Any]) -> None:
    """Also where it saves and evaluates more often."""
    run(gps, tmp_path, *SMALL, "--save-every", 1, "--eval-every", 1, stop_after=2)
    gps.main(["--resume", str(tmp_path / "checkpoint.pt")])
    resumed = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    for name in checkpoint.keys() - {"seconds", "args"}:
        assert_same(resumed[name], checkpoint[name])
    assert [int(row["iteration"]) for row in read_progress(tmp_path)] == [0, 1, 2, 3, 4]


def test_rows_and_files_of_a_run(trained: Path, rows: list[dict[str, str]]) -> None:
    arguments = json.loads((trained / "args.json").read_text())
    assert arguments["hidden"] == 8 and arguments["action_cost"] == 1e-3
    steps = [int(row["control_steps"]) for row in rows]
    assert steps[0] == 30 * (8 + 8 + 4)  # guiding samples, lessons and the policy's own
    # Before a proposal is accepted, as many as of the guides are drawn; a rejection draws the best policy's again.
    for drawn, row in zip(np.diff(steps) // 30, rows[1:], strict=True):
        assert drawn in ((4 + 8,) if row["gps_accepted"] == "1.0" else (4 + 4, 4 + 8 + 4))
    assert [bool(row["eval_return"]) for row in rows] == [False, False, True, False, True]
    assert all(row["return"] and row["gps_return_std"] for row in rows)
    assert not list(trained.glob("*.tmp"))


def test_evaluation(
    trained: Path, rows: list[dict[str, str]], tmp_path: Path, search: gps.Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It repeats the last one of training and leaves the run as it was; one of its trajectories has no noise."""
    before = {path: path.read_bytes() for path in trained.iterdir()}
    monkeypatch.setattr(Evaluation, "compared", True)
    gps.main(["--evaluate", str(trained / "checkpoint.pt"), "--run-dir", str(tmp_path)])
    assert before == {path: path.read_bytes() for path in trained.iterdir()}
    again, training = (json.loads((path / "evaluation.json").read_text()) for path in (tmp_path, trained))
    assert again.pop("finer")["substeps"] == 16 and again == training
    assert again["settings"]["substeps"] == 4 and again["lengths"] == [30] * 3
    for name in ("return", "objective", "objective_std", "without_noise", "worst"):
        assert again[name] == pytest.approx(float(rows[-1][f"eval_{name}"]), rel=1e-6)
    assert search.evaluate().qpos.shape == (30, 3, 2)


def test_the_policy_acts_in_environments_as_it_does_in_the_search(trained: Path, search: gps.Search) -> None:
    env = diffsim.make("cartpole", 2, horizon=1, dtype=torch.float64, stochastic_init=False)
    env.episode_length = 30
    S = search.rollouts.roll_out(search.network.theta, 0 * search.rollouts.noise(1), search.guides[0].x[:1])
    returns = search.system.reward(S.x[:, 1:], S.u).sum(1).expand(2)
    torch.testing.assert_close(evaluate(env, search.policy).returns, returns)
    torch.testing.assert_close(
        evaluate(env, load_policy(trained / "checkpoint.pt").network.double()).returns, returns, rtol=1e-4, atol=0
    )


@pytest.mark.gpu
def test_a_gpu_learns_as_the_cpu_does(tmp_path: Path) -> None:
    """The same guides, the same samples, and policies that differ by rounding alone."""
    flags = [*TINY, *"--ilqr-iterations 3 --adaptive 1 --adaptive-iterations 2 --device".split()]
    one, other = (run(gps, tmp_path / device, *flags, device)["modules"] for device in ("cpu", "cuda"))
    for part in ("x", "u", "K", "L"):
        place = LinearGaussian._fields.index(part)
        torch.testing.assert_close(other["learner"]["guides"][0][place].cpu(), one["learner"]["guides"][0][place])
    assert other["rollouts"]["control_steps"] == one["rollouts"]["control_steps"]
    torch.testing.assert_close(other["network"]["theta"].cpu(), one["network"]["theta"], rtol=1e-3, atol=1e-3)


def test_seeds_and_adaptive_guides(tmp_path: Path) -> None:
    """Of two examples."""
    system, path = make_search("cartpole").system, tmp_path / "two.npz"
    u = torch.tensor([0.1, -0.1], dtype=torch.float64).view(2, 1, 1).expand(2, 8, 1)
    x, _, _ = system.rollout(system.start().expand(2, -1), 8, lambda t, _: u[:, t])
    save_demonstration(system, x, u, path)
    arguments = [*TINY, "--demonstration", path, *"--adaptive 1 --adaptive-iterations 2 --seed".split()]
    one, other = (run(gps, tmp_path / str(seed), *arguments, seed)["modules"] for seed in (1, 2))
    assert not torch.equal(one["network"]["theta"], other["network"]["theta"])
    assert len(one["learner"]["guides"]) == len(one["learner"]["adapted"]) == one["learner"]["initial"] == 2
    assert sum(len(generator) > 1 for generator in one["S"]["generators"]) == 4


def test_control_steps_of_another_length(tmp_path: Path) -> None:
    """They are the search's, the evaluation's, and those of whatever plays the policy."""
    path, example = tmp_path / "run" / "checkpoint.pt", tmp_path / "slow.npz"
    system = System(diffsim.make("cartpole", 1, control_dt=0.05))
    u = torch.tensor([0.1, -0.1], dtype=torch.float64).repeat(4).view(8, 1)
    x, _, _ = system.rollout(system.start(), 8, lambda t, _: u[t : t + 1])
    save_demonstration(system, x[0], u, example)
    run(gps, path.parent, *TINY, *"--control-dt 0.05 --substeps 12 --demonstration".split(), example)
    env, state = make_policy_env(load_policy(path), 1), load(path, "gps")
    search = gps.Search(gps.Args(**state["args"]), make_env(gps.Args(**state["args"]), 1))
    restore(search, state)
    assert env.control_dt == search.system.control_dt == search.evaluate().control_dt == 0.05


def test_an_example_is_where_the_guides_start(tmp_path: Path) -> None:
    path, qpos = tmp_path / "demo.npz", np.linspace((0.3, 3.0), (0.5, 2.8), 9)
    np.savez(path, qpos=qpos, qvel=np.zeros((9, 2)), action=np.linspace(0.1, 0.2, 8)[:, None])
    search = run(gps, tmp_path / "run", *TINY, "--demonstration", path)["modules"]["learner"]
    assert search["guides"][0][0][0].tolist() == [0.3, 3.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def walker() -> gps.Search:
    """A search that has its guides."""
    search = make_search("walker", "--horizon 60 --pretraining 1 --seed 1")
    search.prepare(lambda message: None)
    return search


def test_guides_are_as_wide_as_the_policy(walker: gps.Search) -> None:
    (guide,), sigma = walker.guides, walker.network.sigma
    assert (guide.L.square().sum(-1) / sigma.square()).mean().item() == pytest.approx(1.0)
    assert walker.scale == pytest.approx(walker.S.samples.reward.std().item())


def test_feedback_of_guides_does_not_depend_on_the_policys_noise(walker: gps.Search) -> None:
    """Only their width does."""
    quiet = make_search("walker", "--horizon 60 --pretraining 1 --noise 0.05")
    quiet.prepare(lambda message: None)
    torch.testing.assert_close(quiet.guides[0].K, walker.guides[0].K)
    torch.testing.assert_close(quiet.guides[0].L, 0.5 * walker.guides[0].L)


def test_guides_correct_what_the_example_alone_does_not(walker: gps.Search) -> None:
    """Noise that makes the robot leave the example without feedback stays near it with feedback."""
    (guide,), system = walker.guides, walker.system
    noise = 3.0 * walker.rollouts.noise(8, torch.Generator().manual_seed(1))
    away = [
        system.difference(controller.sample(system, noise)[0][:, -1], guide.x[-1]).norm(dim=-1).median().item()
        for controller in (guide, guide._replace(K=0.0 * guide.K))
    ]
    assert away[0] < 0.7 * away[1]


def test_lessons_of_line_3_are_the_feedback_of_wide_guides(walker: gps.Search) -> None:
    """At each step they differ between samples, and the more so, the wider the samples are."""
    spreads = {}
    for noise in (0.5, 0.1):
        walker.args.pretraining_noise = noise
        obs, u = walker.lessons()
        assert obs.shape[0] == u.shape[0] == 40 * 60
        spreads[noise] = torch.stack([part.view(40, 60, -1)[:, 10:].std(0).norm() for part in (obs, u)])
    assert (spreads[0.1] > 0).all() and (spreads[0.5] / spreads[0.1] > 4).all()


def test_line_3_has_no_lessons_after_a_fall(walker: gps.Search, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of least reward, and all later ones of its trajectory, are left out."""
    follow = walker.rollouts.follow

    def fall(*arguments: Any) -> gps.Samples:
        S = follow(*arguments)
        S.reward[1, 20] = S.reward[3, 0] = walker.rollouts.floor
        return S

    monkeypatch.setattr(walker.rollouts, "follow", fall)
    assert len(walker.lessons()[0]) == 38 * 60 + 20


def test_imitation_finds_a_network_again(rng: np.random.Generator) -> None:
    """Not the weights, but the means where it was fitted."""
    policy, theta = randomise(make_search("hopper", "--hidden 5").network, rng)
    obs = policy.obs_mean + policy.obs_std * normal(rng, 1024, len(policy.observed))
    u = policy.mean(theta, obs)
    policy.standardise(obs, u)
    found = policy.imitate(obs, u, 200, torch.Generator().manual_seed(1))
    assert ((policy.mean(found, obs) - u) / policy.u_std).square().mean() < 0.15


def test_algorithm_1_learns_to_hop_as_its_guides_do(tmp_path: Path) -> None:
    """From the first second of the shipped example, and from a policy that falls behind it. Who imitates earns as much
    as the guides, and who searches more."""
    flags = "--env hopper --horizon 50 --pretraining 3 --iterations 8 --eval-every 8 --quiet".split()
    run(gps, tmp_path, *flags)
    rows = read_progress(tmp_path)
    guides, spread, before = (float(rows[0][name]) for name in ("gps_guides", "gps_guides_std", "return"))
    assert before < guides - 5 * spread
    assert float(rows[-1]["eval_objective"]) > guides + 2 * spread


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--horizon 1", "--horizon must be from 2 to 1,000, not 1"),
        ("--guiding-samples 1", "--guiding-samples must be from 2 to 1,000, not 1"),
        ("--active 20", "--active must be at least 50, for the guides' and the policy's samples, not 20"),
        ("--resume {trained}/checkpoint.pt --control-dt 0.02", "has --control-dt 0.016666666666666666, which cannot "),
        ("--regularizer-bounds 1 0.1", "--regularizer-bounds must be two numbers, the first not above"),
        ("--demonstration {file}.npz", "no such trajectory: {file}.npz"),
        (
            "--demonstration {hopper} --control-dt 0.02",
            "{hopper}: qpos has shape (521, 6) of float32, must be ",
        ),
        ("--demonstration {hopper}", "{hopper} has control steps of 0.02 s, not of 0.01667 s"),
        ("--horizon 999", "cartpole.npz: qpos has shape (261, 2) of float32, must be at least (1000, 2) for 999 steps"),
        ("--env ant", "--demonstration must be an example for ant; shipped are those of cartpole, hopper, "),
        ("--resume {trained}/checkpoint.pt --horizon 9 --iterations 9", "--horizon 30, which cannot change to 9"),
        ("--resume {trained}/checkpoint.pt --noise 0.3 --iterations 9", "--noise 0.1, which cannot change to 0.3"),
        ("--evaluate {trained}/checkpoint.pt --noise 0.3", "--noise 0.1, which cannot change to 0.3; --evaluate takes"),
        ("--resume {trained}/checkpoint.pt --demonstration {hopper}", "cannot change to {hopper}"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: str, message: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, message = (text.replace("{hopper}", f"{gps.EXAMPLES / 'hopper.npz'}") for text in (arguments, message))
    env = "" if "--env" in arguments else "--env cartpole "
    assert_refuses(gps, env + arguments, message, trained, tmp_path, capsys)
