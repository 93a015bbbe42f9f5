"""The clipped adjoint against its NumPy twin, and what it does in an environment."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import diffsim
from diffsim.sim.adjoint import ClipAdjoint, row_scales


def twin(adjoint: np.ndarray, factor: float) -> np.ndarray:
    """Scales (N,): of each finite row down to factor times the lower median of the norms that are finite and not 0."""
    norms = np.array([np.sqrt(sum(float(x) ** 2 for x in row)) for row in adjoint])
    usual = sorted(norm for norm in norms if np.isfinite(norm) and norm > 0)
    if not usual:
        return np.ones(len(norms))
    bound = factor * usual[(len(usual) - 1) // 2]
    return np.array([bound / norm if bound < norm < np.inf else 1.0 for norm in norms])


@pytest.mark.parametrize("rows", [1, 2, 7, 64])
@pytest.mark.parametrize("factor", [0.5, 2.0, 5.0])
def test_scales_are_those_of_the_twin(rows: int, factor: float, rng: np.random.Generator) -> None:
    adjoint = (rng.standard_cauchy((rows, 5)) ** 3).astype(np.float32)
    adjoint[rows // 2 :: 5] = 0
    adjoint[1::7, 2], adjoint[3::11, 0] = np.nan, np.inf
    scales = row_scales(torch.tensor(adjoint), factor)
    assert scales.shape == (rows, 1) and scales.dtype == torch.float32
    np.testing.assert_allclose(scales[:, 0], twin(adjoint, factor), rtol=1e-6)
    assert (rows < 64) or 0.1 < (scales < 1).float().mean() < 0.6


def test_rows_alike_stay_and_a_huge_one_no_longer_dominates() -> None:
    qpos, qvel = torch.zeros(9, 4, requires_grad=True), torch.zeros(9, 3, requires_grad=True)
    weight = torch.ones(9, 1)

    def gradients() -> torch.Tensor:
        loss = sum((weight * part).sum() for part in ClipAdjoint.apply(5.0, qpos, qvel))
        return torch.cat(torch.autograd.grad(loss, (qpos, qvel)), dim=1)

    assert torch.equal(gradients(), torch.ones(9, 7))
    weight[3], weight[4], weight[5] = 1e30, torch.nan, 4.0
    clipped = gradients()
    torch.testing.assert_close(clipped[3], torch.full((7,), 5.0))
    others = [0, 1, 2, 5, 6, 7, 8]
    assert torch.equal(clipped[others], weight[others].expand(-1, 7)) and clipped[4].isnan().all()


def rollout(factor: float, scale: float = 1.0) -> torch.Tensor:
    """The gradient (steps, N, nu) of a rollout of ants on MuJoCo's contact, where one environment counts more."""
    env = diffsim.make("ant", num_envs=6, seed=0, horizon=6, contact="mujoco", adjoint_clip=factor)
    weight = torch.ones(6)
    weight[2] = scale
    actions = torch.full((6, 6, env.scene.nu), 0.1, requires_grad=True)
    reward = torch.stack([env.step(a)[1] for a in actions.unbind()])
    (gradient,) = torch.autograd.grad((weight * reward).sum(), actions)
    return gradient


def test_a_window_of_an_environment() -> None:
    plain = rollout(0.0)
    assert torch.equal(rollout(1e6), plain)
    huge, clipped = rollout(0.0, 1e6), rollout(5.0, 1e6)
    length = huge.norm(dim=(0, 2)), clipped.norm(dim=(0, 2))
    assert length[0][2] > 1e5 * length[0].median() and length[1][2] < 10 * length[1].median()
    others = [0, 1, 3, 4, 5]
    torch.testing.assert_close(rollout(1e3, 1e6)[:, others], plain[:, others])


@torch.no_grad()
def test_steps_without_gradients_and_what_is_no_factor() -> None:
    env = diffsim.make("cartpole", num_envs=2, adjoint_clip=2)
    env.step(torch.zeros(2, 1))
    for factor in (-1.0, torch.nan, torch.inf, True, "5"):
        with pytest.raises(ValueError, match="adjoint_clip is .*, must be a factor of at least 0"):
            diffsim.make("cartpole", num_envs=2, adjoint_clip=factor)
