"""See how particles move while a policy learns: Figure 5 of the PFPN paper.

    python examples/particles.py

A dog with servos (servo_tasks.py) learns a trot by PPO. Writes particles.csv, where the particles of two actions are
along the way, and a picture: a line for each particle, which jumps where it becomes a copy of another one.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch

sys.path += [str(Path(__file__).resolve().parents[1] / folder) for folder in ("", "benchmarks")]
from common import CommonFlags, Line, Panel, plot, run  # noqa: E402

import diffsim  # noqa: E402
import pfpn  # noqa: E402
from diffsim.training import Count, fail, parse  # noqa: E402

DOG = str(Path(__file__).with_name("servo_tasks.py")) + ":Dog"
SETTING = "--num-envs 128 --horizon 32 --gamma 0.95 --lr 1e-3 --lr-bounds 1e-3 1e-3 --minibatch-size 512 --epochs 3"
JOINTS = ("FL_thigh_joint", "FL_calf_joint")  # whose servos' particles are drawn
EVERY = 5  # iterations between two rows


@dataclass
class Args(CommonFlags):
    seed: int = 1
    iterations: Count = 300


def main(args: Args) -> None:
    if args.draw_only:
        fail("the picture is of a training: leave out --draw-only")
    torch.manual_seed(args.seed)
    settings = parse(pfpn.Args, ["--env", DOG, "--device", "cpu", *SETTING.split()])
    env = diffsim.make(DOG, settings.num_envs, horizon=settings.horizon)
    env.reset(seed=args.seed)
    learner = pfpn.PPO(settings, env)
    head, rows = learner.actor.head, list[dict[str, object]]()
    assert isinstance(head, pfpn.ParticleHead)
    places = {joint: list[list[float]]() for joint in JOINTS}
    steps = [k * settings.num_envs * settings.horizon for k in range(0, args.iterations + 1, EVERY)]
    for iteration in range(args.iterations + 1):
        if iteration % EVERY == 0:
            for joint in JOINTS:
                action = env.scene.mj_model.actuator(joint.removesuffix("_joint")).id
                loc, std = head.loc[action].detach(), head.log_std[action].detach().exp()
                row = {"control steps": steps[len(places[joint])], "joint": joint, "lowest": loc.min().item()}
                row |= {"highest": loc.max().item(), "median deviation": std.median().item()}
                rows.append(row | {"moved": learner.resampling.moved.item()})
                places[joint].append(loc.tolist())
        learner.iterate()
    for row in rows:
        args.keep("particles", row, ("control steps", "joint"))
    panels = [
        Panel(
            [Line(steps, list(line), "C0-", width=0.6) for line in zip(*found, strict=True)],
            joint,
            "control steps",
            "location of the particles",
        )
        for joint, found in places.items()
    ]
    plot(args.picture("particles"), [panels])


if __name__ == "__main__":
    run(main, Args, __doc__)
