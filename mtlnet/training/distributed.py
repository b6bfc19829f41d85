"""Several processes that train one network: `torchrun --nproc-per-node N -m mtlnet train ...`.

Each makes its part of every batch; gradients, losses and the statistics of batch normalisation are
averaged, so that N processes take the steps of one. The first process alone writes.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

from trackfeatures.errors import UserError

PATIENCE = timedelta(minutes=30)  # while the first process exports, the others wait


@dataclass(frozen=True)
class Part:
    """Which of how many processes this is; `local` of them share this machine."""

    rank: int = 0
    world: int = 1
    local_rank: int = 0
    local: int = 1

    @property
    def first(self) -> bool:
        """Whether this process writes and speaks."""
        return self.rank == 0


ALONE = Part()


def find_part() -> Part:
    """This process's part as torchrun told it; the only one without torchrun."""
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    values = [os.environ.get(name) for name in names]
    if None in values:
        return Part()
    return Part(*(int(value or 0) for value in values))


@contextmanager
def joined(part: Part, device: torch.device, batch: int) -> Iterator[None]:
    """Joined with the other processes; UserError when the batch does not divide among them."""
    if part.world == 1:
        yield
        return
    if batch % part.world:
        raise UserError(
            f"--batch {batch} does not divide among {part.world} processes; give a multiple of it"
        )
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=PATIENCE)
    try:
        yield
    finally:
        dist.destroy_process_group()


def average(tensors: Sequence[Tensor]) -> None:
    """Replace tensors by their means over all processes, in one message."""
    if not dist.is_initialized():
        return
    flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    begin = 0
    for tensor in tensors:
        tensor.copy_(flat[begin : begin + tensor.numel()].view(tensor.shape))
        begin += tensor.numel()


def agree(values: Sequence[float], device: torch.device) -> list[float]:
    """The first process's values, for decisions that all must take alike."""
    if not dist.is_initialized():
        return list(values)
    tensor = torch.tensor(values, dtype=torch.float64, device=device)
    dist.broadcast(tensor, 0)
    return [float(value) for value in tensor]


def wait() -> None:
    """Wait for the others."""
    if dist.is_initialized():
        dist.barrier()
