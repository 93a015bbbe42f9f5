"""Steppers: control steps as nodes of torch's graph, with the checkpoints that their adjoints need."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
import warp as wp

from diffsim.kernels.model import types
from diffsim.robot.scene import FACTORS
from diffsim.sim.integration import Integration
from diffsim.sim.launcher import Launcher, check_memory

State = tuple[torch.Tensor, torch.Tensor]  # qpos (N, nq), qvel (N, nv)


class Checkpoint(NamedTuple):
    """Where a stepper keeps what the backward pass of one control step needs."""

    slot: int
    version: int  # of the slot, which serves a new step after each round of the ring


class ControlStep(torch.autograd.Function):
    """qpos, qvel, ctrl, factors, forces -> qpos and qvel side by side. The stepper's checkpoint serves backward."""

    @staticmethod
    def forward(ctx: Any, stepper: Stepper, *start: torch.Tensor) -> torch.Tensor:
        ctx.stepper, ctx.checkpoint = stepper, stepper.next_checkpoint()
        return stepper.forward(ctx.checkpoint.slot, *start)

    @staticmethod
    def backward(ctx: Any, g_end: torch.Tensor) -> tuple[Any, ...]:
        if torch.is_grad_enabled():  # create_graph=True; without this, second derivatives would lack their larger part
            raise RuntimeError(
                "a simulated step has a first derivative only, so no create_graph=True: take finite differences of it"
            )
        return (None, *ctx.stepper.backward(ctx.checkpoint, g_end))


class Stepper:
    """Control steps by the launcher's kernels, which are those of the integration; see Simulator."""

    def __init__(self, launcher: Launcher, integration: Integration, control_dt: float, horizon: int) -> None:
        spec, n, slots = launcher.spec, launcher.num_envs, horizon + 1  # the last slot serves steps without gradient
        h = spec.dtype(control_dt / integration.substeps)

        def tensor(*size: int, of: torch.dtype = launcher.dtype) -> torch.Tensor:
            return torch.zeros(size, dtype=of, device=launcher.device)

        self._launcher, self._horizon, self._substeps = launcher, horizon, integration.substeps
        self._scalars = [h, spec.dtype(integration.theta), integration.substeps]
        self._passes = integration.passes
        # One buffer for qpos, qvel, ctrl, factors and forces side by side: torch copies it in one operation, and the
        # kernels see its parts. Each slot keeps those of its step.
        self._widths = (spec.nq, spec.nv, spec.nu, len(FACTORS) * spec.varied, 6 * spec.forced)
        self._end_widths = (spec.nq, spec.nv + int(spec.constrained))  # with constraints a column for the residual
        self._start, self._end = tensor(slots, n, sum(self._widths)), tensor(n, sum(self._end_widths))
        self._g_start, self._g_end = tensor(n, sum(self._widths)), tensor(n, spec.nq + spec.nv)
        self._nonfinite = tensor(slots, n, of=torch.bool)
        self._checkpoint: list[wp.array] | None = None
        self._commands: dict[tuple[str, int], list[wp.Launch]] = {}
        self._slot, self._last = 0, horizon
        self._version = [0] * horizon

    @property
    def nonfinite(self) -> torch.Tensor:
        return self._nonfinite[self._last]

    @property
    def residual(self) -> torch.Tensor:
        return self._end[:, sum(self._widths[:2]) :].sum(1)

    def step(self, *start: torch.Tensor) -> State:
        if torch.is_grad_enabled() and any(part.requires_grad for part in start):
            end = ControlStep.apply(self, *start)
        else:
            end = self.forward(self._horizon, *start)
        return end.split(self._widths[:2], dim=1)

    def rewind(self) -> None:
        self._slot = 0

    def next_checkpoint(self) -> Checkpoint:
        """The next slot of the ring, which from now on is this step's."""
        slot = self._slot
        self._slot = (slot + 1) % self._horizon
        self._version[slot] += 1
        return Checkpoint(slot, self._version[slot])

    def forward(self, slot: int, *start: torch.Tensor) -> torch.Tensor:
        """(N, nq + nv) the state after one control step from start = (qpos, qvel, ctrl, factors, forces)."""
        torch.cat([part.detach() for part in start], dim=1, out=self._start[slot])
        self._last = slot
        self._launcher.launch(self._command("forward", slot))
        return self._end[:, : sum(self._widths[:2])].clone()

    def backward(self, checkpoint: Checkpoint, g_end: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """The adjoints of qpos, qvel, ctrl, factors and forces from that of the state (N, nq + nv) after the step.

        Raises RuntimeError if the checkpoint serves another step by now.
        """
        if self._version[checkpoint.slot] != checkpoint.version:
            raise RuntimeError(
                f"backward through a control step whose checkpoint was overwritten: at most {self._horizon} "
                "differentiable steps can be alive; build the simulator with a larger horizon"
            )
        self._g_end.copy_(g_end)
        self._launcher.launch(self._command("backward", checkpoint.slot))
        return self._g_start.clone().split(self._widths, dim=1)

    def _command(self, kernel: str, slot: int) -> list[wp.Launch]:
        key = (kernel, slot)
        if key not in self._commands:
            self._commands[key] = self._launcher.command(kernel, self._inputs(kernel, slot))
        return self._commands[key]

    def _inputs(self, kernel: str, slot: int) -> list[Any]:
        record = slot < self._horizon
        if record and self._checkpoint is None:
            self._checkpoint = self._rows(self._horizon * self._substeps)
        rows = self._checkpoint if record and self._checkpoint else self._rows(0)
        row0 = slot * self._substeps if record else 0
        start, end, g_start, g_end = (
            [wp.from_torch(part) for part in buffer.split(widths, dim=1)]
            for buffer, widths in (
                (self._start[slot], self._widths),
                (self._end, self._end_widths),
                (self._g_start, self._widths),
                (self._g_end, self._widths[:2]),
            )
        )
        nonfinite = wp.from_torch(self._nonfinite[slot])
        if kernel == "forward":
            return [*self._scalars, self._passes, *start, int(record), row0, *rows, *end, nonfinite]
        qpos, _, *inputs = start  # ctrl, factors and forces
        blown_up = wp.from_torch(self._launcher.nonfinite_gradients)
        return [*self._scalars, row0, *rows, qpos, *inputs, nonfinite, *g_end, *g_start, blown_up]

    def _rows(self, count: int) -> list[wp.array]:
        """Checkpoints of `count` substeps: qpos, qvel, qacc and the factor of the mass matrix.

        With MuJoCo's constraints also the acceleration where the last pass began, and where damping follows them the
        factors of both.
        """
        spec, n, device = self._launcher.spec, self._launcher.num_envs, str(self._launcher.device)
        widths = (spec.nq, spec.nv, (1 + spec.constrained) * spec.nv, spec.nfactor)
        counts = (count, count, count, spec.solves * count)
        numbers = sum(rows * width for rows, width in zip(counts, widths, strict=True))
        check_memory("checkpoints", n, numbers * self._launcher.dtype.itemsize, self._launcher.device)
        if spec.block == 1:
            sizes = [(c, k, n) if spec.env_last else (c, n, k) for c, k in zip(counts, widths, strict=True)]
            return [wp.zeros(size, dtype=spec.dtype, device=device) for size in sizes]
        blocks = self._launcher.num_blocks
        values = [torch.zeros(c, blocks, k, spec.block) for c, k in zip(counts, widths, strict=True)]
        return [array_of_vectors(value, types(spec).T) for value in values]


def array_of_vectors(values: torch.Tensor, dtype: type) -> wp.array:
    """(..., block) float32 values as an array of vectors, which to Warp are numbers of that dtype (kernels.wide)."""
    strides = tuple(stride * values.itemsize for stride in values.stride()[:-1])
    array: Any = wp.array(ptr=values.data_ptr() or None, dtype=dtype, shape=values.shape[:-1], strides=strides)
    array.tensor = values  # keeps the memory
    return array


class ExtrapolatedStepper:
    """Richardson's extrapolation of two semi-implicit steppers, one of half the substeps: 2 fine - coarse.

    An error proportional to the substep cancels in it. Same interface and arguments as Stepper.
    """

    def __init__(self, launcher: Launcher, integration: Integration, control_dt: float, horizon: int) -> None:
        fine = Integration("semi_implicit", integration.substeps)
        coarse = Integration("semi_implicit", integration.substeps // 2)
        self._fine, self._coarse = (Stepper(launcher, part, control_dt, horizon) for part in (fine, coarse))
        first = launcher.scene.quaternion_adr
        self._quaternions = torch.tensor([range(k, k + 4) for k in first], device=launcher.device)

    @property
    def residual(self) -> torch.Tensor:
        return self._fine.residual

    @property
    def nonfinite(self) -> torch.Tensor:
        return self._fine.nonfinite | self._coarse.nonfinite

    def step(self, *start: torch.Tensor) -> State:
        fine, coarse = (stepper.step(*start) for stepper in (self._fine, self._coarse))
        end_qpos, end_qvel = (2.0 * b - a for a, b in zip(coarse, fine, strict=True))
        if len(self._quaternions):
            unit = F.normalize(end_qpos[:, self._quaternions], dim=2)
            end_qpos = end_qpos.index_copy(1, self._quaternions.flatten(), unit.flatten(1))
        bad = self.nonfinite.unsqueeze(1)
        return torch.where(bad, start[0].detach(), end_qpos), torch.where(bad, start[1].detach(), end_qvel)

    def rewind(self) -> None:
        self._fine.rewind()
        self._coarse.rewind()
