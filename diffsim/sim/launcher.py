"""Launcher: a scene's two kernels, and the threads that run them."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp

from diffsim import startup
from diffsim.kernels.backward import backward_kernel
from diffsim.kernels.forward import forward_kernel
from diffsim.kernels.mujoco.ground import pair_column
from diffsim.kernels.thread.division import Division, divide
from diffsim.kernels.thread.model import model_of, types
from diffsim.kernels.thread.spec import kernel_spec
from diffsim.robot.scene import Scene
from diffsim.sim.options import BLOCKS, WARP_DTYPE, Options

# Waking a thread between two torch operations costs a fraction of a millisecond: below this many link-substeps per
# thread it saves nothing. Blocks do five times as many meanwhile: with two threads 64 humanoids are faster, 64 ants are
# not (results/cpu/speed_physics.csv).
MIN_WORK_PER_THREAD, IN_BLOCKS = 4_000, 20_000
# Beyond this number of GPU threads each environment gets one: there are enough environments to fill the GPU.
MAX_THREADS = 65_536
MUSCLE_SHARERS = 4
building = threading.RLock()  # Warp crashes where two threads make, compile or load kernels


class TooLargeError(ValueError):
    """Raised when an allocation does not fit into the device's memory."""


class Launcher:
    """Runs the forward and the backward kernel of a scene over a batch of environments.

    On a CPU each thread takes a share of the environments; on a GPU a launch goes to torch's current stream.

    Attributes:
        spec: the specification of the kernels.
        num_blocks: number of blocks of spec.block environments; the last one may not be full.
    """

    def __init__(self, scene: Scene, num_envs: int, options: Options) -> None:
        self.scene, self.num_envs = scene, num_envs
        self.device, self.dtype = torch.device(options.device), options.dtype
        real, cuda, asked = WARP_DTYPE[self.dtype], self.device.type == "cuda", options.division
        if asked is None:
            division = default_division(scene, num_envs) if cuda else divide(scene)
        else:  # of this scene: contact models have contact spheres of their own
            division = divide(scene, *asked)
        if division.threads_per_env > 1 and not cuda:
            raise ValueError(f"threads_per_env is {division.threads_per_env}, must be 1 on a CPU")
        block = options.block or default_block(num_envs, options)
        how = options.integration
        self.spec = kernel_spec(
            scene,
            division,
            real,
            options.forces,
            implicit=how.implicit,
            constrained=how.contact == "mujoco",
            varied=options.factors,
            env_last=cuda,
            block=block,
        )
        self.num_blocks = -(-num_envs // block)
        with building:
            self._kernels = {"forward": forward_kernel(self.spec), "backward": backward_kernel(self.spec)}
            self._model, self._division = model_of(scene, division, real, str(self.device)), division
        # Coalescing wants wide blocks, but few environments want to reach many multiprocessors.
        self._block_dim = max(8 if num_envs <= 256 else 32, self.spec.threads_per_env)
        work = num_envs * how.substeps * scene.nlink
        least = MIN_WORK_PER_THREAD if block == 1 else IN_BLOCKS
        wanted = 1 if cuda else options.threads or min(available_cores(), max(1, work // least))
        count = min(wanted, self.num_blocks)
        bounds = [self.num_blocks * k // count for k in range(count + 1)]
        self._shares = list(zip(bounds, bounds[1:], strict=False))  # blocks of each thread: first, end
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0  # that owns the threads: a forked child has none of its parent's

    def command(self, kernel: str, inputs: list[Any]) -> list[wp.Launch]:
        """Record the launches of all shares with their arguments: packing those costs more than a small kernel."""
        with building:
            startup.load(self._kernels[kernel].module, str(self.device), self._block_dim, self.scene.name)
            return [
                wp.launch(
                    self._kernels[kernel],
                    dim=(end - first) * self.spec.threads_per_env,
                    inputs=[self._model, first, *inputs],
                    device=str(self.device),
                    block_dim=self._block_dim,
                    record_cmd=True,
                )
                for first, end in self._shares
            ]

    def rewrite(self, scene: Scene, names: Iterable[str], columns: slice = slice(None)) -> None:
        """Copy arrays of a scene with the same kernels, or their columns, to where the kernels read them."""
        model = model_of(scene, self._division, self.spec.dtype, "cpu")
        for name in names:
            if (array := getattr(self._model, name, None)) is not None:
                wp.to_torch(array)[..., columns].copy_(wp.to_torch(getattr(model, name))[..., columns])

    def batch(self, parts: Iterable[torch.Tensor]) -> Any:
        """Make the kernels' struct Batch of its fields."""
        Batch = types(self.spec).Batch
        result = Batch()
        for name, part in zip(Batch.vars, parts, strict=True):
            setattr(result, name, wp.from_torch(part))
        return result

    def launch(self, command: list[wp.Launch]) -> None:
        """Run a command; on a CPU return when it is done."""
        if self.device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
            with wp.ScopedStream(stream, sync_enter=False, sync_exit=False):
                command[0].launch()
            return
        # Warp runs a CPU kernel on the calling thread and releases the interpreter lock meanwhile.
        if len(command) > 1 and self._process != os.getpid():
            self._pool, self._process = ThreadPoolExecutor(len(command) - 1), os.getpid()
        pending = [self._pool.submit(share.launch) for share in command[1:]] if self._pool else []
        command[0].launch()
        for future in pending:
            future.result()

    def checkpoints(self, count: int) -> Any:
        """Allocate the kernels' struct Checkpoint for `count` substeps.

        With MuJoCo's constraints it also holds the acceleration before damping, the contacts, and the factors of both
        solves if damping follows the constraints.
        """
        spec, n, result = self.spec, self.num_envs, types(self.spec).Checkpoint()
        accelerations = pair_column(spec) + 3 * spec.pairs if spec.constrained else spec.nv
        widths = (spec.nq, spec.nv, accelerations, spec.nfactor)
        counts = (count, count, count, spec.solves * count)
        numbers = sum(rows * width for rows, width in zip(counts, widths, strict=True))
        check_memory("checkpoints", n, numbers * self.dtype.itemsize, self.device)
        wide = spec.block > 1
        for name, rows, width in zip("qvaf", counts, widths, strict=True):
            each = (self.num_blocks, width, spec.block) if wide else (width, n) if spec.env_last else (n, width)
            values = torch.zeros(rows, *each, dtype=self.dtype, device=self.device)
            setattr(result, name, array_of_vectors(values, types(spec).T) if wide else wp.from_torch(values))
        return result


def array_of_vectors(values: torch.Tensor, dtype: type) -> wp.array:
    """Wrap float32 values (..., block) as an array of vectors, which Warp takes for numbers of dtype (kernels.wide)."""
    strides = tuple(stride * values.itemsize for stride in values.stride()[:-1])
    array: Any = wp.array(ptr=values.data_ptr() or None, dtype=dtype, shape=values.shape[:-1], strides=strides)
    array.tensor = values  # keeps the memory
    return array


def default_division(scene: Scene, num_envs: int) -> Division:
    """Choose the division of an environment among GPU threads, as measured in docs/performance.md."""
    sharers = MUSCLE_SHARERS if "muscle" in scene.features else 1
    if scene.indivisible:
        return divide(scene)
    candidates = [divide(scene, groups * sharers, sharers) for groups in (1, 2, 4)]
    best = min(candidates, key=lambda division: (division.slots, division.threads_per_env))
    return best if best.threads_per_env * num_envs <= MAX_THREADS else divide(scene)


def default_block(num_envs: int, options: Options) -> int:
    """Choose how many environments a thread steps at once, the fastest as measured in docs/performance.md."""
    if torch.device(options.device).type == "cuda" or options.dtype == torch.float64 or num_envs == 1:
        return 1
    return max(block for block in BLOCKS if block <= max(num_envs, 8))


def available_cores() -> int:
    """Return the number of cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_memory(what: str, num_envs: int, bytes_each: int, device: torch.device) -> None:
    """Raise TooLargeError if an allocation of bytes_each per environment is more than the device has."""
    if device.type == "cuda":
        there = torch.cuda.get_device_properties(device).total_memory
    elif hasattr(os, "sysconf"):
        there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    else:  # Windows does not tell
        return
    if num_envs * bytes_each > there:
        raise TooLargeError(
            f"num_envs is {num_envs:,}: the {what} would take {num_envs * bytes_each / 2**30:,.0f} GiB, but {device} "
            f"has {there / 2**30:,.0f} GiB, enough for {there // bytes_each:,} environments"
        )
