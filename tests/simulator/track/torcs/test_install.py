"""Every TORCS track on this machine is imported, closed, and coincides with TORCS's 3D model.

The tracks are looked for in $TORCS_TRACKS and /usr/share/games/torcs/tracks.
"""

import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import trackfeatures as tf
from simulator.track.catalogue import SYSTEM_TRACKS, VARIABLE, read_track
from simulator.track.geometry import Track
from simulator.track.pieces import MAX_GAP_M
from simulator.track.road import Road
from simulator.world.walls import Walls

FloatArray = NDArray[np.float64]

MESH_STEP_M = 0.25
ADDED_BY_HAND = 0.10
"""Share of a model's road that can be bridges and side streets added by its author."""


def installed() -> list[Path]:
    """Track files (CATEGORY/NAME/NAME.xml), each name once, those with a 3D model first."""
    folders = [SYSTEM_TRACKS, Path(os.environ.get(VARIABLE) or "nowhere")]
    found = [path for folder in folders for path in sorted(folder.glob("**/*.xml"))]
    return list({path.stem: path for path in found[::-1] if path.stem == path.parent.name}.values())


TRACKS = [pytest.param(path, id=path.stem) for path in sorted(installed())] or [
    pytest.param(
        Path(), marks=pytest.mark.skip(f"no TORCS tracks in ${VARIABLE} or {SYSTEM_TRACKS}")
    )
]
MODELLED = [
    pytest.param(model, id=model.stem)
    for path in sorted(installed())
    for model in [path.with_suffix(".acc"), path.with_suffix(".ac")]
    if model.is_file()
] or [pytest.param(Path(), marks=pytest.mark.skip(f"no 3D models (.acc) in {SYSTEM_TRACKS}"))]


@pytest.mark.parametrize("path", TRACKS)
def test_track_is_imported_as_a_closed_loop(path: Path) -> None:
    track = read_track(path)
    assert (track.name, track.source) == (path.stem, "torcs")
    assert 800.0 <= track.length_m <= 25_000.0
    assert 8.0 <= track.width <= 30.0
    assert track.min_radius_m >= 10.0 - 1e-9
    assert max(map(abs, track.grade_range)) <= 0.30
    before, start = track.at(track.length_m - 1e-9), track.at(0.0)
    assert math.hypot(float(before.x - start.x), float(before.y - start.y)) <= MAX_GAP_M
    # Once round, or a figure of eight; forza's angles deviate by 0.016 deg.
    turned = math.degrees(float(np.sum(track.curvature0 * track.length)))
    assert min(abs(turned - whole) for whole in (-360.0, 0.0, 360.0)) < 0.02


@pytest.mark.parametrize("path", TRACKS)
def test_heights_are_continuous(path: Path) -> None:
    track = read_track(path)
    for end, start in ((track.z_left1, track.z_left0), (track.z_right1, track.z_right0)):
        steps = np.abs(end - np.roll(start, -1))
        # ruudskogen leans by half a degree more from one segment to the next.
        assert steps.max() <= (0.10 if track.name == "ruudskogen" else 0.003)


@pytest.mark.slow
@pytest.mark.parametrize("path", TRACKS)
def test_one_to_three_lanes_can_be_laid(path: Path) -> None:
    track = read_track(path)
    roads = [Road(track, lanes, tf.LANE_WIDTH_M) for lanes in (1, 2, 3)]
    for road in roads:
        assert road.edge >= road.markings_y.max() + 0.5
        assert road.edge < track.min_radius_m
        assert len(road.markings_y) == road.lanes + 1
    walls = Walls(roads[-1])
    # No wall stands on the road. A gap at the line, or a kink there, moves a wall a little.
    beside = [side * (walls.offset - 0.1) for side in (1.0, -1.0)]
    stations = np.arange(0.0, track.length_m, 8.0)
    panels = [walls.panel(float(s), d, 1.0) for s in stations for d in beside]
    faces = [panel.face for panel in panels if panel is not None]
    assert len(faces) > 0.8 * len(stations)
    nearest = min(abs(track.project(x, y)[1]) for x, y in faces)
    crosses = track.name == "wheel-2"  # a bridge: its walls stand over the road below
    assert nearest > (0.0 if crosses else roads[-1].edge - MAX_GAP_M)


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELLED)
def test_both_edges_coincide_with_the_3d_model(model: Path) -> None:
    """The 3D model of a track contains points of both edges, up to a constant shift.

    At least 90 % of the model's points must lie on our edges, and all along our edges there must be
    model points.
    """
    track = read_track(model.with_suffix(".xml"))
    theirs = _road_points(model)
    s = np.arange(0.0, track.length_m, MESH_STEP_M)
    edges = np.concatenate([_points(track, s, side * track.width / 2) for side in (1.0, -1.0)])
    off, nearest = _match(track, theirs, edges, s)
    ours = off < 0.05  # the program adds up in single precision: 4 cm after 19 km
    assert ours.mean() > 1.0 - ADDED_BY_HAND
    assert np.median(off[ours]) < 0.01
    # Its points come every 4 to 20 m: between two of them nothing of ours may be missing.
    for side in (0, 1):
        seen = np.sort(s[(nearest % len(s))[ours & (nearest // len(s) == side)]])
        assert np.diff(np.append(seen, seen[0] + track.length_m)).max() < 40.0


def _road_points(model: Path) -> FloatArray:
    """Vertices (N, 3) of the objects called TKMN (track, main) of an AC3D file; z up."""
    rows: list[str] = []
    name = ""
    lines = iter(model.read_text("latin-1").splitlines())
    for line in lines:
        if line.startswith("name "):
            name = line[6:-1].lower()
        elif line.startswith("numvert "):
            block = [next(lines) for _ in range(int(line.split()[1]))]
            rows += block if re.match("tkmn", name) else []
    x, height, minus_y = np.array([row.split()[:3] for row in rows], dtype=np.float64).T
    return np.column_stack((x, -minus_y, height))


def _points(track: Track, s: FloatArray, y: float) -> FloatArray:
    pose = track.at(s, y)
    return np.column_stack((pose.x, pose.y, pose.z))


def _match(
    track: Track, theirs: FloatArray, edges: FloatArray, s: FloatArray
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Distance (N,) m of each of their points to our edges, sideways or in height, and the number
    (N,) of the edge point next to it; the worlds' shift is found first."""
    tree = cKDTree(edges)
    low, high = theirs.min(axis=0) - edges.min(axis=0), theirs.max(axis=0) - edges.max(axis=0)
    # Their corners are ours but for what was added by hand, which spoils one or two of them.
    starts = [low, high, np.r_[low[0], high[1], low[2]], np.r_[high[0], low[1:]]]
    shift = min((_settle(start, theirs, edges, tree) for start in starts), key=lambda f: f[0])[1]
    for _ in range(4):
        nearest = tree.query(theirs - shift)[1]
        error = theirs - shift - edges[nearest]
        along, normals = _frame(track, s[nearest % len(s)])
        off = np.einsum("nij,nj->ni", normals, error)
        near = (np.hypot(*off.T) < 0.3) & (np.abs(np.sum(along * error, axis=1)) < 2 * MESH_STEP_M)
        rows = normals[near].reshape(-1, 3)
        shift = shift + np.linalg.lstsq(rows, off[near].reshape(-1), rcond=None)[0]
    return np.where(near, np.hypot(*off.T), np.inf), nearest


def _settle(
    shift: FloatArray, theirs: FloatArray, edges: FloatArray, tree: cKDTree
) -> tuple[float, FloatArray]:
    for _ in range(20):
        apart, nearest = tree.query(theirs - shift)
        close = apart <= max(float(np.percentile(apart, 60)), 0.2)
        shift = shift + np.median((theirs - shift - edges[nearest])[close], axis=0)
    return float(np.median(tree.query(theirs - shift)[0])), shift


def _frame(track: Track, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions along the road (N, 3), in which samples 0.25 m apart say little, and the two
    across it (N, 2, 3): sideways, and up from its slope."""
    heading = track.at(s).heading
    slope = np.array([track.slope(float(value)) for value in s])
    cos, sin, zero, one = np.cos(heading), np.sin(heading), np.zeros(len(s)), np.ones(len(s))
    along = np.column_stack((cos, sin, slope))
    sideways = np.column_stack((-sin, cos, zero))
    up = np.column_stack((-slope * cos, -slope * sin, one))
    return along, np.stack((sideways, up), axis=1)
