"""Guided policy search (Levine and Koltun 2013, https://proceedings.mlr.press/v28/levine13.html).

Trajectory optimisation finds where reward is and becomes a distribution, whose samples guide an importance-sampled
policy search (Algorithm 1). Its dynamic programming takes exact Jacobians from the simulator's backward pass.

    python gps.py --env cartpole --seed 1                          train; writes runs/cartpole__gps__1__<time>/
    python gps.py --env hopper --demonstration hop.npz             plan from a recorded trajectory (benchmarks/gps.py)
    python gps.py --resume runs/cartpole__gps__1__<time>/checkpoint.pt     continue an interrupted run exactly
    python gps.py --evaluate runs/cartpole__gps__1__<time>/checkpoint.pt   evaluate its best policy
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
import tyro
from diffsim.evaluation import SEED as EVALUATION_SEED
from diffsim.evaluation import Evaluation, write_video
from diffsim.run import Mark, Run, fail, flag, read_arguments
from torch import Tensor

import diffsim
from diffsim import distributed
from diffsim.dynamics import REAL, Dynamics
from diffsim.ilqr import (
    Plan,
    backward_pass,
    follow,
    ilqr,
    quadratic_after_step,
    starting_actions,
    step_jacobian,
    symmetric,
)
from diffsim.simulator import check_device
from diffsim.tasks import TASKS

# Those of Figure 2
Variant = Literal["full", "unregularized", "nonguided", "restart", "single-example", "policy-gradient", "dagger"]


@dataclass
class Args:
    env: Annotated[str, tyro.conf.arg(aliases=["--env-id"])] = "cartpole"
    """task: cartpole, hopper, half_cheetah, ant, humanoid, swimmer or walker"""
    seed: int = 1
    """seed of the planner's starts, the networks and all noise"""
    device: str | None = None
    """torch device of simulation and learning, e.g. cpu or cuda:0; None: the GPU if there is one"""
    threads: int | None = None
    """CPU threads of the simulator, which change no result; None: all cores"""
    variant: Variant = "full"
    """the algorithm, or what its Figure 2 compares it with"""

    iterations: int = 80
    """iterations K of the policy search"""
    horizon: int | None = None
    """control steps T of a trajectory; None: per task"""
    substeps: int | None = None
    """simulation steps per control step; None: per --accuracy"""
    integrator: Literal["semi_implicit", "implicit", "extrapolated"] | None = None
    """time integration of the simulator; None: per --accuracy"""
    accuracy: Literal["fast", "default", "accurate"] | None = None
    """the task's preset of integrator and substeps (docs/accuracy.md); None: default, the paper's"""
    reward: Literal["native", "target"] | None = None
    """the task's own reward, or the paper's: squared errors of velocity and height; None: per task"""
    action_cost: float | None = None
    """w_u: cost of the squared action before tanh, in both rewards; None: per task"""
    target_velocity: float | None = None
    """v_x* of the paper's reward, m/s, with weight 1; None: per task"""
    target_height: float | None = None
    """p_y* of the paper's reward, m; None: per task"""
    height_weight: float | None = None
    """w_h of the paper's reward; None: per task"""
    attitude_weight: float | None = None
    """weight of the trunk's squared rotation, beside the paper's three terms; None: per task"""

    demonstration: Path | None = None
    """start from this trajectory instead of --restarts: an .npz with qpos (T+1, nq), qvel (T+1, nv), action (T, nu)"""
    restarts: int = 16
    """random action sequences from which trajectory optimisation starts; the best are kept"""
    guides: int = 1
    """guiding distributions n, from as many of the best trajectories"""
    screening: int = 40
    """iLQR iterations of all restarts"""
    ilqr_iterations: int = 300
    """further iLQR iterations of the best"""
    tracking: float = 0.05
    """weight of the squared deviation from the example in the initial guiding distributions (Section 6)"""
    spread: float = 1.0
    """standard deviation of the guiding actions, relative to the policy's: sets the temperature of exp(reward)"""
    guiding_samples: int = 40
    """trajectories drawn from the guiding distributions"""
    adaptive: int = 0
    """the first so many iterations adapt the guides to the policy (Section 4.2; the paper: 40)"""
    adaptive_iterations: int = 50
    """iLQR iterations of an adaptation"""

    hidden: int | None = None
    """units of the policy's hidden layer; None: per task"""
    noise: float | None = None
    """the policy's standard deviation, relative to that of the planned actions over time; None: per task"""
    pretraining: int = 1500
    """L-BFGS iterations of the first fit to the guiding samples"""
    pretraining_samples: int = 200
    """trajectories of that fit, with the guides' mean actions; 0: the guiding samples with their own, as the paper"""
    pretraining_spread: float = 3.0
    """standard deviation of these trajectories' actions, relative to the guides': shows what to do off the path"""
    gate: int = 10
    """fits, each with the states that the last one visited, until one follows the guides; or the best is taken"""
    samples: int = 10
    """trajectories of the policy per iteration"""
    active: int = 100
    """trajectories in the active set S_k"""
    stored: int = 300
    """trajectories kept to choose from"""
    lbfgs_iterations: int = 60
    """L-BFGS iterations of each of an iteration's two optimisations"""
    initial_regularizer: float = 1e-2
    """w_r at the start"""
    regularizer_bounds: tuple[float, float] = (1e-4, 1.0)
    """w_r is changed by factors of ten between these"""
    step: float = 0.1
    """policy-gradient: length of a step along the normalised gradient"""

    eval_every: int = 10
    """evaluate the best policy every this many iterations (0: only at the end)"""
    eval_episodes: int = 50
    """trajectories of an evaluation"""
    save_every: int = 10
    """save the checkpoint every this many iterations (0: only at the end)"""
    stop_after: int | None = None
    """stop at this iteration as Ctrl-C would: saved, to be resumed"""
    run_dir: Path | None = None
    """directory of the run; None: runs/{env}__gps__{seed}__{time}, or that of the checkpoint resumed"""
    resume: Path | None = None
    """checkpoint to continue from; its arguments hold where the command line gives no other"""
    evaluate: Path | None = None
    """checkpoint to evaluate, without training"""
    capture_video: bool = False
    """write a video of the final policy"""
    track: bool = False
    """also log to Weights & Biases (pip install wandb)"""
    quiet: bool = False
    """no progress line"""


# fmt: off
COLUMNS = ("horizon", "reward", "action_cost", "target_velocity", "target_height", "height_weight", "attitude_weight",
           "hidden", "noise")
PER_TASK = {
    "cartpole":     (240, "native", 1e-3, 0.0, 0.0,   0.0, 0.0,  50, 0.10),
    "hopper":       (500, "target", 1e-1, 1.5, 1.25, 10.0, 1.0,  50, 0.10),
    "half_cheetah": (500, "target", 1e-1, 3.0, 0.8,   1.0, 0.1,  50, 0.10),
    "ant":          (500, "target", 1e-2, 3.0, 0.75, 10.0, 0.1, 100, 0.10),
    "humanoid":     (500, "target", 1e-2, 2.5, 1.3,  10.0, 0.1, 200, 0.01),
    "swimmer":      (500, "target", 1e-1, 2.0, 0.0,   0.0, 0.0,  50, 0.10),
    "walker":       (500, "target", 1e-1, 1.2, 1.35, 10.0, 0.0,  50, 0.10),
}
DEFAULT =           (500, "native", 1e-3, 0.0, 0.0,   0.0, 0.0,  50, 0.10)

PROGRESS = {  # scalar of tensorboard: column of progress.csv, beside iteration, control_steps and seconds (of training)
    "charts/episodic_return": "return", "eval/return": "eval_return", "eval/length": "eval_length",
    "eval/speed": "eval_speed", "eval/objective": "eval_objective", "eval/objective_std": "eval_objective_std",
    "eval/without_noise": "eval_without_noise", "gps/plan": "plan", "gps/guides": "guides",
    "gps/guides_std": "guides_std", "gps/fit": "fit", "gps/objective": "objective",
    "gps/objective_std": "objective_std", "gps/phi": "phi", "gps/estimate": "estimate",
    "gps/best_estimate": "best_estimate", "gps/accepted": "accepted", "gps/start": "start",
    "gps/regularizer": "regularizer", "gps/ess": "ess", "gps/ess_min": "ess_min", "gps/guide_share": "guide_share",
    "gps/log_weight_spread": "log_weight_spread", "sim/nonfinite": "nonfinite", "sim/model_steps": "model_steps",
}
# fmt: on
FIXED = ("env", "variant", "horizon", "hidden", "guides", "reward", "samples")  # by a checkpoint
FORMAT = "gps-1"  # of checkpoints


# The system -----------------------------------------------------------------------------------------------------------


class System(Dynamics):
    """A task's robot with what is observed and rewarded. States x, actions u before tanh: see Dynamics."""

    def __init__(self, args: Args) -> None:
        self.args, self.task = args, TASKS[args.env](check_device(args.device), REAL)
        scene = diffsim.load_scene(str(files("diffsim") / "assets" / self.task.asset))
        preset = self.task.integration(args.accuracy or "default")
        integration = preset.replaced(args.integrator, args.substeps, None)
        args.integrator, args.substeps, _ = integration
        super().__init__(scene, self.task.control_dt, integration, args.device, args.threads)
        self.root_height = 0.0 if scene.floating else float(scene.mj_model.body_pos[1, 2])
        self.no_action = torch.zeros(self.nu, dtype=REAL, device=self.device)
        self.demonstration: tuple[Tensor, Tensor] | None = None  # x (T + 1, nx), u (T, nu)
        self.nonfinite = 0

    def start(self) -> Tensor:
        """(1, nx) the task's unperturbed start."""
        middle = torch.full((1, self.task.num_random), 0.5, dtype=REAL, device=self.device)
        return torch.cat(self.task.reset(middle), -1)

    def observe(self, x: Tensor) -> Tensor:
        """What the policy sees. A previous action, which ant and humanoid observe, is not of the state: it is zero."""
        action = self.no_action.expand(*x.shape[:-1], -1)
        return self.task.observe(x[..., : self.nq], x[..., self.nq :], action)

    def native(self, x: Tensor, u: Tensor) -> Tensor:
        """The task's own reward (...) of u (..., nu), which led to x (..., nx)."""
        action = torch.tanh(u)
        return self.task.reward(self.task.observe(x[..., : self.nq], x[..., self.nq :], action), action)

    def reward(self, x: Tensor, u: Tensor) -> Tensor:
        """What is optimised, of u (..., nu), which led to x (..., nx)."""
        args = self.args
        cost = args.action_cost * u.square().sum(-1)
        if args.reward == "native":
            return self.native(x, u) - cost
        height = x[..., 2] if self.scene.floating else x[..., 1] + self.root_height
        attitude = 4.0 * x[..., 4:7].square().sum(-1) if self.scene.floating else x[..., 2].square()
        cost = cost + (x[..., self.nq] - args.target_velocity).square()
        cost = cost + args.height_weight * (height - args.target_height).square()
        return -(cost + args.attitude_weight * attitude)


# Guiding distributions ------------------------------------------------------------------------------------------------


class Cost(NamedTuple):
    """Cost of R trajectories: minus the reward, and what guides add to it."""

    system: System
    reward: bool = True
    reference: tuple[Tensor, Tensor] | None = None  # x (R, T + 1, nx), u (R, T, nu) to be tracked with this weight:
    tracking: float = 0.0
    log_policy: tuple[Policy, Tensor, float] | None = None  # -eta log pi_theta (Section 4.2)

    def value(self, x: Tensor, u: Tensor) -> Tensor:
        """(R, A, T) of x (R, A, T + 1, nx), u (R, A, T, nu): A candidates for each of the R."""
        cost = -self.system.reward(x[..., 1:, :], u) if self.reward else torch.zeros_like(u[..., 0])
        if self.reference:
            dx = self.system.difference(x[..., :-1, :], self.reference[0][:, None, :-1])
            cost = cost + self.tracking * (dx.square().sum(-1) + (u - self.reference[1][:, None]).square().sum(-1))
        if self.log_policy:
            policy, theta, eta = self.log_policy
            cost = cost - eta * policy.log_prob(theta, self.system.observe(x[..., :-1, :]), u)
        return cost

    def quadratic(self, x: Tensor, u: Tensor, f_z: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient (R, T, nz) and positive semidefinite Hessian (R, T, nz, nz) in z = (tangent of x_t, u_t)."""
        system, nd, nz = self.system, self.system.nd, f_z.shape[-1]
        eye = torch.eye(nz, dtype=REAL, device=x.device)
        gradient, hessian = u.new_zeros(*u.shape[:2], nz), u.new_zeros(*u.shape[:2], nz, nz)
        if self.reward:
            gradient, hessian = quadratic_after_step(system, lambda x, u: -system.reward(x, u), x, u, f_z)
        if self.reference:
            dx = system.difference(x[:, :-1], self.reference[0][:, :-1])
            gradient = gradient + 2 * self.tracking * torch.cat((dx, u - self.reference[1]), -1)
            hessian = hessian + 2 * self.tracking * eye
        if self.log_policy:
            policy, theta, eta = self.log_policy
            d = u.new_zeros(*u.shape[:2], nd, requires_grad=True)
            with torch.enable_grad():
                mean = policy.mean(theta, system.observe(system.retract(x[:, :-1], d)))
                rows = [torch.autograd.grad(mean[..., i].sum(), d, retain_graph=True)[0] for i in range(system.nu)]
            # Gauss-Newton of |(u - mu(x)) / sigma|^2 / 2
            e_z = torch.cat((-torch.stack(rows, -2), eye[nd:, nd:].expand(*u.shape[:2], -1, -1)), -1)
            e_z = e_z / policy.sigma.unsqueeze(-1)
            e = ((u - mean.detach()) / policy.sigma).unsqueeze(-1)
            gradient = gradient + eta * (e_z.mT @ e).squeeze(-1)
            hessian = hessian + eta * e_z.mT @ e_z
        return gradient, hessian


class Guide(NamedTuple):
    """A linear-Gaussian controller about a trajectory: u ~ N(ubar + K (x - xbar), L L'), all over time."""

    x: Tensor  # (T + 1, nx)
    u: Tensor  # (T, nu)
    K: Tensor  # (T, nu, 2nv)
    L: Tensor  # (T, nu, nu) Cholesky factor of the covariance eta Q_uu^-1
    eta: Tensor  # () the temperature of exp(reward / eta), of which this is the I-projection
    mu: Tensor  # () regularisation of the pass that made it; 0 unless Q_uu was not positive definite

    def mean(self, system: System, t: int | slice, x: Tensor) -> Tensor:
        tangent = system.difference(x, self.x[t])
        return self.u[t] + (self.K[t] @ tangent.unsqueeze(-1)).squeeze(-1)

    def log_prob(self, system: System, x: Tensor, u: Tensor) -> Tensor:
        """(m, T) log q(u_t | x_t) of anyone's trajectories x (m, T + 1, nx), u (m, T, nu)."""
        error = (u - self.mean(system, slice(0, u.shape[1]), x[:, :-1])).unsqueeze(-1)
        e = torch.linalg.solve_triangular(self.L, error, upper=False).squeeze(-1)
        log_det = self.L.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return -0.5 * e.square().sum(-1) - log_det - 0.5 * u.shape[-1] * math.log(2 * math.pi)

    def sample(self, system: System, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Closed-loop rollouts with standard normal noise (m, T, nu)."""

        def act(t: int, x: Tensor) -> Tensor:
            return self.mean(system, t, x) + (self.L[t] @ noise[:, t].unsqueeze(-1)).squeeze(-1)

        return system.rollout(self.x[0].expand(len(noise), -1), noise.shape[1], act)


@torch.no_grad()
def make_guides(cost: Cost, plan: Plan, sigma: Tensor, spread: float) -> list[Guide]:
    """The controllers about R optimised trajectories. Their k is left out: it vanishes where iLQR converged."""
    f_z = step_jacobian(cost.system, plan.x, plan.u)
    quadratic = cost.quadratic(plan.x, plan.u, f_z)
    mu = torch.zeros_like(plan.cost)
    gains = backward_pass(f_z, *quadratic, mu)
    while not bool(gains.ok.all()):
        mu = torch.where(gains.ok, mu, (4 * mu).clamp(min=1e-6))
        gains = backward_pass(f_z, *quadratic, mu)
    covariance = torch.linalg.inv(gains.Q_uu + 1e-9 * torch.eye(cost.system.nu, dtype=REAL, device=mu.device))
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt().median(1).values  # (R, nu)
    eta = (spread * sigma / std).amin(-1).square()
    L = torch.linalg.cholesky(eta.view(-1, 1, 1, 1) * symmetric(covariance))
    return [Guide(*tensors) for tensors in zip(plan.x, plan.u, gains.K, L, eta, mu, strict=True)]


# The policy -----------------------------------------------------------------------------------------------------------


class Policy(NamedTuple):
    """pi_theta(u|o): Gaussian about a network of one softplus layer; theta is one vector of all its weights."""

    hidden: int
    obs_mean: Tensor
    obs_std: Tensor
    u_mean: Tensor
    u_std: Tensor
    sigma: Tensor  # (nu,) fixed

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        return (self.hidden, len(self.obs_mean)), (self.hidden,), (len(self.sigma), self.hidden), (len(self.sigma),)

    def initial(self, rng: torch.Generator) -> Tensor:
        scales = len(self.obs_mean) ** -0.5, 1.0, 0.1, 0.0
        draws = [s * torch.randn(math.prod(n), generator=rng) for s, n in zip(scales, self.shapes, strict=True)]
        return torch.cat(draws).to(self.sigma)

    def mean(self, theta: Tensor, obs: Tensor) -> Tensor:
        """(..., nu) of obs (..., no)."""
        parts = theta.split([math.prod(shape) for shape in self.shapes])
        w1, b1, w2, b2 = (part.view(shape) for part, shape in zip(parts, self.shapes, strict=True))
        hidden = F.softplus(F.linear((obs - self.obs_mean) / self.obs_std, w1, b1))
        return self.u_mean + self.u_std * F.linear(hidden, w2, b2)

    def log_prob(self, theta: Tensor, obs: Tensor, u: Tensor) -> Tensor:
        """(...) log pi_theta(u|o)."""
        e = (u - self.mean(theta, obs)) / self.sigma
        return -0.5 * e.square().sum(-1) - (self.sigma.log() + 0.5 * math.log(2 * math.pi)).sum()


def maximise(objective: Callable[[Tensor], Tensor], theta: Tensor, iterations: int) -> tuple[Tensor, float]:
    """L-BFGS with strong Wolfe conditions; returns the best finite theta that it saw, and its value."""
    leaf = theta.clone().requires_grad_()
    best, best_value = theta.clone(), -math.inf
    options = dict(history_size=50, line_search_fn="strong_wolfe", tolerance_grad=1e-9, tolerance_change=1e-12)
    lbfgs = torch.optim.LBFGS([leaf], lr=1.0, max_iter=iterations, max_eval=iterations * 5 // 4 + 1, **options)

    def closure() -> float:
        nonlocal best_value
        value = objective(leaf)
        (leaf.grad,) = torch.autograd.grad(-value, leaf)
        if not (math.isfinite(value.item()) and bool(torch.isfinite(leaf.grad).all())):
            leaf.grad.zero_()
            return 1e12
        if value.item() > best_value:
            best_value = value.item()
            best.copy_(leaf.detach())
        return -value.item()

    lbfgs.step(closure)
    return best, best_value


# Importance sampling --------------------------------------------------------------------------------------------------


def log_mixture(log_q: Tensor) -> Tensor:
    """(m, T) log of the mixture of n PREFIX densities, from cumulated log q_j (m, n, T) (Section 3)."""
    return torch.logsumexp(log_q, 1) - math.log(log_q.shape[1])


def log_weights(log_pi: Tensor, log_mix: Tensor) -> Tensor:
    """(m, T) log pi(zeta_1:t) / q(zeta_1:t) from per-step log pi (m, T)."""
    return log_pi.cumsum(1) - log_mix


def phi(log_pi: Tensor, log_mix: Tensor, reward: Tensor, w_r: float) -> Tensor:
    """The objective of Section 3: Eq. 2 and the regulariser, of rewards (m, T). At w_r = 0 the value estimate."""
    log_w = log_weights(log_pi, log_mix)
    log_z = torch.logsumexp(log_w, 0) - math.log(len(log_w))
    return (torch.softmax(log_w, 0) * reward).sum() + w_r * log_z.sum()


class Samples(NamedTuple):
    """m trajectories."""

    x: Tensor  # (m, T + 1, nx)
    obs: Tensor  # (m, T, no) on which u acted
    u: Tensor  # (m, T, nu)
    reward: Tensor  # (m, T), bounded from below
    native: Tensor  # (m, T) the task's own
    source: Tensor  # (m,) index of the generator it came from
    log_q: Tensor  # (m, n, T) cumulated log density under each generator

    def pick(self, index: Tensor) -> Samples:
        return Samples(*(tensor[index] for tensor in self))

    @property
    def returns(self) -> Tensor:
        return self.reward.sum(1)


class Search:
    """Algorithm 1 and its variants: the guides, the sample set S, and the best policy so far."""

    STATE = ("theta", "w_r", "floor", "scale", "control_steps", "plan_steps", "fit", "guide_return", "example_return")

    def __init__(self, args: Args, system: System, say: Callable[[str], None] = lambda text: None) -> None:
        self.args, self.system, self.say = args, system, say
        self.rng = torch.Generator().manual_seed(args.seed)
        self.guides: list[Guide] = []  # the initial ones; adapted ones are generators only
        self.adapted: list[Guide] = []
        self.generators: list[Guide | Tensor] = []  # guides, and policies as their theta
        self.best = -1  # theta's index among the generators
        self.w_r = 0.0 if args.variant == "unregularized" else args.initial_regularizer
        self.floor, self.scale, self.fit = -math.inf, 1.0, math.nan
        self.guide_return, self.example_return = (math.nan, math.nan), math.nan
        self.control_steps = self.plan_steps = 0
        self.policy: Policy
        self.theta: Tensor
        self.set: Samples

    def noise(self, count: int, rng: torch.Generator | None = None) -> Tensor:
        """(count, T, nu) standard normal, the same on every device."""
        size = (count, self.args.horizon, self.system.nu)
        return torch.randn(size, generator=rng or self.rng, dtype=REAL).to(self.system.device)

    def measure(self, x: Tensor, u: Tensor, finite: Tensor, source: int = -1) -> Samples:
        """What the estimator needs of trajectories; one diverged step earns the floor, so that it cannot own J."""
        self.system.nonfinite += int((~finite[:, -1]).sum())
        reward = torch.where(finite, self.system.reward(x[:, 1:], u), self.floor).clamp(min=self.floor)
        native = torch.where(finite, self.system.native(x[:, 1:], u), 0.0)
        sources = torch.full((len(u),), source, device=u.device)
        return Samples(x, self.system.observe(x[:, :-1]), u, reward, native, sources, u.new_zeros(len(u), 0, len(u[0])))

    def follow(self, theta: Tensor, noise: Tensor, source: int = -1, start: Tensor | None = None) -> Samples:
        """Trajectories of a policy with standard normal noise (m, T, nu), from the fixed start or from (m, nx)."""
        policy, system = self.policy, self.system
        start = self.start.expand(len(noise), -1) if start is None else start
        act = lambda t, x: policy.mean(theta, system.observe(x)) + policy.sigma * noise[:, t]  # noqa: E731
        return self.measure(*system.rollout(start, self.args.horizon, act), source)

    def draw(self, theta: Tensor, source: int = -1, count: int | None = None) -> Samples:
        """Trajectories, --samples of them; the restart variant's start at states of the guides."""
        count, start = count or self.args.samples, None
        self.control_steps += count * self.args.horizon
        noise = self.noise(count)
        if source >= 0 and self.args.variant == "restart":
            x = torch.cat([guide.x[:-1] for guide in self.guides])
            start = x[torch.randint(len(x), (count,), generator=self.rng).to(x.device)]
        return self.follow(theta, noise, source, start)

    @property
    def start(self) -> Tensor:
        return self.guides[0].x[0]

    def log_density(self, generator: Guide | Tensor, samples: Samples) -> Tensor:
        """(m, T) of the trajectories' prefixes."""
        if isinstance(generator, Guide):
            return generator.log_prob(self.system, samples.x, samples.u).cumsum(1)
        return self.policy.log_prob(generator, samples.obs, samples.u).cumsum(1)

    def append(self, generator: Guide | Tensor | None, samples: Samples) -> Tensor:
        """Adds samples to S, with the generator that they came from unless it is there; returns their indices."""
        if generator is not None:
            self.generators.append(generator)
            column = self.log_density(generator, self.set).unsqueeze(1)
            self.set = self.set._replace(log_q=torch.cat((self.set.log_q, column), 1))
        log_q = torch.stack([self.log_density(g, samples) for g in self.generators], 1)
        first, joined = len(self.set.u), zip(self.set, samples._replace(log_q=log_q), strict=True)
        self.set = Samples(*(torch.cat(tensors) for tensors in joined))
        return torch.arange(first, len(self.set.u), device=log_q.device)

    def mixture(self, samples: Samples) -> Tensor:
        """(m, T) of the distributions that samples come from."""
        return log_mixture(samples.log_q[:, samples.source.unique()])

    def guided(self, samples: Samples) -> Tensor:
        """(m,) whether samples come from guides."""
        return torch.tensor([isinstance(g, Guide) for g in self.generators], device=samples.u.device)[samples.source]

    # Lines 1 to 4 of Algorithm 1

    def plan(self) -> Plan:
        """Trajectory optimisation from random action sequences or from a demonstration."""
        args, system, T, shown = self.args, self.system, self.args.horizon, -math.inf

        def show(iteration: int, best: Tensor) -> None:
            nonlocal shown
            if time.monotonic() - shown > 5.0:
                shown = time.monotonic()
                self.say(f"planning, iteration {iteration}: cost {best.min():.2f}, {len(best)} trajectories")

        if system.demonstration:
            x, u = (tensor.unsqueeze(0) for tensor in system.demonstration)
            # The example need not be reproducible: a tracking controller makes a trajectory of this system of it.
            cost = Cost(system, reward=False, reference=(x, u), tracking=args.tracking)
            f_z, zero = step_jacobian(system, x, u), x.new_zeros(1)
            xs, us, finite = follow(system, x, u, backward_pass(f_z, *cost.quadratic(x, u, f_z), zero), zero)
            if not bool(finite.all()):
                fail(f"{args.demonstration}: no controller follows it to its end")
            plan = Plan(xs[:, 0], us[:, 0], zero, ["example"])
        else:
            u = starting_actions(args.restarts, T, system.nu, system.control_dt, self.rng).to(system.device)
            x, u, finite = system.rollout(system.start().expand(args.restarts, -1), T, lambda t, _: u[:, t])
            if not bool(finite.all(1).any()):
                fail("every random start of the planner left the finite numbers: give more --substeps")
            plan = ilqr(Cost(system), x[finite.all(1)], u[finite.all(1)], args.screening, show=show)
        order = plan.cost.argsort()[: args.guides]
        plan = ilqr(Cost(system), plan.x[order], plan.u[order], args.ilqr_iterations, show=show)
        self.say(f"planned: returns {', '.join(f'{-c:.2f} ({n})' for c, n in zip(plan.cost, plan.note, strict=True))}")
        return plan

    def prepare(self) -> dict[str, float]:
        args, system, before = self.args, self.system, self.system.steps
        plan = self.plan()
        self.example_return = -plan.cost.min().item()
        sigma = (args.noise * plan.u[0].std(0)).clamp(min=1e-3)  # 1e-3: a motor at rest still needs a density
        cost = Cost(system, reference=(plan.x, plan.u), tracking=args.tracking)
        self.guides = make_guides(cost, plan, sigma, args.spread)
        self.plan_steps = system.steps - before
        for guide in self.guides:
            if guide.mu > 1e-2:
                self.say(f"warning: a guide's Q_uu needed mu = {guide.mu:.1e}; it is far from an optimum")
        every = args.horizon // 16 or 1
        error = system.check_jacobians(plan.x[0, :-1:every], plan.u[0, ::every])
        self.say(f"Jacobians against central differences: relative error {error.median():.1e}, worst {error.max():.1e}")
        if not error.median() < 1e-3:
            fail("the simulator's Jacobians are not those of its steps")

        each = -(-args.guiding_samples // args.guides)
        drawn = [self.measure(*g.sample(system, self.noise(each)), i) for i, g in enumerate(self.guides)]
        guiding = Samples(*(torch.stack(column, 1).flatten(0, 1) for column in zip(*drawn, strict=True)))
        guiding = guiding.pick(torch.arange(args.guiding_samples, device=system.device))
        self.control_steps += each * args.guides * args.horizon
        worst, top = guiding.reward[torch.isfinite(guiding.reward)].aminmax()
        self.floor = (2 * worst - top).item()  # as far below the worst guiding step as that is below the best
        guiding = guiding._replace(reward=guiding.reward.clamp(min=self.floor))
        self.guide_return = guiding.returns.mean().item(), guiding.returns.std(correction=0).item()
        self.say("guiding samples: return {:.2f} +- {:.2f}".format(*self.guide_return))

        self.guiding = self.lessons() if args.pretraining_samples else (guiding.obs, guiding.u)
        statistics = [v.flatten(0, 1) for v in self.guiding]
        self.policy = Policy(
            args.hidden, *(s for v in statistics for s in (v.mean(0), v.std(0).clamp(min=1e-3))), sigma
        )
        if args.variant == "single-example":
            self.guiding = system.observe(plan.x[:, :-1]), plan.u
        self.pretrain(*self.guiding, attempts=1 if args.variant == "single-example" else args.gate)
        if args.variant in ("full", "unregularized", "dagger"):
            self.generators, self.set = list(self.guides), guiding
            self.set = guiding._replace(log_q=torch.stack([self.log_density(g, guiding) for g in self.guides], 1))
        else:
            self.set = guiding.pick(guiding.source < 0)
        self.best = len(self.generators)
        own = self.draw(self.theta, self.best)
        self.append(self.theta, own)
        self.scale = self.set.reward.std().clamp(min=1e-6).item()
        scalars = {"gps/plan": self.example_return, "gps/fit": self.fit}
        return self.returns(own) | scalars | dict(zip(("gps/guides", "gps/guides_std"), self.guide_return, strict=True))

    def lessons(self) -> tuple[Tensor, Tensor]:
        """Observations (m, T, no) of trajectories wider than the guides' and the guides' mean actions (m, T, nu) there
        (DART, Laskey et al. 2017): a policy that has seen only the guides' narrow tube does not return to it."""
        args, system, parts = self.args, self.system, []
        each = -(-args.pretraining_samples // args.guides)
        for guide in self.guides:
            wide = guide._replace(L=args.pretraining_spread * guide.L)
            x = wide.sample(system, self.noise(each))[0][:, :-1]
            parts.append((system.observe(x), guide.mean(system, slice(0, args.horizon), x)))
        self.control_steps += each * args.guides * args.horizon
        obs, u = (torch.stack(column, 1).flatten(0, 1) for column in zip(*parts, strict=True))
        return obs, u

    def pretrain(self, obs: Tensor, u: Tensor, attempts: int) -> None:
        """Line 3, until the network follows the guides in closed loop: the states that it visited instead, as far as
        the lessons go, join them with the guides' mean actions (DAgger, Ross et al. 2011)."""
        policy, lessons, best = self.policy, obs, -math.inf
        # As many steps as the guiding samples have, picked from all: neighbours in time teach little more than one.
        steps = torch.randperm(u[..., 0].numel(), generator=self.rng)[: self.args.guiding_samples * self.args.horizon]
        obs, u = (tensor.flatten(0, 1)[steps.to(u.device)] for tensor in (obs, u))
        theta = policy.initial(self.rng)
        for attempt in range(attempts):
            objective = lambda theta: policy.log_prob(theta, obs, u).mean()  # noqa: E731, B023
            theta, _ = maximise(objective, theta, self.args.pretraining)
            seen = self.draw(theta, count=self.args.guiding_samples)
            returns = seen.returns
            fit = ((u - policy.mean(theta, obs)) / policy.sigma).square().mean().sqrt().item()
            text = f"pretraining {attempt + 1}: rms error {fit:.2f} standard deviations, return of its rollouts "
            self.say(text + f"{returns.mean():.2f}, best {returns.max():.2f}")
            if returns.mean() > best:
                best, self.theta, self.fit = returns.mean().item(), theta, fit
            if best >= self.guide_return[0] - 0.1 * abs(self.guide_return[0]):
                return
            if attempt + 1 < attempts:
                labelled = (self.label(g, lessons[i :: len(self.guides)], seen) for i, g in enumerate(self.guides))
                obs, u = (torch.cat(column) for column in zip((obs, u), *labelled, strict=True))
        self.say("warning: no pretrained policy came within a tenth of the guides' return on average")

    def label(self, guide: Guide, lessons: Tensor, samples: Samples) -> tuple[Tensor, Tensor]:
        """Observations (k, no) and a guide's mean actions there (k, nu) from samples, while they are as near to its
        path as its lessons (m, T, no) at that time: beyond, as after a fall, its linear gains mean nothing."""
        mean, std = lessons.mean(0), lessons.std(0).clamp(min=1e-3)
        distance = lambda obs: ((obs - mean) / std).square().mean(-1)  # noqa: E731
        near = (distance(samples.obs) <= distance(lessons).amax(0)).cumprod(1).bool()
        thin = max(1, len(lessons) // len(samples.obs))  # as dense in time as those picked of the lessons
        u = guide.mean(self.system, slice(0, self.args.horizon), samples.x[:, :-1])
        return samples.obs[near][::thin], u[near][::thin]

    # Lines 5 to 18

    def score(self) -> Tensor:
        """(m,) sum of a sample's weights under the best policy; ties are broken by its density."""
        log_w = log_weights(self.policy.log_prob(self.theta, self.set.obs, self.set.u), self.mixture(self.set))
        return torch.softmax(log_w, 0).sum(1) + 1e-9 * log_w[:, -1].clamp(min=-1e6)

    def choose(self) -> Tensor:
        """Indices of S_k: the guiding samples, the newest of the best policy, others by importance under it."""
        score = torch.where(self.guided(self.set), 3e9, self.score())
        score[(self.set.source == self.best).nonzero().flatten()[-self.args.samples :]] = 2e9
        return score.argsort(descending=True, stable=True)[: self.args.active].sort().values

    def prune(self) -> None:
        """Bounds S: the guiding samples, those of the best policy and the best-scored others stay, in that order;
        generators without samples go."""
        if len(self.set.u) <= self.args.stored:
            return
        score = self.score() + 2e9 * self.guided(self.set) + 1e9 * (self.set.source == self.best)
        self.set = self.set.pick(score.argsort(descending=True, stable=True)[: self.args.stored].sort().values)
        used = torch.tensor(sorted({*self.set.source.tolist(), self.best}), device=self.theta.device)
        index = torch.full((len(self.generators),), -1, device=used.device)
        index[used] = torch.arange(len(used), device=used.device)
        self.set = self.set._replace(source=index[self.set.source], log_q=self.set.log_q[:, used])
        self.generators, self.best = [self.generators[i] for i in used.tolist()], int(index[self.best])

    def iterate(self, iteration: int) -> dict[str, float]:
        step = {"policy-gradient": self.policy_gradient, "dagger": self.dagger}.get(self.args.variant, self.search)
        scalars = step(iteration)
        self.prune()
        return scalars

    def search(self, iteration: int) -> dict[str, float]:
        args, policy = self.args, self.policy
        active = self.choose()
        S = self.set.pick(active)
        mixture, reward, top = self.mixture(S), S.reward / self.scale, S.returns.argmax()

        def objective(theta: Tensor) -> Tensor:
            return phi(policy.log_prob(theta, S.obs, S.u), mixture, reward, self.w_r)

        def likelihood(theta: Tensor) -> Tensor:
            return policy.log_prob(theta, S.obs[top], S.u[top]).mean()

        near, _ = maximise(likelihood, self.theta, args.lbfgs_iterations)
        ends = [maximise(objective, theta, args.lbfgs_iterations) for theta in (self.theta, near)]
        start = int(ends[1][1] > ends[0][1])
        theta, value = ends[start]
        source = len(self.generators)
        new = self.draw(theta, source)
        active = torch.cat((active, self.append(theta, new)))
        if iteration <= args.adaptive and args.variant in ("full", "unregularized"):
            active = torch.cat((active, self.adapt()))

        for confirmed in (False, True):
            S = self.set.pick(active)
            mixture = self.mixture(S)
            log_pi = [policy.log_prob(t, S.obs, S.u) for t in (theta, self.theta)]
            estimates = [phi(log_p, mixture, S.reward, 0.0).item() for log_p in log_pi]
            if not all(map(math.isfinite, estimates)):
                raise FloatingPointError(f"the value estimates are {estimates}: no active sample has a finite density")
            accepted = estimates[0] > estimates[1]
            if confirmed or not accepted:
                break
            again = self.draw(theta, source, args.guiding_samples)  # ten may have been lucky
            active = torch.cat((active, self.append(None, again)))
        log_w = log_weights(log_pi[0], mixture)
        weights = torch.softmax(log_w, 0)
        ess = 1.0 / weights.square().sum(0)
        scalars = {
            "gps/phi": value,
            "gps/estimate": estimates[0],
            "gps/best_estimate": estimates[1],
            "gps/accepted": float(accepted),
            "gps/start": start,
            "gps/regularizer": self.w_r,
            "gps/ess": ess.mean().item(),
            "gps/ess_min": ess.min().item(),
            "gps/guide_share": (weights[self.guided(S)].sum() / weights.sum()).item(),
            "gps/log_weight_spread": (log_w[:, -1].max() - log_w[:, -1].min()).item(),
        }
        if args.variant != "unregularized":
            self.w_r = next_regularizer(self.w_r, accepted, args.regularizer_bounds)
        if accepted:
            self.theta, self.best = theta, source
        else:  # the best policy's samples may have been unusually good: line 16
            self.append(None, self.draw(self.theta, self.best))
        return scalars | self.returns(self.draw(theta) if args.variant == "restart" else new)

    def returns(self, samples: Samples) -> dict[str, float]:
        return {
            "charts/episodic_return": samples.native.sum(1).mean().item(),
            "gps/objective": samples.returns.mean().item(),
            "gps/objective_std": samples.returns.std(correction=0).item(),
        }

    def adapt(self) -> Tensor:
        """Section 4.2: guides of exp(reward / eta) pi_theta, from the last ones; returns indices of their samples."""
        args, system, before = self.args, self.system, self.system.steps
        guides, indices = self.adapted or self.guides, []
        x, u = torch.stack([g.x for g in guides]), torch.stack([g.u for g in guides])
        eta = torch.stack([g.eta for g in self.guides]).mean()
        cost = Cost(system, log_policy=(self.policy, self.theta, eta.item()))
        plan = ilqr(cost, x, u, args.adaptive_iterations, mu=1e-3)
        # of exp((r + eta log pi) / eta): the temperature is not chosen anew
        made = make_guides(cost, plan, self.policy.sigma, 1.0)
        self.adapted = [g._replace(L=g.L * (eta / g.eta).sqrt(), eta=eta) for g in made]
        self.plan_steps += system.steps - before
        for i, guide in enumerate(self.adapted):
            count = args.samples // args.guides + (i < args.samples % args.guides)
            samples = self.measure(*guide.sample(system, self.noise(count)), len(self.generators))
            self.control_steps += count * args.horizon
            indices.append(self.append(guide, samples))
        return torch.cat(indices)

    def policy_gradient(self, iteration: int) -> dict[str, float]:
        """GPOMDP (Baxter et al. 2001): reward to go minus its mean over the samples, at each time."""
        new = self.draw(self.theta)
        to_go = new.reward.flip(1).cumsum(1).flip(1)
        theta = self.theta.clone().requires_grad_()
        log_pi = self.policy.log_prob(theta, new.obs, new.u)
        (gradient,) = torch.autograd.grad(((to_go - to_go.mean(0)) * log_pi).sum(), theta)
        self.theta = self.theta + self.args.step * gradient / gradient.norm().clamp(min=1e-12)
        return self.returns(new)

    def dagger(self, iteration: int) -> dict[str, float]:
        """Ross et al. 2011: the controller's actions at the states that the policy visits join the data."""
        new = self.draw(self.theta)
        labels = self.guides[0].mean(self.system, slice(0, self.args.horizon), new.x[:, :-1])
        obs, u = self.guiding = torch.cat((self.guiding[0], new.obs)), torch.cat((self.guiding[1], labels))
        objective = lambda theta: self.policy.log_prob(theta, obs, u).mean()  # noqa: E731
        self.theta, _ = maximise(objective, self.theta, self.args.lbfgs_iterations)
        return self.returns(new)

    def state_dict(self) -> dict[str, Any]:
        pack = lambda g: tuple(g) if isinstance(g, Guide) else g  # noqa: E731
        state = {name: getattr(self, name) for name in self.STATE} | dict(best=self.best, rng=self.rng.get_state())
        state |= {name: [pack(g) for g in getattr(self, name)] for name in ("guides", "adapted", "generators")}
        guiding = self.guiding if self.args.variant == "dagger" else ()
        return state | dict(set=tuple(self.set), policy=tuple(self.policy), guiding=guiding)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        to = lambda value: value.to(self.system.device) if isinstance(value, Tensor) else value  # noqa: E731
        unpack = lambda g: Guide(*map(to, g)) if isinstance(g, tuple) else to(g)  # noqa: E731
        for name in (*self.STATE, "best"):
            setattr(self, name, to(state[name]))
        for name in ("guides", "adapted", "generators"):
            setattr(self, name, [unpack(g) for g in state[name]])
        self.rng.set_state(state["rng"])
        self.set, self.policy = Samples(*map(to, state["set"])), Policy(*map(to, state["policy"]))
        self.guiding = tuple(map(to, state["guiding"]))


def next_regularizer(w_r: float, accepted: bool, bounds: tuple[float, float]) -> float:
    """Lines 13 and 15."""
    return max(w_r / 10, bounds[0]) if accepted else min(w_r * 10, bounds[1])


def evaluate(search: Search) -> tuple[Evaluation, dict[str, float], str]:
    """The best policy from the fixed start, with its noise: the task's own returns, until it falls; and scalars and
    text, with the objective besides. The path's first trajectory has no noise, and is not among the returns."""
    system, count = search.system, search.args.eval_episodes
    noise = search.noise(count + 1, torch.Generator().manual_seed(EVALUATION_SEED))
    noise[0] = 0.0
    S = search.follow(search.theta, noise)
    fallen = system.task.terminated(system.observe(S.x[:, 1:])).int()
    alive = fallen.cumsum(1) - fallen == 0
    lengths, x = alive.sum(1), S.x[..., 0]
    distance = x.gather(1, lengths.unsqueeze(1))[:, 0] - x[:, 0]
    speed = None if search.args.env == "cartpole" else (distance / (lengths * system.control_dt))[1:].mean().item()
    path = S.x[..., : system.nq].transpose(0, 1)
    evaluation = Evaluation((S.native * alive).sum(1)[1:], lengths[1:], speed, path)
    objective = {"eval/objective": S.returns[1:].mean().item(), "eval/without_noise": S.returns[0].item()}
    objective["eval/objective_std"] = S.returns[1:].std(correction=0).item()
    text = "objective {eval/objective:.2f} +- {eval/objective_std:.2f}, without noise {eval/without_noise:.2f}; plan "
    text = text.format(**objective) + f"{search.example_return:.2f}, guides " + "{:.2f} +- {:.2f}; task's own "
    return evaluation, evaluation.scalars() | objective, text.format(*search.guide_return) + str(evaluation)


# Runs -----------------------------------------------------------------------------------------------------------------


def parse(argv: list[str] | None) -> tuple[Args, dict[str, Any] | None]:
    """The arguments, complete and checked, and the checkpoint that they name."""
    if distributed.size() > 1:
        fail("trains in one process; start it without torchrun")
    args, checkpoint = read_arguments(Args, argv, __doc__, FORMAT, FIXED, TASKS)
    for name, value in zip(COLUMNS, PER_TASK.get(args.env, DEFAULT), strict=True):
        if getattr(args, name) is None:
            setattr(args, name, value)
    if args.env == "cartpole" and args.reward == "target":
        fail("--reward target is of robots that walk or swim; cartpole has --reward native")
    least = dict.fromkeys(("iterations", "guides", "hidden", "gate", "eval_episodes", "stop_after", "threads"), 1)
    least |= dict.fromkeys(("pretraining", "lbfgs_iterations", "screening", "ilqr_iterations"), 1)
    least |= dict(horizon=2, samples=2, guiding_samples=max(2, args.guides), active=args.guiding_samples + args.samples)
    least |= dict(stored=args.active, adaptive=0, pretraining_samples=0, restarts=args.guides)
    for name, bound in least.items():
        if (value := getattr(args, name)) is not None and value < bound:
            fail(f"{flag(name)} must be at least {bound}, not {value}")
    for name in ("noise", "spread", "pretraining_spread", "step", "action_cost"):
        if not 0 < getattr(args, name) < math.inf:
            fail(f"{flag(name)} must be positive, not {getattr(args, name)}")
    for name in ("tracking", "initial_regularizer", "height_weight", "attitude_weight"):
        if not 0 <= getattr(args, name) < math.inf:
            fail(f"{flag(name)} must not be negative, not {getattr(args, name)}")
    if not 0 <= args.regularizer_bounds[0] <= args.regularizer_bounds[1]:
        fail(f"--regularizer-bounds must be two numbers in order, not {args.regularizer_bounds}")
    if args.demonstration and args.guides > 1:
        fail("--demonstration is one trajectory: --guides must be 1")
    return args, checkpoint


def make_system(args: Args) -> System:
    try:
        system = System(args)
        system.demonstration = system.load(args.demonstration, args.horizon) if args.demonstration else None
    except ValueError as error:
        fail(error)
    return system


def film(directory: Path, search: Search, evaluation: Evaluation) -> None:
    """The trajectory without noise."""
    length = torch.full_like(evaluation.lengths[:1], search.args.horizon)
    shown = Evaluation(evaluation.returns[:1], length, evaluation.speed, evaluation.qpos[:, :1])
    try:
        print(f"video: {write_video(directory / 'video.mp4', search.system, shown)}")
    except (ImportError, OSError, RuntimeError) as error:
        fail(error)


def evaluate_only(args: Args, checkpoint: dict[str, Any]) -> None:
    search = Search(args, make_system(args))
    search.load_state_dict(checkpoint["search"])
    evaluation, _, text = evaluate(search)
    print(f"{args.env}, {args.eval_episodes} trajectories: {text}")
    if args.capture_video:
        film(args.run_dir or args.evaluate.parent, search, evaluation)


def train(args: Args, checkpoint: dict[str, Any] | None) -> None:
    run = Run(args, Path(__file__).stem, PROGRESS)
    system = make_system(args)
    search, begin = Search(args, system, run.print), Mark(system.device)
    if checkpoint:
        search.load_state_dict(checkpoint["search"])
        start, seconds, system.nonfinite = (checkpoint[name] for name in ("iteration", "seconds", "nonfinite"))
        run.open(start, search.control_steps)
    else:
        scalars = search.prepare()
        end = Mark(system.device)
        end.wait()
        start, seconds = 0, end.since(begin)
        run.open(0, 0)
        run.log(0, search.control_steps, seconds, scalars | {"sim/model_steps": search.plan_steps})

    def save(iteration: int) -> None:
        saved = dataclasses.asdict(args) | dict(demonstration=None, resume=None, run_dir=None, stop_after=None)
        state = dict(format=FORMAT, args=saved, iteration=iteration, seconds=seconds, nonfinite=system.nonfinite)
        run.save(state | dict(search=search.state_dict()))

    last = min(args.iterations, args.stop_after or args.iterations)
    evaluation = None
    for iteration in range(start + 1, last + 1):
        begin = Mark(system.device)
        scalars = search.iterate(iteration)
        end = Mark(system.device)
        end.wait()
        seconds += end.since(begin)
        scalars |= {"sim/nonfinite": system.nonfinite, "sim/model_steps": search.plan_steps}
        if iteration == args.iterations or (args.eval_every and iteration % args.eval_every == 0):
            evaluation, values, text = evaluate(search)
            scalars |= values
            run.print(f"iteration {iteration}: {text}")
        run.log(iteration, search.control_steps, seconds, scalars)
        run.show(iteration, end.since(begin), scalars["gps/objective"], iteration == last)
        if run.signals or iteration == last or (args.save_every and iteration % args.save_every == 0):
            save(iteration)
        if run.signals:
            break

    run.close()
    steps = f"{search.control_steps:,} control steps of samples, {search.plan_steps:,} of planning"
    print(f"{args.env}: {iteration} iterations, {steps}, {seconds:.1f} s of training")
    if evaluation:
        print(f"best policy, {args.eval_episodes} trajectories: {text}")
    print(f"written to {run.directory}")
    if iteration < args.iterations:
        print(f"stopped early: python gps.py --resume {run.directory / 'checkpoint.pt'} goes on")
    elif args.capture_video:
        film(run.directory, search, evaluation)
    if run.signals:
        sys.exit(128 + run.signals[0])


def main(argv: list[str] | None = None) -> None:
    args, checkpoint = parse(argv)
    torch.set_num_threads(1)  # operations this small gain little from more; idle ones would busy the simulator's cores
    if args.evaluate:
        evaluate_only(args, checkpoint)
    else:
        train(args, checkpoint)


if __name__ == "__main__":
    main()
