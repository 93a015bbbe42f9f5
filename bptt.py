"""BPTT, backpropagation through time and through the simulator, the first-order baseline of the SHAC paper.

The policy descends the gradient of the return of a window of simulated steps. There is no critic: nothing stands for
what comes after the window. Windows as long as an episode (--horizon 1000) make it the plain method of section 3.2.

    python bptt.py --env ant --seed 1                                   train; writes runs/ant__bptt__1__<time>/
    python bptt.py --resume runs/ant__bptt__1__<time>/checkpoint.pt     continue an interrupted run exactly
    python bptt.py --evaluate runs/ant__bptt__1__<time>/checkpoint.pt   evaluate its deterministic policy
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
import tyro
from torch import Tensor, nn

import diffsim
from diffsim import distributed, graph
from diffsim.evaluation import Evaluation, evaluate, write_video
from diffsim.run import EpisodeStatistics, Mark, Run, constants, fail, flag, read_arguments


@dataclass
class Args:
    env: Annotated[str, tyro.conf.arg(aliases=["--env-id"])] = "ant"
    """task: cartpole, hopper, half_cheetah, ant, humanoid or humanoid_mtu"""
    seed: int = 1
    """seed of the networks, the policy's noise and the environments' resets"""
    device: str | None = None
    """torch device of simulation and learning, e.g. cpu or cuda:0; None: the GPU if there is one"""
    cuda_graph: bool = True
    """on a GPU, replay an iteration as a CUDA graph; without, the same code runs operation by operation"""
    threads: int | None = None
    """CPU threads of the simulator, which change no result; None: all cores"""

    iterations: int | None = None
    """learning iterations; None: per task"""
    num_envs: int | None = None
    """parallel environments N, over all processes of torchrun; None: per task"""
    horizon: int | None = None
    """control steps H of a window (1/60 s each); None: per task"""
    substeps: int | None = None
    """simulation steps per control step; None: per --accuracy"""
    integrator: Literal["semi_implicit", "implicit", "extrapolated"] | None = None
    """time integration of the simulator; None: per --accuracy"""
    accuracy: Literal["fast", "default", "accurate"] | None = None
    """the task's preset of integrator and substeps (docs/accuracy.md); None: default, the paper's"""
    penalty: tuple[str, ...] = ()
    """constants of contact and limits in place of the robot file's, e.g. k_n=1e5 k_d=1e4"""

    deterministic_policy: bool = False
    """train a policy without noise"""
    hidden: tuple[int, ...] | None = None
    """units of the policy's hidden layers; None: per task"""
    lr: float | None = None
    """initial learning rate; None: per task"""
    final_lr: float = 1e-5
    """learning rate that it reaches, linearly, after the last iteration"""
    normalise_obs: bool | None = None
    """normalise observations by their running mean and variance; None: per task"""
    betas: tuple[float, float] = (0.7, 0.95)
    """Adam's decay rates of the gradient's first and second moment"""
    max_grad_norm: float = 1.0
    """gradients are clipped to this norm"""
    gamma: float = 0.99
    """discount factor"""
    initial_log_std: float = -1.0
    """initial log standard deviation of the policy's noise, before tanh"""

    eval_every: int = 100
    """evaluate the deterministic policy every this many iterations (0: only at the end)"""
    eval_episodes: int = 64
    """episodes of an evaluation, one in each of as many fresh environments"""
    save_every: int = 100
    """save the checkpoint every this many iterations (0: only at the end)"""
    stop_after: int | None = None
    """stop at this iteration as Ctrl-C would: saved, to be resumed; the schedules still run to --iterations"""
    run_dir: Path | None = None
    """directory of the run; None: runs/{env}__bptt__{seed}__{time}, or that of the checkpoint resumed"""
    resume: Path | None = None
    """checkpoint to continue from; its arguments hold where the command line gives no other"""
    evaluate: Path | None = None
    """checkpoint to evaluate, without training; e.g. with other --substeps or --eval-episodes"""
    capture_video: bool = False
    """write a video of the last evaluation's median episode"""
    track: bool = False
    """also log to Weights & Biases (pip install wandb)"""
    quiet: bool = False
    """no progress line"""


# Windows: section 4.2 of the SHAC paper; everything else: its authors' released settings.
# fmt: off
COLUMNS = ("hidden", "horizon", "num_envs", "lr", "normalise_obs", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),       64, 64, 1e-2, False,  500),
    "hopper":       ((128, 64, 32), 128, 32, 1e-3, True,  2000),
    "half_cheetah": ((128, 64, 32), 128, 32, 2e-3, True,  2000),
    "ant":          ((128, 64, 32), 128, 32, 4e-3, True,  2000),
    "humanoid":     ((256, 128),    128, 32, 2e-3, True,  2000),
    "humanoid_mtu": ((512, 256),    128, 16, 2e-3, True,  2000),
}
GENERAL =           ((256, 128),    128, 32, 2e-3, True,  2000)  # of a task that is not in the table

PROGRESS = {  # scalar of tensorboard: column of progress.csv, beside iteration, control_steps and seconds (of training)
    "charts/episodic_return": "return", "charts/episodic_length": "length",
    "eval/return": "eval_return", "eval/length": "eval_length", "eval/speed": "eval_speed",
    "losses/actor": "actor_loss",
    "grad/norm": "grad_norm", "grad/skipped": "skipped", "sim/nonfinite": "nonfinite",
}
# fmt: on
FIXED = ("env", "num_envs", "hidden", "deterministic_policy", "normalise_obs")  # by a checkpoint
FORMAT = "bptt-1"  # of checkpoints


# Networks -------------------------------------------------------------------------------------------------------------


def mlp(inputs: int, hidden: tuple[int, ...], outputs: int, orthogonal: bool) -> nn.Sequential:
    """Linear, ELU, LayerNorm per hidden layer and a linear output; torch's default or orthogonal initialisation."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ELU(inplace=True), nn.LayerNorm(width)]
        inputs = width
    layers.append(nn.Linear(inputs, outputs))
    if orthogonal:
        for layer in layers:
            if isinstance(layer, nn.Linear):
                nn.init.orthogonal_(layer.weight, math.sqrt(2))
                nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


class Actor(nn.Module):
    """pi(a|s): tanh of a Gaussian whose standard deviation does not depend on the state; or of its mean alone."""

    def __init__(self, args: Args, obs_dim: int, action_dim: int):
        super().__init__()
        self.mean = mlp(obs_dim, args.hidden, action_dim, orthogonal=args.deterministic_policy)
        log_std = torch.full((action_dim,), -math.inf if args.deterministic_policy else args.initial_log_std)
        self.log_std = nn.Parameter(log_std, requires_grad=not args.deterministic_policy)

    def sample_noise(self, *shape: int) -> Tensor:
        """(*shape, action_dim) reparameterised noise of a whole window, differentiable in log_std (A.1)."""
        std = self.log_std.exp()
        return std * torch.randn(*shape, std.numel(), dtype=std.dtype, device=std.device)

    def forward(self, obs: Tensor, noise: Tensor | float = 0.0) -> Tensor:
        return torch.tanh(self.mean(obs) + noise)


class Normaliser(nn.Module):
    """Normalises observations by their running mean and variance; constant between updates, thus within a window."""

    def __init__(self, obs_dim: int):
        super().__init__()
        self.register_buffer("count", torch.tensor(0.0))
        self.register_buffer("mean", torch.zeros(obs_dim))
        self.register_buffer("var", torch.ones(obs_dim))
        self.register_buffer("std", torch.ones(obs_dim))

    def forward(self, obs: Tensor) -> Tensor:
        return (obs - self.mean) / self.std

    @torch.no_grad()
    def update(self, obs: Tensor) -> None:
        """Adds obs (..., obs_dim) of all processes to the statistics (Chan et al.'s parallel variance)."""
        obs = obs.flatten(0, -2)
        var, mean = torch.var_mean(obs, dim=0, correction=0)
        own, mean = mean, distributed.average(mean.clone())
        var = distributed.average(var + (own - mean) ** 2)
        new = len(obs) * distributed.size()
        total, delta = self.count + new, mean - self.mean
        self.var.copy_((self.var * self.count + var * new + delta**2 * self.count * new / total) / total)
        self.mean.add_(delta * new / total)
        self.count.copy_(total)
        self.std.copy_((self.var + 1e-5).sqrt())


class ClippedAdam:
    """Adam on the gradient clipped to a norm, however large. One that is not finite is counted and skipped.

    The module's parameters become views of one vector, so a step is a dozen operations for any network; none of them
    waits for the device.
    """

    def __init__(self, module: nn.Module, args: Args):
        self.parameters = [p for p in module.parameters() if p.requires_grad]
        self.vector = nn.utils.parameters_to_vector(self.parameters).detach()
        nn.utils.vector_to_parameters(self.vector, self.parameters)
        self.lr = torch.zeros((), device=self.vector.device)  # a tensor: a captured graph reads its present value
        self.adam = torch.optim.Adam([self.vector], self.lr, args.betas, fused=True, capturable=self.vector.is_cuda)
        self.max_norm = args.max_grad_norm
        self.skipped = torch.zeros_like(self.lr)

    def step(self, loss: Tensor) -> Tensor:
        """One descent step; returns the gradient's norm before clipping."""
        gradients = torch.autograd.grad(loss, self.parameters)
        self.vector.grad = distributed.average(torch.cat([gradient.flatten() for gradient in gradients]))
        norm = torch.linalg.vector_norm(self.vector.grad)
        bad = (~norm.isfinite()).to(norm.dtype)
        # GradScaler's hooks: fused Adam divides by grad_scale and, where found_inf is 1, leaves everything as it was.
        self.adam.grad_scale = (norm / self.max_norm).clamp(min=1.0)
        self.adam.found_inf = bad
        self.adam.step()
        self.skipped += bad
        return norm

    def state_dict(self) -> dict[str, Any]:
        return {"adam": self.adam.state_dict(), "skipped": self.skipped}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.adam.load_state_dict(state["adam"])
        self.adam.param_groups[0]["lr"] = self.lr
        self.skipped.copy_(state["skipped"])


# The algorithm --------------------------------------------------------------------------------------------------------


class Window(NamedTuple):
    """What happened in one window, time first: (H, N, ...)."""

    obs: Tensor  # s_t, on which the policy acted
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    nonfinite: Tensor
    episode_return: Tensor  # of the episode so far, as is the length
    episode_length: Tensor

    @property
    def done(self) -> Tensor:
        return self.terminated | self.truncated


def collect(env: Any, actor: Actor, normalise: Normaliser, noise: Tensor) -> Window:
    """H steps of all environments from where they stand, with the policy's noise (H, N, action_dim)."""
    steps = []
    obs = env.detach()
    for step_noise in noise.unbind():
        next_obs, reward, terminated, truncated, info = env.step(actor(normalise(obs), step_noise))
        episode = info["episode"]["r"], info["episode"]["l"]
        steps.append((obs, reward, terminated, truncated, info["nonfinite"], *episode))
        obs = next_obs
    return Window(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))


def bptt_loss(reward: Tensor, done: Tensor, gamma: float) -> Tensor:
    """Eq. 8 without its value, of (H, N) steps: the discount starts anew after each done."""
    t = torch.arange(len(reward), device=reward.device).unsqueeze(1)
    starts = done.roll(1, 0)
    starts[0] = True
    age = t - torch.where(starts, t, torch.zeros_like(t)).cummax(0).values  # steps since the start or the last done
    return -(gamma ** age.to(reward.dtype) * reward).mean()


# Runs -----------------------------------------------------------------------------------------------------------------


def parse(argv: list[str] | None) -> tuple[Args, dict[str, Any] | None]:
    """The arguments, complete and checked, and the checkpoint that they name."""
    args, checkpoint = read_arguments(Args, argv, __doc__, FORMAT, FIXED, diffsim.TASKS)
    for name, value in zip(COLUMNS, PER_TASK.get(args.env, GENERAL), strict=True):
        if getattr(args, name) is None:
            setattr(args, name, value)
    for name in ("iterations", "eval_episodes", "stop_after", "threads"):
        if (value := getattr(args, name)) is not None and value < 1:
            fail(f"{flag(name)} must be at least 1, not {value}")
    if args.num_envs % distributed.size():
        fail(f"--num-envs {args.num_envs} cannot be split evenly among {distributed.size()} processes")
    return args, checkpoint


def make_env(args: Args, num_envs: int, horizon: int, seed: int = 0) -> Any:
    options: dict[str, Any] = dict(substeps=args.substeps, integrator=args.integrator, threads=args.threads)
    options |= dict(accuracy=args.accuracy or "default", penalty=constants(args.penalty))
    try:
        return diffsim.make(args.env, num_envs, args.device, seed, horizon, **options)
    except ValueError as error:
        fail(error)


def build(args: Args, env: Any) -> tuple[Actor, Normaliser]:
    obs_dim, action_dim = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    return Actor(args, obs_dim, action_dim).to(args.device), Normaliser(obs_dim).to(args.device)


def film(directory: Path, env: Any, evaluation: Evaluation) -> None:
    try:
        print(f"video: {write_video(directory / 'video.mp4', env, evaluation)}")
    except (ImportError, OSError, RuntimeError) as error:
        fail(error)


def evaluate_only(args: Args, checkpoint: dict[str, Any]) -> None:
    env = make_env(args, args.eval_episodes, horizon=1)
    actor, normalise = build(args, env)
    actor.load_state_dict(checkpoint["actor"])
    normalise.load_state_dict(checkpoint["normalise"])
    evaluation = evaluate(env, lambda obs: actor(normalise(obs)))
    print(f"{args.env}, {args.eval_episodes} episodes: {evaluation}")
    if args.capture_video:
        film(args.run_dir or args.evaluate.parent, env, evaluation)


def train(args: Args, checkpoint: dict[str, Any] | None) -> None:
    run = Run(args, Path(__file__).stem, PROGRESS)
    rank, ranks = distributed.rank(), distributed.size()
    num_envs, samples = args.num_envs // ranks, args.horizon * args.num_envs
    env = make_env(args, num_envs, args.horizon, args.seed + rank * 1_000_003)
    eval_env = make_env(args, args.eval_episodes, horizon=1)
    distributed.join(env.device)
    args.accuracy = args.accuracy or "default"
    args.integrator, args.substeps, _ = env.sim.integration
    torch.manual_seed(args.seed)
    actor, normalise = build(args, env)
    optimizer = ClippedAdam(actor, args)
    if rank > 0:  # from here on other numbers on every rank: the policy's noise
        torch.manual_seed(args.seed + rank * 1_000_003)

    # An iteration keeps its state in tensors, changes it in place and never waits for the device: on a GPU it becomes
    # one CUDA graph. It returns numbers to be logged, see `report`.
    def update() -> Tensor:
        window = collect(env, actor, normalise, actor.sample_noise(args.horizon, num_envs))
        loss = bptt_loss(window.reward, window.done, args.gamma)
        norm = optimizer.step(loss)
        if args.normalise_obs:
            normalise.update(window.obs.detach())
        episodes = ((window.done * x).sum() for x in (1, window.episode_return, window.episode_length))
        blown_up = window.nonfinite.sum(), env.sim.nonfinite_gradients.sum()
        return torch.stack([loss.detach(), norm, optimizer.skipped, *blown_up, *episodes])

    if args.cuda_graph:
        update = graph.capture(update, env.device, env)

    parts = dict(actor=actor, normalise=normalise, optimizer=optimizer)
    rng = torch.cuda.default_generators[env.device.index] if env.device.type == "cuda" else torch.default_generator
    start, seconds, nonfinite = 0, 0.0, 0
    episodes = EpisodeStatistics()  # of training
    if checkpoint:
        for name, part in parts.items():
            part.load_state_dict(checkpoint[name])
        env.load_state_dict(checkpoint["ranks"][rank]["env"])
        rng.set_state(checkpoint["ranks"][rank]["rng"])
        start, seconds, nonfinite = (checkpoint[name] for name in ("iteration", "seconds", "nonfinite"))
        episodes.windows.extend(checkpoint["episodes"])

    def save(iteration: int) -> None:
        state = {name: part.state_dict() for name, part in parts.items()}
        state["ranks"] = distributed.gather({"env": env.state_dict(), "rng": rng.get_state()})
        device = args.device if ranks == 1 else env.device.type
        state["args"] = dataclasses.asdict(args) | dict(device=device, resume=None, run_dir=None, stop_after=None)
        state |= dict(format=FORMAT, episodes=list(episodes.windows))
        run.save(state | dict(iteration=iteration, seconds=seconds, nonfinite=nonfinite))

    run.open(start, start * samples)
    last = min(args.iterations, args.stop_after or args.iterations)
    mark, evaluation, stopping = Mark(env.device), None, False
    waiting: deque[tuple[Any, ...]] = deque()  # iterations that are not logged yet
    behind = int(env.device.type == "cuda")

    def report(numbers: Tensor, begin: Mark, end: Mark, simulated: dict) -> dict[str, Any]:
        """What there is to log of an iteration that the device has finished."""
        nonlocal seconds, nonfinite, stopping
        end.wait()
        loss, norm, skipped, contained, nonfinite_gradients, *finished, signals = numbers.tolist()
        seconds += end.since(begin)
        nonfinite += round(contained * ranks)
        episodes.add(*(total * ranks for total in finished))
        stopping = stopping or signals > 0
        scalars = {
            "charts/SPS": samples / end.since(begin),
            "losses/actor": loss,
            "grad/norm": norm,
            "grad/skipped": round(skipped),
            "sim/nonfinite": nonfinite,
            "sim/nonfinite_gradients": round(nonfinite_gradients * ranks),
            "time/total": end.since(begin),
            **{f"time/sim_{kernel}": spent for kernel, spent in simulated.items() if env.device.type == "cpu"},
        }
        if episodes.windows:
            scalars["charts/episodic_return"], scalars["charts/episodic_length"] = episodes.means()
        return scalars

    for iteration in range(start + 1, last + 1):
        optimizer.lr.fill_(args.lr + (args.final_lr - args.lr) * (iteration - 1) / args.iterations)
        simulated, begin = dict(env.sim.seconds), mark
        numbers = update()
        numbers = torch.cat((numbers, numbers.new_full((1,), len(run.signals))))
        numbers = distributed.average(numbers).to("cpu", non_blocking=True)
        mark = Mark(env.device)
        simulated = {kernel: spent - simulated[kernel] for kernel, spent in env.sim.seconds.items()}
        waiting.append((iteration, numbers, begin, mark, simulated))

        # A GPU works on this iteration while the one before is logged, unless something has to be done in between.
        evaluating = iteration == args.iterations or (args.eval_every and iteration % args.eval_every == 0)
        saving = iteration == last or (args.save_every and iteration % args.save_every == 0)
        while waiting and (len(waiting) > behind or evaluating or saving or stopping):
            logged, *results = waiting.popleft()
            scalars = report(*results)
            if evaluating and logged == iteration and rank == 0:
                evaluation = evaluate(eval_env, lambda obs: actor(normalise(obs)))
                scalars |= evaluation.scalars()
                run.print(f"iteration {iteration}: {evaluation}")
            run.log(logged, logged * samples, seconds, scalars)
            run.show(logged, scalars["time/total"], episodes.means()[0], logged == last)
        if saving or stopping:
            save(iteration)
        if stopping:
            break
        if saving or evaluating:
            mark = Mark(env.device)

    run.close()
    distributed.leave()
    if rank == 0:
        skipped, blown_up = (scalars[name] for name in ("grad/skipped", "sim/nonfinite_gradients"))
        print(f"{args.env}: {iteration} iterations, {iteration * samples:,} control steps, {seconds:.1f} s of training")
        print(f"skipped {skipped} updates, contained {nonfinite} non-finite states and {blown_up} gradients")
        if evaluation:
            print(f"deterministic policy, {args.eval_episodes} episodes: {evaluation}")
        print(f"written to {run.directory}")
        if iteration < args.iterations:
            print(f"stopped early: python bptt.py --resume {run.directory / 'checkpoint.pt'} goes on")
        elif args.capture_video:
            film(run.directory, eval_env, evaluation)
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
