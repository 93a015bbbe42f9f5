"""benchmarks/gps_examples.py: what is recorded and shipped."""

from __future__ import annotations

from pathlib import Path

import gps_examples
import numpy as np
import pytest
import torch
from learners import ROOT, SMALL, refusal, run

import diffsim
import gps
import shac
from diffsim.planning import System, load_demonstration
from diffsim.training import parse
from diffsim.training.evaluation import make_env


@pytest.mark.parametrize("env", gps.PER_TASK)
def test_each_shipped_example_is_a_motion_of_its_robot(env: str) -> None:
    """The simulator follows it to its end."""
    args = parse(gps.Args, ["--env", env, "--device", "cpu"])
    search = gps.Search(args, make_env(args, 1))
    ((system, x, u),) = search.examples()
    plan = search.plan(system, x, u)
    torch.testing.assert_close(plan.x[0, :, : system.nq], x[:, : system.nq], rtol=0.0, atol=0.05)


@pytest.mark.parametrize("task", [gps_examples.HopperExample, gps_examples.WalkerExample])
def test_tasks_of_examples_have_the_reward_of_gps(task: type[gps_examples.Hopper]) -> None:
    """But for what a step without error earns, and actions after tanh."""
    name = task.name.removesuffix("_example")
    args = parse(gps.Args, ["--env", name, "--device", "cpu"])
    search = gps.Search(args, make_env(args, 1))
    assert (task.control_dt, task.substeps) == (args.control_dt, args.substeps)
    own = System(diffsim.make(task, 1, control_dt=args.control_dt, substeps=args.substeps))
    x = search.system.start() + 0.05 * torch.randn(6, search.system.nx, generator=torch.Generator().manual_seed(1))
    still = torch.zeros(6, search.system.nu, dtype=torch.float64)
    torch.testing.assert_close(own.reward(x, still), gps_examples.ALIVE + search.reward(x, still))


def test_a_recorded_policy(tmp_path: Path) -> None:
    """Its states follow from its actions."""
    run(shac, tmp_path / "run", *SMALL["shac"])
    gps_examples.main(gps_examples.Args(to=tmp_path / "one.npz", env="cartpole", run=tmp_path / "run", steps=12))
    system = System(diffsim.make("cartpole", 1))
    ((x, u),) = load_demonstration(system, tmp_path / "one.npz", 12)
    played, _, _ = system.rollout(x[:1], 12, lambda t, _: u[t : t + 1])
    torch.testing.assert_close(played[0], x, rtol=0.0, atol=1e-5)


def test_the_other_leg_first(tmp_path: Path) -> None:
    """The shipped walks begin in one state with different actions, and both are motions of the robot."""
    gps_examples.main(gps_examples.Args(to=tmp_path / "both.npz", exchange=gps.EXAMPLES / "walker.npz"))
    args = parse(gps.Args, ["--env", "walker", "--device", "cpu", "--demonstration", str(tmp_path / "both.npz")])
    search = gps.Search(args, make_env(args, 1))
    one, other = search.examples()
    shipped = ROOT / "benchmarks" / "plans" / "walker_both.npz"
    for (x, u), (_, *found) in zip(load_demonstration(search.system, shipped, args.horizon), (one, other), strict=True):
        torch.testing.assert_close([x, u], found)
    assert torch.equal(one[1][0], other[1][0]) and (one[2][0] - other[2][0]).abs().max() > 0.5
    plans = [search.plan(*each) for each in (one, other)]
    torch.testing.assert_close(plans[0].cost, plans[1].cost, rtol=1e-9, atol=0.0)


def test_a_swimmer_swims_forward(tmp_path: Path) -> None:
    gps_examples.main(gps_examples.Args(to=tmp_path / "swim.npz", env="swimmer", steps=60, settle=200))
    x = np.load(tmp_path / "swim.npz")["qpos"][:, 0]
    assert x[0] == 0.0 and x[-1] > 0.6 * 60 * 0.05


def test_without_a_run_there_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = gps_examples.Args(to=tmp_path / "a.npz", env="hopper")
    assert "--run must be the directory of a run" in refusal(lambda: gps_examples.main(args), capsys)
