"""The directory of a run, which no other process uses meanwhile."""

from __future__ import annotations

import errno
import itertools
import os
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from diffsim.training.errors import fail

RUNS = Path("runs")  # parent of runs without --run-dir


class RunDirectory:
    """Made and locked when the run begins: one that fails at its start leaves nothing behind.

    Args:
        path: None: a new one in RUNS.
        resumed: the checkpoint that the run continues.

    Attributes:
        saved: iteration of its checkpoint.
    """

    def __init__(self, path: Path | None, resumed: Path | None) -> None:
        self.path, self.resumed, self.saved = path or RUNS, resumed, 0
        self._chosen = path is not None
        self._lock: TextIO | None = None

    @property
    def checkpoint(self) -> Path:
        """The file in which the run is saved."""
        return self.path / "checkpoint.pt"

    def check(self) -> None:
        """End the script if the run cannot be written there; otherwise nothing changes, except that a resumed run's
        directory is locked before its checkpoint is read."""
        check_writable(self.path)
        self._check_unused()
        if self.resumed and self.path.is_dir():
            self._lock = lock(self.path)

    def open(self, name: str) -> Path:
        """Make and lock it, under this name unless a path was given, and return its path."""
        with self.writing():
            if not self._chosen:
                self.path, self._chosen = make_unused(self.path / name), True
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = self._lock or lock(self.path)
        self._check_unused()  # again: a run may have ended there since this one started
        return self.path

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Around what writes files: a full disk or the like ends the script."""
        try:
            yield
        except OSError as error:
            fail(f"cannot write to {self.path}: {error.strerror}; {self.kept()}")

    def kept(self) -> str:
        """Say what of the run is saved."""
        path = self.checkpoint
        return f"{path} is of iteration {self.saved}" if path.is_file() else "no checkpoint was saved"

    def close(self) -> None:
        """Leave it to others."""
        if self._lock is not None:
            self._lock.close()

    def _check_unused(self) -> None:
        if self.checkpoint.exists() and (self.resumed is None or not self.resumed.samefile(self.checkpoint)):
            fail(f"{self.path} holds another run's checkpoint.pt: --resume it, or choose another --run-dir")


def check_writable(directory: Path) -> None:
    """End the script if nothing can be written to a directory, which need not exist; leaves nothing behind."""
    try:
        str(directory).encode()  # tensorboard writes it
        existing = next(path for path in (directory, *directory.absolute().parents) if path.exists())
        with tempfile.TemporaryFile(dir=existing) as file:
            file.write(bytes(1000))  # a full disk has room for an empty file
    except (OSError, UnicodeError) as error:
        fail(f"cannot write to run directory {directory}: {getattr(error, 'strerror', 'its name is not UTF-8')}")


def make_unused(wanted: Path) -> Path:
    """Make a directory of this name, or with a number behind it where the name is taken."""
    for number in itertools.count(2):
        with suppress(FileExistsError):
            wanted.mkdir(parents=True)
            return wanted
        wanted = wanted.with_name(f"{wanted.name.partition('.')[0]}.{number}")
    raise AssertionError


def lock(directory: Path) -> TextIO:
    """End the script if another process runs in a directory; else keep others out until the file is closed.

    The operating system holds the lock, so a killed process leaves none.
    """
    try:
        file = (directory / "lock").open("a+")
    except OSError as error:
        fail(f"cannot write to run directory {directory}: {error.strerror}")
    with suppress(ImportError):  # of Windows
        import fcntl

        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):  # others: the file system has no locks
                time.sleep(0.5)  # it may have got the lock just now, and writes its name next
                file.seek(0)
                fail(f"{directory} is in use by {file.read().strip()}: wait for its end, or choose another --run-dir")
    file.truncate(0)
    print(f"process {os.getpid()} on {socket.gethostname()}", file=file, flush=True)
    return file
