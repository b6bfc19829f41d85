"""A training step recorded once as a CUDA graph and then replayed: one launch in place of hundreds.

What the step computes with must be the same memory every time, so each batch is copied into the
first one's; and numbers that it holds (the learning rate) are part of the recording, so that it is
recorded anew when they change: every 10,000 steps in recipe `paper`.
"""

from collections.abc import Callable
from dataclasses import fields
from typing import Protocol

import torch

from mtlnet.data.gpu_cache import DeviceBatch
from mtlnet.training.loss import Losses

WARM_UP = 3  # steps taken as they are: what is made at the first step is not made in the graph

Work = Callable[[], Losses]


class Recorder(Protocol):
    """What runs a piece of work, and what records it."""

    def run(self, work: Work) -> Losses:
        """Do it now, where it will be recorded later."""

    def record(self, work: Work) -> Work:
        """What does `work` again, on the same memory; it is not done now."""


class CudaRecorder:
    """Records on a stream of its own, as torch.cuda.graph asks for backward passes."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]  # torch's

    def run(self, work: Work) -> Losses:
        here = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(here)
        with torch.cuda.stream(self._stream):
            done = work()
        here.wait_stream(self._stream)
        return done

    def record(self, work: Work) -> Work:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=self._stream):
            result = work()

        def replay() -> Losses:
            graph.replay()
            return result

        return replay


class CudaGraphStep:
    """`work` on one batch after the other: the first ones as they are, then as recorded."""

    def __init__(self, work: Callable[[DeviceBatch], Losses], recorder: Recorder) -> None:
        self._work = work
        self._recorder = recorder
        self._batch: DeviceBatch | None = None
        self._left = WARM_UP
        self._constants: object = None
        self._replay: Work | None = None

    def __call__(self, batch: DeviceBatch, constants: object) -> Losses:
        """The losses of `work(batch)`; `constants`: what else it depends on, compared by ==."""
        held = self._hold(batch)
        if self._left:
            self._left -= 1
            return self._recorder.run(lambda: self._work(held))
        if self._replay is None or constants != self._constants:
            self._replay = None  # its memory is free for the next one's
            self._replay = self._recorder.record(lambda: self._work(held))
            self._constants = constants
        losses = self._replay()
        # Those of the recording are overwritten by the next replay.
        return Losses(*(getattr(losses, f.name).detach().clone() for f in fields(Losses)))

    def _hold(self, batch: DeviceBatch) -> DeviceBatch:
        """The batch, in the memory of the first."""
        if self._batch is None:
            self._batch = DeviceBatch(
                *(getattr(batch, f.name).clone() for f in fields(DeviceBatch))
            )
            return self._batch
        for field in fields(DeviceBatch):
            getattr(self._batch, field.name).copy_(getattr(batch, field.name))
        return self._batch
