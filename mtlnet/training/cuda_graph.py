"""Records a training step as a CUDA graph and replays it, which takes one launch instead of
hundreds.

A replay uses the memory of the recording. Therefore each batch is copied into the memory of the
first batch, and values that change at every step, such as the learning rate, are tensors on the
device. Values that seldom change, such as the number of frozen layers, are constants of the
recording. When a constant changes, the step is recorded again; in a run of recipe `fast` this
happens twice.
"""

from collections.abc import Callable
from dataclasses import fields
from typing import Protocol

import torch

from mtlnet.data.gpu_cache import DeviceBatch
from mtlnet.training.losses.multi_task import Losses

WARM_UP = 3
"""Number of steps before each recording. Memory is allocated and kernels are loaded in these steps,
so that the recording does not contain either."""

Work = Callable[[], Losses]


class Recorder(Protocol):
    """Interface that runs a training step or records it."""

    def run(self, work: Work) -> Losses:
        """Run `work` now, on the stream on which it will be recorded."""

    def record(self, work: Work) -> Work:
        """Record `work` without running it, and return a function that runs it on the memory that
        it used when it was recorded."""


class CudaRecorder:
    """Runs and records on a CUDA stream of its own, which torch.cuda.graph requires for backward
    passes."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]  # torch's

    def run(self, work: Work) -> Losses:
        current = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            losses = work()
        current.wait_stream(self._stream)
        return losses

    def record(self, work: Work) -> Work:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=self._stream):
            result = work()

        def replay() -> Losses:
            graph.replay()
            return result

        return replay


class CudaGraphStep:
    """Runs `work`, a training step, on batches of one shape: three times directly at the start and
    after each change of its constants, then as a recorded graph."""

    def __init__(self, work: Callable[[DeviceBatch], Losses], recorder: Recorder) -> None:
        self._work = work
        self._recorder = recorder
        self._batch: DeviceBatch | None = None
        self._warm_up_left = WARM_UP
        self._constants: object = None
        """The argument `constants` of the last call."""
        self._replay: Work | None = None

    def __call__(self, batch: DeviceBatch, constants: object) -> Losses:
        """Run `work` on `batch`, directly or as a replay, and return its losses.

        `constants`: Python values on which `work` depends; a change (by ==) causes a new recording.
        """
        static = self._copy_in(batch)
        if constants != self._constants:
            self._replay = None  # frees the old graph's memory before the next recording
            self._constants, self._warm_up_left = constants, WARM_UP
        if self._warm_up_left:
            self._warm_up_left -= 1
            return self._recorder.run(lambda: self._work(static))
        if self._replay is None:
            self._replay = self._recorder.record(lambda: self._work(static))
        losses = self._replay()
        # Copies, because the next replay overwrites the tensors of the graph.
        return Losses(*(getattr(losses, f.name).detach().clone() for f in fields(Losses)))

    def _copy_in(self, batch: DeviceBatch) -> DeviceBatch:
        """Copy `batch` into the memory of the first batch, and return this copy."""
        if self._batch is None:
            self._batch = DeviceBatch(
                *(getattr(batch, f.name).clone() for f in fields(DeviceBatch))
            )
            return self._batch
        for field in fields(DeviceBatch):
            getattr(self._batch, field.name).copy_(getattr(batch, field.name))
        return self._batch
