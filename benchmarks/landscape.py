"""Loss landscapes and gradients of BPTT and SHAC: Figures 2, 11, 12 and 13 of the SHAC paper.

    python benchmarks/landscape.py --env humanoid ant           train, keep six policies on the way, measure, draw
    python benchmarks/landscape.py --env ant --time-limit 500   stop training in time; the same command goes on

A policy that SHAC has learned is changed along one weight, and along two random directions. BPTT's loss is minus the
mean reward of an episode of --horizon steps up to its end (a fallen robot gains no more), SHAC's is Eq. 5 over a window
of 32 steps from states that the policy visits. Every variation of the policy meets the same start states and the same
noise, all at once in one batch.

Writes landscape_*.csv and landscape_*.png. A csv that exists is kept: delete it to measure it anew.
"""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from cells import Case, Runner, ScriptFlags
from common import TASKS, Line, Panel, TaskName, Tasks, can_draw, plot, run
from tables import ROOT, Row, markdown
from torch import Tensor
from torch.func import functional_call, vmap
from worlds import Array

import diffsim
import shac
from diffsim import DiffEnv
from diffsim.training import Count, checkpoint

WARMUP = 100  # control steps of the policy before SHAC's window begins
RADIUS = 0.5  # largest step along a random direction, as a share of the size of each of the policy's tensors
FILES = ("gradients", "weight", "surface")
Loss = Literal["bptt", "shac"]
LOSSES: tuple[Loss, Loss] = ("bptt", "shac")
State = tuple[Tensor, Tensor]


@dataclass
class Args(ScriptFlags):
    env: Tasks = ("humanoid", "ant")  # tasks
    seed: int = 1  # seed of training, start states, noise and directions
    # iterations of SHAC at which gradients are measured; landscapes: at the last
    iterations: tuple[Count, ...] = (50, 200, 500, 1000, 1500, 2000)
    horizon: Count = 1000  # control steps of BPTT's window
    trajectories: Count = 128  # environments that evaluate each variation of the policy
    points: Count = 101  # variations along one weight, from -1 to 1
    side: Count = 41  # variations along each of two directions
    batch: Count = 8192  # environments at a time
    runs: Path = ROOT / "runs" / "landscape"  # directory of the trainings


class Look:
    """A policy, and both losses of many variations of it at once.

    A variation moves the policy by steps (K,) along K directions. Directions and variations are dictionaries of the
    policy's parameters with a first dimension: of the K directions, or of V variations.
    """

    def __init__(self, args: Args, task: TaskName, learner: shac.SHAC) -> None:
        self.args, self.task = args, task
        self.policy, self.target, self.gamma = learner.actor, learner.target, learner.args.gamma
        self.weights = {name: tensor.detach() for name, tensor in self.policy.named_parameters()}
        self.horizons: dict[Loss, int] = {"bptt": args.horizon, "shac": learner.args.horizon}
        self.starts: dict[Loss, State] = dict(zip(LOSSES, self.start_states(), strict=True))

    def make_env(self, num_envs: int, horizon: int, stochastic_init: bool = False) -> DiffEnv:
        """Unless stochastic, a reset starts from the unperturbed state, the same for every variation."""
        args = self.args
        return diffsim.make(self.task, num_envs, args.device, args.seed, horizon, stochastic_init=stochastic_init)

    @torch.no_grad()
    def start_states(self) -> tuple[State, State]:
        """qpos and qvel of random starts, and of where the policy is WARMUP steps later."""
        env = self.make_env(self.args.trajectories, 1, stochastic_init=True)
        torch.manual_seed(self.args.seed)
        first, obs = (env.qpos, env.qvel), env.detach()
        for _ in range(WARMUP):
            obs, *_ = env.step(self.policy(obs, self.policy.sample_noise(env.num_envs)))
        return first, (env.qpos, env.qvel)

    def rollout(self, loss: Loss, env: DiffEnv, parameters: dict[str, Tensor]) -> list[Tensor]:
        """Rewards, terminated, truncated and last observations of V variations, (horizon, V, trajectories, ...)."""
        shape = len(parameters["log_std"]), env.num_envs // len(parameters["log_std"])
        torch.manual_seed(0)  # the same noise for every variation, and for every call
        noise = torch.randn(self.horizons[loss], 1, shape[1], env.scene.nu, device=env.device)

        def act(parameters: dict[str, Tensor], obs: Tensor, noise: Tensor) -> Tensor:
            return functional_call(self.policy, parameters, (obs, parameters["log_std"].exp() * noise))

        env.reset()
        env.detach()
        obs = env.set_state(*(x.repeat(shape[0], 1) for x in self.starts[loss]))
        steps = []
        for step_noise in noise:
            action = vmap(act)(parameters, obs.unflatten(0, shape), step_noise.expand(shape[0], -1, -1))
            obs, reward, terminated, truncated, info = env.step(action.flatten(0, 1))
            steps.append((reward, terminated, truncated, info["final_obs"]))
        return [torch.stack(tensors).unflatten(1, shape) for tensors in zip(*steps, strict=True)]

    def losses(self, loss: Loss, env: DiffEnv, parameters: dict[str, Tensor]) -> Tensor:
        """(V,) BPTT's: minus the rewards of the episodes up to their ends, per step of the horizon; SHAC's: Eq. 5."""
        reward, terminated, truncated, next_obs = self.rollout(loss, env, parameters)
        done = terminated | truncated
        if loss == "bptt":
            ended = done.cumsum(0).roll(1, 0)
            ended[0] = 0
            return -reward.masked_fill(ended > 0, 0.0).mean((0, 2))
        value = self.target(self.policy.normalizer(next_obs)).squeeze(-1).masked_fill(terminated, 0.0)
        variations = zip(reward.unbind(1), value.unbind(1), done.unbind(1), strict=True)
        return torch.stack([shac.actor_loss(*variation, self.gamma) for variation in variations])

    def vary(
        self, loss: Loss, directions: dict[str, Tensor], steps: Tensor, slope: bool = False
    ) -> tuple[Array, Array]:
        """Losses (S,) of the policy moved by steps (S, K), and, if asked for, their gradients (S, K) in the steps."""
        found, slopes, env = list[Tensor](), list[Tensor](), None
        for chunk in steps.split(max(1, self.args.batch // self.args.trajectories)):
            num_envs = len(chunk) * self.args.trajectories
            if env is None or env.num_envs != num_envs:
                env = self.make_env(num_envs, self.horizons[loss] if slope else 1)
            chunk = chunk.clone().requires_grad_(slope)
            with torch.set_grad_enabled(slope):
                moves = {name: torch.einsum("sk,k...->s...", chunk, d) for name, d in directions.items()}
                value = self.losses(loss, env, {name: self.weights[name] + move for name, move in moves.items()})
                slopes += torch.autograd.grad(value.sum(), chunk) if slope else ()
            found.append(value.detach())
        return torch.cat(found).cpu().numpy(), torch.cat(slopes).cpu().numpy() if slope else np.empty((len(steps), 0))

    def gradient(self, loss: Loss) -> dict[str, Tensor]:
        """The loss's gradient with respect to the policy's parameters, on the CPU."""
        parameters = {name: weight.clone().unsqueeze(0).requires_grad_() for name, weight in self.weights.items()}
        env = self.make_env(self.args.trajectories, self.horizons[loss])
        found = torch.autograd.grad(self.losses(loss, env, parameters).sum(), list(parameters.values()))
        return {name: tensor[0].cpu() for name, tensor in zip(parameters, found, strict=True)}

    def one_weight(self) -> dict[str, Tensor]:
        """The direction (K = 1) of the network's weight on which SHAC's loss depends most."""
        sizes = {name: tensor.abs() for name, tensor in self.gradient("shac").items() if tensor.ndim == 2}
        name = max(sizes, key=lambda name: float(sizes[name].max()))
        directions = {name: torch.zeros_like(weight).unsqueeze(0) for name, weight in self.weights.items()}
        directions[name].view(-1)[int(sizes[name].argmax())] = 1.0
        return directions

    def random_directions(self) -> dict[str, Tensor]:
        """Two directions, each tensor's part scaled to the tensor's norm times the radius (Li et al. 2018)."""
        generator, directions = torch.Generator().manual_seed(self.args.seed), {}
        for name, weight in self.weights.items():
            random = torch.randn(2, *weight.shape, generator=generator).to(weight.device)
            norm = random.flatten(1).norm(dim=1).view(2, *[1] * weight.ndim)
            directions[name] = RADIUS * weight.norm() * random / norm
        return directions


def gradients(iteration: int, look: Look) -> Row:
    """Norms of both gradients, and quantiles of their entries' sizes."""
    sizes: dict[str, object] = {"iteration": iteration}
    for loss in LOSSES:
        gradient = torch.cat([tensor.flatten() for tensor in look.gradient(loss).values()])
        finite = gradient[gradient.isfinite()].double()
        sizes[f"{loss}_norm"] = f"{finite.norm():.4g}"
        for q in (0.5, 0.9, 0.99, 1.0):
            sizes[f"{loss}_q{q:g}"] = f"{np.quantile(finite.abs(), q) if len(finite) else 0:.4g}"
        sizes[f"{loss}_nonfinite"] = len(gradient) - len(finite)
    return sizes


def landscape(look: Look, name: str) -> list[Row]:
    """Both losses over the variations; along one weight also the slope of SHAC's."""
    line, count = name == "weight", look.args.points if name == "weight" else look.args.side
    axis = torch.linspace(-1, 1, count, device=look.args.device)
    steps = axis.unsqueeze(1) if line else torch.cartesian_prod(axis, axis)
    directions = look.one_weight() if line else look.random_directions()
    bptt, _ = look.vary("bptt", directions, steps)
    ours, slope = look.vary("shac", directions, steps, slope=line)
    columns = ("step", "bptt", "shac", "shac_gradient") if line else ("k1", "k2", "bptt", "shac")
    table = [*steps.T.cpu().numpy(), bptt, ours, *slope.T]
    return [dict(zip(columns, (f"{value:.7g}" for value in row), strict=True)) for row in zip(*table, strict=True)]


def measure(args: Args, runner: Runner, task: TaskName) -> None:
    """Train once, stop at each of the given iterations to keep the checkpoint, and write the csv files that lack."""
    missing = [name for name in FILES if not args.csv(f"landscape_{task}_{name}").is_file()]
    folder = args.runs / f"{task}__{args.seed}"
    case = Case(folder, task, args.seed, "shac", ("--iterations", str(args.iterations[-1]), "--eval-every", "0"))
    looks = list[Look]()
    for k in args.iterations if missing else ():
        path = folder / f"iteration_{k}.pt"
        if not path.is_file():
            if not runner.train(case, until=k):
                return
            shutil.copy(folder / "checkpoint.pt", path)
        state = checkpoint.load(path, "shac")
        settings = dataclasses.replace(shac.Args(**state["args"]), device=args.device)
        learner = shac.SHAC(settings, diffsim.make(task, 1, args.device))
        checkpoint.restore(learner, state)
        looks.append(Look(args, task, learner))
    for name in missing:
        if runner.time_is_up:
            return
        rows = list(map(gradients, args.iterations, looks)) if name == "gradients" else landscape(looks[-1], name)
        args.write(f"landscape_{task}_{name}", rows)
        print(f"{task}, {name}: done", flush=True)


def draw(args: Args, task: TaskName) -> None:
    """The pictures of a task; prints the norms of both gradients, and how well SHAC's agrees with its loss."""
    sizes = args.read(f"landscape_{task}_gradients")
    line, surface = (
        {column: np.array([float(row[column]) for row in rows]) for column in rows[0]}
        for rows in (args.read(f"landscape_{task}_{name}") for name in ("weight", "surface"))
    )
    x, text, difference = line["step"], "change of one weight", np.gradient(line["shac"], line["step"])
    correlation = np.corrcoef(difference[1:-1], line["shac_gradient"][1:-1])[0, 1]
    print(f"{task}, SHAC's analytic against finite-difference gradient along one weight: correlation {correlation:.3f}")
    print(markdown(sizes, ("iteration", *(f"{loss}_norm" for loss in LOSSES))))
    slopes = Line(x, difference, "-", "finite difference"), Line(x, line["shac_gradient"], "--", "analytic")
    panels = [Panel([Line(x, line[loss], "k-", width=1)], f"{loss.upper()}: loss", text) for loss in LOSSES]
    plot(args.picture(f"landscape_{task}_weight"), [[*panels, Panel(slopes, "SHAC: gradient", text)]], (4, 3.2))

    iterations = [float(row["iteration"]) for row in sizes]
    curves, styles = list[Line](), (("q0.5", ":", "median"), ("q0.99", "--", "0.99 quantile"), ("q1", "-", "largest"))
    for (loss, colour), (quantile, style, name) in product(zip(LOSSES, ("C2", "C0"), strict=True), styles):
        values = [float(row[f"{loss}_{quantile}"]) for row in sizes]
        curves.append(Line(iterations, values, colour + style, f"{loss}, {name}"))
    panel = Panel(curves, "", "iteration of SHAC", "size of the gradient's entries", log="y")
    plot(args.picture(f"landscape_{task}_gradients"), [[panel]], (6, 4))

    if can_draw():
        from matplotlib.figure import Figure

        side, path = round(len(surface["k1"]) ** 0.5), args.picture(f"landscape_{task}_surface")
        figure = Figure(figsize=(10, 4.2), layout="constrained")
        for axis, loss in zip(figure.subplots(1, 2, subplot_kw={"projection": "3d"}), LOSSES, strict=True):
            axis.plot_surface(*(surface[name].reshape(side, side) for name in ("k1", "k2", loss)), cmap="viridis")
            axis.set_title(f"{loss.upper()}: loss along two directions")
        figure.savefig(path, dpi=110)
        print(path)


def main(args: Args) -> None:
    runner = Runner(args)
    for task in () if args.draw_only else args.env:
        measure(args, runner, task)
    for task in TASKS:
        for path in args.machines(f"landscape_{task}_surface").values():
            one = dataclasses.replace(args, output=path.parent)
            if all(one.csv(f"landscape_{task}_{name}").is_file() for name in FILES):
                draw(one, task)


if __name__ == "__main__":
    run(main, Args, __doc__)
