"""Guided policy search: the runs of docs/gps.md, by tasks, cases and seeds, and what came of them.

    python benchmarks/gps_experiments.py                  all runs; finished ones are kept, interrupted ones resumed
    python benchmarks/gps_experiments.py --env hopper --cases full adaptive --seeds 1 2 --train-only    a part of them
    python benchmarks/gps_experiments.py --draw-only      only draw and tabulate what there is
    python benchmarks/gps_experiments.py --list           a command for each plan, and for each run, to run side by side
    python benchmarks/gps_experiments.py --env hopper walker --temperatures      guides at several temperatures
    python benchmarks/gps_experiments.py --record hop.npz --actor runs/<run>/checkpoint.pt     record a policy

Cases, plans and the suite of docs/gps.md are in cases.json; what follows "--" goes to gps.py. Writes gps_runs.csv
(every iteration of all runs), gps_generalisation.csv (controllers from perturbed starts and under pushes),
gps_torques.csv, the table of gps.md, and pictures of the paper's Figures 2 and 3.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from typing import Annotated, Any

import gps_ground
import gps_variants
import numpy as np
import torch
import tyro
from cells import Case, Runner, ScriptFlags
from common import Line, Panel, check_names, checkpoint_of, parse, plot
from groups import grouped, middle, numbers
from tables import ROOT, Row, markdown, read_csv, write_csv
from torch import Tensor

import diffsim
import gps
from diffsim.planning import REAL, LinearGaussian, nearest_feedback
from diffsim.training import checkpoint, command, fail, load_policy, make_policy_env
from diffsim.training import parse as parse_script
from diffsim.training.evaluation import make_env

GPS = json.loads((ROOT / "benchmarks" / "cases.json").read_text())["gps"]
CASES: dict[str, str] = GPS["cases"]  # what a run is called, and its flags
PLANS: dict[str, str] = GPS["plans"]  # runs of gps.py that write a plan of benchmarks/plans/; others: results/README.md
# What docs/gps.md shows, per task: cases, seeds, flags. Other seeds run as the first of their case.
SUITE: dict[str, list[tuple[str, list[int], str]]] = GPS["suite"]
SCRIPTS = {"--case": "gps_variants", "--terrain": "gps_ground", "--practice": "gps_ground"}  # by their own flags
ARGS = {"gps": gps.Args, "gps_variants": gps_variants.VariantArgs, "gps_ground": gps_ground.GroundArgs}
RUN = ("env", "variant", "seed")
KEPT = (  # columns of progress.csv
    "iteration control_steps seconds return gps_objective gps_objective_std gps_accepted gps_regularizer gps_plan "
    "gps_guides gps_guides_std eval_objective eval_objective_std eval_without_noise eval_return eval_speed "
    "eval_length gps_ess gps_guide_share gps_guide_nats gps_near gps_estimate gps_best_estimate sim_model_steps "
    "gps_start"
).split()
SPREADS = (1.0, 3.0, 10.0, 30.0, 0.0)  # the last one is of eta = 1
COUNT = 20  # trajectories of guides, and perturbed starts and pushes of each size
WEIGHED = (1, 2, 5, 10, 20, 50, 100, 200, 500)  # control steps at which weights are told
SHOWN = (1, 10, 50, 500)  # of them in the page
KINDS = {"start": (0.0, 0.05, 0.1, 0.2, 0.5, 1.0), "push": (0.5, 1.0, 2.0)}  # perturbations and their sizes
DRAWN = "unregularized effective nonguided restart single-example policy-gradient dagger full paper adaptive".split()
DRAWN += "feedback feedback-short feedback-long".split()
COLOURS = [*(f"C{i}" for i in range(10)), "k", "m", "y"]
CONTROLLERS = {"policy": "C0", "ddp": "C3", "tbdp": "C1"}
Runs = list[dict[str, str]]
Act = Callable[[int, Tensor], Tensor]


@dataclass
class Args(ScriptFlags):
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = tuple(SUITE)  # type: ignore[assignment]
    device: str = "cpu"  # torch device of the runs
    seeds: tuple[int, ...] = ()  # seeds (default: the suite's)
    cases: tuple[str, ...] = ()  # cases (default: the suite's)
    jobs: int = 1  # runs at a time
    runs: Path = ROOT / "runs" / "gps"  # directory of the runs: {runs}/{env}__{case}__{seed}
    train_only: bool = False  # only train: several such commands may run side by side
    temperatures: bool = False  # only sample guides of the case `paper` at several temperatures
    list: bool = False  # only print a command for each plan and each run
    record: Path | None = None  # write the trajectory of --actor's deterministic policy here; nothing else is done
    actor: Path | None = None  # checkpoint of any script that --record follows
    steps: int = 500  # control steps of a recording


# Demonstrations -------------------------------------------------------------------------------------------------------


@torch.no_grad()
def record(path: Path, actor: Path | None, steps: int) -> None:
    """The trajectory of a script's policy from the task's unperturbed start: qpos, qvel and action."""
    if actor is None:
        fail("--record needs --actor, a checkpoint of any script")
    saved = load_policy(actor)
    env = make_policy_env(saved, 1, early_termination=False)
    env.episode_length = steps + 1  # no reset within the recording
    env.reset()
    obs = env.set_state(*env.task.reset(torch.full((1, env.task.num_random), 0.5)))  # the unperturbed start
    states, actions = [(env.qpos, env.qvel)], []
    for _ in range(steps):
        actions.append(saved.network(obs).clamp(-1, 1))
        obs = env.step(actions[-1])[0]
        states.append((env.qpos, env.qvel))
    qpos, qvel = (torch.cat(parts).numpy() for parts in zip(*states, strict=True))
    with path.open("wb") as file:
        np.savez(file, qpos=qpos, qvel=qvel, action=torch.cat(actions).numpy(), control_dt=env.control_dt)
    print(f"{env.task.name}, {steps} control steps: {path}")


# Runs -----------------------------------------------------------------------------------------------------------------


def script(flags: Sequence[str]) -> str:
    """The script that takes these flags, without .py."""
    return next((f"benchmarks/{name}" for flag, name in SCRIPTS.items() if flag in flags), "gps")


def train(runner: Runner, name: str, flags: Sequence[str]) -> None:
    """Train a run, or resume it, or find that it is done, and measure its controllers and weights."""
    directory, (env, case, seed) = runner.args.runs / name, name.split("__")
    words = (*CASES[case].split(), "--threads", "1", *flags)
    if not runner.train(Case(directory, env, int(seed), script(words), words)):
        return
    for kind, (cases, measure) in MEASURES.items():
        path = directory / f"{kind}.csv"
        if case in cases and not path.is_file():
            write_csv(path, list(measure(load_search(directory / "checkpoint.pt"))))
    print(f"{name}: done", flush=True)


def jobs(args: Args) -> dict[str, list[str]]:
    """The flags of each run, by its name."""
    result = {}
    for env in args.env:
        suite = SUITE.get(env, [("full", [1], "--iterations 30")])
        known = {(case, seed): flags for cases, seeds, flags in suite for case in cases.split() for seed in seeds}
        default, first = suite[0][2], {case: flags for cases, _, flags in reversed(suite) for case in cases.split()}
        for case in args.cases or dict.fromkeys(case for case, _ in known):
            for seed in args.seeds or [seed for own, seed in known if own == case] or [1]:
                flags = known.get((case, seed), first.get(case, default))
                result[f"{env}__{case}__{seed}"] = flags.split()
    return result


def commands(args: Args) -> Iterator[str]:
    """One for each plan that the runs start from, then one for each run, of one thread."""
    for name, plan in PLANS.items():
        if name.split("_")[0] in args.env:
            flags = plan.split()
            yield shlex.join(["python", f"{script(flags)}.py", *flags, "--run-dir", f"runs/plans/{name}"])
    runs = args.runs.relative_to(ROOT) if args.runs.is_relative_to(ROOT) else args.runs
    rest = ["--", *args.arguments] if args.arguments else []
    for name in jobs(args):
        env, case, seed = name.split("__")
        flags = f"--env {env} --cases {case} --seeds {seed} --runs {runs} --train-only".split()
        yield shlex.join(["python", "benchmarks/gps_experiments.py", *flags, *rest])


def load_search(path: Path) -> gps.Search:
    """The search of a checkpoint of gps.py, gps_variants.py or gps_ground.py."""
    state = checkpoint.load(path)
    args = ARGS[state["script"]](**state["args"] | {"device": "cpu"})
    kind: Any = gps_ground.Search if isinstance(args, gps_ground.GroundArgs) else gps.Search
    if isinstance(args, gps_variants.VariantArgs):
        kind = gps_variants.CASES[args.case]
    search: gps.Search = kind(args, make_env(args, 1))
    checkpoint.restore(search, state)
    return search


def load_run(path: Path) -> tuple[dict[str, object], gps.Search]:
    """The cells of RUN and the search of a run's directory, {env}__{variant}__{seed}, or of its checkpoint."""
    path = checkpoint_of(path)
    return dict(zip(RUN, path.parent.name.split("__"), strict=True)), load_search(path)


def controllers(search: gps.Search) -> dict[str, Act]:
    """The policy's mean; the DDP controller; and the DDP controller of the step that looks most alike (TBDP)."""
    system, policy, guide = search.system, search.network, search.guides[0]
    return {
        "policy": lambda _, x: policy.mean(policy.theta, system.observe(x)),
        "ddp": lambda t, x: guide.mean(system, t, x),
        "tbdp": lambda _, x: nearest_feedback(system, search.guides, x, policy.obs_std)[0],
    }


def scalars(**cells: object) -> dict[str, object]:
    """Cells of a row, as numbers where they are tensors."""
    return {name: cell.item() if isinstance(cell, Tensor) else cell for name, cell in cells.items()}


def keeps(returns: Tensor, best: float) -> Tensor:
    """Which trajectories' returns are within a quarter of the best."""
    return returns >= best - 0.25 * abs(best)


def ends(search: gps.Search, x: Tensor, u: Tensor, finite: Tensor) -> dict[str, object]:
    """Mean return of trajectories, and the share that keeps the guides' mean."""
    returns = search.measure(x, u, finite).returns
    return scalars(mean=returns.mean(), kept=keeps(returns, search.guide_return[0]).double().mean())


def pushed(search: gps.Search, start: Tensor, act: Act, kick: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Trajectories whose states change by a tangent vector a quarter of the time in."""
    system, T = search.system, search.args.horizon // 4
    x, u, finite = system.rollout(start, T, act)
    later = system.rollout(system.retract(x[:, -1], kick), search.args.horizon - T, lambda t, x: act(T + t, x))
    x, u = torch.cat((x, later[0][:, 1:]), 1), torch.cat((u, later[1]), 1)
    return x, u, torch.cat((finite, later[2] & finite[:, -1:]), 1)


def generalisation(search: gps.Search) -> Iterator[Row]:
    """Each controller from the same perturbed starts and under the same pushes.

    A start differs by a normal vector of `size` times the standard deviation of each coordinate over the plan; a push
    changes the root's velocity along x by `size` m/s in either direction, a quarter of the time in.
    """
    system, path = search.system, search.guides[0].x[:-1]
    spread = system.difference(path, path[:1]).std(0)
    draws = torch.randn(COUNT, system.nd, generator=torch.Generator().manual_seed(gps.SEED), dtype=REAL)
    kick = torch.zeros_like(draws)
    kick[:, system.nv] = draws[:, 0].sign()
    for kind, size in ((kind, size) for kind, sizes in KINDS.items() for size in sizes):
        start = path[:1].expand(COUNT, -1)
        away = system.retract(start, size * spread * draws)
        for name, act in controllers(search).items():
            if kind == "push":
                found = pushed(search, start, act, size * kick)
            else:
                found = system.rollout(away, search.args.horizon, act)
            yield scalars(kind=kind, size=size, controller=name) | ends(search, *found)


def noisy(act: Act, noise: Tensor) -> Act:
    """The controller with noise (m, T, nu) on its actions."""
    return lambda t, x: act(t, x) + noise[:, t]


def torques(search: gps.Search) -> Iterator[Row]:
    """The motors' torques (N m) under each controller, without noise and with the policy's, and in guiding samples.

    Means over steps and motors of their magnitude and square.
    """
    system, policy, guide = search.system, search.network, search.guides[0]
    gear = torch.tensor(system.scene.mj_model.actuator_gear[:, 0], dtype=REAL)
    noise, horizon = search.noise(COUNT, torch.Generator().manual_seed(gps.SEED)), search.args.horizon
    start = guide.x[:1].expand(COUNT, -1)
    cases = {("guide", "guide"): guide.sample(system, noise)}
    for name, act in controllers(search).items():
        cases[name, "none"] = system.rollout(start, horizon, act)
        cases[name, "policy"] = system.rollout(start, horizon, noisy(act, policy.sigma * noise))
    for (name, kind), found in cases.items():
        torque = gear * found[1].tanh()
        row = scalars(controller=name, noise=kind, magnitude=torque.abs().mean(), square=torque.square().mean())
        yield row | ends(search, *found)


def width(guide: LinearGaussian, sigma: Tensor) -> Tensor:
    """(T,) a guide's mean variance, in the policy's."""
    return (guide.L.norm(dim=-1) / sigma).square().mean(-1)


def weights(search: gps.Search) -> Iterator[Row]:
    """What importance sampling rests on, at some steps t: how theta* weighs the samples of S.

    Mean log weights (nats) of the guides' samples and of its own newest, effective samples, the guides' share of the
    weight; and up to t, per step, on the guides' samples: log pi - log q_guide (nats), the distance of the actions from
    the policy's mean and the guides' deviation, in deviations of the policy's noise.
    """
    S, policy = search.S.samples, search.network
    log_pi, guides = policy.log_prob(policy.theta, S.obs, S.u), search.S.initial
    log_w, guided = gps.log_weights(log_pi, S.log_mixture), S.source < guides
    own, weight = (S.source == search.S.best).nonzero().flatten()[-search.args.samples :], log_w.softmax(0)
    gap = log_pi.cumsum(1) - gps.log_mixture(S.log_q[:, :guides])
    away = ((S.u - policy.mean(policy.theta, S.obs)) / policy.sigma).square().mean(-1)
    wide = width(search.guides[0], policy.sigma)
    for t in (t for t in WEIGHED if t <= search.args.horizon):
        row = scalars(step=t, guides=log_w[guided, t - 1].mean(), own=log_w[own, t - 1].mean())
        row |= scalars(effective=1 / weight[:, t - 1].square().sum(), share=weight[guided, t - 1].sum())
        row |= scalars(gap=gap[guided, t - 1].mean() / t, away=away[guided, :t].mean().sqrt())
        yield row | scalars(wide=wide[:t].mean().sqrt())


MEASURES: dict[str, tuple[Sequence[str], Callable[[gps.Search], Iterator[Row]]]] = {  # csv files, and of which cases
    "generalisation": (("full", "feedback", "feedback-short", "feedback-start"), generalisation),
    "weights": (("paper", "paper-20"), weights),
    "torques": (("feedback-few", "feedback-short"), torques),
}


def temperatures(env: str) -> Iterator[Row]:
    """Guides of the case `paper` by the temperature eta of exp(reward / eta), and how their trajectories end.

    `wide` is the guides' deviation in those of the policy's noise; trajectories are kept by the plan's return.
    """
    (flags,) = jobs(Args(env=(env,), cases=("paper",), seeds=(1,))).values()
    words = ["--env", env, *CASES["paper"].split(), *flags, "--device", "cpu", "--threads", "1"]
    args = parse_script(gps.Args, words)
    search = gps.Search(args, make_env(args, 1))
    plan = search.plan(search.system, lambda _: None)
    search.network.sigma, best = (args.noise * plan.u[0].std(0)).clamp(min=1e-3), -plan.cost.item()
    for args.spread in SPREADS:
        (guide,) = search.guides = search.guide(search.system, plan, lambda _: None)
        returns = search.follow([guide], COUNT).returns
        row = scalars(env=env, spread=args.spread, eta=guide.eta, wide=width(guide, search.network.sigma).mean().sqrt())
        row |= scalars(plan=best, mean=returns.mean(), median=returns.median())
        yield row | scalars(kept=keeps(returns, best).double().mean())


# Table and pictures ---------------------------------------------------------------------------------------------------


def collect(args: Args) -> None:
    """From the runs to the csv files; rows of runs that are not here stay as they are there."""
    for directory in sorted(path.parent for path in args.runs.glob("*__*__*/progress.csv")):
        run = dict(zip(RUN, directory.name.split("__"), strict=True))
        about = run | {"horizon": json.loads((directory / "args.json").read_text())["horizon"]}
        rows = read_csv(directory / "progress.csv")
        kept = [about | {key: f"{float(row[key]):.6g}" if row.get(key) else "" for key in KEPT} for row in rows]
        args.replace("gps_runs", kept, RUN)
        for name in MEASURES:
            args.replace(f"gps_{name}", [run | row for row in read_csv(directory / f"{name}.csv")], RUN)


def table(runs: Runs) -> list[Row]:
    """Of each case, the runs that were evaluated: means over seeds, and the best policy's last evaluation in each."""
    result = list[Row]()
    for (env, case), own in sorted(grouped(runs, "env", "variant").items()):
        seeds = [rows for rows in grouped(own, "seed").values() if any(row["eval_objective"] for row in rows)]
        if not seeds:
            continue
        ends = [[row["eval_objective"] for row in rows if row["eval_objective"]][-1] for rows in seeds]
        guides, pretrained = (mean(numbers([rows[0] for rows in seeds], f"gps_{c}")) for c in ("guides", "objective"))
        iterations = sorted({int(rows[-1]["iteration"]) for rows in seeds})
        line = {"task": env, "case": case, "T": own[0]["horizon"], "guides": f"{guides:.1f}"}
        line |= {"pretrained": f"{pretrained:.0f}"}
        line |= {"end, each seed": ", ".join(f"{float(end):.1f}" for end in ends)}
        result.append(line | {"iterations": "-".join(map(str, iterations[:: len(iterations) - 1 or 1]))})
    return result


def shown(rows: Runs) -> list[Row]:
    """Of each case, at some steps: mean log weight of the guides' samples, effective samples; medians over seeds."""
    result = list[Row]()
    for (env, case), own in grouped(rows, "env", "variant").items():
        steps = {int(float(step)): seeds for (step,), seeds in grouped(own, "step").items()}
        line = {"task": env, "case": case}
        for t in (t for t in SHOWN if t in steps):
            line[f"t = {t}"] = " / ".join(middle(steps[t], name, ".0f") for name in ("guides", "effective"))
        result.append(line)
    return result


def spreads(rows: Runs) -> list[Row]:
    """Of each task, by the spread of its guides: their median return, and the share that keeps the plan's."""
    result = list[Row]()
    for (env,), own in grouped(rows, "env").items():
        cells = {f"spread {row['spread']}" if row["spread"] != "0" else "η = 1": row for row in own}
        shares = {name: f"{float(row['median']):.0f} ({float(row['kept']):.0%})" for name, row in cells.items()}
        result.append({"task": env, "plan": f"{float(own[0]['plan']):.0f}", **shares})
    return result


def variants(rows: Runs, env: str) -> Panel:
    """Mean cost of the proposals: thin, each run; bold, their median; grey, the guiding samples."""
    lines = list[Line]()
    for case, colour in zip(DRAWN, COLOURS, strict=False):
        seeds = grouped((row for row in rows if (row["env"], row["variant"]) == (env, case)), "seed").values()
        costs = [[-value for value in numbers(own, "gps_objective")] for own in seeds]
        middles = [median(values) for values in zip(*costs, strict=False)]
        lines += [Line(range(len(cost)), cost, f"{colour}-", width=0.4) for cost in costs]
        lines.append(Line(range(len(middles)), middles, f"{colour}-", case, 2.0))
        lines += [Line((0, len(middles)), [-numbers(own, "gps_guides")[0]] * 2, "0.6", width=0.8) for own in seeds]
    return Panel(lines, env, "iteration", "cost of the proposal", log="y")


def kept(rows: Runs, title: str, kind: str) -> Panel:
    """The share of trajectories that keep the guides' return, by the size of the perturbation."""
    lines = []
    for name, colour in CONTROLLERS.items():
        sizes = grouped((row for row in rows if row["controller"] == name), "size")
        shares = [100 * mean(numbers(own, "kept")) for own in sizes.values()]
        lines.append(Line([float(size) for (size,) in sizes], shares, f"{colour}o-", name))
    return Panel(lines, title, "perturbation of the start" if kind == "start" else "push (m/s)", "kept (%)", zero=True)


@command
def main(argv: Sequence[str] | None = None) -> None:
    args = parse(Args, __doc__, argv)
    if args.record:
        record(args.record, args.actor, args.steps)
        return
    check_names("--cases", args.cases, CASES)
    check_names("--env", args.env, diffsim.TASKS)
    if args.list:
        print("\n".join(commands(args)))
        return
    if args.temperatures:
        args.replace("gps_temperatures", [row for env in args.env for row in temperatures(env)], ("env", "spread"))
        return
    if not args.draw_only:
        runner = Runner(args, args.jobs)
        with ThreadPoolExecutor(args.jobs) as pool:
            list(pool.map(lambda job: train(runner, *job), jobs(args).items()))
    if args.train_only:
        return
    collect(args)
    runs = args.read("gps_runs")
    args.publish("gps runs", markdown(table(runs)), "gps.md")
    args.publish("gps weights", markdown(shown(args.read("gps_weights"))), "gps.md")
    args.publish("gps temperatures", markdown(spreads(args.read("gps_temperatures"))), "gps.md")
    drawn = [env for env in SUITE if any(row["env"] == env for row in runs)]
    plot(args.picture("gps_variants"), [[variants(runs, env) for env in drawn]])
    groups = grouped(args.read("gps_generalisation"), "kind", "env", "variant").items()
    grid = [[kept(rows, f"{env}, {case}", kind) for (kind, env, case), rows in groups if kind == k] for k in KINDS]
    plot(args.picture("gps_generalisation"), grid)


if __name__ == "__main__":
    main()
