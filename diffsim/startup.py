"""MuJoCo and Warp, started without noise, and an end in one line. The package imports this before everything else."""

from __future__ import annotations

import ctypes
import errno
import importlib
import os
import shutil
import signal
import sys
import threading
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any
from weakref import WeakSet

_one_line: tuple[type[BaseException], ...] = ()
_interrupted = False  # while the package was imported


def end_in_one_line(*kinds: type[BaseException]) -> None:
    """From now on such errors, and Ctrl-C, end the program in one line on stderr instead of a traceback."""
    global _one_line
    _one_line = (KeyboardInterrupt, *kinds)


def imported() -> None:
    """The package is imported. Raises KeyboardInterrupt if Ctrl-C came and a module that was imported kept it back."""
    if signal.getsignal(signal.SIGINT) is _note:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if _interrupted:
        raise KeyboardInterrupt


def _note(number: int, frame: FrameType | None) -> None:
    global _interrupted
    _interrupted = True
    signal.default_int_handler(number, frame)


def _report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    global _interrupted
    # An import that is interrupted fails somewhere in another package, with whatever error that makes of it.
    imports = sum(frame.f_code.co_name == "<module>" for frame, _ in traceback.walk_tb(trace)) > 1
    interrupted = _interrupted or (imports and issubclass(kind, KeyboardInterrupt))
    no_memory = kind is RuntimeError and "can't allocate memory" in str(error)  # torch's on a CPU
    if interrupted or issubclass(kind, _one_line) or (_one_line and no_memory):
        text = "" if interrupted else str(error).partition("\n")[0]
        print(f"{Path(sys.argv[0]).name}: {text or 'interrupted'}", file=sys.stderr)
    else:
        _others(kind, error, trace)
    _interrupted = False


def _report_in_thread(args: threading.ExceptHookArgs) -> None:
    if type(args.thread).__name__ != "_AsyncWriterThread":  # tensorboard's raises its error in the main thread again
        _others_in_threads(args)


_others, sys.excepthook = sys.excepthook, _report
_others_in_threads, threading.excepthook = threading.excepthook, _report_in_thread
if signal.getsignal(signal.SIGINT) is signal.default_int_handler and (
    threading.current_thread() is threading.main_thread()
):
    signal.signal(signal.SIGINT, _note)

import warp as wp  # noqa: E402  Ctrl-C may come during this import and all that follow

ROOM = 16 * 2**20  # bytes that a kernel takes in Warp's cache at most; LLVM aborts the process when there are fewer
# What Warp prints when it starts and nobody needs: pip installs a Warp that supports the Python at hand.
NOISE = (b"Could not find or load the NVIDIA CUDA driver", b"Support for Python 3.10 is deprecated")
_announced: set[str] = set()
_watched: WeakSet[Any] = WeakSet()


class KernelCacheError(ValueError):
    """Warp's folder of compiled kernels cannot be written."""

    def __init__(self, folder: object, error: OSError) -> None:
        super().__init__(
            f"cannot write to Warp's kernel cache {folder}: set WARP_CACHE_PATH to another folder ({error.strerror})"
        )


def import_mujoco() -> None:
    """Import MuJoCo even where MUJOCO_GL names an OpenGL that is not there: only drawing needs it, and says so."""
    try:
        importlib.import_module("mujoco")
    except Exception:  # AttributeError among them
        wanted = os.environ.get("MUJOCO_GL")
        if wanted is None:
            raise
        os.environ["MUJOCO_GL"] = "disable"
        try:
            importlib.import_module("mujoco")
        finally:
            os.environ["MUJOCO_GL"] = wanted


def start_warp() -> None:
    """Start Warp if there is no NVIDIA driver, without the warning that it prints then, from C.

    With a driver there is no warning, and Warp starts when it is first used: CUDA must not begin at an import.
    """
    wp.config.log_level = wp.LOG_WARNING
    if not nvidia_driver():
        try:
            check_kernel_cache()
        except ValueError:
            pass  # repeated when kernels are wanted


def nvidia_driver() -> bool:
    """Whether the library of the NVIDIA driver can be loaded."""
    for name in ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so", "libcuda.so.1"):
        try:
            ctypes.CDLL(name)
            return True
        except OSError:
            pass
    return False


def check_kernel_cache() -> Path:
    """Start Warp; the folder where it keeps compiled kernels.

    Raises:
        KernelCacheError: it cannot be written.
    """
    wanted = wp.config.kernel_cache_dir
    try:
        with _without(*NOISE):
            wp.init()
        if not os.access(str(wp.config.kernel_cache_dir), os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        folder, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, wanted
        raise KernelCacheError(folder, error) from error
    return Path(str(wp.config.kernel_cache_dir))


def announce_compilation(kernels: Iterable[wp.Kernel], name: str) -> None:
    """Say in one line on stderr when Warp begins to compile the first of the kernels; nothing if its cache has them."""
    for kernel in kernels:
        if kernel.module not in _watched:
            _watched.add(kernel.module)
            _watch(kernel.module, name)


def _watch(module: Any, name: str) -> None:
    load = module.load

    def announcing_load(device: Any, block_dim: int | None = None, *args: Any, **kwargs: Any) -> Any:
        try:
            if not _is_compiled(module, wp.get_device(device), block_dim):
                if shutil.disk_usage(str(wp.config.kernel_cache_dir)).free < ROOM:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                if name not in _announced and os.environ.get("RANK", "0") == "0":
                    print(f"compiling kernels for {name} (once, about 10 s) ...", file=sys.stderr, flush=True)
                _announced.add(name)
            return load(device, block_dim, *args, **kwargs)
        except OSError as error:
            raise KernelCacheError(wp.config.kernel_cache_dir, error) from error

    module.load = announcing_load


def _is_compiled(module: Any, device: wp.Device, block_dim: int | None) -> bool:
    folder = Path(str(wp.config.kernel_cache_dir)) / module.get_module_identifier(block_dim)
    return any(folder.glob("*.o" if device.is_cpu else "*.sm*"))


@contextmanager
def _without(*messages: bytes) -> Iterator[None]:
    """Hold back what is written to stderr, by C as well, and let all lines through but those with a message."""
    try:
        stderr = os.dup(2)
    except OSError:  # closed
        yield
        return
    reader, writer = os.pipe()
    os.dup2(writer, 2)
    os.close(writer)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        with open(reader, "rb") as pipe:
            for line in pipe:
                if not any(message in line for message in messages):
                    os.write(2, line)


import_mujoco()
start_warp()
