"""Simulator: the buffers of a batch of environments, the launches of its kernels, and the node of torch's graph."""

from __future__ import annotations

import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from diffsim.integration import Integration, check_count
from diffsim.kernels.backward import backward_kernel
from diffsim.kernels.forward import forward_kernel
from diffsim.kernels.lanes import divide
from diffsim.kernels.model import model_of, shape_of
from diffsim.scene import Scene

State = tuple[torch.Tensor, torch.Tensor]  # qpos, qvel
WARP_DTYPE = {torch.float32: wp.float32, torch.float64: wp.float64}
# Waking a thread between two torch operations costs a fraction of a millisecond: below this many link-substeps per
# thread (about 1 ms) it saves nothing. A whole iteration of 64 ants takes 0.22 s with two threads, 0.26 s with one.
MIN_WORK_PER_THREAD = 4_000
# Beyond as many GPU threads, an environment is left to one of them: there are enough environments to fill the GPU.
MAX_THREADS = 65_536
MUSCLE_SHARERS = 4
LANES = [(lanes, sharers) for lanes in (1, 2, 4, 8, 16) for sharers in (1, 2, 4, 8, 16) if sharers <= lanes]


class Checkpoint(NamedTuple):
    """Where a simulator keeps what the backward pass of one control step needs."""

    slot: int
    version: int  # of the slot, which serves a new step after each round of the ring


class ControlStep(torch.autograd.Function):
    """qpos, qvel, ctrl -> qpos and qvel side by side. The simulator's checkpoint holds what backward needs."""

    @staticmethod
    def forward(ctx: Any, sim: Simulator, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor) -> torch.Tensor:
        ctx.sim, ctx.checkpoint = sim, sim.next_checkpoint()
        return sim.forward(ctx.checkpoint.slot, qpos, qvel, ctrl)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_end: torch.Tensor) -> tuple[Any, ...]:
        return (None, *ctx.sim.backward(ctx.checkpoint, g_end))


class Simulator:
    """A batch of independent copies of one scene, stepped by control steps of equal length.

    Holds the checkpoints of up to `horizon` differentiable control steps in a ring: a backward pass must come before
    its steps are overwritten (asserted). Steps that need no gradient store nothing.

    Args:
        scene: what is simulated.
        num_envs: number of copies N.
        integration: integrator, substeps and theta.
        control_dt: seconds of one control step.
        horizon: differentiable control steps that can be alive at once.
        device: "cpu" or a CUDA device.
        dtype: torch.float32 or torch.float64.
        threads: CPU threads of the kernels; default as many as have enough to do, up to all cores.
        lanes: GPU threads per environment, and how many of them have the same limbs (kernels/lanes.py): powers of two
            up to 16; default as measured to be fastest.

    Raises:
        ValueError: an argument out of range, with what is allowed.

    Attributes:
        nonfinite: (N,) bool, environments whose last step left the finite numbers, or passed 1e5 m/s or rad/s. Their
            state is returned as it was before that step, its gradient is zero; other environments are not touched.
        nonfinite_gradients: (N,) int32, how many adjoints of control steps were not finite, and were set to zero.
        seconds: wall seconds spent in kernels on the CPU, {"forward": ..., "backward": ...}.
    """

    def __init__(
        self,
        scene: Scene,
        num_envs: int,
        integration: Integration = Integration(),
        control_dt: float = 1 / 60,
        horizon: int = 1,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float32,
        threads: int | None = None,
        lanes: tuple[int, int] | None = None,
    ) -> None:
        for name, value in (
            ("num_envs", num_envs),
            ("horizon", horizon),
            ("threads", 1 if threads is None else threads),
        ):
            check_count(name, value)
        integration.check()
        if not 0 < control_dt < math.inf:
            raise ValueError(f"control_dt is {control_dt!r}, must be positive seconds")
        if lanes not in (None, *LANES):
            raise ValueError(f"lanes is {lanes!r}, must be one of {', '.join(map(str, LANES))}")
        if dtype not in WARP_DTYPE:
            raise ValueError(f"dtype is {dtype!r}, must be torch.float32 or torch.float64")
        self.device = check_device(device)
        self.scene, self.num_envs, self.dtype = scene, num_envs, dtype
        self.nq, self.nv, self.nu = scene.nq, scene.nv, scene.nu
        self.integration, self.control_dt, self.horizon = integration, control_dt, horizon
        self.seconds = {"forward": 0.0, "backward": 0.0}

        real, cuda = WARP_DTYPE[dtype], self.device.type == "cuda"
        team = (lanes or default_lanes(scene, num_envs)) if cuda else (1, 1)
        shape = shape_of(scene, real, integration.integrator == "implicit", cuda, *team)
        self._kernels = {"forward": forward_kernel(shape), "backward": backward_kernel(shape)}
        self._model = model_of(scene, real, str(self.device), *team)
        self._commands: dict[tuple[str, int, int], wp.Launch] = {}
        # Coalescing wants wide blocks, but few environments want to reach many multiprocessors.
        self._block_dim = max(8 if num_envs <= 256 else 32, shape.lanes)
        self._chunks = self._split(threads, shape.nlink)
        self._pool = ThreadPoolExecutor(len(self._chunks) - 1) if len(self._chunks) > 1 else None

        def tensor(*size: int, of: torch.dtype = dtype) -> torch.Tensor:
            return torch.zeros(size, dtype=of, device=self.device)

        # One buffer for qpos, qvel and ctrl side by side: torch copies each in one operation, the kernels see parts.
        n, slots = num_envs, horizon + 1  # the last slot serves steps that record nothing
        self._widths = (self.nq, self.nv, self.nu)
        self._start = tensor(slots, n, sum(self._widths))
        self._end = tensor(n, self.nq + self.nv)
        self._nonfinite = tensor(slots, n, of=torch.bool)
        self._g_end = tensor(n, self.nq + self.nv)
        self._g_start = tensor(n, sum(self._widths))
        self._checkpoint: list[wp.array] | None = None
        self._shape = shape
        self._slot, self._last = 0, horizon
        self._version = [0] * horizon
        self.nonfinite_gradients = tensor(n, of=torch.int32)
        self._coarse: Simulator | None = None
        if integration.integrator == "extrapolated":
            half = Integration("semi_implicit", integration.substeps // 2)
            self._coarse = Simulator(
                scene, n, half, control_dt, horizon, device=device, dtype=dtype, threads=threads, lanes=lanes
            )
            self._coarse.nonfinite_gradients, self._coarse.seconds = self.nonfinite_gradients, self.seconds
            first = [*scene.qpos_adr[scene.ball == 0], *([3] if scene.floating else [])]
            self._quaternions = torch.tensor([range(k, k + 4) for k in first], device=self.device)

    @property
    def nonfinite(self) -> torch.Tensor:
        own = self._nonfinite[self._last]
        return own if self._coarse is None else own | self._coarse.nonfinite

    def step(self, qpos: torch.Tensor, qvel: torch.Tensor, ctrl: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Advance all environments by one control step, differentiable in all three arguments.

        Args:
            qpos: (N, nq) MuJoCo's generalised positions; quaternions wxyz, normalised here.
            qvel: (N, nv) MuJoCo's generalised velocities; of a free joint the linear one in the world's frame, the
                angular one in the body's.
            ctrl: (N, nu) one number per motor, [-1, 1] over its control range, constant over the step, not clipped.

        Returns:
            qpos, qvel after the step, of the same shapes.

        Raises:
            ValueError: an argument of the wrong shape, dtype or device.
        """
        for name, value, width in (("qpos", qpos, self.nq), ("qvel", qvel, self.nv), ("ctrl", ctrl, self.nu)):
            self.check_tensor(name, value, width)
        recorded = torch.is_grad_enabled() and (qpos.requires_grad or qvel.requires_grad or ctrl.requires_grad)
        if recorded:
            state = ControlStep.apply(self, qpos, qvel, ctrl)
        else:
            state = self.forward(self.horizon, qpos, qvel, ctrl)
        end = state.split(self._widths[:2], dim=1)
        if self._coarse is None:
            return end
        return self._extrapolate((qpos, qvel), self._coarse.step(qpos, qvel, ctrl), end)

    def _extrapolate(self, start: State, coarse: State, fine: State) -> State:
        """Richardson: an error proportional to the substep cancels in 2 fine - coarse."""
        qpos, qvel = (2.0 * b - a for a, b in zip(coarse, fine, strict=True))
        if len(self._quaternions):
            columns = self._quaternions
            unit = torch.nn.functional.normalize(qpos[:, columns], dim=2)
            qpos = qpos.index_copy(1, columns.flatten(), unit.flatten(1))
        bad = self.nonfinite.unsqueeze(1)
        return torch.where(bad, start[0].detach(), qpos), torch.where(bad, start[1].detach(), qvel)

    def rewind(self) -> None:
        """Let the next differentiable step use the first checkpoint: the start of a new window."""
        self._slot = 0
        if self._coarse is not None:
            self._coarse.rewind()

    def check_tensor(self, name: str, value: torch.Tensor, width: int) -> None:
        """Raise ValueError unless value is a (num_envs, width) tensor of the simulator's dtype on its device."""
        if not isinstance(value, torch.Tensor):
            raise ValueError(f"{name} is a {type(value).__name__}, must be a torch.Tensor")
        wanted = (self.num_envs, width)
        if tuple(value.shape) != wanted:
            raise ValueError(f"{name} has shape {tuple(value.shape)}, must be {wanted} (environments, numbers each)")
        if value.dtype != self.dtype:
            raise ValueError(f"{name} has dtype {value.dtype}, must be {self.dtype}")
        if value.device != self.device:
            raise ValueError(f"{name} is on {value.device}, must be on {self.device}")

    # -- called by ControlStep ----------------------------------------------------------------------------------------

    def next_checkpoint(self) -> Checkpoint:
        """The next slot of the ring, which from now on is this step's."""
        slot = self._slot
        self._slot = (slot + 1) % self.horizon
        self._version[slot] += 1
        return Checkpoint(slot, self._version[slot])

    def forward(self, slot: int, *start: torch.Tensor) -> torch.Tensor:
        """(N, nq + nv) the state after one control step from start = (qpos, qvel, ctrl)."""
        torch.cat([part.detach() for part in start], dim=1, out=self._start[slot])
        self._last = slot
        self._launch("forward", slot)
        return self._end.clone()

    def backward(self, checkpoint: Checkpoint, g_end: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The adjoints of qpos, qvel and ctrl from that of the state (N, nq + nv) after the step."""
        if self._version[checkpoint.slot] != checkpoint.version:
            raise RuntimeError(
                f"backward through a control step whose checkpoint was overwritten: at most {self.horizon} "
                "differentiable steps can be alive; build the simulator with a larger horizon"
            )
        self._g_end.copy_(g_end)
        self._launch("backward", checkpoint.slot)
        return self._g_start.clone().split(self._widths, dim=1)

    # -- launches -----------------------------------------------------------------------------------------------------

    def _split(self, threads: int | None, nlink: int) -> list[tuple[int, int]]:
        """(first environment, count) of each thread's share."""
        n = self.num_envs
        if self.device.type == "cuda":
            return [(0, n)]
        wanted = threads or min(available_cores(), max(1, n * self.integration.substeps * nlink // MIN_WORK_PER_THREAD))
        bounds = [n * k // min(wanted, n) for k in range(min(wanted, n) + 1)]
        return [(a, b - a) for a, b in zip(bounds, bounds[1:], strict=False)]

    def _launch(self, kernel: str, slot: int) -> None:
        if self.device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
            with wp.ScopedStream(stream, sync_enter=False, sync_exit=False):
                self._command(kernel, slot, 0).launch()
            return
        start = time.perf_counter()
        commands = [self._command(kernel, slot, k) for k in range(len(self._chunks))]
        # Warp runs a CPU kernel on the calling thread and releases the interpreter lock meanwhile.
        waiting = [self._pool.submit(c.launch) for c in commands[1:]] if self._pool else []
        commands[0].launch()
        for future in waiting:
            future.result()
        self.seconds[kernel] += time.perf_counter() - start

    def _command(self, kernel: str, slot: int, chunk: int) -> wp.Launch:
        """A launch with its arguments packed once: packing costs more than a small kernel."""
        key = (kernel, slot, chunk)
        if key not in self._commands:
            first, count = self._chunks[chunk]
            self._commands[key] = wp.launch(
                self._kernels[kernel],
                dim=count * self._shape.lanes,
                inputs=self._arguments(kernel, slot, first),
                device=str(self.device),
                block_dim=self._block_dim,
                record_cmd=True,
            )
        return self._commands[key]

    def _arguments(self, kernel: str, slot: int, first: int) -> list[Any]:
        record = slot < self.horizon
        if self._checkpoint is None and record:
            self._checkpoint = self._rows(self.horizon * self.integration.substeps)
        rows = self._checkpoint if record and self._checkpoint else self._rows(0)
        row0 = slot * self.integration.substeps if record else 0
        real = WARP_DTYPE[self.dtype]
        head = [
            self._model,
            real(self.control_dt / self.integration.substeps),
            real(self.integration.theta),
            self.integration.substeps,
            first,
        ]
        qpos, qvel, ctrl = self._parts(self._start[slot], 3)
        nonfinite = wp.from_torch(self._nonfinite[slot])
        if kernel == "forward":
            return [*head, qpos, qvel, ctrl, int(record), row0, *rows, *self._parts(self._end, 2), nonfinite]
        gradients = [*self._parts(self._g_end, 2), *self._parts(self._g_start, 3)]
        blown_up = wp.from_torch(self.nonfinite_gradients)
        return [*head, row0, *rows, qpos, ctrl, nonfinite, *gradients, blown_up]

    def _parts(self, buffer: torch.Tensor, count: int) -> list[Any]:
        """The kernels' views of qpos, qvel and, if `count` is 3, ctrl."""
        return [wp.from_torch(part) for part in buffer.split(self._widths[:count], dim=1)]

    def _rows(self, count: int) -> list[wp.array]:
        """Checkpoints of `count` substeps: qpos, qvel, qacc and the factor of the mass matrix."""
        n, widths = self.num_envs, (self.nq, self.nv, self.nv, self._shape.nfactor)
        sizes = [(count, k, n) if self._shape.env_last else (count, n, k) for k in widths]
        return [wp.zeros(size, dtype=WARP_DTYPE[self.dtype], device=str(self.device)) for size in sizes]


def default_lanes(scene: Scene, num_envs: int) -> tuple[int, int]:
    """GPU threads per environment, and how many of them share limbs: as measured in docs/performance.md."""
    groups = min((1, 2, 4), key=lambda lanes: (divide(scene, lanes).slots, lanes))
    sharers = MUSCLE_SHARERS if "muscle" in scene.features else 1
    return (groups * sharers, sharers) if groups * sharers * num_envs <= MAX_THREADS else (1, 1)


def available_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_device(device: str | torch.device) -> torch.device:
    """The device, with an index if it is a GPU.

    Raises:
        ValueError: neither the CPU nor a CUDA device that is there.
    """
    try:
        result = torch.device(device)
    except RuntimeError as error:
        raise ValueError(f"unknown device {str(device)!r}; choose cpu or cuda") from error
    if result.type not in ("cpu", "cuda"):
        raise ValueError(f"unknown device {str(device)!r}; choose cpu or cuda")
    if result.type == "cuda":
        if not torch.cuda.is_available():
            raise ValueError(f"device {str(device)!r} asked for, but PyTorch sees no CUDA GPU here; choose cpu")
        count = torch.cuda.device_count()
        if (result.index or 0) >= count:
            raise ValueError(f"device {str(device)!r} asked for, but there are {count} CUDA GPUs")
        result = torch.device("cuda", torch.cuda.current_device() if result.index is None else result.index)
    return result
