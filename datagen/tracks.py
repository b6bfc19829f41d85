"""Which tracks a collection drives on."""

from pathlib import Path

from datagen.plan import TrackChoice
from simulator.track.catalogue import find_track, list_tracks, track_files

# Those of the paper and of their kind: TORCS's road tracks, from fast to steep and tight.
TORCS_TRACKS = (
    "forza", "alpine-1", "alpine-2", "eroad", "g-track-1", "g-track-2", "g-track-3", "e-track-2",
    "e-track-3",
)  # fmt: skip


def choose_tracks(names: tuple[str, ...], tracks_dir: Path | None) -> tuple[TrackChoice, ...]:
    """The named tracks; without names TORCS's nine where all are found, else the project's own.

    Raises UnknownTrack for a name that is not there, TrackError for a bad file.
    """
    if names:
        tracks = [(name, find_track(name, tracks_dir)) for name in names]
    elif set(TORCS_TRACKS) <= set(track_files(tracks_dir)):
        tracks = [(name, find_track(name, tracks_dir)) for name in TORCS_TRACKS]
    else:
        own = [track for track in list_tracks(tracks_dir) if track.source == "own"]
        tracks = [(track.name, track) for track in own]
    return tuple(TrackChoice(name, track.content_hash) for name, track in tracks)
