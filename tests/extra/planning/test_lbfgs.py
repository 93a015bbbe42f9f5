"""L-BFGS."""

from __future__ import annotations

import math

import torch

from diffsim.extra.planning.lbfgs import maximise


def test_the_best_finite_point_is_returned() -> None:
    start = torch.full((2,), 0.9, dtype=torch.float64)
    best, value = maximise(lambda theta: (1 - theta.square().sum()).log(), start / 2, 30)  # NaN outside of a circle
    assert abs(value) < 1e-8 and best.abs().max() < 1e-4
    best, value = maximise(lambda theta: -theta.sum() * math.nan, start, 5)
    assert torch.equal(best, start) and value == -math.inf


def test_a_quadratic_is_solved() -> None:
    root = torch.tensor([[2.0, 0.0, 0.0], [1.0, 0.5, 0.0], [-1.0, 3.0, 0.1]]).double()
    target = torch.tensor([1.0, -2.0, 3.0]).double()
    best, value = maximise(lambda theta: -(root @ (theta - target)).square().sum(), torch.zeros(3).double(), 50)
    torch.testing.assert_close(best, target, rtol=1e-5, atol=1e-5)
    assert abs(value) < 1e-10
