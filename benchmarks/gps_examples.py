"""Examples for gps.py: what a controller without a clock does, recorded.

    python shac.py --env benchmarks/gps_examples.py:WalkerExample --num-envs 64 --iterations 600 --actor-hidden 64 \
        --critic-lr 1e-3 --run-dir runs/walker
    python benchmarks/gps_examples.py --env walker --run runs/walker --to diffsim/assets/examples/walker.npz
    python benchmarks/gps_examples.py --env swimmer --settle 200 --to diffsim/assets/examples/swimmer.npz
    python benchmarks/gps_examples.py --exchange diffsim/assets/examples/walker.npz \
        --to benchmarks/plans/walker_both.npz

The tasks here have gps.py's reward and control steps, and a fall ends an episode. The swimmer's controller is a
travelling wave, a formula.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from diffsim.planning import System, load_demonstration, save_demonstration
from diffsim.symmetry.mirror import partners
from diffsim.tasks.hopper import Hopper
from diffsim.tasks.humanoid import Humanoid
from diffsim.training import command, fail, load_policy, parse
from diffsim.training.evaluation import make_env
from diffsim_robots.walker import Walker

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


# Recording ------------------------------------------------------------------------------------------------------------


@dataclass
class Args:
    to: Path  # the file, an .npz
    env: str = "walker"  # task of gps.py
    run: Path | None = None  # of any script, whose policy acts
    exchange: Path | None = (
        None  # in place of a run: a recorded motion, which is written with that of the other leg first
    )
    terrain: tuple[str, ...] = ("level",)  # a trajectory over each, by the names of gps_variants.py
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


@command
def main(args: Args) -> None:
    import gps_variants  # shac.py, which takes tasks from this file, would not find it

    words = ["--env", args.env, "--device", "cpu", "--demonstration", str(args.to)]
    flags = parse(gps_variants.VariantArgs, words)
    search = gps_variants.Search(flags, make_env(flags, 1))
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
        value = search.reward(x[:, 1 : flags.horizon + 1], u[:, : flags.horizon]).sum().item()
        print(f"{name}: {x[0, -1, 0] - x[0, 0, 0]:.2f} m, return {value:.1f}")
        found.append((x[0].float(), u[0].float()))
    x, u = (torch.stack(parts).squeeze(0) for parts in zip(*found, strict=True))
    save_demonstration(search.system, x, u, args.to, terrain=args.terrain)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
