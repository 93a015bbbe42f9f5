"""Signals that ask a run to stop."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

NAMES = "SIGINT", "SIGTERM", "SIGHUP"  # Windows lacks the last one


class Signals:
    """Counts what asks to stop, so that an iteration can end; a second signal of a kind ends the process at once.

    Attributes:
        received: the signals' numbers, in order.
    """

    def __init__(self) -> None:
        self.received: list[int] = []
        self._handlers: dict[int, Any] = {}

    def listen(self) -> None:
        """Receive signals from here on, except those that are ignored, as nohup asks for."""
        for number in (getattr(signal, name) for name in NAMES if hasattr(signal, name)):
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._handlers[number] = signal.signal(number, self._receive)

    def restore(self) -> None:
        """Give the signals back to whoever received them before."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _receive(self, number: int, _frame: FrameType | None) -> None:
        self.received.append(number)
        signal.signal(number, signal.default_int_handler)
