"""Data-parallel training by torchrun: the same code runs as a single process or as one of several ranks."""

from __future__ import annotations

import os
from typing import Any

import torch
import torch.distributed as dist

from diffsim.training import graph

RANK_SEED = 1_000_003  # between the seeds of two ranks


def choose_device(device: str) -> str:
    """The device of this process: of several ranks each takes its own GPU."""
    return f"cuda:{os.environ['LOCAL_RANK']}" if device == "cuda" and "LOCAL_RANK" in os.environ else device


def initialize(device: torch.device) -> None:
    """Connect to the other ranks if torchrun started this process: NCCL on GPUs, gloo on the CPU."""
    if "LOCAL_RANK" in os.environ and not dist.is_initialized():
        if device.type == "cuda":
            torch.cuda.set_device(device)
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")


def finalize() -> None:
    """Disconnect from the other ranks. NCCL waits for CUDA graphs that hold its operations, so they are freed first."""
    if dist.is_initialized():
        graph.release()
        dist.destroy_process_group()


def rank() -> int:
    return dist.get_rank() if dist.is_initialized() else int(os.environ.get("RANK", 0))


def size() -> int:
    return dist.get_world_size() if dist.is_initialized() else int(os.environ.get("WORLD_SIZE", 1))


def own_seed(seed: int) -> int:
    """Return this rank's seed: ranks draw different random numbers."""
    return seed + rank() * RANK_SEED


def generator(device: torch.device) -> torch.Generator:
    """Return the generator of a device from which torch draws by default."""
    return torch.cuda.default_generators[device.index] if device.type == "cuda" else torch.default_generator


def average(tensor: torch.Tensor) -> torch.Tensor:
    """The mean of the tensor over all ranks, in place; it does not wait for the device and can be captured."""
    if dist.is_initialized():
        dist.all_reduce(tensor)
        tensor /= dist.get_world_size()
    return tensor


def gather(value: Any) -> list[Any]:
    """The values of all ranks, in the order of the ranks."""
    if not dist.is_initialized():
        return [value]
    values: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(values, value)
    return values
