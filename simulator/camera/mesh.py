"""Meshes on the graphics card, drawn chunk by chunk where the eye can see them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from simulator.camera.context import Graphics

if TYPE_CHECKING:
    import moderngl

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Chunks:
    """Spheres round runs of indices: centres (N, 3), radii, first index and number of indices."""

    centres: FloatArray
    radii: FloatArray
    first: NDArray[np.int64]
    count: NDArray[np.int64]

    def seen(self, eye: FloatArray, planes: FloatArray, reach: float) -> list[tuple[int, int]]:
        """(first, count) runs that meet the frustum within `reach` m; neighbours are joined."""
        relative = self.centres - eye
        inside = relative @ planes.T > -self.radii[:, None]
        near = np.einsum("ij,ij->i", relative, relative) < (reach + self.radii) ** 2
        chosen = np.flatnonzero(inside.all(axis=1) & near)
        if len(chosen) == 0:
            return []
        breaks = np.flatnonzero(np.diff(chosen) > 1) + 1
        starts = chosen[np.concatenate(([0], breaks))]
        ends = chosen[np.concatenate((breaks - 1, [len(chosen) - 1]))]
        first = self.first[starts]
        count = self.first[ends] + self.count[ends] - first
        return list(zip(first.tolist(), count.tolist(), strict=True))


class Mesh:
    """One indexed vertex array with its chunks. `layout` is moderngl's format and names."""

    def __init__(
        self,
        graphics: Graphics,
        program: str,
        vertices: NDArray[np.float32],
        indices: NDArray[np.uint32],
        layout: Sequence[str],
        chunks: Chunks,
    ) -> None:
        context = graphics.context
        self._vertices = context.buffer(np.ascontiguousarray(vertices).tobytes())
        self._indices = context.buffer(np.ascontiguousarray(indices, dtype=np.uint32).tobytes())
        self._array: moderngl.VertexArray = context.vertex_array(
            graphics.programs[program],
            [(self._vertices, *layout)],
            index_buffer=self._indices,
            index_element_size=4,
        )
        self._chunks = chunks

    def draw(self, eye: FloatArray, planes: FloatArray, reach: float) -> int:
        """Draw what is seen within `reach` m; returns the number of indices drawn."""
        drawn = 0
        for first, count in self._chunks.seen(eye, planes, reach):
            self._array.render(vertices=count, first=first)
            drawn += count
        return drawn

    def release(self) -> None:
        """Free the graphics memory."""
        self._array.release()
        self._indices.release()
        self._vertices.release()
