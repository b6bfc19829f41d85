"""Trees on the graphics card: the nearest seen ones, drawn from far to near and blended."""

import numpy as np
from numpy.typing import NDArray

from simulator.camera.context import Graphics
from simulator.camera.scenery import Trees

FloatArray = NDArray[np.float64]

REACH_M = 420.0
MOST = 160
"""Trees drawn at once; the farthest are left out."""
_CORNERS = np.array([[-0.5, 0.0], [0.5, 0.0], [-0.5, 1.0], [0.5, 1.0]], dtype=np.float32)
_QUAD = np.array([0, 1, 2, 2, 1, 3])


class Woods:
    """All trees of a scene."""

    def __init__(self, graphics: Graphics, trees: Trees) -> None:
        self._feet = trees.feet
        self._size = np.maximum(trees.width, trees.height)
        count = len(trees.feet)
        vertices = np.empty((count, 4, 11), dtype=np.float32)
        vertices[:, :, 0:3] = trees.feet[:, None]
        vertices[:, :, 3] = trees.width[:, None]
        vertices[:, :, 4] = trees.height[:, None]
        vertices[:, :, 5] = trees.cell[:, None]
        vertices[:, :, 6:9] = trees.tint[:, None]
        vertices[:, :, 9:11] = _CORNERS
        context = graphics.context
        self._context = context
        self._vertices = context.buffer(vertices.tobytes() or bytes(4))
        self._indices = context.buffer(reserve=MOST * 6 * 4, dynamic=True)
        self._array = context.vertex_array(
            graphics.programs["tree"],
            [(self._vertices, "3f 3f 3f 2f", "at", "shape", "tint", "corner")],
            index_buffer=self._indices,
            index_element_size=4,
        )

    def draw(self, eye: FloatArray, planes: FloatArray) -> None:
        """Draw the trees that are seen; what is opaque must have been drawn before."""
        relative = self._feet - eye
        squared = np.einsum("ij,ij->i", relative, relative)
        near = np.flatnonzero(squared < REACH_M * REACH_M)
        inside = (relative[near] @ planes.T > -self._size[near, None]).all(axis=1)
        seen = near[inside]
        order = seen[np.argsort(-squared[seen], kind="stable")][-MOST:]
        if len(order) == 0:
            return
        indices = (order[:, None] * 4 + _QUAD).astype(np.uint32)
        self._indices.orphan()
        self._indices.write(indices.tobytes())
        self._array.render(vertices=indices.size)

    def release(self) -> None:
        """Free the graphics memory."""
        self._array.release()
        self._indices.release()
        self._vertices.release()
