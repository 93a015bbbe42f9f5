"""Policies and values that treat left and right alike: networks of states and their mirror images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from diffsim.symmetry.mirror import Mirror, Reflection
from diffsim.training.errors import fail
from diffsim.training.layers import First, ObsNormalizer, moments

Network: TypeAlias = nn.Sequential | nn.ModuleList


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


def make_alike(
    mirror: Mirror,
    actor: nn.Module,
    inputs: Sequence[Network | None],
    action: Network,
    value: Network,
    size: Network | None = None,
) -> None:
    """Treat left and right alike: mirrored states get mirrored actions with the same noise, and the same value.

    Args:
        mirror: the task's.
        actor: has a `normalizer` of observations and a parameter `log_std`, a number per action.
        inputs: the networks that observations enter; None is left out.
        action, value, size: those that end with actions, values, and numbers per action that have no direction.
    """
    normalizer = actor.get_submodule("normalizer")
    assert isinstance(normalizer, ObsNormalizer)
    mirror_statistics(normalizer, mirror.obs)
    for network in inputs:
        if network is not None:
            mirror_inputs(network, mirror.obs)
    mirror_outputs(action, mirror.action)
    mirror_outputs(value, mirror.value)
    if size is not None:
        mirror_outputs(size, mirror.size)
    mirror_parameter(actor, "log_std", mirror.action)


def mirror_inputs(network: Network, reflection: Reflection) -> None:
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


def mirror_outputs(network: Network, reflection: Reflection) -> None:
    """Let a network after `mirror_inputs` end with the mean of its output and the image of that for the image."""
    network.append(MirrorMean(len(reflection.index), reflection.index, reflection.sign))


def mirror_parameter(module: nn.Module, name: str, reflection: Reflection) -> None:
    """Let a parameter (..., n) that has no direction be equal on both sides."""
    both = SymmetricParameter(len(reflection.index), reflection.index, reflection.sign)
    parametrize.register_parametrization(module, name, both)


def mirror_statistics(normalizer: ObsNormalizer, reflection: Reflection) -> None:
    """Let a normalizer's statistics be those of all observations and their mirror images.

    So the normalized image is the image of the normalized observation.
    """

    def moments_of_both(x: Tensor) -> tuple[Tensor, Tensor]:
        var, mean = moments(x)
        image = reflection(mean)
        var = (var + var.index_select(0, reflection.index)) / 2 + ((mean - image) / 2) ** 2
        return var, (mean + image) / 2

    normalizer.moments = moments_of_both
