"""Trajectories, and their densities under each of the distributions that they were drawn from."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

Generator = tuple[Tensor, ...]  # a distribution of trajectories, as a checkpoint takes it


class Samples(NamedTuple):
    """m trajectories of T steps."""

    x: Tensor  # (m, T + 1, nx)
    obs: Tensor  # (m, T, obs_dim) on which u acted
    u: Tensor  # (m, T, nu)
    reward: Tensor  # (m, T)
    source: Tensor  # (m,) number of the generator it came from
    log_q: Tensor  # (m, n, T) log density of its prefixes under each of n generators

    def pick(self, index: Tensor | slice) -> Samples:
        return Samples(*(tensor[index] for tensor in self))

    @property
    def returns(self) -> Tensor:
        return self.reward.sum(1)

    @property
    def spread(self) -> tuple[float, float]:
        """Mean and standard deviation of the returns."""
        return self.returns.mean().item(), self.returns.std(correction=0).item()

    @property
    def log_mixture(self) -> Tensor:
        """(m, T) log density of prefixes under the mixture of the generators that these samples come from."""
        log_q = self.log_q[:, self.source.unique()]
        return torch.logsumexp(log_q, 1) - math.log(log_q.shape[1])


class SampleSet:
    """Samples that come and go, with the generators that they come from.

    Args:
        log_density: (m, T) of prefixes of m samples under a generator.
    """

    samples: Samples

    def __init__(self, log_density: Callable[[Generator, Samples], Tensor], device: torch.device) -> None:
        self.log_density, self.device, self.generators = log_density, device, list[Generator]()

    def append(self, samples: Samples, *new: Generator) -> Tensor:
        """Adds samples, and the generators that they are the first of; returns the samples' indices."""
        for generator in new:
            self.generators.append(tuple(generator))
            column = self.log_density(generator, self.samples).unsqueeze(1)
            self.samples = self.samples._replace(log_q=torch.cat((self.samples.log_q, column), 1))
        log_q = torch.stack([self.log_density(generator, samples) for generator in self.generators], 1)
        first, joined = len(self.samples.u), zip(self.samples, samples._replace(log_q=log_q), strict=True)
        self.samples = Samples(*(torch.cat(tensors) for tensors in joined))
        return torch.arange(first, len(self.samples.u), device=log_q.device)

    def keep(self, index: Tensor, best: int) -> int:
        """Drops other samples, and generators that are without any, except the best one; returns its new number."""
        kept = self.samples.pick(index)
        used = torch.tensor(sorted({*kept.source.tolist(), best}), device=index.device)
        number = torch.full((len(self.generators),), -1, device=index.device)
        number[used] = torch.arange(len(used), device=index.device)
        self.samples = kept._replace(source=number[kept.source], log_q=kept.log_q[:, used])
        self.generators = [self.generators[i] for i in used.tolist()]
        return int(number[best])

    def state_dict(self) -> dict[str, Any]:
        return {"samples": tuple(self.samples), "generators": self.generators}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.samples = Samples(*(tensor.to(self.device) for tensor in state["samples"]))
        self.generators = [tuple(tensor.to(self.device) for tensor in generator) for generator in state["generators"]]
