"""Evaluate a policy: the first episode of each of many fresh environments. What --evaluate does."""

from __future__ import annotations

import copy
import json
import math
import pkgutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import diffsim
from diffsim.env import DiffEnv
from diffsim.robot.scene import Scene
from diffsim.training import checkpoint, graph, provenance
from diffsim.training.directory import check_writable
from diffsim.training.errors import fail
from diffsim.training.flags import OPTIONS, Args, Flags
from diffsim.training.log import say

GAIT = "diffsim_cli.gait:report"
SEED = 1_000_000  # of the start states: the same for every policy, and far from those of training
FINER = 4  # a return counts only if it survives this many times the substeps, without --implicit
ENOUGH = 0.97  # share of the return that must survive; by as much more it may not gain
LOOK_EVERY = 50  # control steps between two after which a GPU is waited for, to see whether all episodes have ended
SETTINGS = OPTIONS | {"env", "device", "eval_episodes"}


@dataclass
class Evaluation:
    """One episode each of n environments."""

    compared: ClassVar[bool] = True  # at a run's end and with --evaluate, with one at FINER times the substeps

    returns: Tensor  # (n,) undiscounted
    lengths: Tensor  # (n,) control steps
    speed: float | None  # mean forward speed, m/s; None for a robot that does not travel
    qpos: Tensor  # (T, n, nq) before each step; valid up to an episode's length
    action: Tensor  # (T, n, nu) of each step
    scene: Scene  # of the episodes; of several terrains episode i has number i % M
    control_dt: float  # s
    others: dict[str, float] = field(default_factory=dict)  # what else a script measured, by name
    ghost: Tensor | None = None  # (T, n, nq) what was to be tracked, before each step; see Task.ghost
    terms: dict[str, float] = field(default_factory=dict)  # of the mean return, by name; see Task.reward_terms

    @property
    def length(self) -> float:
        return self.lengths.float().mean().item()

    def scalars(self) -> dict[str, float]:
        values = {"eval/return": self.returns.median().item(), "eval/length": self.length}
        values |= {} if self.speed is None else {"eval/speed": self.speed}
        values |= {f"eval/reward_{name}": value for name, value in self.terms.items()}
        return values | {f"eval/{name}": value for name, value in self.others.items()}

    def __str__(self) -> str:
        r = self.returns
        speed = "" if self.speed is None else f", forward speed {self.speed:.2f} m/s"
        spread = f"mean {r.mean():.1f}, std {r.std(correction=0):.1f}, min {r.min():.1f}"
        others = "".join(f", {name.replace('_', ' ')} {value:.2f}" for name, value in self.others.items())
        return f"return median {r.median():.1f}, {spread}, length {self.length:.1f}{speed}{others}"

    @property
    def median(self) -> int:
        """The episode of median return."""
        return int(self.returns.argsort()[(len(self.returns) - 1) // 2])

    def episode(self, number: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """qpos (T, nq) and action (T, nu) of all steps of an episode."""
        steps = int(self.lengths[number])
        return self.qpos[:steps, number].numpy(force=True), self.action[:steps, number].numpy(force=True)


def kept(own: float, finer: float) -> float:
    """Share of its own return that a policy keeps with finer substeps; of costs, returns below 0, the inverse ratio.

    It is infinite of a cost that becomes a gain.
    """
    if own > 0:
        return finer / own
    if finer < 0:
        return own / finer
    return 1.0 if finer == own else math.inf


class Player:
    """Plays the first episode of each environment under policy(obs (n, obs_dim)) -> action (n, nu), again and again.

    Args:
        graphs: on a GPU a control step is one CUDA graph; the environments, of horizon 1, are then the player's alone.
    """

    def __init__(self, env: DiffEnv, policy: Callable[[Tensor], Tensor], graphs: bool = False) -> None:
        self.env, self.captured = env, graphs and env.device.type == "cuda"
        self.policy = copy.deepcopy(policy) if self.captured else policy  # a graph knows the addresses of its weights
        self.obs = torch.zeros(env.num_envs, env.task.obs_dim, dtype=env.dtype, device=env.device)
        self.returns, self.lengths = torch.zeros_like(self.obs[:, 0]), torch.zeros_like(env.episode_step)
        self.alive = torch.ones_like(self.lengths, dtype=torch.bool)
        terms = env.task.reward_terms(self.obs, self.obs.new_zeros(env.num_envs, env.scene.nu))
        self.terms = {name: torch.zeros_like(self.returns) for name in terms}  # of the returns
        self.step = graph.capture(self._step, env.device, env) if self.captured else self._step
        self.patience = LOOK_EVERY if env.device.type == "cuda" else 1

    def take(self, policy: nn.Module) -> None:
        """Play another policy of the same architecture from now on."""
        if self.captured and isinstance(self.policy, nn.Module):
            self.policy.load_state_dict(policy.state_dict())
        else:
            self.policy = policy

    def _step(self) -> Tensor:
        action = self.policy(self.obs)
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.obs.copy_(obs)
        for name, term in self.env.task.reward_terms(info["final_obs"], action.clamp(-1.0, 1.0)).items():
            self.terms[name] += torch.where(self.alive & ~info["nonfinite"], term, torch.zeros_like(term))
        self.returns += torch.where(self.alive, reward, torch.zeros_like(reward))
        self.lengths += self.alive
        self.alive &= ~(terminated | truncated)
        return action

    @torch.no_grad()
    def evaluate(self, seed: int = SEED) -> Evaluation:
        """From the start states of a seed. Control steps after the last episode's end are not part of the result."""
        env, path, actions, ghosts = self.env, list[Tensor](), list[Tensor](), list[Tensor]()
        env.sim.unconverged.zero_()
        self.obs.copy_(env.reset(seed=seed)[0])
        self.returns.zero_()
        self.lengths.zero_()
        for total in self.terms.values():
            total.zero_()
        self.alive.fill_(True)
        while len(path) % self.patience or self.alive.any():
            path.append(env.qpos.clone())
            if (ghost := env.task.ghost(env.memory)) is not None:
                ghosts.append(ghost)
            actions.append(self.step().clone())
        returns, lengths = self.returns.clone(), self.lengths.clone()
        qpos, action = (torch.stack(rows[: int(lengths.max())]) for rows in (path, actions))
        speed, forward = None, env.task.forward_column
        if forward is not None:
            distance = qpos[..., forward].gather(0, lengths.unsqueeze(0) - 1)[0] - qpos[0, :, forward]
            speed = (distance.sum() / ((lengths - 1).sum().clamp(min=1) * env.control_dt)).item()
        missed = env.sim.unconverged.sum().item()
        others = {"unconverged": missed} if missed else {}  # control steps, of Newton's method
        followed = torch.stack(ghosts[: len(qpos)]) if ghosts else None
        terms = {name: total.mean().item() for name, total in self.terms.items()}
        return Evaluation(returns, lengths, speed, qpos, action, env.scene, env.control_dt, others, followed, terms)


def evaluate(env: DiffEnv, policy: Callable[[Tensor], Tensor], seed: int = SEED) -> Evaluation:
    """The first episode of each environment under a policy."""
    return Player(env, policy).evaluate(seed)


def fitting(network: nn.Module, env: DiffEnv) -> nn.Module:
    """A policy on the device of an environment, whose task may have changed since it was trained."""
    network, obs_dim, nu = network.to(env.device), env.task.obs_dim, env.scene.nu
    with suppress(RuntimeError):
        if network(torch.zeros(1, obs_dim, device=env.device)).shape == (1, nu):
            return network
    fail(f"the policy is not for task {env.task.name!r} as it is now, with {obs_dim} observations and {nu} actions")


# Environments as the flags say, and --evaluate ------------------------------------------------------------------------


def make_env(args: Flags | SimpleNamespace, num_envs: int, horizon: int = 1, seed: int = 0, **others: Any) -> DiffEnv:
    """The task as flags ask for it, with further options of diffsim.make; what is wrong ends the script.

    Contacts begin as in the file: --onset is the training's, in `Run.make_env`.
    """
    options: dict[str, Any] = {name: value for name, value in vars(args).items() if name in OPTIONS}
    options["threads"] = args.threads or None
    try:
        return diffsim.make(args.task_class, num_envs, args.device, seed, horizon, **options | others)
    except ValueError as error:
        fail(error)


def evaluate_checkpoint(args: Args, learner: Callable[[Args, DiffEnv], Any] | None = None) -> None:
    """Do what --evaluate asks for: print the evaluation of a saved policy, and write evaluation.json.

    Args:
        args: the script's arguments.
        learner: of a method `evaluate`, which then takes the place of `evaluate` of its policy.
    """
    assert args.evaluate and args.run_dir
    check_writable(args.run_dir)
    torch.set_num_threads(1)
    path, state = args.evaluate, checkpoint.load(args.evaluate, args.script())

    def measure(flags: Args, **options: Any) -> Evaluation:
        env = make_env(flags, flags.eval_episodes, **options)
        if learner is None:
            return evaluate(env, fitting(checkpoint.load_policy(path).network, env))
        checkpoint.restore(restored := learner(flags, env), state)
        return restored.evaluate()

    evaluation = measure(args)
    provenance.compare(state.get("robot"), evaluation.scene)
    say(f"{args.env}, {args.eval_episodes} episodes: {evaluation}")
    write_evaluation(args, evaluation, state["iteration"], **compare(args, evaluation, measure))


def compare(args: Args, evaluation: Evaluation, measure: Callable[..., Evaluation]) -> dict[str, Any]:
    """Print how much of its return a policy keeps at FINER times the substeps, without --implicit.

    One that keeps less than ENOUGH has learned to exploit the integrator's errors; one that gains as much was judged on
    other physics than it would meet. After training with --onset, print also how much of the return with that onset is
    left on the file's own contact, on which policies are evaluated.

    Args:
        measure: evaluates the policy with other arguments, and options of diffsim.make.

    Returns:
        for evaluation.json: the finer substeps, or the onset, with the return there and the share that is kept.
    """
    if not evaluation.compared:
        return {}
    own, substeps, finer = evaluation.returns.median().item(), FINER * args.substeps, copy.copy(args)
    finer.substeps, finer.implicit = substeps, False
    value = measure(finer).returns.median().item()
    share = kept(own, value)
    over = f" in {len(evaluation.returns)} episodes"
    say(f"{substeps} substeps: return median {value:.1f}, {share:.1%} retained{over}{_warning(share, 'more substeps')}")
    found = {"finer": {"substeps": substeps, "return": value, "kept": _finite(share)}}
    if onset := args.onset[1]:
        value = measure(args, onset=onset).returns.median().item()
        share, name = kept(value, own), f"the training's last onset of {onset:g} m"
        warning = _warning(share, "a smaller --onset")
        say(f"{name}: return median {value:.1f}, {share:.1%} retained without{over}{warning}")
        found["onset"] = {"metres": onset, "return": value, "kept": _finite(share)}
    return found


def _finite(share: float) -> float | None:
    """Return a share as JSON has it: no infinity."""
    return share if math.isfinite(share) else None


def _warning(share: float, remedy: str) -> str:
    """Tell what to do about a share that is too small, or, as wrong, too large."""
    if ENOUGH <= share <= 1 / ENOUGH:
        return ""
    bound = f"less than {ENOUGH:.0%}" if share < ENOUGH else f"more than {1 / ENOUGH:.0%}"
    return f"; {bound}: train with {remedy}"


def write_evaluation(args: Flags, evaluation: Evaluation, iteration: int, **found: Any) -> None:
    """Write evaluation.json to the run's directory, with what else was found; print and write how the robot walks."""
    assert args.run_dir
    values: dict[str, Any] = dict.fromkeys(("return", "length", "speed"))
    values |= {name.removeprefix("eval/"): value for name, value in evaluation.scalars().items()}
    values |= found | {"returns": evaluation.returns.tolist(), "lengths": evaluation.lengths.tolist()}
    settings = {name: value for name, value in vars(args).items() if name in SETTINGS}
    values["settings"] = settings | {"script": args.script(), "iteration": iteration}
    args.run_dir.mkdir(parents=True, exist_ok=True)
    (args.run_dir / "evaluation.json").write_text(json.dumps(values, indent=2) + "\n")
    pkgutil.resolve_name(GAIT)(evaluation, args.run_dir)
