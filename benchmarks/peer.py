"""mujoco_warp, MuJoCo's simulator for GPUs, and mj_step beside this one with --contact mujoco: one law and substeps.

    python benchmarks/peer.py                                            control steps per second of all
    python benchmarks/peer.py --parts train --env ant --seconds 100      ppo_baseline.py, trained in mujoco_warp
    python benchmarks/transfer.py runs/learning/ppo_mujoco_warp/ant__1   judges its policy here and in MuJoCo
    python benchmarks/peer.py --parts train --env g1_track

What follows "--" goes to ppo_baseline.py. mujoco_warp has at most 10 iterations of Newton's method and 20 of the line
search, as in its own benchmark of a humanoid; this simulator passes until it has converged to its tolerance.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata, util
from typing import Annotated, Literal

import mujoco
import torch
import tyro
import warp as wp
from cells import ScriptFlags
from common import Part, measured, run
from speed import rollouts, timed
from tables import Row, read_csv
from torch import Tensor
from worlds import FASTEST, MuJoCo, mujoco_model

import diffsim
import ppo_baseline
from diffsim.training import Count, Positive, Run, fail, graph, parse

PartName = Literal["speed", "train"]
Name = Literal["hopper", "half_cheetah", "ant", "humanoid", "go1", "go2", "g1", "g1_track"]
# Contacts and rows of constraints for which mujoco_warp has room in a world; `lost` tells whether they are too few.
# With more rows, 4,096 of go2, g1 or humanoid, or g1_track mujoco_warp 4.0.0 reads outside of its memory.
ROOM: dict[Name, tuple[int, int]] = {"hopper": (8, 32), "half_cheetah": (12, 64), "ant": (16, 64)}
ROOM |= {"humanoid": (64, 256), "go1": (16, 96), "go2": (16, 96), "g1": (24, 192), "g1_track": (24, 192)}
PPO = "--num-envs 4096 --minibatch-size 32768 --entropy-coef 0.002 --eval-every 0 --save-every 0 --iterations 1000000"
EVERY: tuple[Name, ...] = ("ant", "humanoid", "go2", "g1")
HORIZON = 32  # control steps of a timed rollout


@dataclass
class Args(ScriptFlags):
    env: Annotated[tuple[Name, ...], tyro.conf.arg(help="tasks")] = EVERY  # type: ignore[assignment]
    parts: tuple[PartName, ...] = ("speed",)  # what to measure
    num_envs: tuple[Count, ...] = (64, 1024, 4096)  # batch sizes of the speed
    repeats: Count = 10  # rollouts of 32 control steps; the fastest counts
    seed: int = 1  # seed of the training, which writes to {runs}/ppo_mujoco_warp/{env}__{seed}
    seconds: Positive = 100.0  # of training, after which it stops and saves


class MuJoCoWarp(diffsim.Simulator):
    """mujoco_warp in place of a simulator of a task; its steps have no gradients. On a GPU each is one CUDA graph."""

    def __init__(self, sim: diffsim.Simulator, name: Name) -> None:
        import mujoco_warp

        super().__init__(sim.scene, sim.num_envs, control_dt=sim.control_dt, **sim.options._asdict())
        model, (contacts, rows) = mujoco_model(sim.scene, sim.control_dt, sim.integration.substeps), ROOM[name]
        model.opt.iterations, model.opt.ls_iterations = 10, 20  # of Newton's method, which is MuJoCo's default
        kinds, place = mujoco_warp.OverflowType, wp.device_from_torch(self.device)
        self._dropped = int(kinds.NEFC | kinds.NJMAX_NNZ | kinds.BROADPHASE | kinds.NARROWPHASE)
        with wp.ScopedDevice(place):
            m, d = mujoco_warp.put_model(model), mujoco_warp.make_data(model, sim.num_envs, contacts, njmax=rows)
        m.opt.warn_overflow = 0  # printing from kernels is slow
        self._qpos, self._qvel, self._ctrl = map(wp.to_torch, (d.qpos, d.qvel, d.ctrl))
        low, high = torch.tensor(model.actuator_ctrlrange.T, dtype=torch.float32, device=self.device)
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self._warmstart, self._overflow = map(wp.to_torch, (d.qacc_warmstart, d.overflow))

        def advance() -> None:
            with wp.ScopedDevice(place):
                for _ in range(self.integration.substeps):
                    mujoco_warp.step(m, d)

        self._advance = advance
        if self.device.type == "cuda":
            advance()  # compiles and loads all kernels, which a capture cannot
            torch.cuda.synchronize(self.device)
            with wp.ScopedDevice(place), wp.ScopedCapture() as capture:
                advance()
            wp.capture_launch(capture.graph)  # instantiates it
            torch.cuda.synchronize(self.device)
            self._advance = partial(wp.capture_launch, capture.graph, wp.stream_from_torch(self.device))

    @torch.no_grad()
    def advance(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor) -> tuple[Tensor, Tensor]:
        """As a Simulator's; a robot that was put elsewhere since the last step, by a reset, has no warm start."""
        moved = (qpos != self._qpos).any(1) | (qvel != self._qvel).any(1)
        self._warmstart.masked_fill_(moved[:, None], 0.0)
        self._qpos.copy_(qpos)
        self._qvel.copy_(qvel)
        self._ctrl.copy_(self._middle + self._half * ctrl)
        self._advance()
        lost = ~((self._qvel.abs() < FASTEST).all(1) & self._qpos.isfinite().all(1))
        self.nonfinite.copy_(lost)
        return self._qpos.where(~lost[:, None], qpos), self._qvel.where(~lost[:, None], qvel)

    def lost(self) -> Tensor:
        """() how many robots have ever had contacts that found no room."""
        return ((self._overflow & self._dropped) != 0).sum()


def measure_speed(args: Args, name: Name) -> Iterator[Row]:
    """Control steps per second of physics, under the same random actions from states to which such actions have led."""
    for num_envs in args.num_envs:
        env = diffsim.make(name, num_envs, args.device, seed=0, horizon=HORIZON, contact="mujoco")
        first, actions = 2 * torch.rand(2, HORIZON, num_envs, env.scene.nu, device=env.device) - 1
        for action in first:
            env.step(action)
        peer, start = MuJoCoWarp(env.sim, name), (env.qpos, env.qvel, actions.requires_grad_())
        (theirs, *_), (forward, _, both) = rollouts(peer, *start), rollouts(env.sim, *start)
        calls = theirs, *(graph.capture(call, env.device) for call in (forward, both))
        other, here, backward = (HORIZON * num_envs / timed(call, env.device, 3, args.repeats) for call in calls)
        row = {"task": name, "environments": num_envs, "mj_step": mj_steps(env.sim, *start[:2], first)}
        row |= {"mujoco_warp": other, "here": here, "ratio": here / other}
        row |= {"forward and backward": backward, "ratio of both": backward / other, "lost": int(peer.lost())}
        yield row | {"version": metadata.version("mujoco-warp")}
        graph.release()


def mj_steps(sim: diffsim.Simulator, qpos: Tensor, qvel: Tensor, actions: Tensor) -> float:
    """Control steps per second of MuJoCo's mj_step on one core, of some of the environments in turn."""
    world = MuJoCo(sim.scene, min(sim.num_envs, 64), sim.control_dt, 1.0, True, sim.integration.substeps)
    for k, data in enumerate(world.data):
        data.qpos, data.qvel = qpos[k].numpy(force=True), qvel[k].numpy(force=True)
        mujoco.mj_forward(world.model, data)
    start = time.perf_counter()
    for action in actions.double().numpy(force=True):
        for k, data in enumerate(world.data):
            world.advance(data, action[k])
    return len(actions) * len(world.data) / (time.perf_counter() - start)


def train(args: Args, name: Name) -> Iterator[Row]:
    """ppo_baseline.py's training, for some seconds. Its rollout is no CUDA graph: each control step in it is one."""
    flags = f"--env {name}:randomise=none --seed {args.seed} --device {args.device} --contact mujoco {PPO}".split()
    folder = f"{args.runs}/ppo_mujoco_warp/{name}__{args.seed}"
    settings = parse(ppo_baseline.Args, [*flags, "--run-dir", folder, *args.arguments])
    if settings.contact != "mujoco" or settings.task_class.varied_by:
        fail(
            "mujoco_warp has its own contact, which does not vary: leave out --contact and ranges after the task's name"
        )
    training = Run(settings)
    training.simulator = "mujoco_warp"
    env = training.make_env(settings.num_envs, settings.horizon)
    env.sim = peer = MuJoCoWarp(env.sim, name)
    ppo = training.restore(ppo_baseline.PPO(settings, env))
    count, sizes = settings.horizon * env.num_envs, ((env.task.obs_dim,), (env.scene.nu,), (env.scene.nu,), (), ())
    samples = ppo_baseline.Batch(*(torch.zeros(count, *size, device=env.device) for size in sizes))
    learn = training.capture(lambda: ppo.learn(samples))
    for iteration in training:
        for kept, part in zip(samples, ppo.act()[0], strict=True):
            kept.copy_(part)
        training.log(learn() | {"charts/speed": env.qvel[:, 0].mean(), "sim/lost": peer.lost()})
        if training.recorder.seconds >= args.seconds:
            training.last = settings.iterations = iteration
    last = read_csv(training.directory.path / "progress.csv")[-1]
    shown = {"control steps": "control_steps", "training (s)": "seconds", "control steps/s": "charts_SPS"}
    shown |= {"return": "return", "lost": "sim_lost"}
    row: Row = {"task": name, "seed": args.seed, "iteration": int(last["iteration"])}
    yield {**row, **{column: last[metric] and float(last[metric]) for column, metric in shown.items()}}


KEY = ("task", "environments")
SPEED = *KEY, "mj_step", "mujoco_warp", "here", "forward and backward"  # of the columns those that a page shows
TRAIN = "task", "seed", "control steps", "training (s)", "control steps/s", "return", "lost"


PARTS = {
    "speed": Part("peer_speed", measure_speed, KEY, "peer_speed", "performance.md", columns=SPEED),
    "train": Part("peer_train", train, ("task", "seed"), columns=TRAIN),
}


def main(args: Args) -> None:
    if not (args.draw_only or util.find_spec("mujoco_warp")):
        fail("mujoco_warp is missing: pip install -e '.[peer]'")
    for part in args.parts:
        measured(args, PARTS[part])


if __name__ == "__main__":
    run(main, Args, __doc__)
