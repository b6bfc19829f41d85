"""Triangle meshes in graphics memory, drawn by chunks that pass frustum culling."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.core.context import Graphics
from simulator.camera.core.frustum_culling import visible_runs

if TYPE_CHECKING:
    import moderngl


@dataclass(frozen=True)
class Surface:
    """Triangles ready to draw: `vertices` (N, F) float32, `indices` uint32, chunks to cull by."""

    vertices: NDArray[np.float32]
    indices: NDArray[np.uint32]
    chunks: "Chunks"


@dataclass(frozen=True)
class Chunks:
    """Runs of indices that are culled together, by the spheres round their bounding boxes. `low`,
    `high` (N, 3): corners of the boxes. `first`, `count` (levels, N): first index and number of
    indices at each level of detail, finest first. Level k is drawn up to `reaches[k]` m."""

    low: FloatArray
    high: FloatArray
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    reaches: tuple[float, ...]
    nearest: float = 0.0
    """m; chunks that lie wholly nearer than this are not drawn, since a finer mesh covers them."""


class Mesh:
    """One indexed vertex array and its chunks, the parts that culling draws or skips. `layout` is
    the vertex format and the attribute names, as moderngl takes them."""

    def __init__(
        self,
        graphics: Graphics,
        program: str,
        surface: Surface,
        layout: Sequence[str],
    ) -> None:
        context = graphics.context
        vertices = context.buffer(np.ascontiguousarray(surface.vertices).tobytes())
        indices = context.buffer(np.ascontiguousarray(surface.indices).tobytes())
        self._arrays = vertex_arrays(graphics, program, vertices, indices, layout)
        chunks = surface.chunks
        radii = np.linalg.norm(chunks.high - chunks.low, axis=1) / 2.0
        self._spheres = np.column_stack([(chunks.low + chunks.high) / 2.0, radii])
        self._levels = chunks.first, chunks.count, np.array(chunks.reaches), chunks.nearest
        self._runs = np.empty((len(self._spheres), 2), dtype=np.int64)

    def visible(self, eye: FloatArray, planes: FloatArray) -> list[list[int]]:
        """Frustum culling: the (first, count) runs of indices visible from `eye` (3,)."""
        found = visible_runs(self._spheres, *self._levels, eye, planes, self._runs)
        runs: list[list[int]] = self._runs[:found].tolist()
        return runs

    def draw(self, runs: list[list[int]], labels: bool) -> None:
        """Draw the visible runs, as depth and class (`labels`) or in colour."""
        array = self._arrays[labels]
        for first, count in runs:
            array.render(vertices=count, first=first)


def vertex_arrays(
    graphics: Graphics,
    program: str,
    vertices: "moderngl.Buffer",
    indices: "moderngl.Buffer | None",
    layout: Sequence[str],
) -> "tuple[moderngl.VertexArray, moderngl.VertexArray]":
    """Two vertex arrays over the same vertices: the first draws colours, the second depth and
    class. Vertex attributes that a program does not use are skipped."""
    drawn, labelled = (
        graphics.context.vertex_array(
            graphics.programs[name],
            [(vertices, *layout)],
            index_buffer=indices,
            index_element_size=4,
            skip_errors=True,
        )
        for name in (program, graphics.label_program(program))
    )
    return drawn, labelled
