"""Errors of a script's user: one line, exit code 2; on its command line as well."""

from __future__ import annotations

import contextlib
import io
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import tyro

from diffsim.training import distributed

T = TypeVar("T")


def fail(message: object) -> NoReturn:
    """End the script with one line on stderr and exit code 2; of several ranks only the first prints it."""
    if distributed.rank() == 0:
        print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    sys.exit(2)


def parse_command_line(kind: type[T], argv: Sequence[str] | None, **options: Any) -> T:
    """tyro.cli; where it would end with a box around what is wrong, the script ends with one line."""
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(kind, args=argv, **options)
    except SystemExit as end:
        if not end.code:  # --help
            raise
        text = re.sub(r"\x1b\[[\d;]*m|[│|╭╮╰╯]", " ", box.getvalue())
        # Horizontal rules separate the title, what is wrong, and flags with similar names.
        _, wrong, *more = [" ".join(part.split()) for part in re.split(r"\s[-─]{5,}[^\n]*\n", text)]
        similar = re.findall(r"^[^-]*(--[\w-]+)", more[0]) if "Perhaps you meant" in text else []
        fail(wrong + "".join(f"; perhaps you meant {flag}" for flag in similar))
