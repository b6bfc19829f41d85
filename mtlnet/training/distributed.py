"""Lets several processes train one network: `torchrun --nproc-per-node N -m mtlnet train ...`.

Each process computes its part of every batch. Gradients, losses and the statistics of batch
normalisation are averaged, so that N processes take the same steps as one. Only the first process
writes files.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from trackfeatures.errors import UserError

TIMEOUT = timedelta(minutes=30)  # all other processes wait while the first publishes the model


@dataclass(frozen=True)
class Rank:
    """Numbers of this process in a distributed training: `index` of `world_size` processes on all
    machines, and `local_index` of `local_world_size` processes on this machine. Indices start at
    0."""

    index: int = 0
    world_size: int = 1
    local_index: int = 0
    local_world_size: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and messages."""
        return self.index == 0


SINGLE_PROCESS = Rank()


def read_rank() -> Rank:
    """Read the rank of this process from the environment variables that torchrun sets.

    Without these variables the result is `SINGLE_PROCESS`.
    """
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    values = [os.environ.get(name) for name in names]
    if None in values:
        return SINGLE_PROCESS
    return Rank(*(int(value or 0) for value in values))


@contextmanager
def process_group(rank: Rank, device: torch.device, batch: int) -> Iterator[None]:
    """Connect the processes of a distributed training for the duration of the context; does nothing
    for a single process.

    Raises UserError when `batch`, the images per step, cannot be divided among the processes.
    """
    if rank.world_size == 1:
        yield
        return
    if batch % rank.world_size:
        raise UserError(
            f"--batch {batch} cannot be divided among {rank.world_size} processes; give a multiple "
            f"of {rank.world_size}"
        )
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=TIMEOUT)
    try:
        yield
    finally:
        dist.destroy_process_group()


def dropout_seed(seed: int, rank: int, step: int = 0) -> int:
    """Compute the seed of torch's generators in process `rank`, for a run that starts or resumes at
    `step`.

    The seed differs between processes, because equal seeds would give the same dropout masks to
    different images. The first process of a new run uses `seed` itself.
    """
    if rank == step == 0:
        return seed
    return int(np.random.SeedSequence([seed, rank, step]).generate_state(1, np.uint64)[0] >> 1)


def average(tensors: Sequence[Tensor]) -> None:
    """Replace the values of each tensor by their means over all processes, in one all-reduce."""
    if not dist.is_initialized():
        return
    flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    begin = 0
    for tensor in tensors:
        tensor.copy_(flat[begin : begin + tensor.numel()].view(tensor.shape))
        begin += tensor.numel()


def broadcast(values: Sequence[float], device: torch.device) -> list[float]:
    """Send the `values` of the first process to all processes and return them, so that all
    processes make the same decisions."""
    if not dist.is_initialized():
        return list(values)
    tensor = torch.tensor(values, dtype=torch.float64, device=device)
    dist.broadcast(tensor, 0)
    return [float(value) for value in tensor]


def barrier() -> None:
    """Wait until all processes reach this point."""
    if dist.is_initialized():
        dist.barrier()
