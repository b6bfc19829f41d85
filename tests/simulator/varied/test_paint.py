"""Labels of varied roads lie on the paint that defines them, in class images of the renderer."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from simulator.camera import CLASSES, Camera, Light
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.varied.carriageway import Carriageway, Line, Marking
from simulator.varied.look import Paint, RoadLook
from trackfeatures.camera import CameraParameters

WIDTH = 3.5
SOLID = Line(0.0, 0.15, "white")
DASHED = replace(SOLID, dash_m=1.5, gap_m=1.5)
ROAD, MARKING, GROUND = (CLASSES.index(name) for name in ("road", "marking", "ground"))


def double(left: Line, right: Line, inner: float = 0.0, apart: float = 0.3) -> Marking:
    """Two lines `apart` m from middle to middle."""
    return Marking(
        (
            replace(left, offset_m=apart * (inner + 0.5)),
            replace(right, offset_m=apart * (inner - 0.5)),
        )
    )


def camera_on(
    markings: tuple[Marking, ...],
    shoulders: tuple[float, float] = (0.8, 0.4),
    paint: Paint | None = None,
    light: str = "clear",
) -> Camera:
    road = Road.varied(find_track("oval"), Carriageway(WIDTH, shoulders, 1.2, markings))
    drawn = Light.named(light, np.random.default_rng(0))
    look = replace(RoadLook(), paint=paint or Paint())
    return Camera(road, CameraParameters(560, 420), seed=1, light=drawn, look=look)


def classes_along(
    camera: Camera, to_middle: float, side: str, at: float = 30.0
) -> list[tuple[float, NDArray[np.uint8]]]:
    """For places ahead: the column at which the label `side` projects, and the classes of its row.

    The label is a distance of `Road.measure`; it is projected along the track from the car's foot.
    """
    road = camera.road
    pose = standing_pose(road, at, to_middle)
    distance = road.measure(at, to_middle, 0.0).distances[side]
    assert distance is not None
    ahead = road.track.at(at + np.arange(4.0, 14.0, 0.37), to_middle - distance)
    pixels, _ = camera.project(np.stack([ahead.x, ahead.y, ahead.z], axis=1), pose)
    picture = camera.render_views(pose, None, ["front:class"])["front:class"]
    rows = np.rint(pixels[:, 1]).astype(int)
    inside = (rows < camera.height) & (pixels[:, 0] > 3) & (pixels[:, 0] < camera.width - 3)
    # A row's pixels show the road at the height of their centres.
    slopes = np.gradient(pixels[:, 0], pixels[:, 1])[inside]
    seen = zip(pixels[inside], rows[inside], slopes, strict=True)
    return [(u + (row - v) * slope, picture[row]) for (u, v), row, slope in seen]


def off_the_paint(camera: Camera, to_middle: float, side: str) -> NDArray[np.float64]:
    """Pixels from the label to the middle of the paint below it; NaN where there is no paint."""
    found = []
    for column, row in classes_along(camera, to_middle, side):
        painted = np.concatenate([[False], row == MARKING, [False]])
        first, last = np.flatnonzero(np.diff(painted.astype(int))).reshape(-1, 2).T
        on = np.flatnonzero((first - 0.5 <= column) & (column <= last - 0.5))
        found.append(abs((first[on[0]] + last[on[0]] - 1) / 2 - column) if len(on) else np.nan)
    return np.array(found)


@pytest.mark.parametrize(
    ("divider", "left_lane", "right_lane"),
    [
        (Marking((SOLID,)), 1.0, 1.0),
        (double(SOLID, SOLID), 1.0, 1.0),
        (double(SOLID, DASHED), 1.0, 0.5),
        (double(DASHED, SOLID), 0.5, 1.0),
    ],
)
def test_of_a_double_line_the_one_nearer_to_the_lane_is_labelled(
    divider: Marking, left_lane: float, right_lane: float
) -> None:
    edges = double(SOLID, SOLID, 0.5), double(SOLID, SOLID, -0.5)
    with camera_on((edges[0], divider, edges[1])) as camera:
        for to_middle, side, share in (
            (WIDTH / 2 - 0.2, "mr", left_lane),
            (WIDTH / 2 - 0.2, "ml", 1.0),
            (-WIDTH / 2 + 0.1, "ml", right_lane),
            (-WIDTH / 2 + 0.1, "mr", 1.0),
            (0.4, "m", left_lane),
            (-0.3, "m", right_lane),
        ):
            off = off_the_paint(camera, to_middle, side)
            assert len(off) > 10
            assert np.nanmax(off) < 0.8
            assert np.mean(~np.isnan(off)) == pytest.approx(share, abs=0.13)


def test_without_paint_the_edge_of_the_asphalt_is_labelled() -> None:
    markings = (Marking(), Marking((SOLID,)), Marking())
    with camera_on(markings, shoulders=(0.0, 0.0)) as camera:
        for to_middle, side, outer in ((1.6, "ml", -1), (-1.6, "mr", 1)):
            seen = classes_along(camera, to_middle, side)
            assert len(seen) > 10
            for column, row in seen:
                assert row[round(column - outer * 1.5)] == ROAD
                assert row[round(column + outer * 1.5)] == GROUND


def test_missing_paint_keeps_its_label() -> None:
    markings = (Marking((SOLID,)),) * 3
    gone = Paint(gap_m=4.0, gap_every_m=8.0, gap_marking=2)
    with camera_on(markings, paint=gone) as camera, camera_on(markings) as whole:
        assert camera.road.measure(30.0, 0.5, 0.0) == whole.road.measure(30.0, 0.5, 0.0)
        there = ~np.isnan(off_the_paint(camera, -1.7, "mr"))
        assert there.mean() == pytest.approx(0.5, abs=0.15)
        assert not np.isnan(off_the_paint(camera, -1.7, "ml")).any()
        assert not np.isnan(off_the_paint(whole, -1.7, "mr")).any()


def test_dots_arrows_and_crosswalks_are_drawn() -> None:
    """Each of them brightens the road of the same scene; none of them moves a label."""
    plain = (Marking((SOLID,)), Marking(), Marking((SOLID,)))
    dotted = (plain[0], Marking((replace(SOLID, dots_m=1.2, width_m=0.1),)), plain[2])
    with camera_on(plain) as camera:
        pose = standing_pose(camera.road, 30.0, -1.7)
        bare = camera.render(pose).astype(int)
    for markings, paint, least in (
        (dotted, Paint(), 20),
        (plain, Paint(arrow_every_m=12.0), 300),
        (plain, Paint(arrow_every_m=12.0, arrow_kind="left"), 300),
        (plain, Paint(crosswalk_every_m=12.0), 2000),
    ):
        with camera_on(markings, paint=paint) as camera:
            brighter = camera.render(pose).astype(int) - bare
        assert (brighter.sum(2) > 90).sum() > least
        assert (brighter.sum(2) < -30).sum() == 0


def test_a_look_of_the_tracks_own_paint_is_the_papers_picture() -> None:
    """The varied shaders draw these lines like the shaders of the paper's roads."""
    road = Road(find_track("oval"), 2, WIDTH)
    style = road.track.markings
    line = replace(SOLID, width_m=style.line_width)
    dashed = replace(line, dash_m=style.dash_length, gap_m=style.dash_gap)
    left = replace(line, colour=style.left_colour)
    markings = (Marking((left,)), Marking((dashed,)), Marking((line,)))
    pose = standing_pose(road, 30.0, -1.7)
    light = Light.named("clear", np.random.default_rng(0))
    with Camera(road, CameraParameters(560, 420), seed=1, light=light) as paper:
        classes = paper.render_views(pose, None, ["front:class"])["front:class"]
    with camera_on(markings, shoulders=(1.0, 1.0)) as varied:
        assert np.array_equal(
            varied.render_views(pose, None, ["front:class"])["front:class"], classes
        )
