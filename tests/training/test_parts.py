"""Parts of learners against plain references: optimizer, running statistics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from learners import assert_same
from torch import nn

from diffsim.training import ClippedAdam, ObsNormalizer

# Optimizer ------------------------------------------------------------------------------------------------------------


def test_the_optimizer_is_bitwise_what_torchs_fused_adam_computes() -> None:
    """Whose hooks for a GradScaler clip and skip; with a learning rate that decays."""
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(3, 5), nn.ELU(), nn.LayerNorm(5), nn.Linear(5, 1))
    optimizer = ClippedAdam(module, 0.5, (0.7, 0.95))
    reference = nn.Parameter(optimizer.vector.clone())
    lr = torch.tensor(0.0)
    adam = torch.optim.Adam([reference], lr, betas=(0.7, 0.95), fused=True)
    hooks: Any = adam
    for k, scale in enumerate((1.0, 1e-3, math.nan, 10.0, 1e9, 0.1, 1.0)):
        lr.fill_(1e-2 * (1 - k / 10))
        optimizer.lr.copy_(lr)
        loss = scale * module(torch.randn(20, 3)).square().mean()
        gradients = torch.autograd.grad(loss, optimizer.parameters, retain_graph=True)
        reference.grad = torch.cat([g.flatten() for g in gradients])
        norm = optimizer.step(optimizer.gradient(loss))
        torch.testing.assert_close(norm, torch.linalg.vector_norm(reference.grad), equal_nan=True)
        hooks.grad_scale, hooks.found_inf = (norm / 0.5).clamp(min=1.0), (~(norm < 1e6)).float()
        adam.step()
        state = optimizer.state_dict()["adam"]
        assert_same(state, adam.state_dict()["state"])
        assert torch.equal(optimizer.vector, reference.detach())
    assert optimizer.step_count == 5 and optimizer.skipped == 2


def test_a_loss_without_a_gradient_is_named() -> None:
    with pytest.raises(ValueError, match="the loss has no gradient: observe and reward must be torch operations"):
        ClippedAdam(nn.Linear(2, 1), 0.5).gradient(torch.zeros(()))


# Running statistics ---------------------------------------------------------------------------------------------------

MEAN, STD = (0, 5, -100, 1e-3), (1, 10, 0.1, 1e-3)


@pytest.fixture
def rollouts(rng: np.random.Generator) -> list[np.ndarray]:
    return [rng.normal(MEAN, STD, size=(8, 6, 4)) for _ in range(20)]


@pytest.mark.parametrize("size", [None, 4])
def test_statistics_are_those_of_all_data(rollouts: list[np.ndarray], size: int | None) -> None:
    """Of scalars, or of each column."""
    normalizer = ObsNormalizer(size)
    probe = torch.randn(5, 4) if size else torch.randn(3, 2)
    torch.testing.assert_close(normalizer(probe), probe)  # nothing seen yet
    for rollout in rollouts:
        normalizer.update(torch.tensor(rollout if size else rollout[..., 1], dtype=torch.float32))
    data = np.concatenate(rollouts).reshape(-1, 4) if size else np.concatenate(rollouts)[..., 1].reshape(-1)
    assert normalizer.count == len(data)
    np.testing.assert_allclose(normalizer.mean, data.mean(0), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(normalizer.var, data.var(0), rtol=1e-3)
    assert all(buffer.dtype == torch.float32 for buffer in (normalizer.mean, normalizer.var, normalizer.std))
    expected = (probe.double() - torch.tensor(data.mean(0))) / torch.tensor(data.var(0) + 1e-5).sqrt()
    torch.testing.assert_close(normalizer(probe).double(), expected, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(normalizer.inverse(normalizer(probe)), probe, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-13), (torch.float32, 2e-6)])
def test_statistics_of_unlike_batches_are_exact_to_rounding(
    rng: np.random.Generator, dtype: torch.dtype, rtol: float
) -> None:
    """Batches of other means, deviations and sizes, the first of a single sample."""
    parts = ((1, 3.0, 1.0), (7, -2.0, 0.5), (300, 4.0, 3.0), (50, 10.0, 0.1))
    batches = [rng.normal(mean, std, size=(count, 2)).astype(np.float32) for count, mean, std in parts]
    normalizer = ObsNormalizer(2).to(dtype)
    for k, batch in enumerate(batches):
        normalizer.update(torch.tensor(batch, dtype=dtype))
        data = np.concatenate(batches[: k + 1], dtype=np.float64)
        np.testing.assert_allclose(normalizer.mean, data.mean(0), rtol=rtol)
        np.testing.assert_allclose(normalizer.var, data.var(0), rtol=rtol)
        np.testing.assert_allclose(normalizer.std, np.sqrt(data.var(0) + 1e-5), rtol=rtol)


@pytest.mark.parametrize("shape", [(), (4,)])
def test_counting_does_not_end_at_the_last_integer_of_float32(rng: np.random.Generator, shape: tuple[int, ...]) -> None:
    """From 2^24 samples of mean 2 on, one by one; half as many of mean 8 move the mean by a third of the way."""
    normalizer = ObsNormalizer(*shape)
    normalizer.count.fill_(2**24)
    normalizer.mean.fill_(2.0)
    normalizer.update(torch.full((1, *shape), 2.0))
    assert normalizer.count.item() == 2**24 + 1
    normalizer.update(torch.full((2**23, *shape), 8.0))
    assert normalizer.count.item() == 2**24 + 1 + 2**23
    np.testing.assert_allclose(normalizer.mean, np.full(shape, 4.0), rtol=1e-5)
