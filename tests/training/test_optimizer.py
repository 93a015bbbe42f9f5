"""ClippedAdam against torch's own Adam and clipping."""

from __future__ import annotations

import math
from typing import Any

import torch
from learners import assert_same
from torch import nn

from diffsim.training import ClippedAdam


def network() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 5), nn.ELU(), nn.LayerNorm(5), nn.Linear(5, 1))


def test_it_is_bitwise_what_torchs_fused_adam_computes() -> None:
    """Whose hooks for a GradScaler clip and skip; with a learning rate that decays."""
    torch.manual_seed(0)
    module = network()
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
