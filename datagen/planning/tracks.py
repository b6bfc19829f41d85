"""Chooses the tracks of a collection. By default these are all tracks of the project and of TORCS
except four tracks that are held out of training."""

from pathlib import Path

from datagen.planning.config import TrackChoice
from simulator.track.catalogue import OWN_TRACKS, find_track, track_files
from simulator.track.random_roads.road import RANDOM
from trackfeatures.errors import UserError

HELD_OUT = ("coast", "countryside", "dirt-3", "e-track-4")
"""Two tracks of the project and two of TORCS. A plan for training uses them only if the user names
them. A plan with `--split unseen` uses only them by default."""


def choose_tracks(
    names: tuple[str, ...], tracks_dir: Path | None, unseen: bool = False
) -> tuple[TrackChoice, ...]:
    """Return the named tracks with their hashes.

    Without names: all tracks of the project and of TORCS that are found, except `HELD_OUT`; with
    `unseen`, the tracks of `HELD_OUT` that are found. The name `random` is kept: the plan later
    gives each round a random road of its own. Raises UnknownTrack for a name that is not found,
    TrackError for a bad file, and UserError for a training track that is given as unseen.
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
    track = find_track(name, tracks_dir)
    return TrackChoice(name, track.content_hash, track.picture_hash)


def _trained_on(file: Path) -> bool:
    """Return whether a plan without names of tracks uses the track in `file`. Such a plan does not
    use a user's own tracks."""
    ours = file.parent == OWN_TRACKS
    return file.stem not in HELD_OUT and (ours or file.suffix.lower() == ".xml")
