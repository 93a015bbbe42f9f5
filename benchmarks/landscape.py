"""Loss landscapes and gradients of BPTT and SHAC: Figures 2, 11, 12 and 13 of the SHAC paper.

    python benchmarks/landscape.py --env humanoid ant           train, keep six policies on the way, measure, draw
    python benchmarks/landscape.py --env ant --time-limit 500   stop training in time; the same command goes on
    python benchmarks/landscape.py --draw-only                  only draw and tabulate what there is
    python benchmarks/landscape.py --env cartpole --iterations 4 8 --trajectories 4 --points 11 --side 5 --horizon 60

A policy that SHAC has learned is changed along one weight, and along two random directions. BPTT's loss is minus the
mean reward of an episode of --horizon steps up to its end (a fallen robot gains no more), SHAC's is Eq. 5 over a window
of 32 steps from states that the policy visits. Every variation of the policy meets the same start states and the same
noise, all at once in one batch. The last line is a short look.

Writes docs/results/landscape_*.csv, docs/landscape_*.png and their part of the page docs/experiments.md. A csv that
exists is kept: delete it to measure it anew.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import matplotlib
import numpy as np
import torch
import tyro
from torch import Tensor
from torch.func import functional_call, vmap

import diffsim
from diffsim import distributed
from diffsim.run import load_checkpoint

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
FILES = ("gradients", "weight", "surface")
BEGIN = time.perf_counter()
sys.path.insert(0, str(ROOT))
from tables import fill, read_csv, write_csv  # noqa: E402

import shac  # noqa: E402


@dataclass
class Args:
    env: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--env-id"])] = ("humanoid", "ant")
    """tasks"""
    device: str | None = None
    """torch device; None: the GPU if there is one"""
    seed: int = 1
    """seed of the training, of start states, noise and directions"""
    iterations: tuple[int, ...] = (50, 200, 500, 1000, 1500, 2000)
    """SHAC's iterations after which a policy is looked at; landscapes are of the last"""
    horizon: int = 1000
    """control steps of BPTT's window"""
    trajectories: int = 128
    """environments that evaluate each variation of the policy"""
    points: int = 101
    """variations along one weight, from -1 to 1"""
    side: int = 41
    """variations along each of two directions"""
    radius: float = 0.5
    """largest step along a direction, as a share of the size of each of the policy's tensors"""
    warmup: int = 100
    """control steps of the policy before SHAC's window begins"""
    batch: int = 8192
    """environments at a time"""
    time_limit: float = float("inf")
    """seconds after which no measurement begins and a training is stopped, to be resumed by the next call"""
    draw_only: bool = False
    """train and measure nothing: pictures and tables of the csv files at hand"""
    runs: Path = ROOT / "runs" / "landscape"
    """directory of the trainings"""
    docs: Path = ROOT / "docs"
    """directory of what is written"""


class Snapshot(NamedTuple):
    settings: Any  # arguments of its training
    actor: Any
    normalise: Any
    target: Any  # critic


class TimeUp(Exception):
    """The time limit is reached; what is done so far is on the disk."""


def remaining(args: Args) -> float | None:
    """Seconds that are left, None without a limit."""
    left = args.time_limit - time.perf_counter() + BEGIN
    if left <= 0:
        raise TimeUp
    return left if left < float("inf") else None


def snapshots(args: Args, env: str) -> list[Path]:
    """One training, stopped and resumed; its checkpoint after each of the given iterations."""
    folder = args.runs / f"{env}__{args.seed}"
    paths = [folder / f"iteration_{k}.pt" for k in args.iterations]
    checkpoint = folder / "checkpoint.pt"
    for k, path in zip(args.iterations, paths, strict=True):
        if path.is_file():
            continue
        if not checkpoint.is_file() or torch.load(checkpoint, weights_only=True)["iteration"] < k:
            start = ["--env", env, "--seed", args.seed, "--run-dir", folder, "--iterations", args.iterations[-1]]
            start = ["--resume", checkpoint] if checkpoint.is_file() else start
            start += ["--device", args.device, "--eval-every", 0, "--stop-after", k, "--quiet"]
            command = [str(word) for word in (sys.executable, ROOT / "shac.py", *start)]
            training = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            try:
                training.wait(remaining(args))
            except (subprocess.TimeoutExpired, TimeUp):
                training.send_signal(signal.SIGTERM)
                training.wait()
                raise TimeUp from None
            if training.returncode != 0:
                raise RuntimeError(f"training failed: {' '.join(command)}")
        shutil.copy(checkpoint, path)
    return paths


def load(args: Args, path: Path, env: Any) -> Snapshot:
    checkpoint = load_checkpoint(path, shac.FORMAT)
    settings = shac.Args(**checkpoint["args"] | {"device": args.device})
    actor, normalise = shac.build(settings, env)
    target = shac.mlp(normalise.mean.numel(), settings.critic_hidden, 1, orthogonal=True).to(env.device)
    for part, name in ((actor, "actor"), (normalise, "normalise"), (target, "target")):
        part.load_state_dict(checkpoint[name])
    return Snapshot(settings, actor, normalise, target.requires_grad_(False))


# Losses of many variations of a policy at once ------------------------------------------------------------------------


def make_env(args: Args, task: str, num_envs: int, horizon: int) -> Any:
    # A reset within a window starts from the unperturbed state, the same for every variation.
    return diffsim.make(task, num_envs, args.device, args.seed, horizon, stochastic_init=False)


@torch.no_grad()
def start_states(args: Args, task: str, snapshot: Snapshot) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """qpos and qvel of random starts, and of where the policy is --warmup steps later."""
    env = diffsim.make(task, args.trajectories, args.device, args.seed, horizon=1)
    torch.manual_seed(args.seed)
    first, obs = (env.qpos, env.qvel), env.detach()
    for _ in range(args.warmup):
        obs, *_ = env.step(snapshot.actor(snapshot.normalise(obs), snapshot.actor.sample_noise(args.trajectories)))
    return first, (env.qpos, env.qvel)


def rollout(env: Any, snapshot: Snapshot, parameters: dict[str, Tensor], start: Any, horizon: int) -> list[Tensor]:
    """Rewards, terminated, truncated and last observations, (horizon, V, trajectories, ...), of V variations."""
    count = len(next(iter(parameters.values())))
    trajectories = env.num_envs // count
    torch.manual_seed(0)  # the same noise for every variation, and for every call
    noise = torch.randn(horizon, 1, trajectories, env.single_action_space.shape[0], device=env.device)

    def act(parameters: dict[str, Tensor], obs: Tensor, noise: Tensor) -> Tensor:
        return functional_call(snapshot.actor, parameters, (obs, parameters["log_std"].exp() * noise))

    env.reset()
    env.detach()
    obs = env.set_state(*(x.repeat(count, 1) for x in start))
    steps = []
    for t in range(horizon):
        per_variation = snapshot.normalise(obs).unflatten(0, (count, trajectories))
        action = vmap(act)(parameters, per_variation, noise[t].expand(count, -1, -1))
        obs, reward, terminated, truncated, info = env.step(action.flatten(0, 1))
        steps.append((reward, terminated, truncated, info["final_obs"]))
    tensors = [torch.stack(tensors) for tensors in zip(*steps, strict=True)]
    return [tensor.unflatten(1, (count, trajectories)) for tensor in tensors]


def bptt_loss(env: Any, snapshot: Snapshot, parameters: dict[str, Tensor], start: Any, horizon: int) -> Tensor:
    """(V,) minus the rewards of the episodes up to their ends, per step of the horizon."""
    reward, terminated, truncated, _ = rollout(env, snapshot, parameters, start, horizon)
    ended = (terminated | truncated).cumsum(0).roll(1, 0)
    ended[0] = 0
    return -reward.masked_fill(ended > 0, 0.0).mean((0, 2))


def shac_loss(env: Any, snapshot: Snapshot, parameters: dict[str, Tensor], start: Any, horizon: int) -> Tensor:
    """(V,) Eq. 5."""
    reward, terminated, truncated, next_obs = rollout(env, snapshot, parameters, start, horizon)
    value = snapshot.target(snapshot.normalise(next_obs)).squeeze(-1).masked_fill(terminated, 0.0)
    count, done, gamma = reward.shape[1], terminated | truncated, snapshot.settings.gamma
    return torch.stack([shac.actor_loss(reward[:, v], value[:, v], done[:, v], gamma) for v in range(count)])


Loss = Callable[[Any, Snapshot, dict[str, Tensor], Any, int], Tensor]


def evaluate(
    args: Args,
    task: str,
    snapshot: Snapshot,
    loss: Loss,
    start: Any,
    horizon: int,
    directions: Any,
    steps: Tensor,
    gradient: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Losses (S,) of the policy moved by steps (S, K) along K directions, and their gradients (S, K) in steps."""
    weights = {name: tensor.detach() for name, tensor in snapshot.actor.named_parameters()}
    losses, gradients = [], []
    envs: dict[int, Any] = {}
    for chunk in steps.split(max(1, args.batch // args.trajectories)):
        if len(chunk) not in envs:
            envs = {len(chunk): make_env(args, task, len(chunk) * args.trajectories, horizon if gradient else 1)}
        chunk = chunk.clone().requires_grad_(gradient)
        with torch.set_grad_enabled(gradient):
            parameters = {
                name: weight + torch.einsum("sk,k...->s...", chunk, directions[name])
                for name, weight in weights.items()
            }
            value = loss(envs[len(chunk)], snapshot, parameters, start, horizon)
            if gradient:
                gradients.append(torch.autograd.grad(value.sum(), chunk)[0])
        losses.append(value.detach())
    return torch.cat(losses).cpu().numpy(), torch.cat(gradients).cpu().numpy() if gradient else np.empty(0)


def policy_gradient(args: Args, task: str, snapshot: Snapshot, loss: Loss, start: Any, horizon: int) -> Tensor:
    """The gradient of the loss with respect to all parameters of the policy, as one vector, on the CPU."""
    parameters = {name: tensor.detach().unsqueeze(0) for name, tensor in snapshot.actor.named_parameters()}
    leaves = [tensor.requires_grad_() for tensor in parameters.values()]
    value = loss(make_env(args, task, args.trajectories, horizon), snapshot, parameters, start, horizon)
    return torch.cat([g.flatten() for g in torch.autograd.grad(value.sum(), leaves)]).cpu()


def one_weight(snapshot: Snapshot, gradient: Tensor) -> tuple[dict[str, Tensor], str]:
    """The direction (K = 1) of the network's weight on which SHAC's loss depends most, and its name."""
    directions, offset, best = {}, 0, (-1.0, "", 0)
    for name, tensor in snapshot.actor.named_parameters():
        directions[name] = torch.zeros(1, *tensor.shape, device=tensor.device)
        part = gradient[offset : offset + tensor.numel()].abs()
        offset += tensor.numel()
        if tensor.ndim == 2:
            best = max(best, (part.max().item(), name, int(part.argmax())))
    _, name, index = best
    directions[name].view(-1)[index] = 1.0
    return directions, f"{name}[{index}]"


def random_directions(args: Args, snapshot: Snapshot) -> dict[str, Tensor]:
    """Two directions, each tensor's part scaled to the tensor's norm times the radius (Li et al. 2018)."""
    generator = torch.Generator().manual_seed(args.seed)
    directions = {}
    for name, tensor in snapshot.actor.named_parameters():
        random = torch.randn(2, *tensor.shape, generator=generator).to(tensor.device)
        norm = random.flatten(1).norm(dim=1).view(2, *[1] * tensor.ndim)
        directions[name] = args.radius * tensor.detach().norm() * random / norm
    return directions


# Figures --------------------------------------------------------------------------------------------------------------


def columns_of(path: Path) -> dict[str, np.ndarray]:
    rows = read_csv(path)
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def measure(args: Args, task: str) -> None:
    """Writes those csv files of a task that there are not."""
    gradients, line, surface = (args.docs / "results" / f"landscape_{task}_{name}.csv" for name in FILES)
    if gradients.is_file() and line.is_file() and surface.is_file():
        return
    probe, paths = make_env(args, task, 1, 1), snapshots(args, task)
    snapshot = load(args, paths[-1], probe)
    first, visited = start_states(args, task, snapshot)
    horizon = snapshot.settings.horizon

    if not gradients.is_file():
        rows = []
        for iteration, path in zip(args.iterations, paths, strict=True):
            remaining(args)
            rows.append({"iteration": iteration} | gradient_sizes(args, task, load(args, path, probe)))
            print(f"{task}, gradients: {rows[-1]}", flush=True)
        write_csv(gradients, rows)

    if not line.is_file():
        remaining(args)
        direction, weight = one_weight(snapshot, policy_gradient(args, task, snapshot, shac_loss, visited, horizon))
        steps = torch.linspace(-1, 1, args.points, device=args.device).unsqueeze(1)
        bptt, _ = evaluate(args, task, snapshot, bptt_loss, first, args.horizon, direction, steps)
        ours, slope = evaluate(args, task, snapshot, shac_loss, visited, horizon, direction, steps, gradient=True)
        write_columns(line, step=steps[:, 0].cpu().numpy(), bptt=bptt, shac=ours, shac_gradient=slope[:, 0])
        print(f"{task}, weight {weight}: done", flush=True)

    if not surface.is_file():
        remaining(args)
        axis = torch.linspace(-1, 1, args.side, device=args.device)
        steps, directions = torch.cartesian_prod(axis, axis), random_directions(args, snapshot)
        bptt, _ = evaluate(args, task, snapshot, bptt_loss, first, args.horizon, directions, steps)
        ours, _ = evaluate(args, task, snapshot, shac_loss, visited, horizon, directions, steps)
        write_columns(surface, **dict(zip(("k1", "k2"), steps.T.cpu().numpy(), strict=True)), bptt=bptt, shac=ours)


def gradient_sizes(args: Args, task: str, snapshot: Snapshot) -> dict[str, Any]:
    """Norm and quantiles of the sizes of the entries of BPTT's and SHAC's gradient."""
    first, visited = start_states(args, task, snapshot)
    sizes: dict[str, Any] = {}
    for name, loss, start, horizon in (
        ("bptt", bptt_loss, first, args.horizon),
        ("shac", shac_loss, visited, snapshot.settings.horizon),
    ):
        gradient = policy_gradient(args, task, snapshot, loss, start, horizon)
        finite = gradient[gradient.isfinite()].double()
        sizes[f"{name}_norm"] = f"{finite.norm():.4g}"
        for q in (0.5, 0.9, 0.99, 1.0):
            sizes[f"{name}_q{q:g}"] = f"{np.quantile(finite.abs(), q) if len(finite) else 0:.4g}"
        sizes[f"{name}_nonfinite"] = len(gradient) - len(finite)
    return sizes


def write_columns(path: Path, **columns: np.ndarray) -> None:
    rows = ([f"{value:.7g}" for value in row] for row in zip(*columns.values(), strict=True))
    write_csv(path, [dict(zip(columns, row, strict=True)) for row in rows])


def roughness(values: np.ndarray) -> tuple[int, float]:
    """Local extrema along a line, and the length of its way up and down, in units of its range."""
    steps = np.diff(values)
    return int((steps[:-1] * steps[1:] < 0).sum()), float(np.abs(steps).sum() / np.ptp(values))


def draw(args: Args, task: str) -> str:
    """Draws a task's figures from its csv files, and returns its part of the page."""
    results = args.docs / "results"
    line = columns_of(results / f"landscape_{task}_weight.csv")
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.2), layout="constrained")
    for axis, name, title in ((axes[0], "bptt", "BPTT"), (axes[1], "shac", "SHAC")):
        axis.plot(line["step"], line[name], linewidth=1)
        axis.set_title(f"{title}: loss")
    difference = np.gradient(line["shac"], line["step"])
    axes[2].plot(line["step"], difference, label="finite difference")
    axes[2].plot(line["step"], line["shac_gradient"], "--", label="analytic")
    axes[2].set_title("SHAC: gradient")
    axes[2].legend()
    for axis in axes:
        axis.set_xlabel("change of one weight")
    figure.savefig(args.docs / f"landscape_{task}_weight.png", dpi=110)
    plt.close(figure)

    surface = columns_of(results / f"landscape_{task}_surface.csv")
    side = round(len(surface["k1"]) ** 0.5)
    k1, k2 = (surface[name].reshape(side, side) for name in ("k1", "k2"))
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained", subplot_kw={"projection": "3d"})
    for axis, name, title in ((axes[0], "bptt", "BPTT"), (axes[1], "shac", "SHAC")):
        axis.plot_surface(k1, k2, surface[name].reshape(side, side), cmap="viridis")
        axis.set_title(f"{title}: loss along two directions")
    figure.savefig(args.docs / f"landscape_{task}_surface.png", dpi=110)
    plt.close(figure)

    gradients = columns_of(results / f"landscape_{task}_gradients.csv")
    figure, axis = plt.subplots(figsize=(5, 3.2), layout="constrained")
    for name, color in (("bptt", "C2"), ("shac", "C0")):
        for quantile, style in (("q0.5", ":"), ("q0.99", "--"), ("q1", "-")):
            label = f"{name}, {'largest' if quantile == 'q1' else quantile[1:] + ' quantile'}"
            axis.plot(gradients["iteration"], gradients[f"{name}_{quantile}"], style, color=color, label=label)
    axis.set_yscale("log")
    axis.set_xlabel("iteration of SHAC")
    axis.set_ylabel("size of the gradient's entries")
    axis.legend(fontsize=7)
    figure.savefig(args.docs / f"landscape_{task}_gradients.png", dpi=110)
    plt.close(figure)

    text = f"### {task}\n\n| | local extrema along one weight | way up and down / range |\n|---|---|---|\n"
    for name in ("bptt", "shac"):
        count, way = roughness(line[name])
        text += f"| {name} | {count} of {len(line['step']) - 2} | {way:.2f} |\n"
    correlation = np.corrcoef(difference[1:-1], line["shac_gradient"][1:-1])[0, 1]
    text += f"\nAnalytic against finite-difference gradient of SHAC along the weight: correlation {correlation:.3f}.\n"
    text += f"\n![one weight](landscape_{task}_weight.png)\n![surface](landscape_{task}_surface.png)\n"
    text += "\n| iteration | " + " | ".join(name for name in gradients if name != "iteration") + " |\n"
    text += "|---" * len(gradients) + "|\n"
    for row in zip(*gradients.values(), strict=True):
        text += "| " + " | ".join(f"{value:.4g}" for value in row) + " |\n"
    return text + f"\nq: quantiles of the entries' sizes.\n\n![gradients](landscape_{task}_gradients.png)\n\n"


def main(args: Args) -> None:
    if unknown := [env for env in args.env if env not in diffsim.TASKS]:
        print(f"landscape.py: unknown task {unknown[0]!r}: choose from {', '.join(diffsim.TASKS)}", file=sys.stderr)
        sys.exit(2)
    args.device = distributed.choose_device(args.device)
    try:
        for task in () if args.draw_only else args.env:
            measure(args, task)
    except TimeUp:
        print("stopped by --time-limit: the same command goes on", flush=True)
    files = {task: [args.docs / "results" / f"landscape_{task}_{name}.csv" for name in FILES] for task in diffsim.TASKS}
    if text := "".join(draw(args, task) for task, paths in files.items() if all(path.is_file() for path in paths)):
        fill(args.docs / "experiments.md", "landscape", text)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
