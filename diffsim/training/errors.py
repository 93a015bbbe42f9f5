"""Errors of a script's user: a message of one line is all that is shown of them."""

from __future__ import annotations

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


def fail(message: object) -> NoReturn:
    """Raise a UsageError; a script that is a `command` ends with it."""
    raise UsageError(str(message))
