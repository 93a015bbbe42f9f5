"""Environments as the flags say, and what --evaluate does."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import torch

import diffsim
from diffsim.env import DiffEnv
from diffsim.training import checkpoint
from diffsim.training.checkpoint import Learner, SavedPolicy
from diffsim.training.directory import check_writable
from diffsim.training.errors import fail
from diffsim.training.evaluation import ENOUGH, FINER, Evaluation, evaluate, kept
from diffsim.training.flags import Args, Flags, parse_penalty

L = TypeVar("L", bound=Learner)


def make_env(args: Flags, num_envs: int, horizon: int = 1, seed: int = 0, **options: Any) -> DiffEnv:
    """The task as the flags ask for it, with further options of diffsim.make; what is wrong ends the script."""
    try:
        return diffsim.make(
            args.env,
            num_envs,
            args.device,
            seed,
            horizon,
            substeps=args.substeps,
            integrator=args.integrator,
            theta=args.theta,
            contact=args.contact,
            penalty=parse_penalty(args.penalty),
            threads=args.threads or None,
            early_termination=args.early_termination,
            clip=args.clip,
            **options,
        )
    except ValueError as error:
        fail(error)


def make_policy_env(saved: SavedPolicy, num_envs: int, forces: bool = False, **changes: Any) -> DiffEnv:
    """The task on which a policy was trained, simulated as there, on the CPU; changes replace its flags."""
    names = {field.name for field in dataclasses.fields(Flags)} & saved.args.keys()
    args = Flags(**{name: saved.args[name] for name in names} | {"device": "cpu", "threads": 0} | changes)
    return make_env(args, num_envs, forces=forces)


def evaluate_checkpoint(
    args: Args,
    learner: Callable[[Args, DiffEnv], L] | None = None,
    method: Callable[[L], Evaluation] | None = None,
) -> None:
    """What --evaluate does: print the evaluation of a saved policy, and write evaluation.json and the video.

    Unless --no-finer is given, the policy must also keep its return at FINER times the substeps, explicitly integrated:
    one that does not has learned to live on the integrator's errors.

    Args:
        args: the script's arguments.
        learner, method: how a restored learner is evaluated, if not by `evaluate` of its policy.
    """
    assert args.evaluate and args.run_dir
    check_writable(args.run_dir)
    torch.set_num_threads(1)
    path, state = args.evaluate, checkpoint.load(args.evaluate, args.script())

    def measure(flags: Args) -> Evaluation:
        env = make_env(flags, flags.eval_episodes)
        if learner and method:
            restored = learner(flags, env)
            checkpoint.restore(restored, state)
            return method(restored)
        return evaluate(env, checkpoint.load_policy(path).network.to(env.device))

    evaluation, found = measure(args), dict[str, Any]()
    print(f"{args.env}, {args.eval_episodes} episodes: {evaluation}")
    if args.finer:
        substeps = FINER * args.substeps
        explicit = dataclasses.replace(args, integrator="semi_implicit", theta=0.0, substeps=substeps)
        value = measure(explicit).returns.median().item()
        share = kept(evaluation.returns.median().item(), value)
        found["finer"] = {"substeps": substeps, "return": value, "kept": share}
        warning = "" if share >= ENOUGH else f"; less than {ENOUGH:.0%}: train with more substeps"
        print(f"explicit with {substeps} substeps: return median {value:.1f}, {share:.1%} kept{warning}")
    write_evaluation(args, evaluation, state["iteration"], **found)


def write_evaluation(args: Flags, evaluation: Evaluation, iteration: int, **found: Any) -> None:
    """Print the gait, and leave evaluation.json and, if asked for, the video in the run's directory."""
    assert args.run_dir
    names = "env integrator substeps theta contact penalty early_termination clip device eval_episodes".split()
    settings = {name: getattr(args, name) for name in names} | dict(script=args.script(), iteration=iteration)
    if gait := evaluation.gait():
        print(f"gait: {gait}")
        found["gait"] = dataclasses.asdict(gait) | {"verdict": gait.verdict}
    evaluation.write_json(args.run_dir / "evaluation.json", settings, **found)
    if args.capture_video:
        try:
            print(f"video: {evaluation.save_video(args.run_dir / 'video.mp4')}")
        except (OSError, RuntimeError) as error:
            fail(error)
