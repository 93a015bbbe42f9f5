"""Errors of a script's user: a message of one line is all that is shown of them."""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from typing import NoReturn

import torch

from diffsim.env import ActionError
from diffsim.robot.profile import TerrainError
from diffsim.robot.types import SceneError
from diffsim.sim.launcher import TooLargeError
from diffsim.startup import KernelCacheError
from diffsim.tasks import TaskError


class UsageError(ValueError):
    """Raised for what cannot be done, with a message of one line: what is wrong, and what is allowed."""


# Errors whose message says all that a user needs.
EXPECTED = (
    *(UsageError, SceneError, TaskError, TerrainError, TooLargeError, KernelCacheError, ActionError),
    *(FloatingPointError, torch.OutOfMemoryError),
)

HELP = {"-h", "--help"}
WIDE = "100000"  # columns of a terminal in which no word is split


@contextmanager
def in_one_line(words: Sequence[str] | None) -> Iterator[None]:
    """Around a call of tyro: what it cannot parse is told like other errors, instead of in a box of several lines.

    words: the command line that it parses; None: the script's.
    """
    columns, box = os.environ.get("COLUMNS"), io.StringIO()
    if not HELP.intersection(sys.argv if words is None else words):
        os.environ["COLUMNS"] = WIDE
    try:
        with redirect_stderr(box):
            yield
    except SystemExit as end:
        if not end.code:  # --help
            raise
        rows = re.sub(r"\x1b\[[\d;]*m", "", box.getvalue()).splitlines()[1:-1]  # without colours, title and border
        parts = re.split("^[─-]+$", "\n".join(row.strip("│ ") for row in rows), flags=re.MULTILINE)
        told = (" ".join(part.split()).strip(" .") for part in parts)
        fail("; ".join(part for part in told if part and not part.startswith("Argument helptext")))
    else:
        sys.stderr.write(box.getvalue())  # warnings
    finally:
        os.environ.pop("COLUMNS", None)
        if columns is not None:
            os.environ["COLUMNS"] = columns


def fail(message: object) -> NoReturn:
    """Raise a UsageError; a script that is a `command` ends with it."""
    raise UsageError(str(message))
