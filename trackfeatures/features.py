"""The track features of one moment."""

from dataclasses import dataclass

from trackfeatures.definitions import Heading


@dataclass(frozen=True, slots=True)
class TrackFeatures:
    """Distances to markings (m, left negative, None where absent), heading angle (rad, positive
    when the car points to the right of the track), class of the track's heading."""

    ml: float | None
    mr: float | None
    l: float | None
    m: float | None
    r: float | None
    angle: float
    heading: Heading

    @property
    def distances(self) -> dict[str, float | None]:
        """The five distances by name, in the order of `MARKINGS`."""
        return {"ml": self.ml, "mr": self.mr, "l": self.l, "m": self.m, "r": self.r}

    @property
    def to_lane_centre(self) -> float | None:
        """Offset from the centre of the lane the car is in or nearest to (m, left positive)."""
        if self.ml is not None and self.mr is not None:
            return (self.ml + self.mr) / 2
        if self.m is None:
            return None
        # A marking on the car's left has the car's lane on its right, and the other way round.
        first, second = (self.r, self.l) if self.m <= 0 else (self.l, self.r)
        neighbour = first if first is not None else second
        return None if neighbour is None else (self.m + neighbour) / 2
