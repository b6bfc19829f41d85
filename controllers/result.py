"""What a drive amounts to."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class DriveResult:
    """A drive's score and the figures that belong beside it."""

    steps: int
    """Control steps driven: those asked for, unless the drive ended."""
    steps_asked: int
    score: float
    """Sum of the reward over the steps asked for; an ending step gives -2, those after it 0."""
    score_per_step: float
    """`score` over `steps_asked`."""
    laps: int
    """Whole laps, from crossing the line to crossing it again."""
    distance_m: float
    """Way made by the car."""
    mean_abs_d_m: float
    """Mean distance from the centre of the lane to follow."""
    max_abs_d_m: float
    speed_kmh: tuple[float, float]
    """Slowest and fastest, the standing start included."""
    cruising_kmh: tuple[float, float] | None
    """The same without the first 15 s; None for a shorter drive."""
    blind_steps: int
    """Steps without a perceived offset."""
    noisy: bool
    """Whether noise was added to the state."""
    ended: str | None
    """Why it ended early: off_track (touching a wall too), backwards, or collision (with a car)."""

    def as_json(self) -> dict[str, Any]:
        values = asdict(self)
        values["speed_kmh"] = list(self.speed_kmh)
        if self.cruising_kmh is not None:
            values["cruising_kmh"] = list(self.cruising_kmh)
        return values
