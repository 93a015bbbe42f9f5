"""Layers of policies that torch lacks: a checkpoint's policy is loaded with them, without its script."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from diffsim.training import distributed


class ObsNormalizer(nn.Module):
    """Normalizes by the running mean and variance of what it has seen; constant between updates.

    The statistics are buffers, so they are saved with the policy that depends on them. Without the size of an
    observation it normalizes scalars.

    Attributes:
        moments: computes the variance and mean of a batch, see `moments`.
    """

    def __init__(self, size: int | None = None) -> None:
        super().__init__()
        self.size, self.moments = size, moments
        shape = () if size is None else (size,)
        self.count: Tensor = nn.Buffer(torch.tensor(0.0, dtype=torch.float64))  # float32 stops counting at 2^24
        self.mean: Tensor = nn.Buffer(torch.zeros(shape))
        self.var: Tensor = nn.Buffer(torch.ones(shape))
        self.std: Tensor = nn.Buffer(torch.ones(shape))

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.std

    def inverse(self, x: Tensor) -> Tensor:
        return x * self.std + self.mean

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Adds x (..., size) or (...) of all ranks to the statistics (Chan et al.'s parallel variance)."""
        x = x.reshape(-1, *self.mean.shape)
        var, mean = self.moments(x)
        new = len(x) * distributed.size()
        total, delta = self.count + new, mean - self.mean
        self.var.copy_((self.var * self.count + var * new + delta**2 * self.count * new / total) / total)
        self.mean.add_(delta * new / total)
        self.count.copy_(total)
        self.std.copy_((self.var + 1e-5).sqrt())


class Chain(nn.Sequential):
    """Layers called by their `forward`, without the hooks of modules, which cost small networks 4 % of a pass."""

    def forward(self, x: Tensor) -> Tensor:
        for layer in self:
            x = layer.forward(x)
        return x


def mlp(
    inputs: int,
    hidden: Sequence[int],
    outputs: int | None,
    activation: Callable[[], nn.Module],
    norm: bool = False,
    orthogonal: bool = False,
    columns: int | None = None,
    gain: float = 1.0,
) -> Chain:
    """Stack linear, activation and, if asked for, LayerNorm per hidden layer, and a linear output unless it is None.

    Weights are initialised as torch does, or orthogonal with gain sqrt(2) and zero biases. A gain other than 1 then
    multiplies the last layer's weights, and its bias is zero. The network sees the first columns of its inputs only, or
    all of them (None).
    """
    layers = list[nn.Module]()
    if columns is not None:
        layers, inputs = [First(columns)], columns
    for width in hidden:
        layers += [nn.Linear(inputs, width), activation(), *([nn.LayerNorm(width)] if norm else [])]
        inputs = width
    layers += [] if outputs is None else [nn.Linear(inputs, outputs)]
    for layer in layers if orthogonal else ():
        if isinstance(layer, nn.Linear):
            nn.init.orthogonal_(layer.weight, 2**0.5)
            nn.init.zeros_(layer.bias)
    if gain != 1.0:
        with torch.no_grad():
            layers[-1].get_parameter("weight").mul_(gain)
            layers[-1].get_parameter("bias").zero_()
    return Chain(*layers)


class First(nn.Module):
    """The first columns of an observation: what an actor sees of it, where a critic sees all (Task.actor_dim)."""

    def __init__(self, columns: int) -> None:
        super().__init__()
        self.columns = columns

    def forward(self, x: Tensor) -> Tensor:
        return x[..., : self.columns]


def moments(x: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the variance and mean of x (B, ...) over the B of all ranks."""
    var, own = torch.var_mean(x, dim=0, correction=0)
    mean = distributed.average(own.clone())
    return distributed.average(var + (own - mean) ** 2), mean
