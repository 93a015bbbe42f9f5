"""benchmarks/gradients.py: what is differentiated, against differences, and how agreement is measured."""

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


def test_agreement_is_the_mean_cosine_of_pairs() -> None:
    same = torch.tensor([[1.0, 0.0], [3.0, 0.0]])
    assert gradients.agreement(same) == pytest.approx(1.0)
    three = torch.tensor([[2.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])  # cosines 0, -1, 0
    assert gradients.agreement(three) == pytest.approx(-1 / 3)


def test_the_gradient_of_a_window_agrees_with_differences() -> None:
    """A shift of every action of a window changes its reward as the gradient says."""
    args = gradients.Args(num_envs=16, warmup=3, noise=0.1)
    env = diffsim.make("hopper", 16, horizon=4, contact="mujoco", dtype=torch.float64)
    policy = torch.nn.Linear(env.task.obs_dim, env.scene.nu).double()
    torch.nn.init.normal_(policy.weight, std=0.02, generator=torch.Generator().manual_seed(0))

    def reward(change: float) -> float:
        """Of the first environment, all of whose actions before the window stay as they are."""
        obs, _ = env.reset(seed=gradients.SEED)
        noise, total = torch.Generator().manual_seed(gradients.SEED), 0.0
        with torch.no_grad():
            for k in range(7):
                action = policy(obs)
                action = action + 0.1 * torch.randn(action.shape, generator=noise)
                obs, r, *_ = env.step(action + (change if k >= 3 else 0.0))
                total += float(r[0]) if k >= 3 else 0.0
        return total

    each, groups = gradients.window_gradients(env, policy, 4, args)
    assert each.shape == (16, 4, env.scene.nu) and groups.shape == (16, env.scene.nu)
    # one environment in each of the 16 groups
    assert float(groups[0].sum()) == pytest.approx((reward(1e-5) - reward(-1e-5)) / 2e-5, rel=1e-5)
    assert torch.allclose(each.sum(1), groups)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = f"--num-envs 16 --horizons 2 --warmup 40 --output {tmp_path}".split()
    gradients.main(parse(gradients.Args, None, [str(POLICIES / "hopper.pt"), *flags]))
    rows = read_csv(tmp_path / "gradients.csv")
    assert [row["ground"] for row in rows] == [*gradients.GROUNDS]
    assert len({row["norm"] for row in rows}) == len(rows)
    assert all(float(row["norm"]) > 0 and abs(float(row["cosine"])) <= 1 for row in rows)
    for arguments, message in (
        ([], "of what? give a checkpoint"),
        ([str(POLICIES / "cartpole.pt")], "cartpole, which has no ground"),
        ([str(POLICIES / "hopper.pt"), "--num-envs", "24"], "--num-envs 24 is not a multiple of 16"),
    ):
        assert message in refusal(lambda a=arguments: gradients.main(parse(gradients.Args, None, a)), capsys)
