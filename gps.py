"""Guided policy search (Levine and Koltun 2013, https://proceedings.mlr.press/v28/levine13.html).

An example and feedback around it are a guide. Samples of guides lead an importance-sampled policy search (Algorithm 1),
which teaches a small network without a clock to act like the example. Ours are the guides' feedback, which does not
depend on the policy's noise, and line 3, which fits the mean actions of guides that noise spreads more widely.

    python gps.py --env walker --seed 1                     learn from the shipped example; writes runs/<run>/
    python gps.py --env walker --demonstration my_walk.npz  from another one, best a policy's (docs/gps.md)
    python gps.py --resume <run>/checkpoint.pt              continue an interrupted run exactly
    python gps.py --evaluate <run>/checkpoint.pt            evaluate its best policy
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor, nn

from diffsim import DiffEnv
from diffsim.planning.controller import LinearGaussian, maximum_entropy_controllers
from diffsim.planning.cost import AfterStep, Sum, Surprisal, Tracking
from diffsim.planning.demonstration import follow_demonstration, load_demonstration
from diffsim.planning.ilqr import Plan, ilqr
from diffsim.planning.lbfgs import maximise
from diffsim.planning.policy import GaussianPolicy
from diffsim.planning.samples import Samples, SampleSet
from diffsim.planning.system import REAL, System
from diffsim.tasks.base import ASSETS
from diffsim.training import evaluate_checkpoint, fail, script
from diffsim.training.evaluation import SEED, Evaluation
from diffsim.training.flags import Flags
from diffsim.training.layers import ObsNormalizer
from diffsim.training.ranges import ORDERED, AtLeast2, Count, Natural, NonNegative, Positive, UpTo10k
from diffsim.training.run import Run

STORED = 3  # times --active, the samples of S that are kept to choose from
# fmt: off
COLUMNS = ("horizon", "control_dt", "action_cost", "hidden", "noise", "tracking", "pretraining_noise", "beyond")
PER_TASK: dict[str, tuple[float, ...]] = {
    "cartpole": (240, 1 / 60, 1e-3,  50, 0.10, 0.05, 0.50, 1),
    "hopper":   (500, 0.02,   1e-1,  50, 0.10, 0.05, 0.50, 1),
    "humanoid": (300, 1 / 60, 1e-1, 200, 0.01, 0.50, 0.50, 3),
    "swimmer":  (500, 0.05,   1e-2,  50, 0.10, 0.05, 0.30, 1),
    "walker":   (500, 0.01,   1e-1,  50, 0.10, 0.50, 0.50, 1),
}
# The paper's reward: v_x* [m/s], p_y* [m], its weight w_h, and that of the trunk's squared rotation, which is ours.
# Other tasks have their own.
TARGETS = {
    "hopper":   (1.5, 1.25, 10.0, 1.0),
    "humanoid": (2.5, 1.20, 10.0, 0.1),
    "swimmer":  (2.0, 0.0,   0.0, 0.0),
    "walker":   (1.2, 1.35, 10.0, 10.0),
}
# fmt: on
EXAMPLES = ASSETS / "examples"  # by task; benchmarks/guided_policy_search.py records them


@dataclass
class Args(Flags):
    """The algorithm. Defaults are those of a task that is not in the table."""

    processes: ClassVar[bool] = False
    fixed: ClassVar = ("horizon", "action_cost", "demonstration", "noise")

    iterations: Count = 6
    """iterations K of the policy search (the paper: 80)"""
    horizon: AtLeast2 = 500
    """control steps T of a trajectory (per task)"""
    control_dt: Positive = 1 / 60
    """seconds of a control step, which the --substeps divide (per task)"""
    action_cost: Positive = 1e-3
    """w_u: cost of the squared action before tanh (per task)"""
    demonstration: Path | None = None
    """the example, or several: .npz of qpos (T+1, nq), qvel (T+1, nv), action (T, nu), a row a step (per task)"""
    ilqr_iterations: Natural = 0
    """iterations of trajectory optimisation, which improve the example and make it harder to learn (docs/gps.md)"""
    guiding_samples: AtLeast2 = 40
    """trajectories drawn from the guiding distributions"""
    adaptive: Natural = 0
    """number of first iterations that adapt the guides to the policy (Section 4.2; the paper: 40)"""
    adaptive_iterations: UpTo10k = 50
    """iLQR iterations of an adaptation"""
    hidden: UpTo10k = 50
    """units of the policy's hidden layer (per task)"""
    noise: Positive = 0.1
    """the policy's standard deviation, relative to that of the example's actions over time (per task)"""
    tracking: NonNegative = 0.05
    """weight of the squared deviation from the example's states, only in the guides (Section 6; per task)"""
    pretraining: UpTo10k = 1000
    """epochs of the fit to the guides"""
    pretraining_noise: Positive = 0.5
    """standard deviation of the guides' actions in the fit, relative to that of the example's actions (per task)"""
    beyond: Count = 1
    """a new policy must be better over so many horizons with as many times the noise, too (per task; 1: the paper)"""
    samples: AtLeast2 = 10
    """trajectories of the policy per iteration"""
    active: UpTo10k = 100
    """trajectories in the active set S_k"""
    lbfgs_iterations: UpTo10k = 30
    """L-BFGS iterations of each of an iteration's two optimisations"""
    regularizer_bounds: Annotated[tuple[NonNegative, NonNegative], ORDERED] = (1e-6, 1e-2)
    """w_r starts at their geometric mean and is changed by factors of ten between them; 0 0: no regularizer"""

    def task_defaults(self) -> dict[str, Any]:
        task, own = self.task_class, dict[str, Any](eval_every=2, eval_episodes=100)
        if self.task not in PER_TASK:
            return own
        own |= dict(zip(COLUMNS, PER_TASK[self.task], strict=True))
        preset = task.integration(self.accuracy, self.contact).substeps / task.control_dt
        substeps = math.ceil(preset * PER_TASK[self.task][1] - 1e-6)
        return own | {"substeps": substeps, "demonstration": EXAMPLES / f"{self.task}.npz"}

    def check(self) -> None:
        super().check()
        task = self.task_class
        if task.varied_by or hasattr(task, "slope"):
            fail(f"guides are of one robot on a plane, but {self.env} varies: leave its options out")
        if task.num_memory:
            fail(f"{self.env} depends on the past, which planned states do not hold: choose another task")
        if (seen := task.actor_dim) is not None:
            fail(f"{self.env} shows its actor the first {seen} numbers of an observation, and this policy takes all")
        if not (self.demonstration or self.resume or self.evaluate):
            fail(f"--demonstration must be an example for {self.env}; shipped are those of {', '.join(PER_TASK)}")
        if any(self.onset):
            fail("--onset is not for guides: they are planned on the file's own contact")
        if self.active < (least := self.guiding_samples + self.samples):
            fail(f"--active must be at least {least}, for the guides' and the policy's samples, not {self.active}")


# The algorithm --------------------------------------------------------------------------------------------------------


class Search:
    """Algorithm 1, line by line."""

    guided = True  # whether S begins with the guides
    starts = 2  # of line 7

    def __init__(self, args: Args, env: DiffEnv, system: System | None = None) -> None:
        self.args = args
        self.system = system or System(env, args.threads or None)
        self.grounds = [self.system]  # of each guide
        self.network = GaussianPolicy(args.hidden, self.system)  # has theta*
        self.rollouts = Rollouts(args, self.system, self.network)
        self.cost = AfterStep(self.system, lambda x, u: -self.rollouts.reward(x, u))
        self.guides: list[LinearGaussian] = []  # pi_G1 to pi_Gn
        self.adapted: list[LinearGaussian] = []  # the last ones of line 9
        self.w_r = math.prod(args.regularizer_bounds) ** 0.5
        self.scale = 1.0  # standard deviation of rewards
        self.S = SampleSet(self.log_density, self.system.device)
        self.best = self.initial = 0  # number of theta* among the generators of S, and of initial guides there

    def prepare(self, say: Callable[[str], None]) -> dict[str, float]:
        """Lines 1 to 4; returns metrics."""
        args, policy, rollouts = self.args, self.network, self.rollouts
        try:
            examples = self.examples()
            plans = [self.plan(*example) for example in examples]
        except ValueError as error:
            fail(error)
        self.grounds = [ground for ground, *_ in examples]
        policy.sigma = (args.noise * plans[0].u[0].std(0)).clamp(min=1e-3)  # a motor at rest needs a density
        self.guides = [*map(self.guide, self.grounds, plans)]  # line 1: generate guides
        rollouts.start = self.guides[0].x[:1]
        guiding = self.sample_guides()  # line 2: sample their mixture
        policy.theta = self.pretrain()  # line 3: initialise theta*
        self.S.samples = guiding.pick(slice(0))  # line 4: build S from the guides and theta*
        if self.guided:
            self.S.append(guiding, *self.guides)
        self.initial = self.best = len(self.S.generators)
        own = rollouts.draw(policy.theta, self.best)
        self.S.append(own, (policy.theta,))
        self.scale = self.S.samples.reward.std().clamp(min=1e-6).item()
        plan, (mean, std) = -sum(plan.cost.item() for plan in plans) / len(plans), guiding.spread
        say(f"returns: example {plan:.1f}, guides {mean:.1f} +- {std:.1f}, policy {own.spread[0]:.1f}")
        guides = {"gps/plan": plan, "gps/guides": mean, "gps/guides_std": std}
        return self.rollouts.metrics(own) | guides | {"gps/guides_action": guiding.u.tanh().abs().mean().item()}

    def iterate(self, iteration: int) -> dict[str, float]:
        """Lines 6 to 17; returns metrics."""
        args, policy, S, draw = self.args, self.network, self.S, self.rollouts.draw
        active = self.choose(args.active, args.samples)  # line 6: choose S_k
        theta, metrics = self.optimise(S.samples.pick(active))  # line 7: theta_k <- arg max Phi
        source = len(S.generators)
        new = draw(theta, source)  # line 8: append samples from theta_k to S_k and S
        active = torch.cat((active, S.append(new, (theta,))))
        if iteration <= args.adaptive:
            active = torch.cat((active, self.adapt()))  # line 9: generate adaptive guiding samples
        better, values = self.estimate(theta, active)  # line 10: estimate the values of theta_k and theta*
        if better:  # ten samples do not see that one in ten falls: confirm it with more, and with all of theta*'s
            S.append(draw(theta, source, args.guiding_samples))
            own = (S.samples.source == source) | (S.samples.source == self.best)
            better, values = self.estimate(theta, torch.cat((active, own.nonzero().flatten())).unique())
        if better and args.beyond > 1:  # Eq. 2 looks no further than the horizon
            better = self.rollouts.endurance(theta) > self.rollouts.endurance(policy.theta)
        metrics |= values | {"gps/accepted": float(better), "gps/regularizer": self.w_r}
        low, high = args.regularizer_bounds
        if better:  # line 11
            policy.theta, self.best = theta, source  # line 12: theta* <- theta_k
            self.w_r = max(self.w_r / 10, low)  # line 13: decrease w_r
        else:  # line 14
            self.w_r = min(self.w_r * 10, high)  # line 15: increase w_r
            S.append(draw(policy.theta, self.best))  # line 16: resample from theta*
        self.best = S.keep(self.choose(STORED * args.active, STORED * args.active // 2), self.best)
        return metrics | self.rollouts.metrics(new)

    def examples(self) -> list[tuple[System, Tensor, Tensor]]:
        """Trajectories x (T + 1, nx), u (T, nu), and what each is planned on."""
        assert (path := self.args.demonstration) is not None
        return [(self.system, x, u) for x, u in load_demonstration(self.system, path, self.args.horizon)]

    def plan(self, ground: System, x: Tensor, u: Tensor) -> Plan:
        """Line 1: an example as this simulator follows it, and as iLQR improves it."""
        followed = follow_demonstration(ground, x, u, self.args.tracking)
        return ilqr(ground, self.cost, *followed, self.args.ilqr_iterations)

    def guide(self, ground: System, plan: Plan) -> LinearGaussian:
        """Line 1: the I-projection of exp(reward) and Section 6's tracking term, as wide as the policy's noise.

        An action is weighed by its deviation over the example, not by --noise: little noise would leave no feedback.
        """
        spread = self.network.sigma / self.args.noise
        cost = Sum((self.cost, Tracking(ground, plan.x, plan.u, self.args.tracking, 0.5 / spread.square())))
        (guide,) = maximum_entropy_controllers(ground, cost, plan)
        return guide.widened(self.network.sigma)

    def sample_guides(self) -> Samples:
        """Line 2. The floor of all later rewards lies as far below the worst step as that one below the best."""
        rollouts = self.rollouts
        samples = rollouts.follow(self.guides, self.grounds, self.args.guiding_samples)
        worst, top = samples.reward[torch.isfinite(samples.reward)].aminmax()
        rollouts.floor = (2 * worst - top).item()
        return samples._replace(reward=samples.reward.clamp(min=rollouts.floor))

    def pretrain(self) -> Tensor:
        """Line 3: the theta under which the guides' actions are likeliest."""
        obs, u = self.lessons()
        self.network.standardise(obs, u)
        return self.network.imitate(obs, u, self.args.pretraining, self.rollouts.rng)

    def lessons(self) -> tuple[Tensor, Tensor]:
        """Observations (n, obs_dim) of guides that --pretraining-noise spreads, and their mean actions (n, nu) there.

        Narrow guides hardly leave the example, and a network that is fitted to them learns no feedback. Steps after a
        fall are left out, because feedback about the example is no answer there.
        """
        wide = [
            guide.widened(self.network.sigma * self.args.pretraining_noise / self.args.noise) for guide in self.guides
        ]
        S = self.rollouts.follow(wide, self.grounds, self.args.guiding_samples)
        steps = slice(0, self.args.horizon)
        means = [guide.mean(self.system, steps, S.x[S.source == i, :-1]) for i, guide in enumerate(wide)]
        upright = (S.reward > self.rollouts.floor).cumprod(1).bool()
        return S.obs[upright], torch.cat(means)[upright]

    def choose(self, active: int, newest: int) -> Tensor:
        """Line 6: indices of theta*'s newest samples, of the initial guides', and of those of most weight under theta*.

        Adapted guides have too many to keep them all. Density breaks ties.
        """
        S, policy = self.S.samples, self.network
        log_w = log_weights(policy.log_prob(policy.theta, S.obs, S.u), S.log_mixture)
        score = torch.softmax(log_w, 0).sum(1) + 1e-9 * log_w[:, -1].clamp(min=-1e6)
        score = torch.where(S.source < self.initial, 2e9, score)
        score[(S.source == self.best).nonzero().flatten()[-newest:]] = 3e9
        return score.argsort(descending=True, stable=True)[:active].sort().values

    def optimise(self, S: Samples) -> tuple[Tensor, dict[str, float]]:
        """Line 7, from two starts (Section 5): theta*, and theta* fitted to the sample of the highest reward."""
        policy, iterations, top = self.network, self.args.lbfgs_iterations, S.returns.argmax()
        value = self.objective(S.log_mixture, S.reward / self.scale)
        starts = [policy.theta, policy.fit(policy.theta, S.obs[top], S.u[top], iterations)][: self.starts]
        ends = [maximise(lambda theta: policy.sparse(value, theta, S), theta, iterations) for theta in starts]
        start = max(range(len(ends)), key=lambda i: ends[i][1])
        return ends[start][0], {"gps/phi": ends[start][1], "gps/start": start}

    def objective(self, mixture: Tensor, reward: Tensor) -> Callable[[Tensor], Tensor]:
        """Phi () of log pi (m, T), for samples of this mixture and these rewards (m, T)."""
        return lambda log_pi: phi(log_pi, mixture, reward, self.w_r)

    def log_density(self, generator: tuple[Tensor, ...], samples: Samples) -> Tensor:
        """(m, T) of prefixes: under a guide, or under a policy (theta,)."""
        if len(generator) > 1:
            return LinearGaussian(*generator).log_prob(self.system, samples.x, samples.u).cumsum(1)
        return self.network.log_prob(generator[0], samples.obs, samples.u).cumsum(1)

    def adapt(self) -> Tensor:
        """Line 9: guides of exp(reward) pi_theta* (Section 4.2), from the last ones; their samples' indices."""
        args, system, policy = self.args, self.system, self.network
        guides, theta = self.adapted or self.guides, policy.theta
        x, u = torch.stack([g.x for g in guides]), torch.stack([g.u for g in guides])
        cost = Sum((self.cost, Surprisal(system, lambda x: policy.mean(theta, system.observe(x)), policy.sigma)))
        plan = ilqr(system, cost, x, u, args.adaptive_iterations, mu=1e-3)
        self.adapted = maximum_entropy_controllers(system, cost, plan)
        new = self.rollouts.follow(self.adapted, self.grounds, args.samples, len(self.S.generators))
        return self.S.append(new, *self.adapted)

    def estimate(self, theta: Tensor, active: Tensor) -> tuple[bool, dict[str, float]]:
        """Line 10: whether theta is better than theta* by Eq. 2 on the active set; the values, and theta's weights."""
        S = self.S.samples.pick(active)
        mixture = S.log_mixture
        log_pi = [self.network.log_prob(t, S.obs, S.u) for t in (theta, self.network.theta)]
        values = [phi(log_p, mixture, S.reward, 0.0).item() for log_p in log_pi]
        if not all(map(math.isfinite, values)):
            raise FloatingPointError(f"the value estimates are {values}: no active sample has a finite density")
        weights = torch.softmax(log_weights(log_pi[0], mixture), 0).sum(1)
        share = (weights[S.source < self.initial].sum() / weights.sum()).item()
        metrics = {"gps/estimate": values[0], "gps/best_estimate": values[1], "gps/guide_share": share}
        return values[0] > values[1], metrics

    def evaluate(self) -> Evaluation:
        """The best policy."""
        return self.rollouts.evaluate(self.network.theta)

    @property
    def policy(self) -> nn.Sequential:
        """theta* without noise, for environments and checkpoints: actions after tanh, a previous one not observed."""
        policy = self.network
        normalizer = ObsNormalizer(len(policy.observed))
        normalizer.mean, normalizer.std = policy.obs_mean, policy.obs_std
        w1, b1, w2, b2 = policy.split(policy.theta)
        layers = [nn.utils.skip_init(nn.Linear, *w.mT.shape) for w in (w1, w2)]  # draws no random numbers
        parts = (w1 * policy.observed, b1), (policy.u_std.unsqueeze(1) * w2, policy.u_std * b2 + policy.u_mean)
        for layer, (weight, bias) in zip(layers, parts, strict=True):
            layer.weight, layer.bias = nn.Parameter(weight), nn.Parameter(bias)
        return nn.Sequential(normalizer, layers[0], nn.Softplus(), layers[1], nn.Tanh())

    def state_dict(self) -> dict[str, Any]:
        state = {name: getattr(self, name) for name in ("best", "initial", "w_r", "scale")}
        return state | {name: [tuple(guide) for guide in getattr(self, name)] for name in ("guides", "adapted")}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name in ("best", "initial", "w_r", "scale"):
            setattr(self, name, state[name])
        for name in ("guides", "adapted"):
            guides = [LinearGaussian(*(part.to(self.system.device) for part in guide)) for guide in state[name]]
            setattr(self, name, guides)
        self.grounds = [self.system] * len(self.guides)


class Rollouts:
    """Trajectories of guides and policies, with the reward that is optimised."""

    def __init__(self, args: Args, system: System, network: GaussianPolicy) -> None:
        self.args, self.system, self.network = args, system, network
        self.rng = torch.Generator().manual_seed(args.seed)  # on the CPU: the same numbers for every device
        self.start = system.start()  # (n, nx) any of which a policy starts from
        self.floor = -math.inf  # least reward of a step
        self.control_steps = self.nonfinite = 0

    def reward(self, x: Tensor, u: Tensor) -> Tensor:
        """What is optimised (Section 6): reward (...) of u (..., nu), which led to x (..., nx)."""
        system, cost = self.system, self.args.action_cost * u.square().sum(-1)
        if self.args.task not in TARGETS:
            return system.reward(x, u) - cost
        target_velocity, target_height, height_weight, attitude_weight = TARGETS[self.args.task]
        if system.scene.floating:
            height, attitude = x[..., 2], 4.0 * x[..., 4:7].square().sum(-1)
        else:
            height, attitude = x[..., 1] + float(system.scene.mj_model.body_pos[1, 2]), x[..., 2].square()
        cost = cost + (x[..., system.nq] - target_velocity).square() + attitude_weight * attitude
        return -(cost + height_weight * (height - target_height).square())

    def noise(self, count: int, rng: torch.Generator | None = None, horizons: int = 1) -> Tensor:
        """(count, horizons T, nu) standard normal."""
        size, rng = (count, horizons * self.args.horizon, self.system.nu), rng or self.rng
        return torch.randn(size, generator=rng, dtype=REAL).to(self.system.device)

    def measure(self, x: Tensor, u: Tensor, finite: Tensor, source: int = -1) -> Samples:
        """What the estimator needs of trajectories; a diverged step earns the floor, so that it does not rule Phi."""
        self.nonfinite += int((~finite[:, -1]).sum())
        reward = torch.where(finite, self.reward(x[:, 1:], u), self.floor).clamp(min=self.floor)
        sources, log_q = torch.full((len(u),), source, device=u.device), u.mT[:, :0]
        return Samples(x, self.system.observe(x[:, :-1]), u, reward, sources, log_q)

    def roll_out(self, theta: Tensor, noise: Tensor, start: Tensor, source: int = -1) -> Samples:
        """Trajectories of a policy with standard normal noise (m, T, nu), from start (1 or m, nx)."""

        def act(t: int, x: Tensor) -> Tensor:
            return self.network.mean(theta, self.system.observe(x)) + self.network.sigma * noise[:, t]

        return self.measure(*self.system.rollout(start.expand(len(noise), -1), noise.shape[1], act), source)

    def draw(self, theta: Tensor, source: int = -1, count: int = 0) -> Samples:
        """So many trajectories of a policy, by default --samples; those without a source do not join S."""
        count = count or self.args.samples
        self.control_steps, noise = self.control_steps + count * self.args.horizon, self.noise(count)
        start = self.start[torch.randint(len(self.start), (count,), generator=self.rng).to(self.start.device)]
        return self.roll_out(theta, noise, start, source)

    def endurance(self, theta: Tensor) -> float:
        """The mean return of a policy over --beyond horizons with as many times the noise, each time the same."""
        factor, rng = self.args.beyond, torch.Generator().manual_seed(self.args.seed)
        noise = factor * self.noise(self.args.samples, rng, factor)
        self.control_steps += noise.shape[0] * noise.shape[1]
        return self.roll_out(theta, noise, self.start[:1]).spread[0]

    def follow(self, guides: list[LinearGaussian], grounds: list[System], count: int, first: int = 0) -> Samples:
        """So many trajectories of guides in equal shares, each on its ground, numbered from the first source on."""
        self.control_steps += count * self.args.horizon
        shares = [self.noise(len(range(i, count, len(guides)))) for i in range(len(guides))]
        each = enumerate(zip(guides, grounds, shares, strict=True), first)
        parts = [self.measure(*guide.sample(ground, noise), source) for source, (guide, ground, noise) in each]
        return Samples(*map(torch.cat, zip(*parts, strict=True)))

    def metrics(self, samples: Samples) -> dict[str, float]:
        mean, std = samples.spread
        return {"charts/episodic_return": mean, "gps/return_std": std, "sim/nonfinite": self.nonfinite}

    @torch.no_grad()
    def evaluate(self, theta: Tensor) -> Evaluation:
        """A policy by the reward that is optimised, with the same noise each time."""
        system, count, steps = self.system, self.args.eval_episodes, self.args.horizon
        noise = self.noise(count + 1, torch.Generator().manual_seed(SEED))
        noise[count] = 0.0
        rollouts = self.roll_out(theta, noise, self.start[:1])
        S, speed = rollouts.pick(slice(count)), None
        if (forward := system.task.forward_column) is not None:
            speed = (S.x[:, -1, forward] - S.x[:, 0, forward]).mean().item() / (steps * system.control_dt)
        qpos, action = S.x[:, :-1, : system.nq].transpose(0, 1), S.u.tanh().transpose(0, 1)
        lengths, (mean, std), size = torch.full_like(S.source, steps), S.spread, action.abs().mean().item()
        others = dict(objective=mean, objective_std=std, worst=S.returns.min().item(), action=size)
        others["without_noise"] = rollouts.returns[count].item()
        return Evaluation(S.returns, lengths, speed, qpos, action, system.scene, system.control_dt, others)

    def state_dict(self) -> dict[str, Any]:
        state = {name: getattr(self, name) for name in ("start", "floor", "control_steps", "nonfinite")}
        return state | {"rng": self.rng.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.start = state["start"].to(self.system.device)
        self.floor, self.control_steps, self.nonfinite = (state[n] for n in ("floor", "control_steps", "nonfinite"))
        self.rng.set_state(state["rng"])


# Importance sampling --------------------------------------------------------------------------------------------------


def log_weights(log_pi: Tensor, log_mix: Tensor) -> Tensor:
    """(m, T) log pi(zeta_1:t) / q(zeta_1:t) from per-step log pi (m, T)."""
    return log_pi.cumsum(1) - log_mix


def phi(log_pi: Tensor, log_mix: Tensor, reward: Tensor, w_r: float) -> Tensor:
    """The objective of Section 3: Eq. 2 and the regulariser, of rewards (m, T). At w_r = 0 the value estimate."""
    log_w = log_weights(log_pi, log_mix)
    log_z = torch.logsumexp(log_w, 0) - math.log(len(log_w))
    return (torch.softmax(log_w, 0) * reward).sum() + w_r * log_z.sum()


# The run --------------------------------------------------------------------------------------------------------------


def train(args: Args, learner: type[Search] = Search) -> None:
    run = Run(args)
    search = run.restore(learner(args, run.eval_env))
    if run.iteration == 0:
        run.log(search.prepare(run.message), search.rollouts.control_steps)
    for iteration in run:  # lines 5 to 18
        before = search.rollouts.control_steps
        run.log(search.iterate(iteration), search.rollouts.control_steps - before)
        if run.evaluation_due:
            run.log_evaluation(search.evaluate())


main = script(Args, train, lambda args: evaluate_checkpoint(args, Search))

if __name__ == "__main__":
    main()
