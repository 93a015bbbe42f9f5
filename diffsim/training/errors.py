"""Errors of a script's user: one line, exit code 2."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NoReturn

from diffsim.training import distributed


def fail(message: object) -> NoReturn:
    """End the script with one line on stderr and exit code 2; of several ranks only the first prints it."""
    if distributed.rank() == 0:
        print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    sys.exit(2)
