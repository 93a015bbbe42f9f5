"""The replay buffer of off-policy learners."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn


class Transition(NamedTuple):
    """B control steps as a learner needs them."""

    obs: Tensor  # (B, obs_dim)
    action: Tensor  # (B, action_dim)
    reward: Tensor  # (B,)
    next_obs: Tensor  # (B, obs_dim) before any reset
    terminated: Tensor  # (B,) 1 where the episode failed, 0 where it went on or its time ran out


class ReplayBuffer(nn.Module):
    """The last transitions, on the device. Adding and sampling never wait for it, so both can be captured.

    A checkpoint holds the rows that are filled and no others.

    Attributes:
        rows: (size, obs_dim + action_dim + 1 + obs_dim + 1) transitions; the oldest are overwritten first.
        count: () of transitions ever added.
    """

    def __init__(self, size: int, obs_dim: int, action_dim: int) -> None:
        super().__init__()
        self.size, self.widths = size, (obs_dim, action_dim, 1, obs_dim, 1)
        self.rows: Tensor = nn.Buffer(torch.zeros(size, sum(self.widths)), persistent=False)
        self.count: Tensor = nn.Buffer(torch.zeros((), dtype=torch.int64))

    def add(self, transitions: Transition) -> None:
        """Store B transitions, no more than the buffer keeps."""
        columns = [tensor if tensor.dim() > 1 else tensor.unsqueeze(1) for tensor in transitions]
        number = len(columns[0])
        place = (self.count + torch.arange(number, device=self.count.device)) % self.size
        self.rows.index_copy_(0, place, torch.cat(columns, 1))
        self.count += number

    def sample(self, number: int) -> Transition:
        """Transitions drawn uniformly, with repetition: B is `number`. Something must have been added before."""
        filled = self.count.clamp(max=self.size)
        place = (torch.rand(number, device=self.count.device, dtype=torch.float64) * filled).long()
        return self.split(self.rows[place])

    def split(self, rows: Tensor) -> Transition:
        """Rows (B, ...) of the buffer as transitions."""
        obs, action, reward, next_obs, terminated = rows.split(self.widths, 1)
        return Transition(obs, action, reward.squeeze(1), next_obs, terminated.squeeze(1))

    def get_extra_state(self) -> Tensor:
        return self.rows[: min(int(self.count), self.size)]

    def set_extra_state(self, rows: Tensor) -> None:
        """Raises a ValueError where they are of a buffer of another size that was full."""
        if len(rows) != (filled := min(int(self.count), self.size)):
            raise ValueError(f"{len(rows)} transitions, and a replay buffer that holds {filled}")
        self.rows[: len(rows)] = rows
