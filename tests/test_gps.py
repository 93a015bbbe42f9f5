"""Guided policy search: each part against closed forms and dense solutions, and the script as its users run it."""

from __future__ import annotations

import csv
import importlib.util
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learners import assert_refuses
from scenes import acting_states

import diffsim
import gps
import shac
from diffsim import dynamics

ROOT = Path(__file__).resolve().parents[1]
spec = importlib.util.spec_from_file_location("gps_benchmark", ROOT / "benchmarks" / "gps.py")
benchmark = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = benchmark
spec.loader.exec_module(benchmark)

SMALL = (
    "--env cartpole --horizon 30 --restarts 3 --screening 4 --ilqr-iterations 20 --pretraining 60 --gate 1 --hidden 8 "
    "--pretraining-samples 8 --guiding-samples 8 --samples 4 --active 16 --stored 24 --iterations 4 "
    "--lbfgs-iterations 5 --eval-every 2 --eval-episodes 3 --quiet"
).split()


def normal(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    return torch.tensor(rng.normal(size=shape))


def make_system(env: str, *flags: str) -> gps.System:
    return gps.make_system(gps.parse(["--env", env, *flags])[0])


class Linear:
    """x' = A x + B u with the quadratic reward of (x', u), in the interface of gps.System."""

    def __init__(self, rng: np.random.Generator, nx: int = 3, nu: int = 2) -> None:
        self.nd, self.nu, self.device, self.steps = nx, nu, torch.device("cpu"), 0
        self.A, self.B = 0.5 * normal(rng, nx, nx), normal(rng, nx, nu)
        root = normal(rng, nx + nu, nx + nu)
        self.H, self.g = root @ root.mT + 0.1 * torch.eye(nx + nu), normal(rng, nx + nu)

    def difference(self, x: torch.Tensor, origin: torch.Tensor) -> torch.Tensor:
        return x - origin

    def retract(self, x: torch.Tensor, tangent: torch.Tensor) -> torch.Tensor:
        return x + tangent

    def observe(self, x: torch.Tensor) -> torch.Tensor:
        return x

    def reward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        y = torch.cat((x, u), -1)
        return -0.5 * ((y @ self.H) * y).sum(-1) - y @ self.g

    def rollout(self, x: torch.Tensor, steps: int, act: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        states, actions = [x], []
        for t in range(steps):
            actions.append(act(t, states[-1]))
            states.append(states[-1] @ self.A.mT + actions[-1] @ self.B.mT)
        finite = torch.ones(len(x), steps, dtype=torch.bool)
        return torch.stack(states, 1), torch.stack(actions, 1), finite

    def jacobians(self, x: torch.Tensor, u: torch.Tensor, following: torch.Tensor) -> torch.Tensor:
        return torch.cat((self.A, self.B), 1).expand(len(x), -1, -1)

    def dense(self, steps: int, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient and Hessian of the total cost of `steps` actions at zero, from x."""

        def cost(u: torch.Tensor) -> torch.Tensor:
            xs, us, _ = self.rollout(x.unsqueeze(0), steps, lambda t, _: u.view(steps, 1, -1)[t])
            return -self.reward(xs[:, 1:], us).sum()

        zero = torch.zeros(steps * self.nu, dtype=torch.float64)
        return torch.func.grad(cost)(zero), torch.func.hessian(cost)(zero)


# Trajectory optimisation


def test_ilqr_of_a_linear_system_is_its_least_squares_solution(rng: np.random.Generator) -> None:
    """One full step, whose gain is the predicted one; the feedback is right too: from any other start."""
    system, T = Linear(rng), 12
    x, u, _ = system.rollout(normal(rng, 2, 3), T, lambda t, _: torch.zeros(2, 2, dtype=torch.float64))
    cost = gps.Cost(system)
    plan = gps.ilqr(cost, x, u, 1, mu=0.0)
    f_z = gps.step_jacobian(system, x, u)
    gains = gps.backward_pass(f_z, *cost.quadratic(x, u, f_z), torch.zeros(2, dtype=torch.float64))
    before = cost.value(x[:, None], u[:, None]).sum(-1)[:, 0]
    torch.testing.assert_close((plan.cost - before) / (gains.d1 + gains.d2), torch.ones(2).double(), rtol=1e-8, atol=0)
    for r in range(2):
        gradient, hessian = system.dense(T, x[r, 0])
        expected = -torch.linalg.solve(hessian, gradient).view(T, -1)
        torch.testing.assert_close(plan.u[r], expected, rtol=1e-10, atol=1e-10)
    elsewhere = x.clone()
    other = normal(rng, 1, 3)
    act = lambda t, s: u[:1, t] + gains.k[:1, t] + (s - elsewhere[:1, t]) @ gains.K[0, t].mT  # noqa: E731
    gradient, hessian = system.dense(T, other[0])
    expected = -torch.linalg.solve(hessian, gradient).view(T, -1)
    torch.testing.assert_close(system.rollout(other, T, act)[1][0], expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("mu, alphas", [(3.0, [1.0]), (0.0, [1.0, 0.5, 0.1])])
def test_value_of_gains_is_what_they_cost(mu: float, alphas: list[float], rng: np.random.Generator) -> None:
    """The short form of the value update is wrong for mu > 0; the general one predicts the cost of the full step with
    any gains. Of shorter steps only with optimal ones: others feed back the difference to a path not taken."""
    system, T = Linear(rng), 6
    x, u, _ = system.rollout(normal(rng, 1, 3), T, lambda t, _: torch.zeros(1, 2, dtype=torch.float64))
    cost, f_z = gps.Cost(system), gps.step_jacobian(system, x, u)
    gains = gps.backward_pass(f_z, *cost.quadratic(x, u, f_z), torch.tensor([mu], dtype=torch.float64))
    sizes = torch.tensor(alphas, dtype=torch.float64)
    xs, us, _ = gps.follow(system, x, u, gains, sizes)
    change = cost.value(xs, us).sum(-1)[0] - cost.value(x[:, None], u[:, None]).sum()
    torch.testing.assert_close(change, sizes * gains.d1 + sizes**2 * gains.d2, rtol=1e-10, atol=1e-10)


def test_guide_is_the_maximum_entropy_policy(rng: np.random.Generator) -> None:
    """eta Q_uu^-1, with Q_uu the Schur complement of the dense cost to go, from the present action to the end."""
    system, T, sigma = Linear(rng), 8, torch.tensor([0.3, 0.2], dtype=torch.float64)
    x, u, _ = system.rollout(normal(rng, 1, 3), T, lambda t, _: torch.zeros(1, 2, dtype=torch.float64))
    cost = gps.Cost(system)
    plan = gps.ilqr(cost, x, u, 3, mu=0.0)
    guide = gps.make_guides(cost, plan, sigma, 1.0)[0]
    stds = []
    for t in range(T):
        _, hessian = system.dense(T - t, plan.x[0, t])
        q_uu = torch.linalg.inv(torch.linalg.inv(hessian)[:2, :2])  # the rest minimised out
        covariance = guide.L[t] @ guide.L[t].mT
        torch.testing.assert_close(covariance, guide.eta * torch.linalg.inv(q_uu), rtol=1e-8, atol=1e-12)
        stds.append(covariance.diagonal().sqrt())
    ratio = torch.stack(stds).median(0).values / sigma
    assert ratio.min() == pytest.approx(0) or ratio.max() == pytest.approx(1.0, rel=1e-6)  # one eta, the tightest motor

    noise = normal(rng, 40_000, 2, 2)
    xs, us, _ = guide._replace(u=guide.u[:2], K=guide.K[:2], L=guide.L[:2]).sample(system, noise)
    sampled = torch.cov(us[:, 0].mT)
    torch.testing.assert_close(sampled, guide.L[0] @ guide.L[0].mT, rtol=0.05, atol=2e-4)
    log_q = guide._replace(x=guide.x[:3], u=guide.u[:2], K=guide.K[:2], L=guide.L[:2]).log_prob(system, xs, us)
    expected = torch.distributions.MultivariateNormal(torch.zeros(2).double(), scale_tril=guide.L[:2]).log_prob(
        torch.einsum("tij,mtj->mti", guide.L[:2], noise)
    )
    torch.testing.assert_close(log_q, expected, rtol=1e-9, atol=1e-9)


def test_indefinite_cost_raises_mu_and_ends_without_an_exception(rng: np.random.Generator) -> None:
    class Hill(Linear):
        def reward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            return -(0.1 * u.square()).sum(-1) - (x.square().sum(-1) - 1).square()

    system = Hill(rng)
    x, u, _ = system.rollout(normal(rng, 2, 3), 10, lambda t, _: torch.zeros(2, 2, dtype=torch.float64))
    cost = gps.Cost(system)
    before = cost.value(x[:, None], u[:, None]).sum(-1)[:, 0]
    plan = gps.ilqr(cost, x, u, 60)
    assert (plan.cost < 0.5 * before).all() and all(note in ("cost", "gradient", "iterations") for note in plan.note)
    torch.testing.assert_close(cost.value(plan.x[:, None], plan.u[:, None]).sum(-1)[:, 0], plan.cost)


def test_adapted_guide_without_reward_is_the_policy(rng: np.random.Generator) -> None:
    """Section 4.2 with r = 0: the I-projection of pi is its linearisation, with its covariance."""
    system = make_system("cartpole")
    one = torch.ones(1, dtype=torch.float64)
    policy = gps.Policy(6, torch.zeros(5).double(), torch.ones(5).double(), 0 * one, one, 0.2 * one)
    theta = policy.initial(torch.Generator().manual_seed(3))
    start = torch.tensor([[0.1, 2.0, 0.3, -0.2]], dtype=torch.float64)
    x, u, _ = system.rollout(start, 20, lambda t, s: 0.3 * torch.ones(1, 1).double())
    cost = gps.Cost(system, reward=False, log_policy=(policy, theta, 0.07))
    plan = gps.ilqr(cost, x, u, 50, mu=0.0)
    guide = gps.make_guides(cost, plan, policy.sigma, 1.0)[0]
    torch.testing.assert_close(guide.u, policy.mean(theta, system.observe(guide.x[:-1])), rtol=0, atol=1e-6)
    torch.testing.assert_close(guide.L, torch.full_like(guide.L, 0.2), rtol=1e-8, atol=0)
    slopes = torch.func.vmap(torch.func.jacrev(lambda s: policy.mean(theta, system.observe(s))))(guide.x[:-1])
    torch.testing.assert_close(guide.K, slopes, rtol=1e-6, atol=1e-6)


# The system


def random_state(system: gps.System, rng: np.random.Generator, count: int = 6) -> tuple[torch.Tensor, ...]:
    qpos, qvel, ctrl = acting_states(system.scene, count, rng)
    return torch.tensor(np.concatenate((qpos, qvel), 1)), torch.tensor(ctrl)


@pytest.mark.parametrize("env", ["cartpole", "hopper", "ant", "swimmer", "walker"])
def test_jacobians_are_those_of_differences(env: str, rng: np.random.Generator) -> None:
    system = make_system(env)
    x, u = random_state(system, rng)
    assert system.check_jacobians(x, u).max() < 1e-5
    following = system.rollout(x, 1, lambda t, _: u)[0][:, 1]
    alone = system.jacobians(x[2:3], u[2:3], following[2:3])
    together = system.jacobians(x, u, following)
    assert torch.equal(alone[0], together[2])  # environments do not know each other
    assert (together.abs().amax(0) > 0).any(0).all()  # no column that never reached the simulator


def test_jacobians_in_several_batches(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    system = make_system("hopper")
    x, u = random_state(system, rng)
    following = system.rollout(x, 1, lambda t, _: u)[0][:, 1]
    expected = system.jacobians(x, u, following)
    monkeypatch.setattr(dynamics, "BATCH", 4 * system.nd)  # six states: four, and four with an overlap of two
    assert torch.equal(system.jacobians(x, u, following), expected)


def test_tangents_of_a_free_joint(rng: np.random.Generator) -> None:
    system = make_system("ant")
    x, u = random_state(system, rng)
    tangent = normal(rng, 6, system.nd)
    moved = system.retract(x, tangent)
    torch.testing.assert_close(moved[:, 3:7].norm(dim=-1), torch.ones(6).double())
    torch.testing.assert_close(system.difference(moved, x), tangent, rtol=0, atol=1e-12)
    other = moved.clone()
    other[:, 3:7] *= -1  # the same rotation
    torch.testing.assert_close(system.difference(other, x), tangent, rtol=0, atol=1e-12)
    # to first order a body-frame rotation vector: that which the body's angular velocity integrates to
    rotating = x.clone()
    rotating[:, system.nq :] = 0
    rotating[:, system.nq + 3 : system.nq + 6] = torch.tensor([0.3, -0.2, 0.5])
    step = 1e-6 * torch.zeros(6, system.nd).double()
    step[:, 3:6] = 1e-6 * rotating[:, system.nq + 3 : system.nq + 6]
    quat, w = x[:, 3:7], 1e-6 * rotating[:, system.nq + 3 : system.nq + 6]
    turn = torch.cat((torch.ones(6, 1).double(), w / 2), 1)
    product = [
        quat[:, 0] * turn[:, 0] - (quat[:, 1:] * turn[:, 1:]).sum(1),
        *(quat[:, :1] * turn[:, 1:] + turn[:, :1] * quat[:, 1:] + torch.linalg.cross(quat[:, 1:], turn[:, 1:])).mT,
    ]
    torch.testing.assert_close(system.retract(x, step)[:, 3:7], torch.stack(product, 1), rtol=0, atol=1e-12)
    longer = x.clone()
    longer[:, 3:7] *= 1 + 1e-4
    following = system.rollout(x, 1, lambda t, _: u)[0][:, 1]
    expected = system.jacobians(x, u, following)
    atol = 1e-8 * expected.abs().max().item()
    torch.testing.assert_close(system.jacobians(longer, u, following), expected, rtol=1e-8, atol=atol)


@pytest.mark.parametrize("env, flags", [("ant", ""), ("cartpole", ""), ("hopper", "--reward native")])
def test_quadratic_of_the_reward(env: str, flags: str, rng: np.random.Generator) -> None:
    """Gradient in (x_t, u_t) through the step, against central differences of the reward after it."""
    system = make_system(env, *flags.split())
    start, u = random_state(system, rng, 3)
    x = system.rollout(start, 1, lambda t, _: u)[0]
    f_z = gps.step_jacobian(system, x, u[:, None])
    gradient, hessian = gps.Cost(system).quadratic(x, u[:, None], f_z)
    assert torch.linalg.eigvalsh(hessian).min() > -1e-6 * hessian.abs().max()
    eps, directions = 1e-6, normal(rng, 4, system.nd + system.nu)
    for d in directions:

        def cost(s: float, d: torch.Tensor = d) -> torch.Tensor:
            action = u + s * d[system.nd :]
            at = system.retract(start, s * d[: system.nd].expand(3, -1))
            return -system.reward(system.rollout(at, 1, lambda t, _: action)[0][:, 1], action)

        slope = (cost(eps) - cost(-eps)) / (2 * eps)
        torch.testing.assert_close(gradient[:, 0] @ d, slope, rtol=1e-4, atol=1e-4 * slope.abs().max().item())


def test_reward_of_the_paper() -> None:
    system = make_system("hopper", "--target-velocity", "1.5", "--target-height", "1.2", "--action-cost", "0.01")
    x = torch.zeros(12, dtype=torch.float64)
    x[1], x[2], x[6] = 0.1, 0.2, 2.0
    u = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
    expected = -(0.01 * 5.25 + 0.5**2 + 10 * (1.25 + 0.1 - 1.2) ** 2 + 0.2**2)
    assert system.reward(x, u).item() == pytest.approx(expected)


def test_a_trajectory_that_blows_up_stays_where_it_was() -> None:
    system = make_system("cartpole")
    start = torch.zeros(3, 4, dtype=torch.float64)
    wild = torch.tensor([[0.0], [math.nan], [0.0]], dtype=torch.float64)
    x, u, finite = system.rollout(start, 5, lambda t, _: wild if t == 2 else 0 * wild.nan_to_num())
    assert finite.tolist() == [[True] * 5, [True, True, False, False, False], [True] * 5]
    assert torch.isfinite(x).all() and torch.isfinite(u).all() and torch.equal(x[1, 2], x[1, 5])


# Importance sampling


def a_policy(rng: np.random.Generator, obs: int = 3, nu: int = 2, hidden: int = 5) -> tuple[gps.Policy, torch.Tensor]:
    one = torch.ones(nu, dtype=torch.float64)
    policy = gps.Policy(hidden, normal(rng, obs), 1 + normal(rng, obs).abs(), 0 * one, 2 * one, 0.5 * one)
    return policy, normal(rng, sum(math.prod(shape) for shape in policy.shapes))


def a_set(rng: np.random.Generator, m: int = 15, T: int = 9, n: int = 3) -> tuple[torch.Tensor, ...]:
    return normal(rng, m, T, 3), normal(rng, m, T, 2), normal(rng, m, T), 0.3 * normal(rng, m, n, T).cumsum(2) - 5


@pytest.mark.parametrize("w_r", [0.0, 1e-2, 3.0])
def test_gradient_of_phi_is_that_of_appendix_a(w_r: float, rng: np.random.Generator) -> None:
    """And of central differences: G1."""
    policy, theta = a_policy(rng)
    obs, u, reward, log_q = a_set(rng)
    u = policy.mean(theta, obs) + 0.6 * u  # likely enough under the policy that no product underflows
    mixture = gps.log_mixture(log_q)

    def objective(theta: torch.Tensor) -> torch.Tensor:
        return gps.phi(policy.log_prob(theta, obs, u), mixture, reward, w_r)

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

    direction, eps = normal(rng, len(theta)), 1e-5
    slope = (objective(theta + eps * direction) - objective(theta - eps * direction)) / (2 * eps)
    assert slope.item() == pytest.approx((gradient @ direction).item(), rel=1e-6)
    expected = (weight * reward).sum() + w_r * ratio.mean(0).log().sum()
    assert objective(theta).item() == pytest.approx(expected.item(), rel=1e-12)


def test_mixture_is_of_prefixes(rng: np.random.Generator) -> None:
    """Not a product of per-step mixtures: with components this unlike the two are many nats apart."""
    per_step = torch.tensor([[[0.0, -20.0, 0.0], [-20.0, 0.0, -20.0]]], dtype=torch.float64)
    expected = [[math.log((math.exp(a) + math.exp(b)) / 2) for a, b in ((0, -20), (-20, -20), (-20, -40))]]
    torch.testing.assert_close(gps.log_mixture(per_step.cumsum(2)), torch.tensor(expected, dtype=torch.float64))


def test_adding_a_constant_to_all_densities(rng: np.random.Generator) -> None:
    _, _, reward, log_q = a_set(rng)
    log_pi = normal(rng, *reward.shape)
    one, other = (gps.phi(log_pi, gps.log_mixture(q), reward, 0.5) for q in (log_q, log_q + 300))
    assert (one - other).item() == pytest.approx(0.5 * 300 * reward.shape[1], rel=1e-12)
    one, other = (gps.phi(log_pi, gps.log_mixture(q), reward, 0.0) for q in (log_q, log_q + 300))
    assert one.item() == pytest.approx(other.item(), rel=1e-10)


def scalar_rollouts(
    rng: np.random.Generator, m: int, gains: tuple[float, ...], std: float, T: int = 5
) -> tuple[torch.Tensor, ...]:
    """x' = 0.9 x + 0.5 u from x = 1 under u ~ N(-gain x, std^2), as many of each gain: states, actions, rewards."""
    gain = np.repeat(gains, m // len(gains))
    x, states, actions, rewards = np.ones(m), [], [], []
    for _ in range(T):
        u = -gain * x + std * rng.normal(size=m)
        states.append(x)
        actions.append(u)
        x = 0.9 * x + 0.5 * u
        rewards.append(-(x**2) - 0.1 * u**2)
    return tuple(torch.tensor(np.stack(column, 1)) for column in (states, actions, rewards))


def scalar_log_prob(x: torch.Tensor, u: torch.Tensor, gain: float, std: float) -> torch.Tensor:
    return -0.5 * ((u + gain * x) / std).square() - math.log(std) - 0.5 * math.log(2 * math.pi)


def test_estimate_is_unbiased_and_its_error_falls(rng: np.random.Generator) -> None:
    """G3: E_pi of the return of a linear-Gaussian system, in closed form, from two other controllers' samples."""
    gain, std, T = 0.6, 0.3, 5
    mean, variance, expected = 1.0, 0.0, 0.0
    for _ in range(T):
        u_mean, u_variance = -gain * mean, gain**2 * variance + std**2
        mean, variance = (0.9 - 0.5 * gain) * mean, (0.9 - 0.5 * gain) ** 2 * variance + 0.25 * std**2
        expected -= mean**2 + variance + 0.1 * (u_mean**2 + u_variance)

    def estimate(m: int) -> tuple[float, torch.Tensor]:
        x, u, reward = scalar_rollouts(rng, m, (0.3, 0.9), 0.4)
        log_q = torch.stack([scalar_log_prob(x, u, g, 0.4).cumsum(1) for g in (0.3, 0.9)], 1)
        log_pi, mixture = scalar_log_prob(x, u, gain, std), gps.log_mixture(log_q)
        return gps.phi(log_pi, mixture, reward, 0.0).item(), gps.log_weights(log_pi, mixture).exp()

    few, many = (np.array([estimate(m)[0] for _ in range(200)]) for m in (200, 1800))
    for values in (few, many):
        assert abs(values.mean() - expected) < 3 * values.std() / np.sqrt(len(values)) + 2e-3
    assert few.std() / many.std() == pytest.approx(3.0, rel=0.25)
    z = estimate(200_000)[1]
    assert ((z.mean(0) - 1).abs() < 3 * z.std(0) / math.sqrt(len(z))).all()


def test_maximise_finds_the_optimum_of_a_bandit(rng: np.random.Generator) -> None:
    """T = 1, reward -(u - 0.7)^2: whatever the variance, the best mean is 0.7."""
    one = torch.ones(1, dtype=torch.float64)
    policy = gps.Policy(1, 0 * one, one, 0 * one, one, 0.3 * one)
    u = torch.tensor(rng.uniform(-3, 4, size=(20_000, 1, 1)))
    obs, flat = torch.zeros(20_000, 1, 1, dtype=torch.float64), torch.full((20_000, 1), -math.log(7.0)).double()
    reward = -(u[..., 0] - 0.7).square()
    theta = policy.initial(torch.Generator().manual_seed(0))
    objective = lambda t: gps.phi(policy.log_prob(t, obs, u), flat, reward, 0.0)  # noqa: E731
    best, value = gps.maximise(objective, theta, 50)
    assert policy.mean(best, obs[0, 0]).item() == pytest.approx(0.7, abs=0.02)
    assert value == pytest.approx(-0.09, rel=0.05)


def test_maximise_returns_the_best_finite_point() -> None:
    start = torch.full((2,), 0.9, dtype=torch.float64)
    best, value = gps.maximise(lambda t: (1 - t.square().sum()).log(), start / 2, 30)
    assert value == pytest.approx(0.0, abs=1e-8) and best.abs().max() < 1e-4
    best, value = gps.maximise(lambda t: -t.sum() * math.nan, start, 5)
    assert torch.equal(best, start) and value == -math.inf


def test_policy_has_the_papers_1256_parameters(rng: np.random.Generator) -> None:
    policy, _ = a_policy(rng, obs=18, nu=6, hidden=50)
    assert len(policy.initial(torch.Generator())) == 1256


def test_regulariser_schedule() -> None:
    w, seen = 1e-4, []
    for accepted in (True, True, True, False, False, False, False, False, False, True):
        w = gps.next_regularizer(w, accepted, (1e-6, 1e-2))
        seen.append(w)
    np.testing.assert_allclose(seen, [1e-5, 1e-6, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-2, 1e-2, 1e-3])


# The script


def run(path: Path, *arguments: object) -> dict[str, Any]:
    gps.main([*map(str, arguments), "--run-dir", str(path)])
    return torch.load(path / "checkpoint.pt", weights_only=True)


@pytest.fixture(autouse=True)
def called_gps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its messages begin with the script's name."""
    monkeypatch.setattr(sys, "argv", ["gps.py"])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trained")
    run(path, *SMALL)
    return path


@pytest.fixture
def checkpoint(trained: Path) -> dict[str, Any]:
    return torch.load(trained / "checkpoint.pt", weights_only=True)


def assert_same(value: Any, expected: Any) -> None:
    if isinstance(expected, torch.Tensor):
        assert torch.equal(value, expected)
    elif isinstance(expected, dict):
        assert value.keys() == expected.keys()
        for key in expected:
            assert_same(value[key], expected[key])
    elif isinstance(expected, (list, tuple)):
        assert len(value) == len(expected)
        for pair in zip(value, expected, strict=True):
            assert_same(*pair)
    else:
        assert value == expected or value != value


def test_resume_continues_exactly(trained: Path, tmp_path: Path, checkpoint: dict[str, Any]) -> None:
    run(tmp_path, *SMALL, "--stop-after", 2)
    gps.main(["--resume", str(tmp_path / "checkpoint.pt")])
    resumed = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    for name in checkpoint.keys() - {"seconds"}:
        assert_same(resumed[name], checkpoint[name])
    with (tmp_path / "progress.csv").open() as file:
        assert [int(row["iteration"]) for row in csv.DictReader(file)] == [0, 1, 2, 3, 4]


def test_seeds(tmp_path: Path, checkpoint: dict[str, Any]) -> None:
    other = run(tmp_path, *SMALL, "--seed", 2, "--iterations", 1)
    assert not torch.equal(other["search"]["theta"], checkpoint["search"]["theta"])


def test_files_of_a_run(trained: Path, checkpoint: dict[str, Any]) -> None:
    arguments = json.loads((trained / "args.json").read_text())
    assert arguments["hidden"] == 8 and arguments["action_cost"] == 1e-3
    with (trained / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    steps = [int(row["control_steps"]) for row in rows]
    assert steps[0] == 30 * (8 + 8 + 8 + 4)  # guiding samples, those of pretraining, a network's and the policy's own
    # Before a proposal is accepted it is drawn again; a rejection draws the best policy's samples again.
    for drawn, row in zip(np.diff(steps) // 30, rows[1:], strict=True):
        assert drawn in ((4 + 8,) if row["accepted"] == "1.0" else (4 + 4, 4 + 8 + 4))
    assert [bool(row["eval_return"]) for row in rows] == [False, False, True, False, True]
    assert len(checkpoint["search"]["set"][1]) <= 24
    assert not list(trained.glob("*.tmp"))


def test_guides_reproduce_the_plan(checkpoint: dict[str, Any]) -> None:
    """G4: their mean return is within 1 % of the plan's, and they spread by less."""
    mean, std = checkpoint["search"]["guide_return"]
    plan = checkpoint["search"]["example_return"]
    assert abs(mean - plan) < 0.01 * abs(plan) and 0 < std < 0.01 * abs(plan)


def test_lessons_are_the_guides_means_about_a_wider_path(checkpoint: dict[str, Any]) -> None:
    search = search_of(checkpoint)
    search.args.pretraining_samples, guide = 400, search.guides[0]

    def spread(factor: float) -> torch.Tensor:
        search.args.pretraining_spread = factor
        obs, u = search.lessons()
        assert obs.shape == (400, 30, 5) and u.shape == (400, 30, 1)
        torch.testing.assert_close(u[:, 0], guide.u[:1].expand(400, 1))  # without noise at the start, which all share
        return (u[:, 1] - guide.u[1]).std()

    ratio = spread(0.1) / spread(0.01)  # small: at this plan the motor is in the tail of its tanh
    torch.testing.assert_close(ratio, torch.tensor(10.0).double(), rtol=0.15, atol=0)


def test_labels_are_the_guides_means_until_a_trajectory_leaves_the_lessons(checkpoint: dict[str, Any]) -> None:
    search = search_of(checkpoint)
    guide, (lessons, _) = search.guides[0], search.lessons()  # 8 trajectories
    samples = search.measure(*guide.sample(search.system, 0.1 * search.noise(2)))
    samples.obs[1, 12] += 10.0  # the second trajectory leaves at step 12, and what it does later counts no more
    obs, u = search.label(guide, lessons, samples)
    x = torch.cat((samples.x[0, :30], samples.x[1, :12]))
    path, K = (torch.cat((tensor[:30], tensor[:12])) for tensor in (guide.x, guide.K))
    mean = torch.cat((guide.u, guide.u[:12])) + (K @ (x - path).unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(u, mean[::4])  # as many of its steps as 2 of the 8 lessons
    torch.testing.assert_close(obs, search.system.observe(x)[::4])


def test_pretraining_learns_from_the_states_that_a_network_visited(
    checkpoint: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    search, sizes, starts = search_of(checkpoint), [], []

    def maximise(objective: Any, theta: torch.Tensor, iterations: int) -> tuple[torch.Tensor, float]:
        with monkeypatch.context() as patch:
            patch.setattr(gps.Policy, "log_prob", lambda policy, theta, obs, u: sizes.append(len(obs)) or theta)
            objective(theta)
        starts.append(theta)
        return theta + 1.0, 0.0

    monkeypatch.setattr(gps, "maximise", maximise)
    monkeypatch.setattr(search, "label", lambda guide, lessons, samples: (samples.obs[:, 0], samples.u[:, 0]))
    search.guide_return = 0.0, 0.0  # out of reach
    search.pretrain(*search.lessons(), attempts=3)
    assert sizes == [8 * 30, 8 * 30 + 8, 8 * 30 + 16]  # each time the first steps of 8 trajectories join
    assert torch.equal(starts[1], starts[0] + 1.0) and torch.equal(starts[2], starts[1] + 1.0)  # from the last network


def search_of(checkpoint: dict[str, Any]) -> gps.Search:
    args = gps.Args(**checkpoint["args"])
    search = gps.Search(args, gps.make_system(args))
    search.load_state_dict(checkpoint["search"])
    return search


def test_active_set(checkpoint: dict[str, Any]) -> None:
    """All guiding samples, the newest of the best policy, and a planted sample of high weight."""
    search = search_of(checkpoint)
    other = search.theta + 0.01
    planted = int(search.append(other, search.draw(other, len(search.generators)))[-1])
    S = search.set
    log_q = S.log_q.clone()
    log_q[planted] -= 1e3
    search.set = S._replace(log_q=log_q)
    chosen = set(search.choose().tolist())
    guiding, own = (S.source == 0).nonzero().flatten(), (S.source == search.best).nonzero().flatten()[-4:]
    assert {planted, *guiding.tolist(), *own.tolist()} <= chosen and len(chosen) == 16


def test_densities_of_the_set_are_those_of_its_generators(checkpoint: dict[str, Any]) -> None:
    """After all appending and pruning, and each sample was more likely where it came from than it is elsewhere."""
    search = search_of(checkpoint)
    S = search.set
    for j, generator in enumerate(search.generators):
        torch.testing.assert_close(S.log_q[:, j], search.log_density(generator, S), rtol=1e-9, atol=1e-9)
    own = S.log_q[torch.arange(len(S.u)), S.source, -1]
    assert (own >= S.log_q[:, :, -1].median(1).values).double().mean() > 0.9
    torch.testing.assert_close(search.theta, search.generators[search.best])


@pytest.mark.parametrize(
    "variant", ["unregularized", "nonguided", "restart", "single-example", "policy-gradient", "dagger"]
)
def test_variants(variant: str, tmp_path: Path) -> None:
    search = run(tmp_path, *SMALL, "--variant", variant, "--iterations", 2)["search"]
    guided = variant in ("unregularized", "dagger")
    assert any(isinstance(g, tuple) for g in search["generators"]) == guided
    if variant == "unregularized":
        assert search["w_r"] == 0
    if variant == "restart":
        starts = search["set"][0][:, 0]
        assert len(starts.unique(dim=0)) > 3


def test_adaptive_guides_join_the_set(tmp_path: Path) -> None:
    search = run(tmp_path, *SMALL, "--adaptive", 1, "--adaptive-iterations", 3, "--iterations", 2)["search"]
    assert len(search["adapted"]) == 1
    assert sum(isinstance(g, tuple) for g in search["generators"]) == 2


def test_evaluation(trained: Path, checkpoint: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    """It repeats the last one of training and leaves the search as it was; the first trajectory has no noise."""
    before = (trained / "checkpoint.pt").read_bytes()
    gps.main(["--evaluate", str(trained / "checkpoint.pt")])
    assert (trained / "checkpoint.pt").read_bytes() == before
    with (trained / "progress.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert f"without noise {float(last['eval_without_noise']):.2f}; plan" in capsys.readouterr().out
    search = search_of(checkpoint)
    evaluation, scalars, _ = gps.evaluate(search)
    assert evaluation.qpos.shape == (31, 4, 2) and evaluation.lengths.tolist() == [30] * 3
    assert scalars["eval/objective"] == pytest.approx(float(last["eval_objective"]))
    act = benchmark.controllers(search)["policy"]
    x, u, _ = search.system.rollout(search.start[None], 30, act)
    assert scalars["eval/without_noise"] == pytest.approx(search.system.reward(x[:, 1:], u).sum().item())


def test_an_evaluation_ends_where_the_robot_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    """The step that ends an episode still counts, as in an environment; nothing after it does."""
    system = make_system("hopper", "--horizon", "400", "--eval-episodes", "2")
    search = gps.Search(system.args, system)
    one = torch.ones(system.nu, dtype=gps.REAL)
    search.policy = gps.Policy(1, torch.zeros(11).double(), torch.ones(11).double(), 0 * one, one, 0.1 * one)
    search.theta = torch.zeros(11 + 1 + 3 + 3, dtype=gps.REAL)
    monkeypatch.setattr(gps.Search, "start", system.start()[0])
    evaluation, _, _ = gps.evaluate(search)
    env = diffsim.make("hopper", 2, horizon=1, dtype=gps.REAL, stochastic_init=False)
    noise = search.noise(3, torch.Generator().manual_seed(gps.EVALUATION_SEED))[1:]
    env.reset()
    returns: dict[int, tuple[int, float]] = {}
    for t in range(400):
        terminated, _, info = env.step(torch.tanh(0.1 * noise[:, t]))[2:]
        for e in terminated.nonzero().flatten().tolist():
            returns.setdefault(e, (t + 1, info["episode"]["r"][e].item()))
    for e in range(2):
        assert evaluation.lengths[e] == returns[e][0] < 400
        assert evaluation.returns[e].item() == pytest.approx(returns[e][1], rel=1e-6)


def test_benchmark(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Tables and pictures of a run; a second time from the tables alone."""
    run = tmp_path / "runs" / "cartpole__full__1"
    run.mkdir(parents=True)
    for name in ("checkpoint.pt", "progress.csv", "args.json"):
        (run / name).write_bytes((trained / name).read_bytes())
    options = ["--runs", str(tmp_path / "runs"), "--docs", str(tmp_path / "docs"), "--count", "4", "--draw-only"]
    benchmark.main(options)
    results = tmp_path / "docs" / "results"
    with (results / "gps_generalisation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["controller"] for row in rows} == {"policy", "ddp", "tbdp"}
    plan = torch.load(trained / "checkpoint.pt", weights_only=True)["search"]["example_return"]
    ddp = next(row for row in rows if row["controller"] == "ddp" and float(row["size"]) == 0)
    assert float(ddp["mean"]) == pytest.approx(plan, rel=1e-9)  # unperturbed, it repeats the plan
    assert "| cartpole | full | 1 | 30 |" in (results / "gps.md").read_text()
    before = {path: path.read_bytes() for path in results.iterdir()}
    benchmark.main([*options, "--runs", str(tmp_path / "nowhere")])
    assert before == {path: path.read_bytes() for path in results.iterdir()}
    assert len(list((tmp_path / "docs").glob("gps_*.png"))) == 3


def test_nearest_controller_acts_by_the_nearest_state(checkpoint: dict[str, Any]) -> None:
    search = search_of(checkpoint)
    guide, act = search.guides[0], benchmark.controllers(search)
    torch.testing.assert_close(act["tbdp"](0, guide.x[20:21]), guide.u[20:21])
    torch.testing.assert_close(act["ddp"](20, guide.x[20:21]), guide.u[20:21])
    assert not torch.equal(act["ddp"](0, guide.x[20:21]), guide.u[20:21])


def test_demonstration_of_shac(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A recording is what shac.py's own policy does, and guides are built around it."""
    shac.main(f"--env cartpole --num-envs 2 --iterations 1 --eval-episodes 1 --quiet --run-dir {tmp_path}/shac".split())
    demonstration, actor = tmp_path / "demo.npz", tmp_path / "shac" / "checkpoint.pt"
    benchmark.main(["--record", str(demonstration), "--actor", str(actor), "--steps", "250"])
    data = np.load(demonstration)
    assert data["qpos"].shape == (251, 2) and np.abs(np.diff(data["qpos"], axis=0)).max() < 1  # no reset
    qpos, qvel, action = (torch.tensor(data[name]) for name in ("qpos", "qvel", "action"))
    sim = diffsim.make("cartpole", 250).sim
    for value, expected in zip(sim.step(qpos[:-1], qvel[:-1], action), (qpos[1:], qvel[1:]), strict=True):
        torch.testing.assert_close(value, expected)
    result = run(tmp_path / "gps", *SMALL, "--demonstration", demonstration, "--iterations", 1)
    assert result["search"]["guides"][0][0][0].tolist() == [*data["qpos"][0], *data["qvel"][0]]
    capsys.readouterr()
    for text, message in (
        (["--horizon", "400"], "qpos has shape (251, 2), must be at least (401, 2) for 400 steps"),
        (["--env", "hopper"], "must be at least (501, 6)"),
    ):
        with pytest.raises(SystemExit) as exit:
            run(tmp_path / "none", *SMALL[:2], *text, "--demonstration", demonstration)
        assert exit.value.code == 2 and message in capsys.readouterr().err
    with pytest.raises(SystemExit) as exit:
        benchmark.main(["--record", str(demonstration)])
    assert exit.value.code == 2 and "--record needs --actor" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "--env anty",
            "unknown task 'anty': choose from cartpole, hopper, half_cheetah, ant",
        ),
        ("--horizon 1", "--horizon must be at least 2, not 1"),
        ("--guiding-samples 1", "--guiding-samples must be at least 2, not 1"),
        ("--active 20", "--active must be at least 50, not 20"),
        ("--noise 0", "--noise must be positive, not 0.0"),
        ("--initial-regularizer -1", "--initial-regularizer must not be negative, not -1.0"),
        ("--regularizer-bounds 1 0.1", "--regularizer-bounds must be two numbers in order"),
        ("--substeps 0", "substeps"),
        ("--device nonsense", "nonsense"),
        ("--reward target", "cartpole has --reward native"),
        ("--demonstration {file}.npz", "no such trajectory: {file}.npz"),
        ("--demonstration {file}", "{file} is not an .npz with qpos, qvel and action"),
        ("--run-dir {file}", "cannot write to run directory {file}: Not a directory"),
        ("--run-dir {trained}", "{trained} holds another run's checkpoint.pt"),
        ("--resume {file}.pt", "no such checkpoint: {file}.pt"),
        ("--evaluate {file}", "{file} is not a whole checkpoint of gps.py"),
        ("--evaluate {trained}/checkpoint.pt --env ant", "has --env cartpole, not ant"),
        ("--resume {trained}/checkpoint.pt --hidden 9", "has --hidden 8, not 9"),
        ("--resume {trained}/checkpoint.pt", "is at iteration 4 already"),
        ("--resume {file} --evaluate {file}", "--resume and --evaluate exclude each other"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: str, message: str, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refuses(gps, arguments, message, trained, tmp_path, capsys)
