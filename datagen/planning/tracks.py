"""The tracks that a collection drives on: our own and TORCS's, less those held out of training."""

from pathlib import Path

from datagen.planning.config import TrackChoice
from simulator.track.catalogue import OWN_TRACKS, find_track, track_files
from simulator.track.random_roads.road import RANDOM
from trackfeatures.errors import UserError

HELD_OUT = ("coast", "countryside", "dirt-3", "e-track-4")
"""Two of our own and two of TORCS: in no training plan unless they are named. The split `unseen` is
of them."""


def choose_tracks(
    names: tuple[str, ...], tracks_dir: Path | None, unseen: bool = False
) -> tuple[TrackChoice, ...]:
    """The named tracks. Without names: our own and all of TORCS that are found, not `HELD_OUT`.

    With `unseen`: those of `HELD_OUT` that are found, or named ones that are not trained on.
    `random` is kept as it is: each round will have a random road of its own, unseen by all others.
    Raises UnknownTrack for a name that is not found, TrackError for a bad file, UserError for a
    training track given as unseen.
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
    """By default. A user's own TOML or CSV track is driven on only when it is named."""
    ours = file.parent == OWN_TRACKS
    return file.stem not in HELD_OUT and (ours or file.suffix.lower() == ".xml")
