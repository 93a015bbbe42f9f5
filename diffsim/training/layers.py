"""Layers of policies that torch lacks: a checkpoint's policy is loaded with them, without its script."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from diffsim.training import distributed
from diffsim.training.errors import fail


class Reflection(Protocol):
    """How numbers look in a mirror: a permutation with signs, its own inverse."""

    @property
    def index(self) -> Tensor: ...  # (n,) from where each number comes

    @property
    def sign(self) -> Tensor: ...  # (n,) 1 or -1, of each number after the permutation

    def __call__(self, x: Tensor) -> Tensor:
        """Return the mirror image (..., n) of x (..., n)."""


class ObsNormalizer(nn.Module):
    """Normalizes by the running mean and variance of what it has seen; constant between updates.

    The statistics are buffers, so they are saved with the policy that depends on them. Without the size of an
    observation it normalizes scalars. With a mirror they are those of all observations and their mirror images, so
    that the normalized image is the image of the normalized observation.

    Attributes:
        mirror: of observations; None at first.
    """

    mirror: Reflection | None = None

    def __init__(self, size: int | None = None) -> None:
        super().__init__()
        self.size = size
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
        var, mean = moments(x)
        if self.mirror is not None:
            image = self.mirror(mean)
            var = (var + var.index_select(0, self.mirror.index)) / 2 + ((mean - image) / 2) ** 2
            mean = (mean + image) / 2
        new = len(x) * distributed.size()
        total, delta = self.count + new, mean - self.mean
        self.var.copy_((self.var * self.count + var * new + delta**2 * self.count * new / total) / total)
        self.mean.add_(delta * new / total)
        self.count.copy_(total)
        self.std.copy_((self.var + 1e-5).sqrt())


class Likeliest(nn.Module):
    """Of each action, the location of the component with the largest weight.

    Not the mixture's mean, which lies between two peaks, where neither is.

    Args:
        actions, components: how many, m and n.
        shared: the locations are parameters, the same in all states: the input (..., m n) holds the logits of the
            weights. Otherwise it holds the logits and then the locations (..., 2 m n).

    Attributes:
        loc: (m, n) the locations, if shared.
    """

    def __init__(self, actions: int, components: int, shared: bool = True) -> None:
        super().__init__()
        self.actions, self.components, self.shared = actions, components, shared
        self.loc = nn.Parameter(torch.zeros(actions, components)) if shared else None

    def forward(self, x: Tensor) -> Tensor:
        parts = x.unflatten(-1, (-1, self.actions, self.components))
        index = parts[..., 0, :, :].argmax(-1, keepdim=True)
        loc = parts[..., 1, :, :] if self.loc is None else self.loc.expand(parts.shape[:-3] + self.loc.shape)
        return loc.gather(x.dim(), index).squeeze(-1)  # not -1, which onnx's reference evaluator gets wrong


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
) -> Chain:
    """Stack linear, activation and, if asked for, LayerNorm per hidden layer, and a linear output unless it is None.

    Weights are initialised as torch does, or orthogonal with gain sqrt(2) and zero biases. The network sees the first
    columns of its inputs only, or all of them (None).
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
    return Chain(*layers)


class First(nn.Module):
    """The first columns of an observation: what an actor sees of it, where a critic sees all (Task.actor_dim)."""

    def __init__(self, columns: int) -> None:
        super().__init__()
        self.columns = columns

    def forward(self, x: Tensor) -> Tensor:
        return x[..., : self.columns]


class WithMirrorImage(nn.Module):
    """Rows (..., B, n), and then their mirror images: (..., 2 B, n)."""

    def __init__(self, size: int, index: Tensor | None = None, sign: Tensor | None = None) -> None:
        super().__init__()
        self.size = size  # n
        self.index: Tensor = nn.Buffer(torch.arange(size) if index is None else index)
        self.sign: Tensor = nn.Buffer(torch.ones(size) if sign is None else sign)

    def image(self, x: Tensor) -> Tensor:
        return x.index_select(-1, self.index) * self.sign

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat((x, self.image(x)), dim=-2)


class MirrorMean(WithMirrorImage):
    """Outputs for rows and for their images (..., 2 B, n): the mean of the first half and the second half's image.

    So f becomes (f(s) + M f(M s)) / 2: for the mirror image of s it is exactly the image of what it is for s.
    """

    def forward(self, x: Tensor) -> Tensor:
        own, other = x.unflatten(-2, (2, -1)).unbind(-3)
        return (own + self.image(other)) / 2


class SymmetricParameter(WithMirrorImage):
    """Numbers (..., n) without direction, such as standard deviations: the mean of those of both sides."""

    def forward(self, x: Tensor) -> Tensor:
        return (x + x.index_select(-1, self.index)) / 2


def mirror_inputs(network: nn.Sequential | nn.ModuleList, reflection: Reflection) -> None:
    """Let a network of observations see their mirror images as well.

    Raises:
        UsageError: the network sees some columns only, whose images have others.
    """
    first = network[0] if len(network) else None
    columns = first.columns if isinstance(first, First) else None
    index, sign = (part[:columns] for part in (reflection.index, reflection.sign))
    if (index >= len(index)).any():
        fail(f"--symmetric: the first {columns} numbers of an observation, which the actor sees, need others' images")
    network.insert(0 if columns is None else 1, WithMirrorImage(len(index), index, sign))


def mirror_outputs(network: nn.Sequential | nn.ModuleList, reflection: Reflection) -> None:
    """Let a network after `mirror_inputs` end with the mean of its output and the image of that for the image."""
    network.append(MirrorMean(len(reflection.index), reflection.index, reflection.sign))


def make_symmetric(module: nn.Module, name: str, reflection: Reflection) -> None:
    """Let a parameter (..., n) that has no direction be equal on both sides."""
    both = SymmetricParameter(len(reflection.index), reflection.index, reflection.sign)
    parametrize.register_parametrization(module, name, both)


def moments(x: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the variance and mean of x (B, ...) over the B of all ranks."""
    var, own = torch.var_mean(x, dim=0, correction=0)
    mean = distributed.average(own.clone())
    return distributed.average(var + (own - mean) ** 2), mean
