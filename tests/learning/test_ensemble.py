"""Ensembles against their networks, one by one."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from diffsim.learning.ensemble import Ensemble, EnsembleAdam
from diffsim.training import ClippedAdam

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


def descend(optimizer: ClippedAdam, value: Tensor) -> Tensor:
    """One step; the gradient's norm."""
    return optimizer.step(optimizer.gradient(value))


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
        norms = [descend(optimizer, scale * loss(single(samples))) for optimizer, single, samples in parts]
        torch.testing.assert_close(descend(together, scale * loss(ensemble(x))), torch.stack(norms).max())
        for e, single in enumerate(networks):
            for p, q in zip(ensemble[e].parameters(), single.parameters(), strict=True):
                torch.testing.assert_close(p, q)
    before = together.vector.clone()
    x[1, 0, 0] = math.nan
    descend(together, loss(ensemble(x)))
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
        descend(together, loss(ensemble(x)))
        own = x.unflatten(0, (2, 3))
        for single, optimizer, samples in zip(singles, alone, own if step else own[:, 1], strict=True):
            descend(optimizer, single(samples).square().mean())
        if step == 0:
            together.tie(1)
            tied.fill_(1.0)
        for e in range(6) if step else (1, 4):
            for p, q in zip(ensemble[e].parameters(), singles[e // 3].parameters(), strict=True):
                torch.testing.assert_close(p, q)
