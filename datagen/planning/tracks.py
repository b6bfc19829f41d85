"""The tracks of a collection: the project's and TORCS's, without those held out of training."""

from pathlib import Path

from datagen.planning.config import TrackChoice
from simulator.track.catalogue import OWN_TRACKS, find_track, track_files
from simulator.track.random_roads.road import RANDOM
from trackfeatures.errors import UserError

HELD_OUT = ("coast", "countryside", "dirt-3", "e-track-4")
"""Two tracks of the project and two of TORCS. A training plan uses them only if it names them; the
split `unseen` consists of them."""


def choose_tracks(
    names: tuple[str, ...], tracks_dir: Path | None, unseen: bool = False
) -> tuple[TrackChoice, ...]:
    """The named tracks. Without names: the project's and all TORCS tracks found, not `HELD_OUT`.

    With `unseen`: the tracks of `HELD_OUT` that are found, or named tracks outside training plans.
    `random` is kept as it is: each round will have a random road of its own, which no other round
    has. Raises UnknownTrack for a name that is not found, TrackError for a bad file, UserError for
    a training track given as unseen.
    """
    files = track_files(tracks_dir)
    held_out = tuple(name for name in HELD_OUT if name in files)
    usual = tuple(sorted(n for n, file in files.items() if _trained_on(file)))
    if unseen and (seen := set(names) & set(usual)):
        raise UserError(f"track {min(seen)} is one of those to train on; choose another as unseen")
    chosen = names or (held_out if unseen else usual)
    return tuple(_choice(name, tracks_dir) for name in chosen)


def _choice(name: str, tracks_dir: Path | None) -> TrackChoice:
    if name == RANDOM:
        return TrackChoice(name, content_hash="")
    return TrackChoice(name, find_track(name, tracks_dir).content_hash)


def _trained_on(file: Path) -> bool:
    """Whether a plan without names uses the track; a user's own tracks must be named."""
    ours = file.parent == OWN_TRACKS
    return file.stem not in HELD_OUT and (ours or file.suffix.lower() == ".xml")
