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
class Surface:
    """Triangles ready to draw: `vertices` (N, F) float32, `indices` uint32, chunks to cull by."""

    vertices: NDArray[np.float32]
    indices: NDArray[np.uint32]
    chunks: "Chunks"


@dataclass(frozen=True)
class Chunks:
    """Spheres round runs of indices: centres (N, 3), radii (N,), and one row of first index and
    number of indices a level of detail, (levels, N), the finest first."""

    centres: FloatArray
    radii: FloatArray
    first: NDArray[np.int64]
    count: NDArray[np.int64]

    def seen(
        self, eye: FloatArray, planes: FloatArray, reaches: Sequence[float]
    ) -> list[tuple[int, int]]:
        """(first, count) runs that meet the frustum; level k is drawn up to reaches[k] m."""
        relative = self.centres - eye
        inside = (relative @ planes.T > -self.radii[:, None]).all(axis=1)
        distance = np.sqrt(np.einsum("ij,ij->i", relative, relative)) - self.radii
        level = np.searchsorted(np.asarray(reaches), distance)
        runs: list[tuple[int, int]] = []
        for k in range(len(reaches)):
            runs += _joined(np.flatnonzero(inside & (level == k)), self.first[k], self.count[k])
        return runs


def _joined(
    chosen: NDArray[np.intp], first: NDArray[np.int64], count: NDArray[np.int64]
) -> list[tuple[int, int]]:
    """Runs of indices of the chosen chunks, neighbours in one run."""
    if len(chosen) == 0:
        return []
    breaks = np.flatnonzero(np.diff(chosen) > 1)
    starts = chosen[np.concatenate(([0], breaks + 1))]
    ends = chosen[np.concatenate((breaks, [len(chosen) - 1]))]
    sizes = first[ends] + count[ends] - first[starts]
    return list(zip(first[starts].tolist(), sizes.tolist(), strict=True))


class Mesh:
    """One indexed vertex array with its chunks. `layout` is moderngl's format and names."""

    def __init__(
        self,
        graphics: Graphics,
        program: str,
        surface: Surface,
        layout: Sequence[str],
    ) -> None:
        context = graphics.context
        self._vertices = context.buffer(np.ascontiguousarray(surface.vertices).tobytes())
        self._indices = context.buffer(np.ascontiguousarray(surface.indices).tobytes())
        self._array: moderngl.VertexArray = context.vertex_array(
            graphics.programs[program],
            [(self._vertices, *layout)],
            index_buffer=self._indices,
            index_element_size=4,
        )
        self._chunks = surface.chunks

    def draw(self, eye: FloatArray, planes: FloatArray, *reaches: float) -> None:
        """Draw the chunks that are seen, each level of detail up to its reach (m)."""
        for first, count in self._chunks.seen(eye, planes, reaches):
            self._array.render(vertices=count, first=first)

    def release(self) -> None:
        """Free the graphics memory."""
        self._array.release()
        self._indices.release()
        self._vertices.release()
