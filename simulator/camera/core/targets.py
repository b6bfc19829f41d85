"""Framebuffers to draw colours, or depth and class, and functions to read them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.render_modes import CLASSES
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    import moderngl

GPU_SAMPLES = 4
"""Samples per pixel on a GPU. On llvmpipe there is one sample per pixel, because four samples took
24 ms per frame instead of 6 ms, and the shaders antialias road and paint in any case."""
_KEPT = 16
_SKY = float(CLASSES.index("sky"))


@dataclass(frozen=True)
class Target:
    """The framebuffer `drawn`, in which the scene is drawn, and the framebuffer `resolved`, which
    is read. Without multisampling both are the same object."""

    drawn: "moderngl.Framebuffer"
    resolved: "moderngl.Framebuffer"

    def clear(self, labels: bool) -> None:
        """Bind the framebuffer and clear it. If `labels` is true, it is cleared to infinite depth
        and the class "sky", otherwise to 0."""
        self.drawn.use()
        if labels:
            self.drawn.clear(np.inf, _SKY)
        else:
            self.drawn.clear()

    def colours(self) -> NDArray[np.uint8]:
        """Return the drawn picture (height, width, 3) uint8 RGB."""
        if self.resolved is not self.drawn:
            self.drawn.ctx.copy_framebuffer(self.resolved, self.drawn)
        width, height = self.resolved.size
        read = np.empty((height, width, 4), np.uint8)
        self.resolved.read_into(read, components=4)
        # The alpha channel is read too, because Mesa takes twice as long without it.
        return np.asarray(cv2.cvtColor(read, cv2.COLOR_RGBA2RGB), dtype=np.uint8)

    def labels(self) -> NDArray[np.float32]:
        """Return the drawn labels (height, width, 2): depth in metres and class number."""
        width, height = self.resolved.size
        read = np.empty((height, width, 2), np.float32)
        self.resolved.read_into(read, components=2, dtype="f4")
        return read


class Targets:
    """A cache of the targets of one context, by size and by content (colours or labels). It keeps
    at most 16 targets."""

    def __init__(self, context: "moderngl.Context", samples: int) -> None:
        self._context, self._samples = context, samples
        self._kept: dict[tuple[int, int, bool], Target] = {}

    def of(self, width: int, height: int, labels: bool) -> Target:
        """Return the target of this size, created at first use; `labels` selects depth and class.
        Raises UserError if it cannot be created."""
        key = (width, height, labels)
        if key not in self._kept:
            if len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
                self._context.gc()
            self._kept[key] = self._make(*key)
        return self._kept[key]

    def _make(self, width: int, height: int, labels: bool) -> Target:
        """Create the framebuffers for colours (RGBA, 8 bit) or labels (2 x float32)."""
        import moderngl

        size = (width, height)
        # Depths and classes must not be averaged.
        samples = 0 if labels else self._samples
        components, dtype = (2, "f4") if labels else (4, "f1")
        try:
            drawn = self._context.framebuffer(
                [self._context.renderbuffer(size, components, samples=samples, dtype=dtype)],
                self._context.depth_renderbuffer(size, samples=samples),
            )
            resolved = drawn
            if samples:
                resolved = self._context.framebuffer([self._context.renderbuffer(size, 4)])
        except moderngl.Error as error:
            raise UserError(f"cannot draw pictures of {width} x {height}: {error}") from error
        return Target(drawn, resolved)
