"""Fit a small network to values without autograd, whose bookkeeping on a CPU costs nearly as much as the arithmetic."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim.training.optimizer import ClippedAdam

KINDS = nn.Linear, nn.ELU, nn.LayerNorm


class Regression:
    """Descends the mean squared error of a network. With autograd the numbers would be the same, bit for bit.

    The network is a chain of Linear, ELU and LayerNorm, first a Linear, with one output; all of its parameters are the
    optimizer's.
    """

    def __init__(self, network: nn.Sequential, optimizer: ClippedAdam) -> None:
        if wrong := [type(layer).__name__ for layer in network if not isinstance(layer, KINDS)]:
            raise TypeError(
                f"no regression of {wrong[0]}: only of Linear, ELU and LayerNorm; fit others by optimizer.step(loss)"
            )
        self.layers, self.optimizer = list(network), optimizer

    @torch.no_grad()
    def step(self, x: Tensor, target: Tensor) -> Tensor:
        """One descent step on network(x (B, inputs)) (B, 1) - target (B,); returns its mean square () before."""
        kept = []  # what the backward pass needs of each layer
        for layer in self.layers:
            if isinstance(layer, nn.Linear):
                kept.append([x])
                x = torch.addmm(layer.bias, x, layer.weight.t())
            elif isinstance(layer, nn.ELU):
                y = F.elu(x, layer.alpha, layer.inplace)
                kept.append([x])  # in place, this is y
                x = y
            elif isinstance(layer, nn.LayerNorm):
                y, *moments = torch.native_layer_norm(x, layer.normalized_shape, layer.weight, layer.bias, layer.eps)
                kept.append([x, *moments])
                x = y
        error = x.squeeze(-1) - target
        g = (2.0 / len(error) * error).unsqueeze(-1)  # the adjoint of what a layer returns
        gradients: list[Tensor] = []  # of the parameters, the last one first
        for layer, (x, *moments) in zip(self.layers[::-1], kept[::-1], strict=True):
            if isinstance(layer, nn.Linear):
                gradients += g.sum(0), g.t() @ x
                g = g @ layer.weight if layer is not self.layers[0] else g
            elif isinstance(layer, nn.ELU):
                g = torch.ops.aten.elu_backward(g, layer.alpha, 1.0, 1.0, layer.inplace, x)
            elif isinstance(layer, nn.LayerNorm):
                affine = layer.normalized_shape, *moments, layer.weight, layer.bias
                g, weight, bias = torch.ops.aten.native_layer_norm_backward(g, x, *affine, (True, True, True))
                gradients += bias, weight
        self.optimizer.descend(self.optimizer.flatten(gradients[::-1]))
        return error.square().mean()
