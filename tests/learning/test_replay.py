"""The replay buffer: what it samples, keeps and restores."""

from __future__ import annotations

import pytest
import torch

from diffsim.learning.replay import ReplayBuffer, Transition


def transitions(*numbers: int) -> Transition:
    """Each part of a transition is a function of its number."""
    x = torch.tensor(numbers, dtype=torch.float32)
    obs = torch.stack((x, -x), 1)
    return Transition(obs, x.unsqueeze(1), 100 + x, obs + 1000, x % 2)


def test_samples_are_uniform_over_the_last_transitions() -> None:
    buffer = ReplayBuffer(10, 2, 1)
    buffer.add(transitions(0, 1, 2, 3))
    assert set(buffer.sample(500).reward.tolist()) == {100, 101, 102, 103}
    buffer.add(transitions(4, 5, 6, 7))
    buffer.add(transitions(8, 9, 10, 11))  # over the first two
    sample = buffer.sample(20_000)
    x = (sample.reward - 100).long()
    counts = torch.bincount(x, minlength=12)
    assert (counts[:2] == 0).all() and (counts[2:] > 1700).all() and (counts[2:] < 2300).all()
    for part, expected in zip(sample, transitions(*x.tolist()), strict=True):
        assert torch.equal(part, expected)


def test_a_full_buffer_keeps_its_size() -> None:
    """In a larger one rows would be sampled that nothing has filled."""
    old, young = ReplayBuffer(4, 2, 1), ReplayBuffer(4, 2, 1)
    young.add(transitions(0, 1, 2))
    assert young.state_dict()["_extra_state"].shape == (3, 7)  # the filled rows alone
    for _ in range(2):
        old.add(transitions(0, 1, 2))
    for size in (3, 5):
        with pytest.raises(ValueError, match=f"4 transitions, and a replay buffer that holds {size}"):
            ReplayBuffer(size, 2, 1).load_state_dict(old.state_dict())
        (copy := ReplayBuffer(size, 2, 1)).load_state_dict(young.state_dict())  # not full: any that has room
        assert torch.equal(copy.rows[:3], young.rows[:3]) and copy.count == 3
