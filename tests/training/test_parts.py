"""Parts of learners against plain references: optimizer, ensemble, replay buffer, running statistics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from learners import assert_same
from torch import Tensor, nn

from diffsim.training import ClippedAdam, Ensemble, EnsembleAdam, ObsNormalizer, ReplayBuffer, Transition

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
        norm = optimizer.step(loss)
        torch.testing.assert_close(norm, torch.linalg.vector_norm(reference.grad), equal_nan=True)
        hooks.grad_scale, hooks.found_inf = (norm / 0.5).clamp(min=1.0), (~(norm < 1e6)).float()
        adam.step()
        state = optimizer.state_dict()["adam"]
        assert_same(state, adam.state_dict()["state"])
        assert torch.equal(optimizer.vector, reference.detach())
    assert optimizer.step_count == 5 and optimizer.skipped == 2


def test_a_loss_without_a_gradient_is_named() -> None:
    with pytest.raises(ValueError, match="the loss has no gradient: observe and reward must be torch operations"):
        ClippedAdam(nn.Linear(2, 1), 0.5).step(torch.zeros(()))


# Ensemble -------------------------------------------------------------------------------------------------------------

BETAS = (0.7, 0.95)


def network() -> nn.Sequential:
    chain = nn.Sequential(nn.Linear(3, 5), nn.SiLU(), nn.LayerNorm(5), nn.Linear(5, 2))
    with torch.no_grad():
        chain[2].weight.normal_()
        chain[2].bias.normal_()
    return chain


def loss(outputs: Tensor) -> Tensor:
    """Of (..., B, 2), summed over the networks."""
    return outputs.square().mean((-1, -2)).sum()


def test_an_ensemble_is_its_networks_and_gives_them_back() -> None:
    torch.manual_seed(0)
    networks = [network() for _ in range(4)]
    ensemble, x = Ensemble(networks), torch.randn(4, 7, 3)
    for e, single in enumerate(networks):
        torch.testing.assert_close(ensemble(x)[e], single(x[e]))
        assert all(torch.equal(p, q) for p, q in zip(ensemble[e].parameters(), single.parameters(), strict=True))
    with pytest.raises(TypeError, match="no ensemble of Conv1d: only of Linear, LayerNorm"):
        Ensemble([nn.Sequential(nn.Conv1d(1, 1, 1))] * 2)
    with pytest.raises(TypeError, match="no ensemble of LayerNorm and then ELU: only Linear may follow"):
        Ensemble([nn.Sequential(nn.LayerNorm(3), nn.ELU())] * 2)(torch.ones(2, 2, 3))
    trunk = nn.Sequential(*network()[:3])  # ends with a LayerNorm
    torch.testing.assert_close(Ensemble([trunk] * 2)(x[:2])[1], trunk(x[1]))
    assert torch.equal(Ensemble([trunk])(x[:1])[0], trunk(x[0]))


def test_untied_members_learn_as_if_alone() -> None:
    """Two networks of each of three members, one of which gets a bad gradient on the way."""
    torch.manual_seed(0)
    networks = [network() for _ in range(6)]
    ensemble = Ensemble(networks)
    together = EnsembleAdam(ensemble, 2, 3, 0.5, BETAS, tied=torch.zeros(()))
    alone = [ClippedAdam(single, 0.5, BETAS, lr=1e-2) for single in networks]
    together.lr.fill_(1e-2)
    for scale in (1.0, 1e-4, 30.0, 1.0):
        x = torch.randn(6, 9, 3)
        parts = zip(alone, networks, x, strict=True)
        norms = [optimizer.step(scale * loss(single(samples))) for optimizer, single, samples in parts]
        torch.testing.assert_close(together.step(scale * loss(ensemble(x))), torch.stack(norms).max())
        for e, single in enumerate(networks):
            for p, q in zip(ensemble[e].parameters(), single.parameters(), strict=True):
                torch.testing.assert_close(p, q)
    before = together.vector.clone()
    x[1, 0, 0] = math.nan
    together.step(loss(ensemble(x)))
    assert together.skipped == 1 and together.vector.isfinite().all()
    assert (together.vector != before).any(-1).all()


def test_tied_members_are_one_learner_with_the_samples_of_all() -> None:
    torch.manual_seed(0)
    networks = [network() for _ in range(6)]  # the first ones of three members, then the second ones
    ensemble, tied = Ensemble(networks), torch.zeros(())
    together = EnsembleAdam(ensemble, 2, 3, 0.5, BETAS, tied)
    singles = networks[1], networks[4]  # member 1
    alone = [ClippedAdam(single, 0.5, BETAS, lr=1e-2) for single in singles]
    together.lr.fill_(1e-2)
    for step in range(4):
        x = torch.randn(6, 9, 3)
        together.step(loss(ensemble(x)))
        own = x.unflatten(0, (2, 3))
        for single, optimizer, samples in zip(singles, alone, own if step else own[:, 1], strict=True):
            optimizer.step(single(samples).square().mean())
        if step == 0:
            together.tie(1)
            tied.fill_(1.0)
        for e in range(6) if step else (1, 4):
            for p, q in zip(ensemble[e].parameters(), singles[e // 3].parameters(), strict=True):
                torch.testing.assert_close(p, q)


# Replay buffer --------------------------------------------------------------------------------------------------------


def transitions(*numbers: int) -> Transition:
    """Each part of a transition is a function of its number."""
    x = torch.tensor(numbers, dtype=torch.float32)
    obs = torch.stack((x, -x), 1)
    return Transition(obs, x.unsqueeze(1), 100 + x, obs + 1000, x % 2)


def test_samples_are_uniform_over_the_last_transitions() -> None:
    buffer = ReplayBuffer(10, 2, 1)
    buffer.add(transitions(0, 1, 2, 3))
    assert set(buffer.sample(500).reward.tolist()) == {100, 101, 102, 103}
    buffer.add(transitions(4, 5, 6, 7))
    buffer.add(transitions(8, 9, 10, 11))  # over the first two
    sample = buffer.sample(20_000)
    x = (sample.reward - 100).long()
    counts = torch.bincount(x, minlength=12)
    assert (counts[:2] == 0).all() and (counts[2:] > 1700).all() and (counts[2:] < 2300).all()
    for part, expected in zip(sample, transitions(*x.tolist()), strict=True):
        assert torch.equal(part, expected)


def test_a_full_buffer_keeps_its_size() -> None:
    """In a larger one rows would be sampled that nothing has filled."""
    old, young = ReplayBuffer(4, 2, 1), ReplayBuffer(4, 2, 1)
    young.add(transitions(0, 1, 2))
    assert young.state_dict()["_extra_state"].shape == (3, 7)  # the filled rows alone
    for _ in range(2):
        old.add(transitions(0, 1, 2))
    for size in (3, 5):
        with pytest.raises(ValueError, match=f"4 transitions, and a replay buffer that holds {size}"):
            ReplayBuffer(size, 2, 1).load_state_dict(old.state_dict())
        (copy := ReplayBuffer(size, 2, 1)).load_state_dict(young.state_dict())  # not full: any that has room
        assert torch.equal(copy.rows[:3], young.rows[:3]) and copy.count == 3


# Running statistics ---------------------------------------------------------------------------------------------------

MEAN, STD = (0, 5, -100, 1e-3), (1, 10, 0.1, 1e-3)


@pytest.fixture
def windows(rng: np.random.Generator) -> list[np.ndarray]:
    return [rng.normal(MEAN, STD, size=(8, 6, 4)) for _ in range(20)]


@pytest.mark.parametrize("size", [None, 4])
def test_statistics_are_those_of_all_data(windows: list[np.ndarray], size: int | None) -> None:
    """Of scalars, or of each column."""
    normalizer = ObsNormalizer(size)
    probe = torch.randn(5, 4) if size else torch.randn(3, 2)
    torch.testing.assert_close(normalizer(probe), probe)  # nothing seen yet
    for window in windows:
        normalizer.update(torch.tensor(window if size else window[..., 1], dtype=torch.float32))
    data = np.concatenate(windows).reshape(-1, 4) if size else np.concatenate(windows)[..., 1].reshape(-1)
    assert normalizer.count == len(data)
    np.testing.assert_allclose(normalizer.mean, data.mean(0), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(normalizer.var, data.var(0), rtol=1e-3)
    assert all(buffer.dtype == torch.float32 for buffer in (normalizer.mean, normalizer.var, normalizer.std))
    expected = (probe.double() - torch.tensor(data.mean(0))) / torch.tensor(data.var(0) + 1e-5).sqrt()
    torch.testing.assert_close(normalizer(probe).double(), expected, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(normalizer.inverse(normalizer(probe)), probe, rtol=1e-4, atol=1e-4)


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
