"""What the benchmarks of accuracy and stability share: a trained policy and the states it visits."""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor, nn

import diffsim
from diffsim.run import fail, load_checkpoint
from diffsim.scene import Scene

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))
import shac  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results"
DOCS = ROOT / "docs"
RUNS = ROOT / "runs" / "learning"  # where benchmarks/learning.py trains


# Policies and states --------------------------------------------------------------------------------------------------


class Policy(nn.Module):
    """The deterministic policy of shac.py, obs -> action."""

    def __init__(self, actor: nn.Module, normalise: nn.Module) -> None:
        super().__init__()
        self.actor, self.normalise = actor, normalise

    def forward(self, obs: Tensor) -> Tensor:
        return self.actor(self.normalise(obs))


def load_policy(name: str, checkpoint: Path | None, runs: Path = RUNS) -> tuple[Policy, str]:
    """The policy of a checkpoint of shac.py in float64, and what to call it.

    Without a checkpoint it is that of seed 1 in `runs`; where there is none, an untrained one (seed 0).
    """
    path = checkpoint or runs / "shac" / f"{name}__1" / "checkpoint.pt"
    if checkpoint is None and not path.is_file():
        torch.manual_seed(0)
        return Policy(
            *shac.build(shac.parse(["--env", name, "--device", "cpu"])[0], diffsim.make(name, num_envs=1))
        ).double(), "no training"
    loaded = load_checkpoint(path, shac.FORMAT)
    args = shac.Args(**loaded["args"] | {"device": "cpu"})
    if args.env != name:
        fail(f"{path} was trained on {args.env}, not {name}")
    policy = Policy(*shac.build(args, diffsim.make(name, num_envs=1)))
    policy.actor.load_state_dict(loaded["actor"])
    policy.normalise.load_state_dict(loaded["normalise"])
    return policy.double(), f"{path.parent.name}, iteration {loaded['iteration']}"


@torch.no_grad()
def visited_states(
    name: str, policy: Policy, count: int, penalty: dict[str, float] | None = None
) -> tuple[Tensor, Tensor]:
    """(count, nq), (count, nv) in float64: a quarter each after 0.25, 0.5, 1 and 2 s of episodes under the policy."""
    env = diffsim.make(name, num_envs=count, seed=0, penalty=penalty)
    obs, _ = env.reset(seed=0)
    qpos, qvel = env.qpos.double(), env.qvel.double()
    for step in range(1, 121):
        obs = env.step(policy(obs.double()).float())[0]
        if step in (15, 30, 60, 120):
            rows = slice((15, 30, 60, 120).index(step), None, 4)
            qpos[rows], qvel[rows] = env.qpos[rows].double(), env.qvel[rows].double()
    return qpos, qvel


def idle(scene: Scene) -> Tensor:
    """(nu,) the control without any force: 0 of a motor, -1 of a muscle."""
    return torch.where(torch.tensor(scene.motor_link) > 0, 0.0, -1.0).double()
