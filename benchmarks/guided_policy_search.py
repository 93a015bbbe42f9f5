"""Guided policy search as its paper compares it: ablations, terrains, what lasts; and examples for it.

    python benchmarks/guided_policy_search.py --case dagger --env hopper      train a variant (Figure 2)
    python benchmarks/guided_policy_search.py --env walker --terrain incline:10 --demonstration slope.npz
    python benchmarks/guided_policy_search.py last runs/gps/humanoid__full__1    three horizons, three times the noise
    python benchmarks/guided_policy_search.py walk runs/gps/walker__incline__1   over terrains (Figures 3 to 5)
    python benchmarks/guided_policy_search.py draw --update-results              the picture (Figure 2) and the tables
    python benchmarks/guided_policy_search.py record --env walker --run runs/walker --to example.npz

Trainings take the flags of gps.py, too. --resume and --evaluate take the checkpoints of this script. A demonstration of
several terrains says by `terrain` which trajectory is over which one.

last and walk take runs in folders TASK__CASE__SEED. A trajectory counts as walked if the robot stands to its end (the
root never sinks FALL below its start's height over the ground) and comes at least FAR as far as the guides. walk
compares the policy with two controllers of the guides, none of which sees the terrain: DDP is a guide's controller by
time, the best guide's in the table, and TBDP is the feedback of the step of all guides that looks most alike.

record writes what a controller without a clock does. The tasks here have gps.py's reward and control steps, and a fall
ends an episode. The swimmer's controller is a travelling wave, a formula.

    python shac.py --env benchmarks/guided_policy_search.py:WalkerExample --num-envs 64 --iterations 600 \
        --actor-hidden 64 --critic-lr 1e-3 --run-dir runs/walker
    python benchmarks/guided_policy_search.py record --env swimmer --settle 200 --to diffsim/assets/examples/swimmer.npz
    python benchmarks/guided_policy_search.py record --exchange diffsim/assets/examples/walker.npz \
        --to benchmarks/plans/walker_both.npz
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import mean
from typing import Literal, get_args

import numpy as np
import torch
import torch.nn.functional as F
import tyro
from torch import Tensor

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]  # shac.py takes tasks from this file
from common import CheckpointFlags, CommonFlags, checkpoint_of  # noqa: E402
from tables import Row, grouped, markdown, numbers  # noqa: E402

import gps  # noqa: E402
from diffsim import DiffEnv
from diffsim.planning import REAL, System, load_demonstration, save_demonstration
from diffsim.robot.profile import TerrainError
from diffsim.robot.scene import Array, Scene
from diffsim.sim.elevation import Elevation
from diffsim.symmetry.mirror import partners
from diffsim.tasks.hopper import Hopper
from diffsim.tasks.humanoid import Humanoid
from diffsim.training import checkpoint, command, evaluate_checkpoint, fail, load_policy, parse, script
from diffsim.training.evaluation import Evaluation, make_env
from diffsim_robots.terrain import incline, rough
from diffsim_robots.walker import Walker

Act = Callable[[int, Tensor], Tensor]
Rows = list[dict[str, str]]

KEY = ("env", "variant", "seed", "kind", "terrain", "controller")
CONTROLLERS = ("policy", "ddp", "tbdp")  # ddp: the best of "ddp 1", "ddp 2", ..., one for each guide
FALL, FAR = 0.45, 0.9  # m; of the guides' way
COUNT = 10  # trajectories over each terrain, from the same start with the policy's noise
LASTING = ("group", "cell", "seed", "noise")  # key of gps_lasting.csv
HORIZONS, FACTORS = 3, (1, 3)  # as long as the search looks, and times the policy's noise
TRAJECTORIES = {"humanoid": 20}  # of others 100
OTHERS = {"humanoid": (10,)}  # further factors: other tasks search with that noise

Case = Literal[
    "guided", "one-start", "effective-samples", "nonguided", "restart", "single-example", "policy-gradient", "dagger"
]
LEAST = 5.0  # effective samples: half of what the policy draws
MAKERS: dict[str, Callable[..., Array]] = {
    "level": lambda: incline(0.0),
    "incline": incline,
    "rough": lambda degrees, segment=1.0, seed=0.0: rough(seed, segment, degrees),
}
USAGE = "level, incline:DEGREES[:START] or rough:DEGREES[:SEGMENT[:SEED]]"


@dataclass
class VariantArgs(gps.Args):
    """What differs from gps.py."""

    case: Case = "guided"
    """the search of gps.py, or a variant of the paper's algorithm"""
    terrain: tuple[str, ...] = ("level",)
    """train on each, with its own guides: level, incline:DEGREES or rough:DEGREES; the policy sees none"""

    def check(self) -> None:
        super().check()
        if (least := len(self.terrain)) > min(self.samples, self.guiding_samples):
            fail(f"--samples and --guiding-samples must be at least {least}, one for each --terrain")
        if self.adaptive and least > 1:
            fail("--adaptive takes one --terrain")
        named_terrains(*self.terrain)


# Terrains by their names ----------------------------------------------------------------------------------------------


def named_terrains(*names: str) -> Array:
    """(M, K, 2) profiles of M names, K of the longest; USAGE without numbers that have defaults, or with them.

    Raises:
        TerrainError: another name, a number too few or too many, or one that its function refuses.
    """
    profiles = []
    for name in names:
        kind, *numbers = name.split(":")
        try:
            profiles.append(MAKERS[kind](*map(float, numbers)))
        except (KeyError, TypeError, ValueError) as error:
            raise TerrainError(f"terrain {name!r} must be {USAGE}: {error}") from error
    most = max(map(len, profiles))
    for i, p in enumerate(profiles):  # the last segment goes on
        more = p[-1] + np.arange(1, most - len(p) + 1)[:, None] * (p[-1] - p[-2])
        profiles[i] = np.concatenate((p, more))
    return np.stack(profiles)


# Planning over them ---------------------------------------------------------------------------------------------------


class Ground(System):
    """A robot over a terrain (K, 2), or trajectory i of a rollout over number i % M of (M, K, 2).

    The root's height in a state is that over the ground below.
    """

    def __init__(self, env: DiffEnv, terrain: Array, threads: int | None = None) -> None:
        scene = env.scene.with_terrain(terrain)
        assert scene.terrain is not None
        self.profiles = scene.terrain
        self._elevations: dict[int, Elevation] = {}
        super().__init__(env, threads, scene)

    def copies(self, count: int) -> Scene:
        M = len(self.profiles)
        return self.scene if M == 1 else self.scene.with_terrain(self.profiles[np.arange(count) % M])

    def rollout(self, x: Tensor, steps: int, act: Callable[[int, Tensor], Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        ground = self.ground(len(x))
        start = self._moved(x, ground.lift)
        x, u, finite = super().rollout(start, steps, lambda t, x: act(t, self._moved(x, ground.lower)))
        return self._moved(x, ground.lower), u, finite

    def jacobians(self, x: Tensor, u: Tensor) -> Tensor:
        if len(self.profiles) > 1:
            raise ValueError("Jacobians need one terrain for all steps")
        ground, nq, nv = self.ground(1), self.nq, self.nv
        f_z, following = super().jacobians(self._moved(x, ground.lift), u), self.rollout(x, 1, lambda *_: u)[0][:, 1]
        before, after = (F.pad(ground.gradient(part[:, :nq])[..., :nv, :nv], (0, nv, 0, nv)) for part in (x, following))
        f_z[..., : self.nd] = f_z[..., : self.nd] + f_z[..., : self.nd] @ before
        return f_z - after @ f_z

    def ground(self, count: int) -> Elevation:
        """The ground below so many trajectories."""
        if count not in self._elevations:
            self._elevations[count] = Elevation(self.copies(count), self.device, REAL)
        return self._elevations[count]

    def _moved(self, x: Tensor, move: Callable[[Tensor], Tensor]) -> Tensor:
        """x (n, nx) or (n, T, nx), a row for each ground, with qpos lifted or lowered."""
        qpos = move(x[..., : self.nq].movedim(0, -2)).movedim(-2, 0)
        return torch.cat((qpos, x[..., self.nq :]), -1)


class Search(gps.Search):
    """Plans and guides on each of --terrain; the policy's trajectory i goes over number i % n."""

    args: VariantArgs

    def __init__(self, args: VariantArgs, env: DiffEnv) -> None:
        self.args, self.env = args, env
        super().__init__(args, env, None if args.terrain == ("level",) else self.over(*args.terrain))

    def over(self, *names: str) -> Ground:
        return Ground(self.env, named_terrains(*names), self.args.threads or None)

    def examples(self) -> list[tuple[System, Tensor, Tensor]]:
        path, trajectories = self.args.demonstration, [(x, u) for _, x, u in super().examples()]
        assert path is not None
        with np.load(path) as example:
            known = example["terrain"].tolist() if "terrain" in example else ["level"] * len(trajectories)
        if missing := [name for name in self.args.terrain if name not in known]:
            fail(f"{path} has no trajectory over {missing[0]}, only over {', '.join(dict.fromkeys(known))}")
        grounds = {name: self.over(name) if len(self.args.terrain) > 1 else self.system for name in self.args.terrain}
        return [(grounds[name], *pair) for name, pair in zip(known, trajectories, strict=True) if name in grounds]

    def evaluate(self) -> Evaluation:
        found = super().evaluate()
        if isinstance(self.system, Ground):
            found.qpos = self.system.ground(len(found.returns)).lift(found.qpos)
        return found


# The variants ---------------------------------------------------------------------------------------------------------


class OneStart(Search):
    """Line 7 from theta* alone."""

    starts = 1


class EffectiveSamples(Search):
    """Tang and Abbeel 2010: in place of the regularizer a bound on the effective samples of each step (footnote 4)."""

    def objective(self, mixture: Tensor, reward: Tensor) -> Callable[[Tensor], Tensor]:
        def value(log_pi: Tensor) -> Tensor:
            effective = 1 / gps.log_weights(log_pi, mixture).softmax(0).square().sum(0)
            return gps.phi(log_pi, mixture, reward, 0.0) - (LEAST - effective).clamp(min=0).square().sum()

        return value


class NonGuided(Search):
    """S begins without the guides; they only pretrain the policy."""

    guided = False


class Restart(NonGuided):
    """The policy's samples start at any state of the guides, which are no guides otherwise."""

    def sample_guides(self) -> gps.Samples:
        self.rollouts.start = torch.cat([guide.x[:-1] for guide in self.guides])
        return super().sample_guides()


class SingleExample(NonGuided):
    """Pretrained on the example alone, without samples about it."""

    def lessons(self) -> tuple[Tensor, Tensor]:
        x = torch.cat([guide.x[:-1] for guide in self.guides])
        return self.system.observe(x), torch.cat([guide.u for guide in self.guides])


class PolicyGradient(NonGuided):
    """GPOMDP (Baxter et al. 2001): reward to go minus its mean over the samples, at each time."""

    def iterate(self, iteration: int) -> dict[str, float]:
        policy = self.network
        new = self.rollouts.draw(policy.theta)
        to_go = new.reward.flip(1).cumsum(1).flip(1)
        theta = policy.theta.clone().requires_grad_()
        log_pi = policy.log_prob(theta, new.obs, new.u)
        (gradient,) = torch.autograd.grad(((to_go - to_go.mean(0)) * log_pi).sum(), theta)
        policy.theta = policy.theta + 0.1 * gradient / gradient.norm().clamp(min=1e-12)
        return self.rollouts.metrics(new)


class DAgger(NonGuided):
    """Ross et al. 2011: the controller's actions at the states that the policy visits join the data."""

    def lessons(self) -> tuple[Tensor, Tensor]:
        self.data = super().lessons()
        return self.data

    def iterate(self, iteration: int) -> dict[str, float]:
        new = self.rollouts.draw(self.network.theta)
        labels = self.guides[0].mean(self.system, slice(0, new.u.shape[1]), new.x[:, :-1])
        obs, u = torch.cat((self.data[0], new.obs.flatten(0, 1))), torch.cat((self.data[1], labels.flatten(0, 1)))
        self.data = obs, u
        self.network.theta = self.network.fit(self.network.theta, obs, u, self.args.lbfgs_iterations)
        return self.rollouts.metrics(new)


CLASSES = Search, OneStart, EffectiveSamples, NonGuided, Restart, SingleExample, PolicyGradient, DAgger
CASES: dict[str, type[Search]] = dict(zip(get_args(Case), CLASSES, strict=True))


# What lasts, and what walks over terrain ------------------------------------------------------------------------------


def terrains(env: str) -> dict[str, list[str]]:
    """What is walked over: an incline that begins at eight places, and four rough grounds of each steepness."""
    first, steeper = (3, ()) if env == "humanoid" else (10, (15, 20))
    return {f"incline of {first}°": [f"incline:{first}:{0.5 * place}" for place in range(1, 9)]} | {
        f"rough ground of {degrees}°": [f"rough:{degrees}:{size}:{seed}" for size in (1, 2) for seed in (1001, 1002)]
        for degrees in (first, *steeper)
    }


def load_search(path: Path) -> Search:
    """The search of a checkpoint of gps.py or of this script."""
    state = checkpoint.load(path)
    args = VariantArgs(**state["args"] | {"device": "cpu"})
    search = CASES[args.case](args, make_env(args, 1))
    checkpoint.restore(search, state)
    return search


def controllers(search: gps.Search) -> dict[str, Act]:
    """Their mean actions at step t, of states (m, nx)."""
    system, policy = search.system, search.network
    guides = enumerate(search.guides, 1)
    return {
        "policy": lambda _, x: policy.mean(policy.theta, system.observe(x)),
        **{f"ddp {k}": lambda t, x, guide=guide: guide.mean(system, t, x) for k, guide in guides},  # type: ignore[misc]
        "tbdp": nearest(search),
    }


def nearest(search: gps.Search) -> Act:
    """The feedback of the guides' step whose observation is nearest, in deviations of observations.

    The place along x does not count: it is not observed, and a guide's is that of its own terrain.
    """
    system, scale = search.system, search.network.obs_std
    path, u, K = (torch.cat(parts) for parts in zip(*((g.x[:-1], g.u, g.K) for g in search.guides), strict=True))
    looks = system.observe(path) / scale

    def act(_: int, x: Tensor) -> Tensor:
        own = system.observe(x) / scale
        t = torch.cdist(own, looks, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
        away = system.difference(x, path[t])
        away[:, system.task.forward_column] = 0.0
        return u[t] + (K[t] @ away.unsqueeze(-1)).squeeze(-1)

    return act


def walked(search: gps.Search, x: Tensor, finite: Tensor) -> Tensor:
    """(m,) of trajectories x (m, T + 1, nx), of as many steps as the guides or more."""
    height, forward = 2 if search.system.scene.floating else 1, search.system.task.forward_column
    up = (x[:, 1:, height] > x[:, :1, height] - FALL) & finite
    if gps.TARGETS[search.args.task][2] == 0.0:  # a swimmer has no height
        up = finite
    way = mean((guide.x[-1, forward] - guide.x[0, forward]).item() for guide in search.guides)
    return up.all(1) & (x[:, -1, forward] - x[:, 0, forward] >= FAR * way * finite.shape[1] / search.args.horizon)


def lasts(path: Path) -> Iterator[Row]:
    """Of a run: one row for each noise, of HORIZONS times the steps that the search looks at."""
    path = checkpoint_of(path)
    about, search = dict(zip(LASTING, path.parent.name.split("__"), strict=False)), load_search(path)
    T, rollouts = search.args.horizon, search.rollouts
    size = TRAJECTORIES.get(search.args.task, 100), HORIZONS * T, search.system.nu
    noise = torch.randn(size, generator=torch.Generator().manual_seed(gps.SEED), dtype=REAL)
    for factor in (*FACTORS, *OTHERS.get(search.args.task, ())):
        S = rollouts.roll_out(search.network.theta, factor * noise, rollouts.start[:1])
        finite = torch.ones_like(S.reward, dtype=torch.bool)  # diverged ones stay where they fell
        ends = {steps: walked(search, S.x[:, : steps + 1], finite[:, :steps]) for steps in (T, HORIZONS * T)}
        shares = {f"walked {steps // T}": found.double().mean().item() for steps, found in ends.items()}
        returns = {f"return {k + 1}": S.reward[:, k * T : k * T + T].sum(1).mean().item() for k in range(HORIZONS)}
        yield {**about, "noise": factor, "trajectories": len(noise), "steps": T, **shares, **returns}


def walks(path: Path) -> Iterator[Row]:
    """Of a run: one row for each terrain and controller."""
    path = checkpoint_of(path)
    about, search = dict(zip(KEY, path.parent.name.split("__"), strict=False)), load_search(path)
    steps, sigma = search.args.horizon, search.network.sigma
    noise = sigma * search.rollouts.noise(COUNT, torch.Generator().manual_seed(gps.SEED))
    start, acts = search.guides[0].x[:1].expand(COUNT, -1), controllers(search)
    for kind, names in terrains(about["env"]).items():
        for terrain, (name, act) in product(names, acts.items()):
            ground = Ground(search.env, named_terrains(terrain), 1)
            x, _, finite = ground.rollout(start, steps, lambda t, x, act=act: act(t, x) + noise[:, t])  # type: ignore[misc]
            share = walked(search, x, finite).double().mean().item()
            yield about | dict(kind=kind, terrain=terrain, controller=name, walked=share)


def table(rows: Rows) -> list[Row]:
    """A line for each kind of terrain, a column for each training: means over places, seeds; policy / DDP / TBDP."""
    result = list[Row]()
    for (kind,), here in grouped(rows, "kind").items():
        line = dict[str, object](over=kind, **dict.fromkeys((row["variant"] for row in rows), ""))
        for (name,), own in grouped(here, "variant").items():
            seeds = [shares(found) for found in grouped(own, "seed").values()]
            line[name] = " / ".join(f"{mean(each[name] for each in seeds):.0%}" for name in CONTROLLERS)
        result.append(line)
    return result


def shares(rows: Rows) -> dict[str, float]:
    """What each controller of one training walks on average; of the guides the best one."""
    each = {name: mean(numbers(found, "walked")) for (name,), found in grouped(rows, "controller").items()}
    return each | {"ddp": max(share for name, share in each.items() if name.startswith("ddp"))}


# Tables and the picture -----------------------------------------------------------------------------------------------


SHORT = "walker_short"  # whose networks fall when the search begins
NAMES = {
    "full": "guided policy search",
    "unregularized": "without the regularizer",
    "nonguided": "without guides",
    "restart": "restarts from the guides' states",
    "single-example": "a single example, no guides",
    "policy-gradient": "policy gradient",
    "dagger": "DAgger",
}
MAIN = {"full": "", "one-horizon": ", `--beyond 1`", "ddp": ", plan of iLQR"}  # cells of the table of tasks


def tasks(runs: Rows, lasting: Rows) -> list[Row]:
    """A line for each task and example: lowest to highest returns of the seeds, core seconds, and what lasts."""
    result = list[Row]()
    for (group, cell), own in grouped(runs, "group", "cell").items():
        if cell not in MAIN or group == SHORT:
            continue
        line: dict[str, object] = {"task": f"{group}{MAIN[cell]}", "seeds": len(own)}
        for title, name in (("guides", "guides"), ("pretraining alone", "pretrained"), ("search", "end")):
            low, high = min(numbers(own, name)), max(numbers(own, name))
            line[title] = f"{low:.1f} to {high:.1f}" if low < high else f"{low:.1f}"
        line["core seconds"] = f"{mean(numbers(own, 'core_seconds')):.0f}"
        shares = [
            [
                float(row[f"walked {HORIZONS}"])
                for row in lasting
                if [row[name] for name in LASTING if name != "seed"] == key
            ]
            for key in ([group, cell, str(factor)] for factor in FACTORS)
        ]
        line["lasts, noise x 1 / x 3"] = " / ".join(f"{mean(share):.0%}" if share else "" for share in shares)
        result.append(line)
    return result


def plot(args: CommonFlags) -> None:
    """Figure 2: the last return of each training."""
    from matplotlib.figure import Figure

    rows = [row for row in args.read("gps_runs") if row["group"] == SHORT]
    figure = Figure(figsize=(6.5, 2.8), layout="constrained")
    axis = figure.subplots()
    for place, cell in enumerate(NAMES):
        own = [row for row in rows if row["cell"] == cell]
        for column, look in (("pretrained", "k|"), ("end", "C0o" if cell == "full" else "C1o")):
            axis.plot(numbers(own, column), [-place] * len(own), look, alpha=0.7)
    axis.axvline(mean(numbers(rows, "guides")), color="k", linestyle="--", linewidth=1)
    axis.set(xlabel="return (dashed: guides; strokes: before the search)", xscale="symlog", xlim=(-2600, -50))
    axis.set_yticks(range(0, -len(NAMES), -1), NAMES.values())
    axis.xaxis.set_major_formatter("{x:.0f}")
    axis.grid(alpha=0.3)
    path = args.picture("gps_runs")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    print(path)


# Examples -------------------------------------------------------------------------------------------------------------


ALIVE = 3.0  # per step: a fall costs the rest of the episode


class HopperExample(Hopper):
    """Hops at 1.5 m/s."""

    name = "hopper_example"
    control_dt = 0.02
    substeps = 20
    min_height = -0.35

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        error = (obs[..., 5] - 1.5).square() + 10.0 * obs[..., 0].square() + obs[..., 1].square()
        return ALIVE - error - 0.1 * action.square().sum(-1)


class WalkerExample(Walker):
    """Walks at 1.2 m/s."""

    name = "walker_example"
    control_dt = 0.01
    substeps = 10
    min_height = -0.35

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        error = (obs[..., 8] - 1.2).square() + 10.0 * (obs[..., 0] + 0.05).square()
        return ALIVE - error - 10.0 * obs[..., 1].square() - 0.1 * action.square().sum(-1)


class HumanoidExample(Humanoid):
    """Runs at 2.5 m/s, straight on, and does not look at the action before, which gps.py's states do not hold."""

    name = "humanoid_example"
    observe_action, obs_dim = False, 55

    def reward(self, obs: Tensor, action: Tensor) -> Tensor:
        error = (obs[..., 5] - 2.5).square() + obs[..., 6].square() + 10.0 * (obs[..., 0] - 1.2).square()
        turn = 4.0 * obs[..., 1:4].square().sum(-1) + 0.1 * obs[..., 8:11].square().sum(-1)
        return 3.0 * ALIVE - error - turn - 0.3 * action.square().sum(-1)


@dataclass
class RecordArgs:
    to: Path  # the file, an .npz
    env: str = "walker"  # task of gps.py
    run: Path | None = None  # of any script, whose policy acts
    exchange: Path | None = (
        None  # in place of a run: a recorded motion, which is written with that of the other leg first
    )
    terrain: tuple[str, ...] = ("level",)  # a trajectory over each, by the names of this file
    steps: int = 520  # control steps
    settle: int = 0  # control steps before, from a start that is moved by 0.1 in all coordinates: of a cycle


def wave(x: Tensor) -> Tensor:
    """A swimmer's actions (n, 2) before tanh in states x (n, 10), found by a cross-entropy search for the return.

    The front joint oscillates with a limited amplitude about a straight course; the back one follows, later and wider.
    """
    yaw, front, back, front_speed, back_speed = x[:, [2, 3, 4, 8, 9]].unbind(-1)
    q, rate = front - 0.2 * yaw, front_speed / 18.4  # rad
    first = -0.0725 * q + 0.0077 * (1 - (q.square() + rate.square()) / 1.435**2) * front_speed
    second = 0.0854 * (2.055 * (0.946 * q + 0.323 * rate) - back) - 0.0045 * back_speed
    return torch.stack((first, second), -1)


def exchanged(system: System, path: Path) -> tuple[Tensor, Tensor]:
    """States (2, T + 1, nx) and actions (2, T, nu) of a planar robot's motion, and with its legs exchanged."""
    m, sides = system.scene.mj_model, (("right_", "left_"),)
    joints = partners([m.joint(k).name for k in range(m.njnt)], sides)
    motors = partners([m.actuator(k).name for k in range(m.nu)], sides)
    with np.load(path) as file:
        ((x, u),) = load_demonstration(system, path, len(file["action"]))
    other = x[:, [*joints, *(system.nq + k for k in joints)]]
    return torch.stack((x, other)).float(), torch.stack((u, u[:, motors])).float()


def record(args: RecordArgs) -> None:
    words = ["--env", args.env, "--device", "cpu", "--demonstration", str(args.to)]
    flags = parse(VariantArgs, words)
    search = Search(flags, make_env(flags, 1))
    if args.exchange:
        return save_demonstration(search.system, *exchanged(search.system, args.exchange), args.to)
    if not args.run and args.env != "swimmer":
        fail(f"--run must be the directory of a run: only the swimmer has a formula, not {args.env}")
    policy = load_policy(args.run / "checkpoint.pt").network.double() if args.run else None
    inputs = None if policy is None else len(policy.get_buffer("0.mean"))  # a humanoid's own ones may be fewer
    found = list[tuple[Tensor, Tensor]]()
    for name in args.terrain:
        system = search.system if name == "level" else search.over(name)

        def act(t: int, x: Tensor, system: System = system) -> Tensor:
            if policy is None:
                return wave(x)
            return torch.atanh(policy(system.observe(x)[:, :inputs]).clamp(-0.995, 0.995))

        start = system.start()
        if args.settle:
            moved = system.retract(start, torch.full((1, system.nd), 0.1).to(start))
            start = system.rollout(moved, args.settle, lambda t, x, act=act: act(0, x))[0][:, -1]  # type: ignore[misc]
            start[:, system.task.forward_column] = 0.0
        x, u, finite = system.rollout(start, args.steps, act)
        if not bool(finite.all()):
            fail(f"over {name} the motion is not finite")
        value = search.rollouts.reward(x[:, 1 : flags.horizon + 1], u[:, : flags.horizon]).sum().item()
        print(f"{name}: {x[0, -1, 0] - x[0, 0, 0]:.2f} m, return {value:.1f}")
        found.append((x[0].float(), u[0].float()))
    x, u = (torch.stack(parts).squeeze(0) for parts in zip(*found, strict=True))
    save_demonstration(search.system, x, u, args.to, terrain=args.terrain)


# The commands ---------------------------------------------------------------------------------------------------------


@dataclass
class RunArgs(CheckpointFlags):
    """What last and walk take."""


def last(args: RunArgs) -> None:
    for path in args.measured:
        for row in lasts(path):
            args.keep("gps_lasting", row, LASTING)


def walk(args: RunArgs) -> None:
    for path in args.measured:
        for row in walks(path):
            args.keep("gps_controllers", row, KEY)


def draw(args: CommonFlags) -> None:
    args.publish(
        "gps tasks", markdown(tasks(args.read("gps_runs"), args.read("gps_lasting"))), "gps.md", everywhere=True
    )
    if rows := args.read("gps_controllers"):
        args.publish("gps terrain", markdown(table(rows)), "gps.md", everywhere=True)
    plot(args)


train = script(
    VariantArgs,
    lambda args: gps.train(args, CASES[args.case]),
    lambda args: evaluate_checkpoint(args, CASES[args.case]),
)
COMMANDS: dict[str, tuple[Callable[..., None], type]] = {
    "last": (last, RunArgs),
    "walk": (walk, RunArgs),
    "draw": (draw, CommonFlags),
    "record": (record, RecordArgs),
}


@command
def main(words: Sequence[str] | None = None) -> None:
    """Train, unless the first word is one of COMMANDS."""
    words = sys.argv[1:] if words is None else words
    if words and words[0] in COMMANDS:
        function, kind = COMMANDS[words[0]]
        function(tyro.cli(kind, description=__doc__, args=words[1:]))
    else:
        train(words)


if __name__ == "__main__":
    main()
