"""The replay buffer against what was added to it."""

from __future__ import annotations

import pytest
import torch

from diffsim.training import ReplayBuffer, Transition


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


def test_a_checkpoint_holds_the_filled_rows_alone() -> None:
    young, copy = ReplayBuffer(10, 2, 1), ReplayBuffer(10, 2, 1)
    young.add(transitions(3, 4, 5))
    state = young.state_dict()
    assert state["_extra_state"].shape == (3, 7)
    copy.load_state_dict(state)
    assert torch.equal(copy.rows, young.rows) and copy.count == 3


def test_more_than_it_keeps_is_refused() -> None:
    buffer = ReplayBuffer(3, 2, 1)
    with pytest.raises(ValueError, match="4 transitions at once do not fit into a replay buffer of 3"):
        buffer.add(transitions(0, 1, 2, 3))
    assert buffer.count == 0
