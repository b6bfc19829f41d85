"""Dataclasses of the frame queue's engines: the engine in use, and one that is to replace it, each
with the cameras that clients can name."""

from collections.abc import Callable
from dataclasses import dataclass

import trackfeatures as tf
from mtlnet.inference.engine import Engine
from mtlnet.inference.rectification import Rectification, shown_shares
from serve.cameras import Cameras
from trackfeatures.camera import CameraParameters


@dataclass(frozen=True, slots=True)
class LoadedEngine:
    """An engine, the members that identify it and its model in every answer, and the cameras that
    clients can name. Values that a camera's file omits come from this model's camera."""

    engine: Engine
    provenance: dict[str, str]
    cameras: Cameras
    view: CameraParameters
    """The model's camera."""

    def rectification(self, camera: str) -> Rectification:
        """Return the conversion from the camera of this name to the model's camera."""
        return Rectification(self.cameras[camera], self.view)

    @classmethod
    def of(cls, engine: Engine, cameras: Cameras) -> "LoadedEngine":
        """Combine `engine` with the members that identify it, and with `cameras`."""
        provenance = {
            "model": engine.card.model_hash,
            "definitions_version": tf.VERSION,
            "engine": engine.kind,
            "precision": engine.precision,
        }
        # Computed and kept here, because a frame's size is checked in the event loop.
        for camera in cameras.values():
            shown_shares(camera, engine.card.camera)
        return cls(engine, provenance, cameras, engine.card.camera)


@dataclass(frozen=True, slots=True)
class StagedEngine:
    """An engine that replaces the current engine as soon as `is_committed()` is true."""

    loaded: LoadedEngine
    is_committed: Callable[[], bool]
