"""Makes a road of the kind ("paper" or "varied") that a command or an environment names."""

import trackfeatures as tf
from simulator.track.geometry import Track
from simulator.track.road import Road
from simulator.varied import ROADS
from simulator.varied.carriageway import Carriageway
from trackfeatures.errors import UserError


def make_road(
    track: Track, lanes: int, lane_width_m: float | None, roads: str = ROADS[0], seed: int = 0
) -> Road:
    """Make a road with `lanes` lanes on `track`, of the kind `roads`, one of ROADS. All values of a
    varied road, including its lane width, are random with the seed `seed`. `lane_width_m` (m) is
    for a road of the kind "paper"; None means 4.0 m.

    Raises UserError for an unknown kind, or for a lane width given for a varied road.
    """
    if roads not in ROADS:
        raise UserError(f"unknown roads {roads!r}; choose {', '.join(ROADS)}")
    if roads == "paper":
        return Road(track, lanes, tf.LANE_WIDTH_M if lane_width_m is None else lane_width_m)
    if lane_width_m is not None:
        raise UserError(
            f"a lane width of {lane_width_m:g} m asked for on varied roads, whose width is random; "
            "leave it out, or choose the paper's roads"
        )
    tf.check_lanes(lanes, tf.LANE_WIDTH_M)
    return Road.varied(track, Carriageway.drawn(seed, lanes))
