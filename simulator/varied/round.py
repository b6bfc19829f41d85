"""The random values of one round of `--roads varied`: its road, and the look of each scene."""

from dataclasses import dataclass
from typing import Any

from simulator.varied.carriageway import Carriageway
from simulator.varied.draw import rebuilt
from simulator.varied.look import RoadLook


@dataclass(frozen=True, slots=True)
class VariedRound:
    """The road of one round, and the looks of its scenes in order."""

    carriageway: Carriageway
    scenes: tuple[RoadLook, ...]

    @staticmethod
    def drawn(seed: int, lanes: int, scenes: int, model_height_m: float) -> "VariedRound":
        """Return the round with `seed`, with `lanes` lanes and `scenes` scenes. The model's camera
        is `model_height_m` (m) above the road."""
        looks = tuple(RoadLook.drawn(seed, scene) for scene in range(scenes))
        return VariedRound(Carriageway.drawn(seed, lanes, model_height_m), looks)

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "VariedRound":
        """Return the round whose `dataclasses.asdict` is `values`, also after a round trip through
        JSON. Raises KeyError, TypeError or ValueError if a field is unknown or a required field is
        missing."""
        found: VariedRound = rebuilt(VariedRound, values)
        return found
