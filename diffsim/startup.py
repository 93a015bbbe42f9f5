"""Start MuJoCo and Warp without messages. The package imports this before everything else."""

from __future__ import annotations

import ctypes
import errno
import importlib
import os
import shutil
import sys
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import warp as wp

ROOM = 16 * 2**20  # largest size of a kernel in Warp's cache, bytes; with less space LLVM aborts the process
_started, _starting = False, threading.Lock()
_announced: set[str] = set()


class KernelCacheError(ValueError):
    """Raised when Warp's folder of compiled kernels cannot be written."""

    def __init__(self, folder: object, error: OSError) -> None:
        super().__init__(
            f"cannot write to Warp's kernel cache {folder}: set WARP_CACHE_PATH to another folder ({error.strerror})"
        )


def import_mujoco() -> None:
    """Import MuJoCo, also if MUJOCO_GL names an OpenGL that is missing: only drawing needs it, and reports it.

    MuJoCo's warnings go to stderr, unless the host program has set another handler.
    """
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
    mujoco = sys.modules["mujoco"]
    if mujoco.get_mju_user_warning() is None:  # MuJoCo would write MUJOCO_LOG.TXT into the user's folder
        mujoco.set_mju_user_warning(lambda text: print(f"MuJoCo: {text}", file=sys.stderr))


def start_warp() -> None:
    """Start Warp if there is no NVIDIA driver, without the warning that its C code then prints.

    With a driver there is no warning, and Warp starts when it is first used: CUDA must not begin at an import.
    """
    wp.config.log_level = wp.LOG_WARNING
    if not nvidia_driver():
        with suppress(KernelCacheError):  # repeated when kernels are wanted
            check_kernel_cache()


def nvidia_driver() -> bool:
    """Tell whether the library of the NVIDIA driver can be loaded."""
    for name in ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so", "libcuda.so.1"):
        with suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


def check_kernel_cache() -> Path:
    """Start Warp, return its folder of compiled kernels; raises KernelCacheError if that cannot be written."""
    global _started
    wanted = wp.config.kernel_cache_dir
    try:
        with _starting:  # stderr is the process's: two threads that hold it back would wait for each other
            if not _started:
                with _silent():  # without "Could not find or load the NVIDIA CUDA driver" and a deprecation of Python
                    wp.init()
                _started = True
        if not os.access(str(wp.config.kernel_cache_dir), os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        folder, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, wanted
        raise KernelCacheError(folder, error) from error
    return Path(str(wp.config.kernel_cache_dir))


def load(module: wp.Module, device: str, block_dim: int, name: str) -> None:
    """Load a module of kernels; if it is missing in the cache or damaged there, compile it with one line on stderr.

    Raises:
        KernelCacheError: the cache cannot be written, or what was compiled cannot be loaded from there.
    """
    pattern, block_dim = ("*.o", 1) if device == "cpu" else ("*.sm*", block_dim)  # Warp's block on a CPU is 1
    folder = Path(str(wp.config.kernel_cache_dir)) / module.get_module_identifier(block_dim)
    try:
        if any(folder.glob(pattern)):
            try:
                _check_objects(folder)
                module.load(device, block_dim)
                return
            except Exception:  # Warp's and json's
                shutil.rmtree(folder)
        if shutil.disk_usage(folder.parent).free < ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if name not in _announced and os.environ.get("RANK", "0") == "0":
            print(
                f"compiling kernels for {name} (about 10 s, once for such a batch and options) ...",
                file=sys.stderr,
                flush=True,
            )
        _announced.add(name)
        module.load(device, block_dim)
        _check_objects(folder)
    except OSError as error:
        raise KernelCacheError(wp.config.kernel_cache_dir, error) from error


def _check_objects(folder: Path) -> None:
    """Store checksums of a CPU's kernels, or raise ValueError if one has changed: it would crash the process."""
    for path in folder.glob("*.o"):
        found, stored = f"{zlib.crc32(path.read_bytes()):08x}", path.with_suffix(".crc")
        if not stored.exists():
            stored.write_text(found)
        elif stored.read_text() not in ("", found):  # empty while another process writes it
            raise ValueError(f"{path} has changed")


@contextmanager
def _silent() -> Iterator[None]:
    """Discard what is written to stderr, by C as well; failures still raise."""
    try:
        stderr = os.dup(2)
    except OSError:  # closed
        yield
        return
    with open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


import_mujoco()
start_warp()
