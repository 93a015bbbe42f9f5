"""Fits the constants of contact and limits to recorded motion, by the simulator's own gradient.

    python benchmarks/calibrate.py runs/learning/shac/ant__1               to MuJoCo, where this policy acts with noise
    python benchmarks/calibrate.py --recording walk.npz --env ant          to measurements of your own
    python benchmarks/calibrate.py runs/... --fit k_n k_d mu mass          other constants

A recording holds qpos (E, T + 1, nq), qvel (E, T + 1, nv) and ctrl (E, T, nu) of E episodes, one row per control step
of 1/60 s, ctrl as the task's actions in [-1, 1]; or one episode without the E. The fit starts segments of 0.2 s at
random rows, simulates them and descends the error of the velocities after 0.05, 0.1 and 0.2 s. A fifth of the episodes
is held out. Writes calibration.csv: the constants and the held-out error, before and after.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import common
import numpy as np
import torch
import transfer
import tyro
from common import run
from tables import Row, markdown
from torch import Tensor

import diffsim
from diffsim import DiffEnv
from diffsim.robot.scene import FACTORS
from diffsim.training import Count, NonNegative, Positive, fail
from diffsim.training.evaluation import SEED

STEPS = (3, 6, 12)  # control steps after which the error is measured
Constant = Literal["k_n", "k_d", "k_t", "mu", "k_limit", "d_limit", "mass", "motor"]
CONTACT: tuple[Constant, ...] = ("k_n", "k_d", "k_t", "k_limit", "d_limit")
LAST = f"held-out error after {STEPS[-1] / 60:.2g} s"
SHOWN = ("task", "reference", "constant", "before", "after", f"{LAST}, before", LAST)
SKIPPED = 12  # control steps at the start of an episode, which say more of the start state than of the ground


@dataclass
class Args(common.CommonFlags):
    checkpoint: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="CHECKPOINT")] = None
    # checkpoint of any script, or its run: the policy that acts in MuJoCo
    recording: Path | None = None  # .npz to fit to instead
    env: common.Tasks = ()  # the task of the recording
    contact: Literal["soft", "firm"] = "firm"  # the constants to begin with
    fit: tuple[Constant, ...] = CONTACT  # constants to fit
    episodes: Count = 20  # episodes of the policy in MuJoCo
    steps: Count = 200  # control steps of each
    noise: NonNegative = 0.2  # standard deviation of the noise on its actions
    segments: Count = 256  # segments drawn in each iteration
    iterations: Count = 120  # steps of the optimiser
    lr: Positive = 0.1  # step size of the constants' logarithms, which falls to a tenth
    substeps: Count = 16  # substeps of the implicit integrator


class Recording(NamedTuple):
    """Episodes of one robot: (E, T + 1, nq), (E, T + 1, nv), (E, T, nu), and how many steps of each count (E,)."""

    qpos: Tensor
    qvel: Tensor
    ctrl: Tensor
    lengths: Tensor


def record(args: Args, path: Path) -> tuple[str, Recording]:
    """The task and the motion of a policy in MuJoCo, with noise on its actions."""
    case = transfer.load(path, transfer.Args(episodes=args.episodes, device="cpu"))
    env, generator, actions = case.env, torch.Generator().manual_seed(0), list[Tensor]()
    env.reset(seed=SEED)
    start = env.qpos.double().numpy(), env.qvel.double().numpy()

    def policy(obs: Tensor) -> Tensor:
        action = case.saved.network(obs)
        actions.append((action + args.noise * torch.randn(action.shape, generator=generator)).clamp(-1.0, 1.0))
        return actions[-1]

    world, task = transfer.MuJoCo(env.scene, args.episodes, env.control_dt), type(env.task)(dtype=torch.float64)
    motion = transfer.act(world, task, policy, *start, env.scene.nu, args.steps)
    qpos, qvel = (torch.from_numpy(x).float().transpose(0, 1) for x in (motion.qpos, motion.qvel))
    lengths = torch.from_numpy(motion.lengths - motion.fallen)
    return env.task.name, Recording(qpos, qvel, torch.stack(actions, 1), lengths)


def read(path: Path, name: str) -> Recording:
    """The user's recording; one that does not fit the task ends the benchmark with one line."""
    scene, arrays = diffsim.make(name, 1).scene, list[np.ndarray]()
    if not path.is_file():
        fail(f"no such recording: {path}")
    try:
        with np.load(path) as file:
            arrays = [np.asarray(file[key], np.float32) for key in ("qpos", "qvel", "ctrl")]
    except (KeyError, ValueError, zipfile.BadZipFile, OSError) as error:
        fail(f"{path} is no .npz of qpos, qvel and ctrl: {error}")
    arrays = [array[None] if array.ndim == 2 else array for array in arrays]
    E, T = (*arrays[2].shape, 0, 0)[:2]
    shapes = {"qpos": (E, T + 1, scene.nq), "qvel": (E, T + 1, scene.nv), "ctrl": (E, T, scene.nu)}
    for (key, shape), array in zip(shapes.items(), arrays, strict=True):
        if array.shape != shape:
            fail(f"{path}: {key} has shape {array.shape}, must be {shape} for task {name}")
        if not np.isfinite(array).all():
            fail(f"{path}: {key} holds numbers that are not finite")
    qpos, qvel, ctrl = map(torch.from_numpy, arrays)
    return Recording(qpos, qvel, ctrl, torch.full((E,), T))


def starts(recording: Recording, episodes: Sequence[int]) -> Tensor:
    """(M, 2) episode and row of all rows of some episodes that a whole segment follows."""
    lengths = recording.lengths.tolist()
    pairs = [(e, t) for e in episodes for t in range(min(SKIPPED, lengths[e] // 4), lengths[e] - max(STEPS) + 1)]
    if not pairs:
        fail(
            f"no episode is long enough for a segment of {max(STEPS)} control steps: record longer ones, without falls"
        )
    return torch.tensor(pairs)


def errors(env: DiffEnv, recording: Recording, at: Tensor, factors: Tensor) -> Tensor:
    """Root mean square error of the velocities (M, len(STEPS)) of segments, differentiable in factors (M, 8)."""
    env.sim.rewind()
    env.sim.factors = factors
    episode, row = at.T
    qpos, qvel, found = recording.qpos[episode, row], recording.qvel[episode, row], list[Tensor]()
    for k in range(1, max(STEPS) + 1):
        qpos, qvel = env.sim.step(qpos, qvel, recording.ctrl[episode, row + k - 1])
        if k in STEPS:
            found.append((qvel - recording.qvel[episode, row + k]).square().mean(1).add(1e-12).sqrt())
    return torch.stack(found, 1)


def fit(args: Args, name: str, recording: Recording) -> list[Row]:
    """The rows of the csv, one of each constant."""
    env = diffsim.make(
        name, args.segments, horizon=max(STEPS), integrator="implicit", substeps=args.substeps, theta=0.0,
        contact=args.contact, factors=True,
    )  # fmt: skip
    number = len(recording.lengths)
    held = list(range(0, number, 5)) if number > 1 else [0]
    train = starts(recording, [e for e in range(number) if e not in held] or held)
    test = starts(recording, held)
    generator = torch.Generator().manual_seed(0)
    columns = torch.tensor([FACTORS.index(constant) for constant in args.fit])
    logs = torch.zeros(len(columns), requires_grad=True)
    optimizer = torch.optim.Adam([logs], lr=args.lr)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.1, args.iterations)

    def error(rows: Tensor, each: Tensor) -> Tensor:
        """(M, len(STEPS)) of M of these rows, drawn at random, from the logarithms (M, constants fitted)."""
        at = rows[torch.randint(len(rows), (args.segments,), generator=generator)]
        factors = torch.ones(len(each), len(FACTORS)).index_copy(1, columns, each.exp())
        return errors(env, recording, at, factors)

    @torch.no_grad()
    def check(rows: Tensor) -> Tensor:
        """Mean over four drawings of the median error after each of STEPS."""
        every = logs.expand(args.segments, -1)
        return torch.stack([error(rows, every).median(0).values for _ in range(4)]).mean(0)

    scale, before = check(train).clamp(min=1e-6), float(check(test)[-1])
    for iteration in range(1, args.iterations + 1):
        each = logs.detach().expand(args.segments, -1).clone().requires_grad_()  # of each segment its own
        found = error(train, each) / scale
        (gradient,) = torch.autograd.grad(found.clamp(max=4.0).sum(), each)
        # Some segments' gradients explode through contacts: each votes with its direction and a bounded size.
        norm = gradient.norm(dim=1, keepdim=True)
        bound = norm.median().clamp(min=1e-12)
        logs.grad = (gradient / (norm / bound).clamp(min=1.0)).mean(0) / bound
        optimizer.step()
        schedule.step()
        if iteration % 20 == 0:
            values = ", ".join(f"{c} x{f:.3g}" for c, f in zip(args.fit, logs.detach().exp().tolist(), strict=True))
            print(f"  {iteration}: error {found.detach().mean():.3f}; {values}", flush=True)
    after, rows = float(check(test)[-1]), list[Row]()
    for constant, factor in zip(args.fit, logs.detach().exp().tolist(), strict=True):
        own = {"mass": 1.0, "motor": 1.0}.get(constant) or float(np.max(getattr(env.scene, constant)))
        reference = args.recording.name if args.recording else "MuJoCo"
        cells = name, reference, constant, own, own * factor, before, after
        rows.append(dict(zip(SHOWN, cells, strict=True)))
    return rows


def main(args: Args) -> None:
    if (args.checkpoint is None) == (args.recording is None):
        fail("give one of a checkpoint, whose policy acts in MuJoCo, and --recording FILE")
    if args.checkpoint:
        name, recording = record(args, args.checkpoint)
    elif args.recording and len(args.env) == 1:
        name, recording = args.env[0], read(args.recording, args.env[0])
    else:
        fail("--recording needs the --env of one task")
    rows = fit(args, name, recording)
    found = args.merge("calibration", rows, ("task", "reference", "constant"))
    args.publish("calibration", markdown(found, SHOWN), "transfer.md")


if __name__ == "__main__":
    run(main, Args, __doc__)
