"""Triangle meshes in graphics memory; each frame draws the chunks that pass frustum culling."""

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
    """A triangle mesh: `vertices` (N, F) float32 with F values each, `indices` (3 T,) uint32 of the
    vertices of T triangles, and `chunks`, the parts for culling."""

    vertices: NDArray[np.float32]
    indices: NDArray[np.uint32]
    chunks: "Chunks"


@dataclass(frozen=True)
class Chunks:
    """Parts of a mesh. Each part is culled as a whole, by the sphere round its bounding box. `low`
    and `high` (N, 3), m, are the least and greatest corners of the boxes. `first` and `count`
    (levels, N) are the first index and the number of indices of each part at each level of detail,
    finest first. Level k is drawn up to `reaches[k]` (m) from the eye."""

    low: FloatArray
    high: FloatArray
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    reaches: tuple[float, ...]
    nearest: float = 0.0
    """Chunks that lie completely nearer than this (m) are not drawn: a finer mesh covers them."""


class Mesh:
    """An indexed vertex array in graphics memory and its chunks. `layout` is moderngl's vertex
    format, followed by the names of the attributes."""

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
        """Return the runs (first index, number of indices) that are visible from `eye` (3,), m,
        world. `planes` (4, 3) are the inward normals of the side planes of the view."""
        found = visible_runs(self._spheres, *self._levels, eye, planes, self._runs)
        runs: list[list[int]] = self._runs[:found].tolist()
        return runs

    def draw(self, runs: list[list[int]], labels: bool) -> None:
        """Draw the `runs` (first index, number of indices), as depth and class if `labels`, else as
        colours."""
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
    """Create two vertex arrays over the same `vertices` and `indices`: the first draws colours, the
    second depth and class. `layout` is moderngl's vertex format, followed by the names of the
    attributes. Attributes that `program` does not use are skipped."""
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
