"""Learning: trains learners on tasks and seeds, evaluates the final policies, and draws and tabulates all of it.

    python benchmarks/learning.py --env ant --seeds 1 2 3              train (finished runs are kept), evaluate, draw
    python benchmarks/learning.py --experiment comparison              the paper's Figures 4 and 7, likewise
    python benchmarks/learning.py --experiment horizon --time-limit 500    stop in time; the same command goes on
    python benchmarks/learning.py --experiment horizon --draw-only     only draw and tabulate what there is
    python benchmarks/learning.py --runs runs/short -- --iterations 50 what follows "--" goes to the learner

Writes {learner}_{env}.csv (about 100 points of each run), learning.csv (a line for each learner and task), pictures of
the learner or the experiment, and with --update-results the tables of their pages. Each final policy is
evaluated where it was trained, explicitly with four times the substeps, and explicitly with four times the task's
default.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, product
from statistics import mean, median, pstdev
from typing import Literal

import common
import numpy as np
from common import LEARNT, TASKS, Line, Panel, TaskName, Tasks, plot
from runner import COLUMNS, Case, Curve, Runner, ScriptFlags, curve, folders, parse, passing, seed, summary
from tables import ROOT, Row, markdown, read_csv

from diffsim.training import Count, fail
from diffsim.training.evaluation import ENOUGH

POINTS = 100  # kept of each run
PPO = "ppo_baseline"
# The return to which learners are compared, those whose passing is timed, and those published of SHAC and PPO: Georgiev
# et al. 2024, "Adaptive Horizon Actor-Critic", 10 seeds, best point of the curve; AHAC has 6,964 on humanoid_mtu.
# fmt: off
RETURNS: dict[TaskName, tuple[int, tuple[int, ...], dict[str, int]]] = {
    "cartpole":     (-520, (-1000, -520),      {}),
    "hopper":       (3000, (3000, 4500), {"shac": 4837, PPO: 4742}),
    "half_cheetah": (6000, (),                 {}),
    "ant":          (5000, (5000, 7300, 7661), {"shac": 7661, PPO: 6605}),
    "humanoid":     (5000, (5000, 7000, 8387), {"shac": 8387, PPO: 7293}),
    "humanoid_mtu": (4246, (4246, 6114, 6964), {"shac": 6114, PPO: 4246}),
    "humanoid_imitation": (500, (),            {}),
}
# The best published of any learner, timed for SAPO: AHAC's (Georgiev et al. 2024).
RECORDS: dict[TaskName, int] = {"ant": 9313, "humanoid": 9845}
SAPO = ("sapo", "--accuracy", "fast")
SAPO_16 = ("sapo", "--integrator", "implicit", "--substeps", "16")  # the humanoids in minutes
SAPO_CPU = (*SAPO_16, "--iterations", "1000")
PPO_MANY = (PPO, "--accuracy", "fast", "--num-envs", "4096", "--minibatch-size", "32768", "--entropy-coef", "0.002",
            "--iterations", "2500")
FIRM = ("--contact", "firm")
SHAC_FIRM = ("shac", *FIRM, "--num-envs", "256")
PPO_MANY_FIRM = (PPO, *FIRM, *PPO_MANY[3:-2], "--iterations", "1200")
SAC = "sac_baseline"
PFPN_PPO = ("pfpn", "--algorithm", "ppo", *PPO_MANY[1:-2], "--iterations", "1200")
PFPN_SHAC = ("pfpn", "--algorithm", "shac", "--accuracy", "fast")
PFPN_SAC = ("pfpn", "--algorithm", "sac")
PRESETS = {  # what the trade of accuracy for speed does to learning
    "shac_fast":           ("shac", "--accuracy", "fast"),
    "shac_accurate":       ("shac", "--accuracy", "accurate"),
    "shac_stiff":          ("shac", "--penalty", "k_n=1e5", "k_d=1e4"),  # published SHAC's hopper falls to 1,603
    "shac_explicit_8":     ("shac", "--integrator", "semi_implicit", "--substeps", "8"),
    "shac_explicit_12":    ("shac", "--integrator", "semi_implicit", "--substeps", "12"),
    "shac_implicit_16":    ("shac", "--integrator", "implicit", "--substeps", "16"),
}
LEARNERS: dict[str, tuple[str, ...]] = {  # script and flags
    "shac":               ("shac",),
    "shac_no_critic":     ("shac", "--no-critic"),
    "shac_general":       ("shac", "--general-hyperparameters"),
    "shac_deterministic": ("shac", "--deterministic-policy"),
    **{f"shac_{n}":       ("shac", "--num-envs", str(n)) for n in (256, 1024)},
    **{f"shac_h{h}":      ("shac", "--horizon", str(h), "--num-envs", str(2048 // h)) for h in (4, 8, 16, 64, 128)},
    **PRESETS,
    "shac_firm":          SHAC_FIRM,
    "shac_firm_sudden":   (*SHAC_FIRM, "--anneal", "0", "0"),
    "shac_firm_fixed":    (*SHAC_FIRM, "--randomise"),
    "shac_firm_wide":     (*SHAC_FIRM, "--anneal", "0", "0", "--randomise", "stiffness=0.3:4", "friction=0.7:1.3"),
    "shac_firm_h16":      ("shac", *FIRM, "--num-envs", "512", "--horizon", "16", "--iterations", "3000"),
    "sapo_firm":          ("sapo", *FIRM),
    "ppo_firm":           PPO_MANY_FIRM,
    "ppo_firm_sudden":    (*PPO_MANY_FIRM, "--anneal", "0", "0"),
    PPO:                  (PPO,),
    "ppo_256":            (PPO, "--num-envs", "256", "--minibatch-size", "2048", "--entropy-coef", "0"),
    "ppo_4096":           (PPO, "--num-envs", "4096", "--minibatch-size", "32768", "--entropy-coef", "0"),
    **{f"ppo_e{c}":       (PPO, "--entropy-coef", c) for c in ("0", "0.002", "0.005", "0.01", "0.02")},
    "bptt":               ("bptt",),
    "pods":               ("pods",),
    "pods_second":        ("pods", "--order", "2"),
    SAC:                  (SAC,),
    "sac_large":          (SAC, "--large-batch", "--accuracy", "fast"),
    "redq":               (SAC, "--critics", "10", "--critic-subset", "2", "--updates-per-step", "20"),
    "mbpo":               ("mbpo",),
    "se_mbpo":            ("mbpo", "--sample-enhance", "4"),
    "pfpn_ppo":           PFPN_PPO,
    "pfpn_shac":          PFPN_SHAC,
    "pfpn_sac":           PFPN_SAC,
    **{f"pfpn_{p}_ppo":   (*PFPN_PPO, "--policy", p) for p in ("gaussian", "gmm", "discrete")},
    "pfpn_gaussian_shac": (*PFPN_SHAC, "--policy", "gaussian"),
    "pfpn_gaussian_sac":  (*PFPN_SAC, "--policy", "gaussian"),
    **{f"pfpn_{how}":     (*PFPN_PPO, "--resampling", how) for how in ("uniform", "none")},
    **{f"pfpn_{n}":       (*PFPN_PPO, "--particles", str(n)) for n in (5, 10, 100)},
    "sapo":               SAPO,
    "ppo_many":           PPO_MANY,
    "ppo_many_symmetric": (*PPO_MANY, "--symmetric"),
    "sapo_16":            SAPO_16,
    "sapo_cpu":           (*SAPO_CPU, "--critic-iterations", "16"),
    "sapo_cpu_4":         (*SAPO_16, "--critic-iterations", "4"),
    "sapo_cpu_8":         (*SAPO_CPU, "--critic-iterations", "8"),
    "sapo_cpu_symmetric": (*SAPO_CPU, "--critic-iterations", "8", "--symmetric"),
    "sapo_symmetric":     (*SAPO, "--symmetric"),
    "sapo_no_entropy":    (*SAPO, "--no-entropy"),
    "sapo_no_state_std":  (*SAPO, "--no-state-std"),
    "sapo_one_critic":    (*SAPO, "--critics", "1"),
    "sapo_elu":           (*SAPO, "--activation", "elu"),
    "sapo_alone":         (*SAPO, "--population", "1"),
}
Name = Literal[
    "comparison", "environments", "entropy", "horizon", "general", "deterministic", "accuracy", "muscles", "records",
    "ablation", "firm", "orders", "off_policy", "models", "pfpn", "resampling", "imitation",
]
EXPERIMENTS: dict[Name, tuple[str, tuple[str, ...], tuple[TaskName, ...]]] = {  # the others are compared with the first
    "comparison":    ("Figures 4 and 7: the learners", ("shac", PPO, "bptt", "shac_no_critic"), TASKS),
    "environments":  ("SHAC and PPO at several numbers of environments",
                      ("shac", "shac_1024", "ppo_256", "ppo_e0", "ppo_4096"), ("ant", "humanoid")),
    "entropy":       ("PPO's entropy bonus", (PPO, "ppo_e0", "ppo_e0.002", "ppo_e0.005", "ppo_e0.01", "ppo_e0.02"),
                      ("hopper", "ant", "humanoid")),
    "horizon":       ("Figure 6: short horizon length, 2,048 samples per iteration",
                      ("shac", "shac_h4", "shac_h8", "shac_h16", "shac_h64", "shac_h128"), ("ant",)),
    "general":       ("Figure 8: one setting for all tasks", ("shac", "shac_general"), TASKS),
    "deterministic": ("Figure 9: deterministic policy", ("shac", "shac_deterministic"), TASKS),
    "accuracy":      ("SHAC at each accuracy", ("shac_fast", "shac", "shac_accurate"), TASKS[:-1]),
    "records":       ("SHAC, SAPO and PPO", ("shac", "sapo", "sapo_16", PPO, "ppo_many"), TASKS),
    "ablation":      ("SAPO without each of its parts", ("sapo", "sapo_no_entropy", "sapo_no_state_std",
                      "sapo_one_critic", "sapo_elu", "sapo_alone"), ("humanoid",)),
    "firm":          ("Learning through firm contact", ("shac_firm", "shac_firm_sudden", "shac_firm_fixed",
                      "shac_firm_wide", "shac_firm_h16", "sapo_firm", "ppo_firm", "ppo_firm_sudden"),
                      ("hopper", "half_cheetah", "ant", "humanoid")),
    "off_policy":    ("Figures 4 and 10: off-policy, model-based and sequence learners",
                      ("shac", PPO, SAC, "sac_large", "redq", "mbpo", "se_mbpo", "pods"),
                      ("cartpole", "hopper", "ant", "humanoid")),
    "models":        ("MBPO and SE-MBPO", ("shac", "mbpo", "se_mbpo"), ("cartpole", "ant")),
    "orders":        ("PODS of first and second order", ("pods", "pods_second", "shac", "bptt"), ("cartpole",)),
    "pfpn":          ("PFPN and a Gaussian policy, by PPO, through the simulator's gradient and off-policy",
                      ("pfpn_ppo", "pfpn_gaussian_ppo", "pfpn_shac", "pfpn_gaussian_shac", "pfpn_sac",
                      "pfpn_gaussian_sac"),
                      ("hopper", "ant", "humanoid")),
    "imitation":     ("Imitation by the four policies", ("pfpn_ppo", "pfpn_gaussian_ppo", "pfpn_gmm_ppo",
                      "pfpn_discrete_ppo", "pfpn_shac", "pfpn_gaussian_shac"), ("humanoid_imitation",)),
    "resampling":    ("PFPN by PPO: its 35 particles, others, and other ways to resample them", ("pfpn_ppo",
                      "pfpn_uniform", "pfpn_none", "pfpn_5", "pfpn_10", "pfpn_100"), ("hopper", "ant", "humanoid")),
    "muscles":       ("humanoid_mtu", ("shac", "shac_256", "shac_1024"), ("humanoid_mtu",)),
}
# fmt: on
LEARNER_PAGES = {
    SAC: "sac.md",
    "shac": "shac.md",
    "sapo": "sapo.md",
    PPO: "ppo.md",
    "bptt": "bptt.md",
    "mbpo": "mbpo.md",
}
PAIRS = {name: (f"pfpn_{name}", f"pfpn_gaussian_{name}") for name in ("ppo", "shac", "sac")}  # by their algorithms
KEPT = ("return", "each seed", "explicit, substeps x4", "kept")
RESULT_COLUMNS = ("task", "seeds", *KEPT[:2], "published", "training (s)", "return passes", "kept")
SETTINGS = ("integrator", "substeps", "seeds", "iterations", "training (s)")
GATE_COLUMNS = ("machine", "task", "learner", *SETTINGS, *KEPT, "gate", "in the reference")  # the gate: 97 % is kept
MUSCLE_COLUMNS = ("machine", "learner", *SETTINGS, *KEPT[:2], "speed (m/s)", "falls per episode", "return passes")

ORDER_COLUMNS = ("task", "learner", *SETTINGS[2:], *KEPT[:2], "return passes", "kept")
PAGES = {"muscles": ("humanoid_mtu", MUSCLE_COLUMNS), "orders": ("pods", ORDER_COLUMNS)}  # experiments with their own


@dataclass
class Args(ScriptFlags):
    env: Tasks = LEARNT  # tasks
    algorithm: str = "shac"  # learner: a script in the repository's root, without .py, or a variant, e.g. shac_1024
    experiment: Name | None = None  # several learners beside each other, among them those of the paper's Figures 4 to 9
    seeds: tuple[int, ...] = (1, 2, 3)  # seeds of each
    jobs: Count = 1  # runs at a time; they share the device, which slows each of them down
    evaluate_only: bool = False  # train nothing: evaluate the runs there are, finished or not


def collect(args: Args, learner: str, env: TaskName) -> None:
    """Write about POINTS rows of each of a task's runs, and the summary of those that have been evaluated."""
    points: list[dict[str, str]] = []
    for folder in folders(args.runs / learner, env):
        rows = read_csv(folder / "progress.csv")
        returns = np.array([float(row.get("return") or "nan") for row in rows])
        if np.isnan(returns).all():
            continue
        columns = (*COLUMNS, *(name for name in rows[0] if name.startswith("models_")))
        keep = {*np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).round().astype(int)}
        keep |= {np.nanargmax(returns), *np.flatnonzero(returns >= RETURNS[env][0])[:1]}
        keep |= {k for k, row in enumerate(rows) if row.get("eval_return")}
        for row in (rows[k] for k in sorted(keep)):
            points.append({"seed": seed(folder)} | {c: row.get(c) and f"{float(row[c]):.6g}" or "" for c in columns})
    args.write(f"{learner}_{env}", points)
    records = {RECORDS[env]} if learner.startswith("sapo") and env in RECORDS else set()
    if found := summary(args.runs / learner, env, sorted({*RETURNS[env][1]} | records)):
        row = {"learner": learner, "task": env} | found | {"published": RETURNS[env][2].get(learner, "")}
        args.merge("learning", [row], ("learner", "task"))


def curves(args: Args, learner: str, env: str) -> list[Curve]:
    """Of each seed, from the csv file; where this machine has none, from another one's, without the seconds."""
    seeds: dict[str, list[dict[str, str]]] = {}
    rows = args.read(name := f"{learner}_{env}")
    if not rows and args.directory.parent == common.RESULTS:
        paths = sorted(common.RESULTS.glob(f"*/{name}.csv"))
        rows = [row | {"seconds": ""} for path in paths[:1] for row in read_csv(path)]
    for row in rows:
        seeds.setdefault(row["seed"], []).append(row)
    return [curve(rows) for rows in seeds.values()]


def timed(runs: Sequence[Curve]) -> list[Curve]:
    """Those that had the machine to themselves: of the others the csv files have no seconds."""
    return [run for run in runs if not np.isnan(run["seconds"]).any()]


def table(args: Args, learners: Sequence[str], tasks: Sequence[TaskName]) -> list[Row]:
    """The learners beside each other, on tasks where there are two."""
    rows = list[Row]()
    for env in tasks:
        found = {learner: runs for learner in learners if (runs := curves(args, learner, env))}
        target, _, published = RETURNS[env]
        for learner, runs in found.items() if len(found) > 1 else ():
            best = [np.nanmax(run["return"]) for run in runs]
            last = [values[-1] for run in runs if len(values := run["eval_return"][~np.isnan(run["eval_return"])])]
            own = timed(runs)
            steps = median(passing(runs, target, "control_steps"))
            seconds = median(passing(own, target, "seconds")) if own else math.nan
            spread = f" ± {pstdev(best):.0f}" if len(runs) > 1 else ""
            row: dict[str, object] = {"task": env, "learner": learner, "seeds": len(runs)}
            row |= {"best return of training": f"{mean(best):.0f}{spread}", "published": published.get(learner, "")}
            row |= {"last evaluation": f"{median(last):.0f}" if last else ""}
            row |= {"control steps": f"{median(run['control_steps'][-1] for run in runs) / 1e6:.3g} M"}
            row |= {"training, s": f"{median(run['seconds'][-1] for run in own):.0f}" if own else ""}
            row |= {"target": target, "steps to target": "never" if steps == math.inf else f"{steps / 1e6:.3g} M"}
            words = "" if math.isnan(seconds) else "never" if seconds == math.inf else f"{seconds:.0f}"
            rows.append(row | {"s to target": words})
    return rows


def ratios(args: Args, learners: Sequence[str], tasks: Sequence[TaskName]) -> list[Row]:
    """Of PFPN and the Gaussian policy, by each algorithm: the best return within control steps that all runs made."""
    rows = list[Row]()
    for env, (algorithm, names) in product(tasks, PAIRS.items()):
        both = [curves(args, name, env) for name in names if name in learners]
        if len(both) == 2 and all(both):
            end = min(run["control_steps"][-1] for runs in both for run in runs)
            best = [[np.nanmax(run["return"][run["control_steps"] <= end]) for run in runs] for runs in both]
            row: dict[str, object] = {"task": env, "algorithm": algorithm, "control steps": f"{end / 1e6:.3g} M"}
            for policy, values in zip(("PFPN", "Gaussian"), best, strict=True):
                row[policy] = f"{mean(values):.0f} ± {pstdev(values):.0f}" if len(values) > 1 else f"{values[0]:.0f}"
            rows.append(row | {"PFPN / Gaussian": f"{mean(best[0]) / mean(best[1]):.2f}"})
    return rows


def draw(args: Args, name: str, learners: Sequence[str], tasks: Sequence[TaskName]) -> None:
    """Each seed (thin) and the median (bold) against control steps and seconds, on log axes if ends lie far apart."""
    grid = list[list[Panel]]()
    for x, text in (("control_steps", "control steps"), ("seconds", "seconds of training")):
        panels = list[Panel]()
        for env in tasks:
            lines, begins, ends, published = list[Line](), list[float](), list[float](), RETURNS[env][2]
            for k, learner in enumerate(learners):
                runs = curves(args, learner, env)
                if runs := timed(runs) if x == "seconds" else runs:
                    shared = np.geomspace(max(run[x][0] for run in runs), min(run[x][-1] for run in runs), 400)
                    middle = np.median([np.interp(shared, run[x], run["return"]) for run in runs], axis=0)
                    lines += [Line(run[x], run["return"], f"C{k}-", width=0.5) for run in runs]
                    lines.append(Line(shared, middle, f"C{k}-", learner, width=2))
                    begins.append(shared[0])
                    ends.append(shared[-1])
            for learner in (learner for learner in learners if ends and learner in published):
                value, style = [published[learner]] * 2, f"C{learners.index(learner)}--"
                lines.append(Line((min(begins), max(ends)), value, style, f"{learner}, published", 0.8))
            log = "x" if ends and max(ends) > 10 * min(ends) else ""
            panels.append(Panel(lines, env, text, "" if panels else "return of training episodes", log))
        if any(panel.lines for panel in panels):  # not where all runs shared their machine, and have no seconds
            grid.append(panels)
    plot(args.picture(name), grid)


def summaries(args: Args, learners: Sequence[str], tasks: Sequence[str]) -> list[Row]:
    """Lines of learning.csv, of all machines."""
    rows = [
        {"machine": machine} | row | {"gate": "passed" if float(row["kept"] or 0) >= ENOUGH else "failed"}
        for machine, path in args.machines("learning").items()
        for row in read_csv(path)
        if row["learner"] in learners and row["task"] in tasks
    ]
    return sorted(rows, key=lambda row: (tasks.index(row["task"]), learners.index(row["learner"])))


def report(args: Args, name: Name) -> None:
    """An experiment's table and picture, from the csv files."""
    title, learners, tasks = EXPERIMENTS[name]
    if name == "accuracy":
        text = markdown(summaries(args, ("shac", *PRESETS), tasks), GATE_COLUMNS)
        return args.publish("learning", text, "accuracy.md", everywhere=True)
    if name in PAGES:
        page, columns = PAGES[name]
        everywhere, rows = "machine" in columns, summaries(args, learners, tasks)
        rows = [row for row in rows if everywhere or row["machine"] == args.directory.name]
        args.publish("results", markdown(rows, columns), f"{page}.md", everywhere)
        return draw(args, page, learners, tasks)
    rows, beside = table(args, learners, tasks), ratios(args, learners, tasks)
    parts = [beside] if set(learners) <= {*chain(*PAIRS.values())} else [rows, beside]
    text = "".join(f"{markdown(part)}\n" for part in parts if part)
    page = "pfpn.md" if "pfpn_ppo" in learners else "experiments.md"
    args.publish(name, f"{text}![{title}]({args.link(name)})\n", page)
    if compared := [env for env in tasks if env in {row["task"] for row in rows}]:
        draw(args, name, learners, compared)


def main(args: Args) -> None:
    _, learners, tasks = EXPERIMENTS[args.experiment] if args.experiment else ("", (args.algorithm,), LEARNT)
    scripts = {learner: LEARNERS.get(learner, (learner,)) for learner in learners}
    if missing := [script for script, *_ in scripts.values() if not (ROOT / f"{script}.py").is_file()]:
        fail(f"no script {missing[0]}.py in {ROOT}")
    tasks = tuple(env for env in args.env if env in tasks)
    if not args.draw_only:
        cases = (
            Case(args.runs / learner / f"{env}__{seed}", env, seed, script, tuple(flags))
            for seed in args.seeds
            for env in tasks
            for learner, (script, *flags) in scripts.items()
        )
        Runner(args, args.jobs).run(cases, args.evaluate_only)
    for learner, env in product(learners, tasks):
        collect(args, learner, env)
    if args.experiment:
        report(args, args.experiment)
    else:
        rows = [row for row in args.read("learning") if row["learner"] == args.algorithm]
        rows.sort(key=lambda row: LEARNT.index(row["task"]))
        args.publish("results", markdown(rows, RESULT_COLUMNS), LEARNER_PAGES.get(args.algorithm, "experiments.md"))
        draw(args, args.algorithm, learners, [env for env in LEARNT if curves(args, args.algorithm, env)])


if __name__ == "__main__":
    main(parse(Args, __doc__))
