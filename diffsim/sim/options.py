"""Options of a simulator, and their checks."""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from diffsim.sim.integration import Integration, check_count

WARP_DTYPE = {torch.float32: wp.float32, torch.float64: wp.float64}
BLOCKS = (1, 8, 16)


class Options(NamedTuple):
    """Options of a simulation that do not depend on num_envs.

    Attributes:
        integration: contact model and substeps.
        device: "cpu" or a CUDA device.
        dtype: torch.float32 or torch.float64.
        threads: CPU threads of the kernels; default as many as have enough to do, up to all cores.
        factors: let constants of the scene differ between environments: Simulator.factors.
        forces: let external forces act on the bodies: Simulator.forces.
        block: environments that a CPU thread steps at once in vectors of float32, 1, 8 or 16; default the fastest.
        division: (threads_per_env, sharers) of kernels.lanes.divide, how GPU threads share an environment; default the
            fastest as measured.
    """

    integration: Integration = Integration()
    device: str | torch.device = "cpu"
    dtype: torch.dtype = torch.float32
    threads: int | None = None
    factors: bool = False
    forces: bool = False
    block: int | None = None
    division: tuple[int, int] | None = None

    def check(self) -> Options:
        """Return itself with plain types; raises ValueError, with what is allowed, for an invalid field."""
        device, dtype = check_device(self.device), check_dtype(self.dtype)
        block = None if self.block is None else check_count("block", self.block)
        if block not in (None, *BLOCKS):
            raise ValueError(f"block is {block}, must be 1, 8 or 16")
        if (block or 1) > 1 and (device.type == "cuda" or dtype == torch.float64):
            raise ValueError(f"block is {block}, must be 1 on a GPU and in float64")
        return self._replace(
            integration=self.integration.check(),
            device=device,
            dtype=dtype,
            block=block,
            threads=None if self.threads is None else check_count("threads", self.threads),
        )


def check_dtype(dtype: torch.dtype) -> torch.dtype:
    """Return the dtype; raises ValueError unless the kernels support it."""
    if dtype not in WARP_DTYPE:
        raise ValueError(f"dtype is {dtype!r}, must be torch.float32 or torch.float64")
    return dtype


def check_device(device: str | torch.device) -> torch.device:
    """Return the device, with an index if it is a GPU; raises ValueError unless it is the CPU or a present GPU."""
    try:
        result = torch.device("none" if device is None else device)  # torch takes None for its default device
    except (RuntimeError, TypeError):
        result = None
    if result is None or result.type not in ("cpu", "cuda"):
        raise ValueError(f"unknown device {str(device)!r}; choose cpu or cuda")
    if result.type == "cuda":
        if (result.index or 0) >= (count := torch.cuda.device_count()):
            raise ValueError(f"device {str(device)!r} asked for, but PyTorch sees {count} CUDA GPUs here; choose cpu")
        result = torch.device("cuda", torch.cuda.current_device() if result.index is None else result.index)
    return result
