"""Regression against autograd: the same numbers, bit for bit."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from diffsim.training import ClippedAdam, Regression


def layers(width: int) -> list[nn.Module]:
    norm = nn.LayerNorm(width)
    return [nn.Linear(5, width), nn.ELU(inplace=True), norm, nn.Linear(width, 7), nn.ELU(0.5), nn.Linear(7, 1)]


@pytest.mark.parametrize("network", [nn.Sequential(*layers(128)), nn.Sequential(nn.Linear(5, 1))])
def test_it_descends_as_autograd_does(network: nn.Sequential) -> None:
    """Clipped, skipped where a target is not a number, and with a batch whose size is no power of two."""
    torch.manual_seed(0)
    reference = copy.deepcopy(network)
    optimizer, theirs = ClippedAdam(network, 0.5, lr=1e-2), ClippedAdam(reference, 0.5, lr=1e-2)
    regression = Regression(network, optimizer)
    for scale in (1.0, 1e3, torch.nan, 1e-3, 1.0):
        x, target = torch.randn(300, 5), scale * torch.randn(300)
        loss = F.mse_loss(reference(x).squeeze(-1), target)
        theirs.step(loss)
        torch.testing.assert_close(regression.step(x, target), loss.detach(), rtol=1e-6, atol=0, equal_nan=True)
        assert torch.equal(optimizer.vector, theirs.vector)
    assert optimizer.skipped == 1


def test_other_layers_are_refused() -> None:
    network = nn.Sequential(nn.Linear(5, 3), nn.SiLU(), nn.Linear(3, 1))
    with pytest.raises(TypeError, match="no regression of SiLU: only of Linear, ELU and LayerNorm"):
        Regression(network, ClippedAdam(network, 1.0))
