"""The window of a rollout: which of a simulator's slots keeps what each step needs for its backward pass."""

from __future__ import annotations


class Window:
    """Hands out slots 0 to horizon - 1 to the differentiable steps of a rollout; the next rollout overwrites them.

    Slot number `horizon` serves steps without gradient, which need no place of their own.

    Attributes:
        horizon: largest number of differentiable steps in a rollout.
        used: how many there were in this one.
    """

    def __init__(self, horizon: int) -> None:
        self.horizon, self.used = horizon, 0
        self._versions = [0] * horizon

    def take(self) -> int:
        """Return the slot of the rollout's next differentiable step; raises RuntimeError if it has none left."""
        if self.used == self.horizon:
            raise RuntimeError(
                f"horizon of {self.horizon} differentiable steps exceeded: begin a new rollout by an environment's "
                "detach() or a simulator's rewind(), step under torch.no_grad(), or make it with a larger horizon"
            )
        slot, self.used = self.used, self.used + 1
        self._versions[slot] += 1
        return slot

    def version(self, slot: int) -> int:
        """Return which step of all rollouts a slot holds, for `check`."""
        return self._versions[slot]

    def check(self, slot: int, version: int) -> None:
        """Raise RuntimeError if a slot does not hold this step any more."""
        if self._versions[slot] != version:
            raise RuntimeError(
                f"backward through a control step whose checkpoint was overwritten: at most {self.horizon} "
                "differentiable steps can be alive; build the simulator with a larger horizon"
            )

    def forget(self) -> None:
        """Let no step so far have a backward pass."""
        self._versions = [version + 1 for version in self._versions]
