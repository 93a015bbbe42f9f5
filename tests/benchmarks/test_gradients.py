"""benchmarks/gradients.py: what is differentiated, against differences."""

from __future__ import annotations

from pathlib import Path

import gradients
import pytest
import torch
from common import parse
from learners import refusal
from tables import read_csv

import diffsim

POLICIES = Path(diffsim.__file__).parent / "policies"


def test_the_gradient_of_a_window_agrees_with_differences() -> None:
    """Where no jump is in reach; both begin in the same state, which differences leave as it was."""
    env = diffsim.make("hopper", 16, horizon=4, dtype=torch.float64, early_termination=False)
    policy = torch.nn.Linear(env.task.obs_dim, env.scene.nu).double()
    torch.nn.init.normal_(policy.weight, std=0.02, generator=torch.Generator().manual_seed(0))
    env.reset(seed=0)
    noise = 0.1 * torch.randn(4, 16, env.scene.nu, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    start = env.qpos.clone()
    slopes = gradients.differences(env, policy, 4, noise, 1e-5)
    assert torch.equal(env.qpos, start)
    shift = torch.zeros(16, env.scene.nu, dtype=torch.float64, requires_grad=True)
    (each,) = torch.autograd.grad(gradients.window(env, policy, 4, shift, noise).sum(), shift)
    torch.testing.assert_close(each.mean(0), slopes, rtol=1e-4, atol=1e-6)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = f"--num-envs 16 --horizons 8 --warmup 990 --output {tmp_path}".split()
    gradients.main(parse(gradients.Args, None, [str(POLICIES / "hopper.pt"), *flags]))
    rows = read_csv(tmp_path / "gradients.csv")
    assert [row["ground"] for row in rows] == [*gradients.GROUNDS]
    assert len({row["norm"] for row in rows}) == len(rows)
    assert all(abs(float(row["cosine"])) <= 1 for row in rows) and float(rows[0]["differences"]) > 0.99
    for arguments, message in (
        ([], "of what? give a checkpoint"),
        ([str(POLICIES / "cartpole.pt")], "cartpole, which has no ground"),
    ):
        assert message in refusal(lambda a=arguments: gradients.main(parse(gradients.Args, None, a)), capsys)
