"""Errors of a script's user: a message of one line is all that is shown of them."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from typing import NoReturn

import torch

from diffsim.env import ActionError
from diffsim.robot.scene import SceneError, TerrainError
from diffsim.sim.launcher import TooLargeError
from diffsim.startup import KernelCacheError
from diffsim.tasks import TaskError


class UsageError(ValueError):
    """What a user asked for cannot be done. The message is one line: what is wrong, and what is allowed."""


# Errors whose message says all that a user needs.
EXPECTED = (
    *(UsageError, SceneError, TaskError, TerrainError, TooLargeError, KernelCacheError, ActionError),
    *(FloatingPointError, torch.OutOfMemoryError),
)


@contextmanager
def in_one_line() -> Iterator[None]:
    """Around a call of tyro: what it cannot parse is told like other errors, instead of in a box of several lines."""
    try:
        with redirect_stderr(io.StringIO()) as box:
            yield
    except SystemExit as end:
        if not end.code:  # --help
            raise
        rows = re.sub(r"\x1b\[[\d;]*m", "", box.getvalue()).splitlines()[1:-1]  # without colours, title and border
        parts = re.split("[─-]{5,}", " ".join(" ".join(row.strip("│|").split()) for row in rows))  # between rules
        fail("; ".join(part.strip(" .") for part in parts if part and not part.startswith(" Argument helptext")))


def fail(message: object) -> NoReturn:
    """Raise a UsageError; a script that is a `command` ends with it."""
    raise UsageError(str(message))
