"""Imports TORCS track files (XML, versions 3 and 4) by the rules of TORCS 1.3.7."""

from pathlib import Path
from typing import Final

from simulator.track.errors import TrackError
from simulator.track.geometry import Track, readable_name
from simulator.track.markings import imported_style
from simulator.track.pieces import Piece, assemble, check_closes
from simulator.track.torcs.appearance import has_kerbs, surface_and_look
from simulator.track.torcs.segments import read_pieces
from simulator.track.torcs.torcs_xml import Section, read_parameter_file

DEFAULT_WIDTH_M: Final = 15.0
SEGMENT_LISTS: Final = {3: "segments", 4: "Track Segments"}
"""Name of the list of segments in each version of the format that can be read."""
MAX_PIECES: Final = 200_000


def read_torcs(path: Path) -> Track:
    """Read the track of one TORCS XML file; it is named after the file.

    Raises TrackError for a file that is unreadable or unsafe (see `torcs_xml`), for lengths that
    are not positive, and for segments that do not close (see `pieces.MAX_GAP_M`).
    """
    root = read_parameter_file(path)
    main = _required(root, "Main Track")
    header = root.section("Header")
    version = int(header.number("version") or 0) if header else 0
    if version not in SEGMENT_LISTS:
        raise TrackError(f"{path}: track format version {version}; versions 3 and 4 can be read")
    width = main.length("width")
    width = DEFAULT_WIDTH_M if width is None else width
    if not 1.0 <= width <= 100.0:
        raise TrackError(f"{path}: the track is {width:g} m wide, expected 1 to 100 m")
    pieces: list[Piece] = []
    for piece in read_pieces(_required(main, SEGMENT_LISTS[version]), main, width):
        pieces.append(piece)
        if len(pieces) > MAX_PIECES:
            raise TrackError(f"{path}: more than {MAX_PIECES} profile steps, which no track needs")
    if not pieces:
        raise TrackError(f"{path}: no segments, so the track has no length")
    placed = assemble(pieces, y=width / 2.0)
    check_closes(placed, str(path))
    surface, look = surface_and_look(readable_name(path.stem), root, main, placed)
    return Track.from_placed(
        placed,
        name=readable_name(path.stem),
        source="torcs",
        width=width,
        surface=surface,
        look=look,
        markings=imported_style(readable_name(path.stem), kerbs=has_kerbs(main)),
    )


def _required(section: Section, name: str) -> Section:
    found = section.section(name)
    if found is None:
        raise TrackError(f"{section.file}: has no section {name!r}; is it a TORCS track?")
    return found
