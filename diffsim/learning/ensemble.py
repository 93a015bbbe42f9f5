"""Networks of one shape side by side, evaluated and optimised as one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from diffsim.training.optimizer import ClippedAdam


class Linears(nn.Module):
    """E linear layers: (E, B, inputs) -> (E, B, outputs)."""

    def __init__(self, layers: Sequence[nn.Linear]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.stack([layer.weight.detach().T for layer in layers]))
        self.bias = nn.Parameter(torch.stack([layer.bias.detach().unsqueeze(0) for layer in layers]))

    def forward(self, x: Tensor, norms: LayerNorms | None = None) -> Tensor:
        """Apply the layers; given norms scale and shift the inputs first, in the weights, which are fewer."""
        if norms is None:
            return torch.baddbmm(self.bias, x, self.weight)
        return torch.baddbmm(self.bias + norms.bias @ self.weight, x, norms.weight.mT * self.weight)

    def __getitem__(self, e: int) -> nn.Linear:
        layer = nn.utils.skip_init(nn.Linear, *self.weight.shape[1:]).to(self.weight)  # draws no random numbers
        layer.load_state_dict({"weight": self.weight[e].T, "bias": self.bias[e, 0]})
        return layer


class LayerNorms(nn.Module):
    """E layer normalizations: (E, B, width) -> (E, B, width), before they are scaled and shifted."""

    def __init__(self, layers: Sequence[nn.LayerNorm]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.stack([layer.weight.detach().unsqueeze(0) for layer in layers]))
        self.bias = nn.Parameter(torch.stack([layer.bias.detach().unsqueeze(0) for layer in layers]))

    def forward(self, x: Tensor) -> Tensor:
        return F.layer_norm(x, x.shape[-1:])

    def __getitem__(self, e: int) -> nn.LayerNorm:
        layer = nn.LayerNorm(self.weight.shape[-1]).to(self.weight)
        layer.load_state_dict({"weight": self.weight[e, 0], "bias": self.bias[e, 0]})
        return layer


class Ensemble(nn.Module):
    """E networks of one shape as one: (E, B, inputs) -> (E, B, outputs), each on its own inputs.

    Indexed by e, it gives a copy of the network e. A single network keeps its own layers, which are faster.

    Args:
        networks: chains of Linear, LayerNorm and layers without parameters, equal except for their weights.
    """

    def __init__(self, networks: Sequence[nn.Sequential]) -> None:
        super().__init__()
        self.count, alone = len(networks), len(networks) == 1
        self.layers = nn.ModuleList(networks[0] if alone else map(_stack, zip(*networks, strict=True)))

    def forward(self, x: Tensor) -> Tensor:
        norms = None  # whose scale and shift the next layer is to apply
        for layer in self.layers:
            if isinstance(layer, Linears):
                x, norms = layer(x, norms), None
            elif norms is None:
                x, norms = layer(x), layer if isinstance(layer, LayerNorms) else None
            else:
                raise TypeError(f"no ensemble of LayerNorm and then {type(layer).__name__}: only Linear may follow")
        return x if norms is None else torch.addcmul(norms.bias, x, norms.weight)

    def value(self, *inputs: Tensor) -> Tensor:
        """Return what each says of the same inputs (B, ...), side by side, in its only output: (E, B)."""
        x = torch.cat(inputs, -1)
        return self.forward(x.expand(self.count, *x.shape)).squeeze(-1)

    def __getitem__(self, e: int) -> nn.Sequential:
        return nn.Sequential(*(layer[e] if isinstance(layer, Linears | LayerNorms) else layer for layer in self.layers))


def _stack(layers: Sequence[nn.Module]) -> nn.Module:
    kind = type(layers[0])
    if kind is nn.Linear:
        return Linears([layer for layer in layers if isinstance(layer, nn.Linear)])
    if kind is nn.LayerNorm:
        return LayerNorms([layer for layer in layers if isinstance(layer, nn.LayerNorm)])
    if list(layers[0].parameters()):
        raise TypeError(f"no ensemble of {kind.__name__}: only of Linear, LayerNorm and layers without parameters")
    return layers[0]


class EnsembleAdam(ClippedAdam):
    """ClippedAdam for each member of a population, which may own several networks; members can be tied.

    Each network's gradient is clipped by itself, and a bad one counts as zero. Tied members hold equal weights and step
    along the mean of their gradients: together they are one learner with the samples of all.

    Args:
        module: of Ensembles of E = networks * members, in this order.
        networks, members: how many networks a member has in each of them, and how many members there are.
        max_norm, betas, skip_norm: see ClippedAdam.
        tied: () whether the members are tied, 0 or 1; a captured graph reads its present value. None: never.
    """

    def __init__(
        self,
        module: nn.Module,
        networks: int,
        members: int,
        max_norm: float,
        betas: tuple[float, float],
        tied: Tensor | None = None,
        skip_norm: float = 1e6,
    ) -> None:
        self.shape, self.tied = (networks, members), tied
        super().__init__(module, max_norm, betas, skip_norm=skip_norm)

    def flatten(self, tensors: Sequence[Tensor]) -> Tensor:
        """(networks, members, P)"""
        return torch.cat([tensor.reshape(*self.shape, -1) for tensor in tensors], dim=-1)

    def _adopt(self, vector: Tensor) -> None:
        sizes = [p.numel() // math.prod(self.shape) for p in self.parameters]
        for p, own in zip(self.parameters, vector.flatten(0, 1).split(sizes, dim=-1), strict=True):
            p.data = own.view(p.shape)

    def step(self, gradient: Tensor) -> Tensor:
        """Take one descent step of each; returns the gradients' largest norm () before clipping."""
        if self.tied is not None:
            gradient = torch.where(self.tied > 0, gradient.mean(1, keepdim=True), gradient)
        norm = torch.linalg.vector_norm(gradient, dim=-1, keepdim=True)
        good = norm < self.skip_norm
        self.step_count += 1
        self._update(torch.where(good, gradient / (norm / self.max_norm).clamp(min=1.0), 0.0))
        self.skipped += (~good).sum()
        return norm.max()

    def tie(self, member: int) -> None:
        """Give all members the weights and moments of one."""
        for tensor in (self.vector, self.exp_avg, self.exp_avg_sq):
            tensor.copy_(tensor[:, member : member + 1].clone().expand_as(tensor))
