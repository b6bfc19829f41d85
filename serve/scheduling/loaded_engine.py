"""Dataclasses of the frame queue's engines: the engine in use, and one that is to replace it."""

from collections.abc import Callable
from dataclasses import dataclass

import trackfeatures as tf
from mtlnet.inference.engine import Engine


@dataclass(frozen=True, slots=True)
class LoadedEngine:
    """An engine, and the members that identify it and its model in every answer."""

    engine: Engine
    provenance: dict[str, str]

    @classmethod
    def of(cls, engine: Engine) -> "LoadedEngine":
        """Combine `engine` with the members that identify it."""
        provenance = {
            "model": engine.card.model_hash,
            "definitions_version": tf.VERSION,
            "engine": engine.kind,
            "precision": engine.precision,
        }
        return cls(engine, provenance)


@dataclass(frozen=True, slots=True)
class StagedEngine:
    """An engine that replaces the current engine as soon as `is_committed()` is true."""

    loaded: LoadedEngine
    is_committed: Callable[[], bool]
