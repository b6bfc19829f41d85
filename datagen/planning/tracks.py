"""The tracks that a collection drives on: TORCS's where they are installed, else our own."""

from pathlib import Path

from datagen.planning.config import TrackChoice
from simulator.track.catalogue import OWN_TRACKS, find_track, track_files
from trackfeatures.errors import UserError

# The road tracks of TORCS that the paper uses and similar ones, from fast to steep and tight.
TORCS_TRACKS = (
    "forza", "alpine-1", "alpine-2", "eroad", "g-track-1", "g-track-2", "g-track-3", "e-track-2",
    "e-track-3",
)  # fmt: skip
# Held out of every training plan, for tests on a track that no model was trained on.
UNSEEN_TORCS, UNSEEN_OWN = "wheel-1", "coast"


def choose_tracks(
    names: tuple[str, ...], tracks_dir: Path | None, unseen: bool = False
) -> tuple[TrackChoice, ...]:
    """The named tracks. Without names: the nine of TORCS if all are installed, else our own.

    With `unseen`: the held-out track, or named ones that are in neither of those sets.
    Raises UnknownTrack for a name that is not found, TrackError for a bad file, UserError for a
    training track given as unseen.
    """
    own = tuple(name for name in _own_tracks() if name != UNSEEN_OWN)
    torcs = {*TORCS_TRACKS, UNSEEN_TORCS} <= set(track_files(tracks_dir))
    if unseen and (seen := set(names) & {*TORCS_TRACKS, *own}):
        raise UserError(f"track {min(seen)} is one of those to train on; choose another as unseen")
    usual = TORCS_TRACKS if torcs else own
    held_out = UNSEEN_TORCS if torcs else UNSEEN_OWN
    chosen = names or ((held_out,) if unseen else usual)
    tracks = [(name, find_track(name, tracks_dir)) for name in chosen]
    return tuple(TrackChoice(name, track.content_hash) for name, track in tracks)


def _own_tracks() -> list[str]:
    return [path.stem for path in sorted(OWN_TRACKS.glob("*.toml"))]
