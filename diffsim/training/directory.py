"""The directory of a run: whether it can be written, and that one process alone trains into it."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from diffsim.training.errors import fail

if sys.platform != "win32":
    import fcntl


def check_writable(directory: Path) -> None:
    """End the script if nothing can be written to a directory, which need not exist; leaves nothing behind."""
    try:
        existing = next(path for path in (directory, *directory.absolute().parents) if path.exists())
        tempfile.TemporaryFile(dir=existing).close()
    except OSError as error:
        fail(f"cannot write to run directory {directory}: {error.strerror}")


class Lock:
    """The right to train into a directory. It ends with the process, however that ends.

    The directory itself is locked, so no file is left behind. On Windows, and on file systems without locks, anyone has
    the right.
    """

    def __init__(self) -> None:
        self._descriptor: int | None = None

    def acquire(self, directory: Path) -> None:
        """End the script if another process has the right; does nothing where there is no directory yet."""
        if sys.platform == "win32" or self._descriptor is not None or not directory.is_dir():
            return
        self._descriptor = os.open(directory, os.O_RDONLY)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            fail(f"another process trains into {directory}")
        except OSError:  # no locks here
            self.release()

    def release(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    __del__ = release
