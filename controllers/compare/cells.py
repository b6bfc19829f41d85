"""The cells of a comparison: the settings by which its drives differ."""

from dataclasses import dataclass

from controllers.compare.config import CompareConfig
from controllers.drive.disturbance import DISTURBANCES, UNDISTURBED
from trackfeatures.errors import UserError


@dataclass(frozen=True)
class Cell:
    """The settings that identify one drive of a comparison."""

    track: str
    controller: str
    perception: str
    disturbance: str
    seed: int

    @property
    def name(self) -> str:
        changed = "" if self.disturbance == UNDISTURBED else f", {self.disturbance}"
        return f"{self.controller} on {self.track}, {self.perception}{changed}, seed {self.seed}"


def cells(config: CompareConfig) -> list[Cell]:
    """Return the cells of all drives, ordered by track. Raises UserError if there is no seed, or no
    name in an option that lists tracks, perceptions or controllers."""
    if config.seeds < 1:
        raise UserError(f"{config.seeds} seeds; give 1 or more")
    disturbances = list(DISTURBANCES) if config.disturb else [UNDISTURBED]
    return [
        Cell(track, controller, perception, disturbance, seed)
        for track in names(config.tracks, "tracks")
        for perception in names(config.perceptions, "perceptions")
        for disturbance in disturbances
        for controller in names(config.controllers, "controllers")
        for seed in range(config.seeds)
    ]


def names(text: str, what: str) -> list[str]:
    """Return the names in `text`, separated by commas, without repetition. Raises UserError if
    there is no name; `what` is the name of the option."""
    found = list(dict.fromkeys(filter(None, (name.strip() for name in text.split(",")))))
    if not found:
        raise UserError(f"--{what} names nothing; give names with commas between them")
    return found
