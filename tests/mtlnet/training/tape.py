"""The rules of a CUDA graph on a CPU: a step is recorded once, operation by operation, and
replayed.

As in a recording on a GPU, Python runs only once: a number or a branch of Python is then a constant
of the tape, and a tensor is read from the memory that the recording used. Operations for which a
GPU would have to wait or to copy from the host's memory are refused.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from mtlnet.training.losses.multi_task import Losses

REFUSED = (
    "_local_scalar_dense",  # Tensor.item(), float(tensor), if tensor
    "nonzero",
    "masked_select",
    "lift_fresh",  # torch.tensor([...]), a copy from the host's memory
    "is_nonzero",
)


class Tape(TorchDispatchMode):  # type: ignore[no-untyped-call]  # torch's
    """Within the context, operations run and are recorded; `replay` runs them on the same
    memory."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch's
        self.operations: list[tuple[Any, tuple[Any, ...], dict[str, Any], Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.name().removeprefix("aten::").split(".")[0]
        if name in REFUSED or (name in ("index", "index_put_") and _by_mask(args[1])):
            raise AssertionError(f"{func} cannot be part of a CUDA graph")
        result = func(*args, **kwargs)
        if not func.name().startswith("profiler"):
            self.operations.append((func, args, kwargs, result))
        return result

    @torch.no_grad()
    def replay(self) -> None:
        """Run the operations again; each result is written to the memory of the recorded one."""
        for func, args, kwargs, result in self.operations:
            again = func(*args, **kwargs)
            for new, old in zip(tree_leaves(again), tree_leaves(result), strict=True):
                if isinstance(new, Tensor) and new.data_ptr() != old.data_ptr():
                    old.copy_(new)


def _by_mask(indices: Any) -> bool:
    return any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in indices)


class TapeRecorder:
    """Replaces `mtlnet.training.cuda_graph.CudaRecorder`."""

    def __init__(self) -> None:
        self.ran = self.recorded = self.replayed = 0

    def run(self, work: Callable[[], Losses]) -> Losses:
        self.ran += 1
        return work()

    def record(self, work: Callable[[], Losses]) -> Callable[[], Losses]:
        """Unlike a GPU, a tape takes the step while it records, so the recording is the first
        replay."""
        self.recorded += 1
        tape = Tape()
        with tape:
            result = work()
        taken = True

        def again() -> Losses:
            nonlocal taken
            if not taken:
                tape.replay()
            taken = False
            self.replayed += 1
            return result

        return again
