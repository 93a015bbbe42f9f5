"""mujoco_warp, MuJoCo's own simulator for GPUs, beside this one with --contact mujoco: the same law and substeps.

    python benchmarks/peer.py                                              control steps per second of both
    python benchmarks/peer.py --parts train --env ant --seconds 100        ppo_baseline.py, trained in mujoco_warp
    python benchmarks/peer.py --parts train --env ant -- --num-envs 2048   what follows "--" goes to the script
    python benchmarks/transfer.py runs/learning/ppo_mujoco_warp/ant__1     judges its policy here and in MuJoCo

It needs `pip install -e ".[peer]"`. mujoco_warp has at most 10 iterations of Newton's method, 20 of the line search, as
in its own benchmark of a humanoid; this simulator has four passes. Both have elliptic cones and four substeps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata, util
from pathlib import Path
from typing import Literal

import common
import mujoco
import torch
import warp as wp
from common import Part, TaskName, Tasks, measured, run
from motions import RUNS
from speed import timed
from tables import Row, read_csv
from torch import Tensor
from transfer import FASTEST, mujoco_model

import diffsim
import ppo_baseline
from diffsim import Simulator
from diffsim.training import Count, Positive, Run, fail, graph
from diffsim.training import parse as parse_script

PartName = Literal["speed", "train"]
HORIZON = 32  # control steps of a timed window
# Contacts and rows of constraints for which mujoco_warp has room in a world; `lost` tells whether they are too few.
ROOM = {"hopper": (8, 32), "half_cheetah": (12, 64), "ant": (16, 64), "humanoid": (24, 96)}
PPO = "--num-envs 4096 --minibatch-size 32768 --entropy-coef 0.002 --eval-every 0 --save-every 0 --iterations 1000000"


@dataclass
class Args(common.CommonFlags):
    env: Tasks = ("ant", "humanoid")  # tasks, also hopper and half_cheetah
    device: str = "auto"  # torch device of both simulators (auto: the GPU if there is one)
    parts: tuple[PartName, ...] = ("speed",)  # what to measure
    num_envs: tuple[Count, ...] = (1024, 4096)  # batch sizes of the speed
    repeats: Count = 10  # windows of 32 control steps; the fastest counts
    seed: int = 1  # seed of the training
    seconds: Positive = 100.0  # of training, after which it stops and saves
    runs: Path = RUNS / "ppo_mujoco_warp"  # the training writes to {runs}/{env}__{seed}


class MuJoCoWarp(Simulator):
    """mujoco_warp in place of a simulator of a task; its steps have no gradients. On a GPU each is one CUDA graph."""

    def __init__(self, sim: Simulator, task: str) -> None:
        import mujoco_warp

        super().__init__(sim.scene, sim.num_envs, control_dt=sim.control_dt, **sim.options._asdict())
        model = mujoco_model(sim.scene, sim.control_dt, sim.integration.substeps)  # Newton's method is the default
        model.opt.iterations, model.opt.ls_iterations = 10, 20
        low, high = torch.tensor(model.actuator_ctrlrange, dtype=self.dtype, device=self.device).unbind(1)
        self._middle, self._reach = (low + high) / 2, (high - low) / 2
        self._place, kinds = wp.device_from_torch(self.device), mujoco_warp.OverflowType
        self._dropped = int(kinds.NEFC | kinds.NJMAX_NNZ | kinds.BROADPHASE | kinds.NARROWPHASE)
        contacts, rows = ROOM[task]
        with wp.ScopedDevice(self._place):
            m, data = mujoco_warp.put_model(model), mujoco.MjData(model)
            d = mujoco_warp.put_data(model, data, nworld=self.num_envs, nconmax=contacts, njmax=rows)
        m.opt.warn_overflow = 0  # `lost` tells; printing from kernels is slow
        self._substep = partial(mujoco_warp.step, m, d)
        arrays = d.qpos, d.qvel, d.ctrl, d.qacc_warmstart, d.overflow
        self._qpos, self._qvel, self._ctrl, self._warmstart, self._overflow = map(wp.to_torch, arrays)
        self._graph = self._capture() if self.device.type == "cuda" else None

    def _capture(self) -> wp.Graph:
        """A control step. The state after it does not matter: `step` begins by setting it."""
        torch.cuda.synchronize(self.device)
        with wp.ScopedDevice(self._place):
            self._substep()  # compiles and loads all kernels, which a capture cannot
            wp.synchronize_device(self._place)
            with wp.ScopedCapture() as capture:
                self._advance()
            wp.capture_launch(capture.graph)
            wp.synchronize_device(self._place)
        return capture.graph

    def _advance(self) -> None:
        with wp.ScopedDevice(self._place):
            for _ in range(self.integration.substeps):
                self._substep()

    @torch.no_grad()
    def step(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor) -> tuple[Tensor, Tensor]:
        """As a Simulator's; a robot that was put elsewhere since the last step, by a reset, has no warm start."""
        moved = (qpos != self._qpos).any(1) | (qvel != self._qvel).any(1)
        self._warmstart.masked_fill_(moved.unsqueeze(1), 0.0)
        self._qpos.copy_(qpos)
        self._qvel.copy_(qvel)
        torch.addcmul(self._middle, self._reach, ctrl, out=self._ctrl)
        if self._graph is None:
            self._advance()
        else:
            wp.capture_launch(self._graph, stream=wp.stream_from_torch(torch.cuda.current_stream(self.device)))
        fine = (self._qvel.abs() < FASTEST).all(1) & self._qpos.isfinite().all(1)
        self.nonfinite.copy_(~fine)
        fine = fine.unsqueeze(1)
        return torch.where(fine, self._qpos, qpos), torch.where(fine, self._qvel, qvel)

    def lost(self) -> Tensor:
        """() how many robots have ever had contacts that found no room."""
        return ((self._overflow & self._dropped) != 0).sum()


def measure_speed(args: Args, name: TaskName) -> Iterator[Row]:
    """Both take the same random actions from the same states, to which random actions have led."""
    for num_envs in args.num_envs:
        graph.release()  # the memory of the setting before
        env = diffsim.make(name, num_envs, args.device, seed=0, horizon=HORIZON, contact="mujoco")
        first, actions = 2 * torch.rand(2, HORIZON, num_envs, env.scene.nu, device=env.device) - 1
        with torch.no_grad():
            for action in first:
                env.step(action)
        yield {"task": name, "environments": num_envs} | race(env, actions.requires_grad_(), args.repeats)


def race(env: diffsim.DiffEnv, actions: Tensor, repeats: int) -> dict[str, object]:
    """Control steps per second through windows of actions (H, N, nu)."""
    peer, start = MuJoCoWarp(env.sim, env.task.name), (env.qpos.clone(), env.qvel.clone())

    def window(sim: Simulator) -> Tensor:
        sim.rewind()
        qpos, qvel = start
        for action in actions.unbind():
            qpos, qvel = sim.step(qpos, qvel, action)
        return qpos.sum() + qvel.sum()

    theirs, ours = (torch.no_grad()(partial(window, sim)) for sim in (peer, env.sim))
    both = graph.capture(lambda: torch.autograd.grad(window(env.sim), actions)[0], env.device)
    calls = theirs, graph.capture(ours, env.device), both
    seconds = [min(timed(call, env.device, warmup=3, calls=repeats)) for call in calls]
    names = f"mujoco_warp {metadata.version('mujoco-warp')}", "here", "forward and backward"
    rates = {name: len(actions) * env.num_envs / each for name, each in zip(names, seconds, strict=True)}
    ratios = {f"{name}, ratio": seconds[0] / each for name, each in zip(names[1:], seconds[1:], strict=True)}
    return rates | ratios | {"lost": int(peer.lost())}


def train(args: Args, name: TaskName) -> Iterator[Row]:
    """ppo_baseline.py's training, for some seconds. Its rollout is no CUDA graph: each control step in it is one."""
    flags = f"--env {name} --seed {args.seed} --device {args.device} --contact mujoco {PPO} --run-dir".split()
    settings = parse_script(ppo_baseline.Args, [*flags, str(args.runs / f"{name}__{args.seed}"), *args.arguments])
    training = Run(settings)
    training.simulator = "mujoco_warp"
    env = training.make_env(settings.num_envs, settings.horizon)
    env.sim = peer = MuJoCoWarp(env.sim, name)
    ppo = training.restore(ppo_baseline.PPO(settings, env))
    update = training.capture(ppo.update)
    for iteration in training:
        training.log(ppo.roll_out() | update() | {"charts/speed": env.qvel[:, 0].mean(), "sim/lost": peer.lost()})
        if training.seconds >= args.seconds:
            training.last = settings.iterations = iteration
    last = read_csv(training.directory / "progress.csv")[-1]
    columns = ("iteration", "control_steps", "seconds", "return", "length", "charts_speed", "sim_lost")
    yield {"task": name, "seed": args.seed} | {column: last.get(column, "") for column in columns}


PARTS: dict[PartName, Part] = {
    "speed": Part("peer_speed", measure_speed, ("task", "environments"), "peer_speed", "performance.md"),
    "train": Part("peer_train", train, ("task", "seed")),
}


def main(args: Args) -> None:
    if not util.find_spec("mujoco_warp"):
        fail("mujoco_warp is missing: pip install -e '.[peer]'")
    if others := [name for name in args.env if name not in ROOM]:
        fail(f"--env {' '.join(others)}: choose from {', '.join(ROOM)}")
    for part in args.parts:
        measured(args, PARTS[part])


if __name__ == "__main__":
    run(main, Args, __doc__)
