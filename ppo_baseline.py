"""PPO, Proximal Policy Optimization (Schulman et al. 2017, https://arxiv.org/abs/1707.06347), the model-free baseline.

It acts in the same environments as the other learners, without their gradients. Thousands of environments, large
minibatches and a learning rate that follows the policy's KL divergence, as the SHAC paper ran its baseline (A.2.1).

    python ppo_baseline.py --env ant --seed 1                train; writes runs/ant__ppo_baseline__1__<time>/
    python ppo_baseline.py --resume <run>/checkpoint.pt      continue an interrupted run exactly
    python ppo_baseline.py --evaluate <run>/checkpoint.pt    evaluate its deterministic policy
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
    """seed of the network, the policy's noise, the minibatches and the environments' resets"""
    device: str | None = None
    """torch device of simulation and learning, e.g. cpu or cuda:0; None: the GPU if there is one"""
    cuda_graph: bool = True
    """on a GPU, replay an iteration as CUDA graphs; without, the same code runs operation by operation"""
    threads: int | None = None
    """CPU threads of the simulator, which change no result; None: all cores"""

    iterations: int | None = None
    """learning iterations, a rollout and its updates each; None: per task"""
    num_envs: int | None = None
    """parallel environments N, over all processes of torchrun; None: per task and device"""
    horizon: int | None = None
    """control steps of a rollout (1/60 s each); None: per task"""
    substeps: int | None = None
    """simulation steps per control step; None: per --accuracy"""
    integrator: Literal["semi_implicit", "implicit", "extrapolated"] | None = None
    """time integration of the simulator; None: per --accuracy"""
    accuracy: Literal["fast", "default", "accurate"] | None = None
    """the task's preset of integrator and substeps (docs/accuracy.md); None: default, the paper's"""
    penalty: tuple[str, ...] = ()
    """constants of contact and limits in place of the robot file's, e.g. k_n=1e5 k_d=1e4"""

    hidden: tuple[int, ...] | None = None
    """units of the hidden layers that policy and value share; None: per task"""
    lr: float = 3e-4
    """initial learning rate"""
    target_kl: float = 0.008
    """the learning rate falls where a minibatch's KL divergence is beyond twice this, and rises below half of it"""
    lr_bounds: tuple[float, float] = (1e-6, 1e-2)
    """least and largest learning rate"""
    max_grad_norm: float = 1.0
    """gradients are clipped to this norm"""
    gamma: float = 0.99
    """discount factor"""
    gae_lambda: float = 0.95
    """lambda of the advantage estimation"""
    epochs: int | None = None
    """passes over a rollout's samples; None: per task"""
    minibatch_size: int | None = None
    """samples of a minibatch; None: per task and device"""
    clip: float = 0.2
    """the probability ratio counts only within 1 - clip and 1 + clip"""
    value_coef: float = 2.0
    """weight of the value's squared error, in units of its standard deviation"""
    entropy_coef: float | None = None
    """weight of the policy's entropy, which keeps its noise from vanishing; None: per task"""
    bound_coef: float = 1e-4
    """weight of the squared excess of the policy's mean beyond 1.1, where the action is clipped"""
    initial_log_std: float = 0.0
    """initial log standard deviation of the policy"""

    eval_every: int = 500
    """evaluate the deterministic policy every this many iterations (0: only at the end)"""
    eval_episodes: int = 64
    """episodes of an evaluation, one in each of as many fresh environments"""
    save_every: int = 100
    """save the checkpoint every this many iterations (0: only at the end)"""
    stop_after: int | None = None
    """stop at this iteration as Ctrl-C would: saved, to be resumed"""
    run_dir: Path | None = None
    """directory of the run; None: runs/{env}__ppo_baseline__{seed}__{time}, or that of the checkpoint resumed"""
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


# Table 2 of the SHAC paper; networks, iterations, hopper and half_cheetah: its authors' released settings. They have no
# entropy bonus, with which hopper and ant learn more (docs/ppo.md).
# fmt: off
COLUMNS = ("hidden", "num_envs", "horizon", "minibatch_size", "epochs", "entropy_coef", "iterations")
PER_TASK = {
    "cartpole":     ((64, 64),         32, 240,  1920, 5, 0.0,    500),
    "hopper":       ((128, 64, 32),  1024,  32,  8192, 5, 0.01,  5000),
    "half_cheetah": ((128, 64, 32),  1024,  32,  8192, 5, 0.0,   5000),
    "ant":          ((128, 64, 32),  2048,  32, 16384, 5, 0.01,  5000),
    "humanoid":     ((256, 128, 64), 1024,  32,  8192, 5, 0.0,   5000),
    "humanoid_mtu": ((512, 512, 256), 1024, 32,  8192, 6, 0.0,  20000),
}
GENERAL =           ((256, 128, 64), 1024,  32,  8192, 5, 0.0,   5000)  # of a task that is not in the table

PROGRESS = {  # scalar of tensorboard: column of progress.csv, beside iteration, control_steps and seconds (of training)
    "charts/episodic_return": "return", "charts/episodic_length": "length",
    "eval/return": "eval_return", "eval/length": "eval_length", "eval/speed": "eval_speed",
    "losses/policy": "policy_loss", "losses/value": "value_loss", "losses/kl": "kl",
    "charts/learning_rate": "learning_rate", "charts/std": "std",
    "grad/norm": "grad_norm", "grad/skipped": "skipped", "sim/nonfinite": "nonfinite",
}
# fmt: on
CPU = {"num_envs": 256, "minibatch_size": 2048}  # at most: where samples cost more, smaller steps learn more of each
FIXED = ("env", "num_envs", "hidden")  # by a checkpoint
FORMAT = "ppo_baseline-1"  # of checkpoints


# Networks -------------------------------------------------------------------------------------------------------------


class Policy(nn.Module):
    """The mean of the Gaussian pi(a|s), whose standard deviation does not depend on s, and V(s), on common features."""

    def __init__(self, args: Args, obs_dim: int, action_dim: int):
        super().__init__()
        layers: list[nn.Module] = []
        for width in args.hidden:
            layers += [nn.Linear(obs_dim, width), nn.ELU(inplace=True)]
            obs_dim = width
        self.features = nn.Sequential(*layers)
        self.mean, self.value = nn.Linear(obs_dim, action_dim), nn.Linear(obs_dim, 1)
        self.log_std = nn.Parameter(torch.full((action_dim,), args.initial_log_std))

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """The mean (..., action_dim), and the value (...) in units of the normaliser of returns."""
        features = self.features(obs)
        return self.mean(features), self.value(features).squeeze(-1)


class Normaliser(nn.Module):
    """Normalises by the running mean and variance of what it has seen; constant between updates."""

    def __init__(self, *shape: int):
        super().__init__()
        self.register_buffer("count", torch.tensor(0.0, dtype=torch.float64))  # exact beyond 2^24 samples
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("var", torch.ones(shape))
        self.register_buffer("std", torch.ones(shape))

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.std

    def inverse(self, x: Tensor) -> Tensor:
        return x * self.std + self.mean

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Adds x (..., *shape) of all processes to the statistics (Chan et al.'s parallel variance)."""
        x = x.reshape(-1, *self.mean.shape)
        var, mean = moments(x)
        total, delta = self.count + len(x) * distributed.size(), mean - self.mean
        share = self.count / total
        old, new = share.to(x.dtype), (1 - share).to(x.dtype)
        self.var.copy_(old * self.var + new * var + old * new * delta**2)
        self.mean.add_(new * delta)
        self.count.copy_(total)
        self.std.copy_((self.var + 1e-5).sqrt())


def moments(x: Tensor) -> tuple[Tensor, Tensor]:
    """Variance and mean of x (B, ...) over the B of all processes."""
    var, own = torch.var_mean(x, dim=0, correction=0)
    mean = distributed.average(own.clone())
    return distributed.average(var + (own - mean) ** 2), mean


class ClippedAdam:
    """Adam on the gradient clipped to a norm. A gradient that is not finite, or is beyond 1e6, is counted and skipped.

    The module's parameters become views of one vector, so a step is a dozen operations for any network; none of them
    waits for the device.
    """

    def __init__(self, module: nn.Module, args: Args):
        self.parameters = list(module.parameters())
        self.vector = nn.utils.parameters_to_vector(self.parameters).detach()
        nn.utils.vector_to_parameters(self.vector, self.parameters)
        self.lr = torch.full((), args.lr, device=self.vector.device)  # a tensor: it changes within a captured graph
        self.adam = torch.optim.Adam([self.vector], self.lr, fused=True, capturable=self.vector.is_cuda)
        self.max_norm = args.max_grad_norm
        self.skipped = torch.zeros_like(self.lr)

    def step(self, loss: Tensor) -> Tensor:
        """One descent step; returns the gradient's norm before clipping."""
        gradients = torch.autograd.grad(loss, self.parameters)
        self.vector.grad = distributed.average(torch.cat([gradient.flatten() for gradient in gradients]))
        norm = torch.linalg.vector_norm(self.vector.grad)
        bad = (~(norm < 1e6)).to(norm.dtype)
        # GradScaler's hooks: fused Adam divides by grad_scale and, where found_inf is 1, leaves everything as it was.
        self.adam.grad_scale = (norm / self.max_norm).clamp(min=1.0)
        self.adam.found_inf = bad
        self.adam.step()
        self.skipped += bad
        return norm

    def state_dict(self) -> dict[str, Any]:
        return {"adam": self.adam.state_dict(), "lr": self.lr, "skipped": self.skipped}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.adam.load_state_dict(state["adam"])
        self.adam.param_groups[0]["lr"] = self.lr
        self.lr.copy_(state["lr"])
        self.skipped.copy_(state["skipped"])


# The algorithm --------------------------------------------------------------------------------------------------------


class Window(NamedTuple):
    """What happened in one rollout, time first: (H, N, ...)."""

    obs: Tensor  # s_t, on which the policy acted
    next_obs: Tensor  # s_{t+1}, before any reset
    mean: Tensor  # of the policy
    action: Tensor  # before it is clipped to [-1, 1]
    value: Tensor  # V(s_t), normalised
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    nonfinite: Tensor
    episode_return: Tensor  # of the episode so far, as is the length
    episode_length: Tensor

    @property
    def done(self) -> Tensor:
        return self.terminated | self.truncated


class Batch(NamedTuple):
    """What the update needs of a rollout's samples, or of some of them: (B, ...)."""

    obs: Tensor  # normalised
    mean: Tensor  # of the policy that acted
    action: Tensor
    advantage: Tensor  # normalised
    target: Tensor  # of the value, normalised


@torch.no_grad()
def collect(env: Any, policy: Policy, normalise: Normaliser, noise: Tensor) -> Window:
    """H steps of all environments from where they stand, with standard normal noise (H, N, action_dim)."""
    steps = []
    obs, std = env.detach(), policy.log_std.exp()
    for step_noise in noise.unbind():
        mean, value = policy(normalise(obs))
        action = mean + std * step_noise
        next_obs, reward, terminated, truncated, info = env.step(action)
        episode = info["episode"]["r"], info["episode"]["l"]
        ends = terminated, truncated, info["nonfinite"]
        steps.append((obs, info["final_obs"], mean, action, value, reward, *ends, *episode))
        obs = next_obs
    return Window(*(torch.stack(tensors) for tensors in zip(*steps, strict=True)))


def gae(reward: Tensor, value: Tensor, next_value: Tensor, done: Tensor, gamma: float, lam: float) -> Tensor:
    """Advantages of (H, N) steps (Schulman et al. 2016, Eq. 16), cut at the dones and at the window's end.

    next_value is V(s_{t+1}), before any reset: zero where the episode terminated, but not where its time ran out.
    """
    advantages, following = torch.empty_like(reward), torch.zeros_like(reward[0])
    delta, decay = reward + gamma * next_value - value, gamma * lam * (~done).to(reward.dtype)
    for t in reversed(range(len(reward))):
        following = advantages[t] = torch.addcmul(delta[t], decay[t], following)
    return advantages


def log_ratio(batch: Batch, mean: Tensor, log_std: Tensor, old_log_std: Tensor) -> Tensor:
    """log pi(a|s) / pi_old(a|s) (B,)."""
    new = ((batch.action - mean) / log_std.exp()).square() / 2 + log_std
    old = ((batch.action - batch.mean) / old_log_std.exp()).square() / 2 + old_log_std
    return (old - new).sum(-1)


def kl_divergence(old_mean: Tensor, old_log_std: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """KL(pi_old || pi) of diagonal Gaussians, mean over states."""
    ratio = ((2 * old_log_std).exp() + (old_mean - mean).square()) / (2 * log_std).exp()
    return (log_std - old_log_std + (ratio - 1) / 2).sum(-1).mean()


def clipped_loss(log_ratio: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """Minus the clipped surrogate objective (Eq. 7)."""
    ratio = log_ratio.exp()
    return -torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage).mean()


def entropy(log_std: Tensor) -> Tensor:
    """Of a diagonal Gaussian, in nats."""
    return (log_std + (1 + math.log(2 * math.pi)) / 2).sum(-1)


@torch.no_grad()
def adapt(lr: Tensor, kl: Tensor, target: float, bounds: tuple[float, float]) -> None:
    """Divides lr by 1.5 where kl is beyond twice the target, and multiplies it by 1.5 below half of it."""
    lr.mul_(1.5 ** ((kl < target / 2).to(lr.dtype) - (kl > 2 * target).to(lr.dtype))).clamp_(*bounds)


# Runs -----------------------------------------------------------------------------------------------------------------


def parse(argv: list[str] | None) -> tuple[Args, dict[str, Any] | None]:
    """The arguments, complete and checked, and the checkpoint that they name."""
    args, checkpoint = read_arguments(Args, argv, __doc__, FORMAT, FIXED, diffsim.TASKS)
    defaults = dict(zip(COLUMNS, PER_TASK.get(args.env, GENERAL), strict=True))
    if args.device == "cpu":
        defaults |= {name: min(defaults[name], most) for name, most in CPU.items()}
    for name, value in defaults.items():
        if getattr(args, name) is None:
            setattr(args, name, value)
    for name in ("iterations", "epochs", "minibatch_size", "eval_episodes", "stop_after", "threads"):
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


def build(args: Args, env: Any) -> tuple[Policy, Normaliser]:
    obs_dim, action_dim = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    return Policy(args, obs_dim, action_dim).to(args.device), Normaliser(obs_dim).to(args.device)


def film(directory: Path, env: Any, evaluation: Evaluation) -> None:
    try:
        print(f"video: {write_video(directory / 'video.mp4', env, evaluation)}")
    except (ImportError, OSError, RuntimeError) as error:
        fail(error)


def evaluate_only(args: Args, checkpoint: dict[str, Any]) -> None:
    env = make_env(args, args.eval_episodes, horizon=1)
    policy, normalise = build(args, env)
    policy.load_state_dict(checkpoint["policy"])
    normalise.load_state_dict(checkpoint["normalise"])
    evaluation = evaluate(env, lambda obs: policy(normalise(obs))[0])
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
    policy, normalise = build(args, env)
    normalise_return, optimizer = Normaliser().to(env.device), ClippedAdam(policy, args)
    obs_dim, action_dim = normalise.mean.numel(), policy.log_std.numel()
    minibatches = math.ceil(args.horizon * num_envs / args.minibatch_size * ranks)
    sizes = (obs_dim,), (action_dim,), (action_dim,), (), ()
    batch = Batch(*(torch.zeros(args.horizon * num_envs, *size, device=env.device) for size in sizes))
    if rank > 0:  # from here on other numbers on every rank: the policy's noise and the minibatches
        torch.manual_seed(args.seed + rank * 1_000_003)

    # The two halves of an iteration. They keep their state in tensors, change it in place and never wait for the
    # device: on a GPU each becomes one CUDA graph. Each returns numbers to be logged, see `report`.
    @torch.no_grad()
    def roll_out() -> Tensor:
        noise = torch.randn(args.horizon, num_envs, action_dim, device=env.device)
        window = collect(env, policy, normalise, noise)
        value = normalise_return.inverse(window.value)
        next_value = normalise_return.inverse(policy(normalise(window.next_obs))[1])
        next_value = next_value.masked_fill(window.terminated, 0.0)
        advantage = gae(window.reward, value, next_value, window.done, args.gamma, args.gae_lambda)
        normalise_return.update(value + advantage)
        target = normalise_return(value + advantage)
        var, mean = moments(advantage.flatten())
        advantage = (advantage - mean) / (var.sqrt() + 1e-8)
        values = normalise(window.obs), window.mean, window.action, advantage, target
        for buffer, tensor in zip(batch, values, strict=True):
            buffer.copy_(tensor.flatten(0, 1))
        normalise.update(window.obs)
        episodes = ((window.done * x).sum() for x in (1, window.episode_return, window.episode_length))
        return torch.stack([window.nonfinite.sum(), *episodes])

    def update() -> Tensor:
        old_log_std, metrics = policy.log_std.detach().clone(), []
        for _ in range(args.epochs):
            order = torch.randperm(len(batch.obs), device=env.device)
            for tensors in zip(*(tensor[order].chunk(minibatches) for tensor in batch), strict=True):
                b = Batch(*tensors)
                mean, value = policy(b.obs)
                kl = kl_divergence(b.mean, old_log_std, mean.detach(), policy.log_std.detach())
                adapt(optimizer.lr, distributed.average(kl), args.target_kl, args.lr_bounds)
                policy_loss = clipped_loss(log_ratio(b, mean, policy.log_std, old_log_std), b.advantage, args.clip)
                value_loss = (value - b.target).square().mean()
                bound_loss = (mean.abs() - 1.1).clamp(min=0).square().sum(-1).mean()
                loss = policy_loss + args.value_coef * value_loss + args.bound_coef * bound_loss
                norm = optimizer.step(loss - args.entropy_coef * entropy(policy.log_std))
                metrics.append(torch.stack((policy_loss.detach(), value_loss.detach(), kl, norm)))
        std = policy.log_std.detach().exp().mean()
        return torch.cat([torch.stack(metrics).mean(0), torch.stack([optimizer.skipped, optimizer.lr, std])])

    if args.cuda_graph:
        roll_out = graph.capture(roll_out, env.device, env)
        update = graph.capture(update, env.device)

    parts = dict(policy=policy, normalise=normalise, normalise_return=normalise_return, optimizer=optimizer)
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

    def report(numbers: Tensor, begin: Mark, middle: Mark, end: Mark, simulated: float) -> dict[str, Any]:
        """What there is to log of an iteration that the device has finished."""
        nonlocal seconds, nonfinite, stopping
        end.wait()
        contained, count, returns, lengths, *metrics, signals = numbers.tolist()
        policy_loss, value_loss, kl, norm, skipped, lr, std = metrics
        seconds += end.since(begin)
        nonfinite += round(contained * ranks)
        episodes.add(*(total * ranks for total in (count, returns, lengths)))
        stopping = stopping or signals > 0
        scalars = {
            "charts/SPS": samples / end.since(begin),
            "charts/learning_rate": lr,
            "charts/std": std,
            "losses/policy": policy_loss,
            "losses/value": value_loss,
            "losses/kl": kl,
            "grad/norm": norm,
            "grad/skipped": round(skipped),
            "sim/nonfinite": nonfinite,
            "time/update": end.since(middle),
            "time/total": end.since(begin),
        }
        if env.device.type == "cpu":
            scalars["time/sim_forward"] = simulated
        if episodes.windows:
            scalars["charts/episodic_return"], scalars["charts/episodic_length"] = episodes.means()
        return scalars

    for iteration in range(start + 1, last + 1):
        simulated, begin = env.sim.seconds["forward"], mark
        numbers = roll_out()
        middle = Mark(env.device)
        numbers = torch.cat((numbers, update(), numbers.new_full((1,), len(run.signals))))
        numbers = distributed.average(numbers).to("cpu", non_blocking=True)
        mark = Mark(env.device)
        simulated = env.sim.seconds["forward"] - simulated
        waiting.append((iteration, numbers, begin, middle, mark, simulated))

        # A GPU works on this iteration while the one before is logged, unless something has to be done in between.
        evaluating = iteration == args.iterations or (args.eval_every and iteration % args.eval_every == 0)
        saving = iteration == last or (args.save_every and iteration % args.save_every == 0)
        while waiting and (len(waiting) > behind or evaluating or saving or stopping):
            logged, *results = waiting.popleft()
            scalars = report(*results)
            if evaluating and logged == iteration and rank == 0:
                evaluation = evaluate(eval_env, lambda obs: policy(normalise(obs))[0])
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
        print(f"{args.env}: {iteration} iterations, {iteration * samples:,} control steps, {seconds:.1f} s of training")
        print(f"skipped {scalars['grad/skipped']} updates, contained {nonfinite} non-finite states")
        if evaluation:
            print(f"deterministic policy, {args.eval_episodes} episodes: {evaluation}")
        print(f"written to {run.directory}")
        if iteration < args.iterations:
            print(f"stopped early: python ppo_baseline.py --resume {run.directory / 'checkpoint.pt'} goes on")
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
