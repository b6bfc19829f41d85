"""Labels of the road ahead, and how augmentation changes them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mtlnet.architecture import GRID
from mtlnet.data.augment.geometric import rotate, rotations, shift_lateral
from mtlnet.data.augment.pipeline import AugmentParams, draw_params
from mtlnet.data.road_ahead import (
    POINTS,
    changed_points,
    crossings,
    curvature_ahead,
    hard_frames,
    own_markings,
)
from mtlnet.model.auxiliary import AHEAD_M, CURVATURES, LABELS, ROWS, auxiliary_loss, split_columns
from mtlnet.model.network import Network, initialise
from trackfeatures.camera import CameraParameters

CAMERA = CameraParameters()
NAN = float("nan")
FOCAL = 105 / np.tan(np.radians(67.5 / 2))


def line(aside: float, angle: float = 0.0) -> NDArray[np.float64]:
    """A straight marking `aside` m to the right, seen from 1.2 m by a car that points `angle` rad
    to the right of the road: pixels (n, 2), near to far."""
    ahead = np.arange(1.0, 60.0)
    right = (aside - ahead * np.sin(angle)) / np.cos(angle)
    return np.column_stack([139.5 + FOCAL * right / ahead, 104.5 + FOCAL * 1.2 / ahead])


def marked(aside: float, angle: float) -> NDArray[np.uint8]:
    """An image with that one marking, white, 0.3 m wide, on black ground."""
    rows, columns = np.mgrid[:210, :280] + 0.5
    ahead = FOCAL * 1.2 / np.maximum(rows - 105, 0.01)
    right = (columns - 140) / FOCAL * ahead
    across = right * np.cos(angle) + ahead * np.sin(angle)
    white = (np.abs(across - aside) < 0.15) & (rows > 106)
    return np.repeat((white * 255).astype(np.uint8)[..., None], 3, 2)


def seen_columns(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Middle of the white pixels in each of `ROWS`, px."""
    found = []
    for row in ROWS:
        at = row - 0.5  # rows count from the upper border, pixels from their centres
        low = int(at)
        grey = image[low, :, 0] * (1 - at + low) + image[low + 1, :, 0] * (at - low)
        grey = np.where(grey > 100, grey, 0)  # areas that come into view are filled with dark road
        found.append((grey * (np.arange(280) + 0.5)).sum() / max(grey.sum(), 1e-9))
    return np.array(found)


def points_of(*lines: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.full((1, 2, POINTS, 2), np.nan)
    for side, each in enumerate(lines):
        out[0, side, : min(len(each), POINTS)] = each[:POINTS]
    return out


def no_changes() -> AugmentParams:
    drawn = draw_params(1, 210, 280, np.random.default_rng(0))
    none = {"shift": np.zeros(1), "rotation": np.zeros(1, int), "mirrored": np.zeros(1, bool)}
    return replace(drawn, **none)


def test_columns_of_a_straight_road_by_hand() -> None:
    found = crossings(points_of(line(-2.0), line(2.0)), 280)[0]
    expected = 2.0 / 1.2 * (np.array(ROWS) - 105)
    inside = expected < 140
    np.testing.assert_allclose(found[0][inside], 140 - expected[inside], atol=1e-3)
    np.testing.assert_allclose(found[1][inside], 140 + expected[inside], atol=1e-3)
    assert np.isnan(found[:, ~inside]).all()
    assert np.isnan(crossings(points_of(line(-2.0)), 280)[0, 1]).all()


def test_the_lanes_own_markings_are_found_among_all() -> None:
    lines = [line(aside, 0.05) for aside in (-5.5, -1.5, 2.5, 6.5)]
    out = np.full((2, POINTS, 2), np.nan)
    own_markings(lines, np.array([-1.5, 2.5]), CAMERA, out)
    np.testing.assert_allclose(out[0], lines[1][:POINTS])
    np.testing.assert_allclose(out[1], lines[2][:POINTS])


@pytest.mark.parametrize(
    ("aside", "which", "mirrored"), [(0.4, 0, False), (0.0, 9, False), (-0.3, 50, True)]
)
def test_columns_follow_the_image(aside: float, which: int, mirrored: bool) -> None:
    image = marked(0.3, 0.02)
    if aside:
        shift_lateral(image, CAMERA, aside)
    rotate(image, CAMERA, which)
    if mirrored:
        image = image[:, ::-1]
    params = replace(
        no_changes(),
        shift=np.array([aside]),
        rotation=np.array([which]),
        mirrored=np.array([mirrored]),
    )
    moved = changed_points(points_of(line(0.3, 0.02)), params, CAMERA)
    found = crossings(moved, 280)[0]
    assert abs(rotations()[which, 0]) > 0.01 or which == 0
    assert np.isnan(found[0 if mirrored else 1]).all()
    np.testing.assert_allclose(found[1 if mirrored else 0], seen_columns(image), atol=1.0)


def test_a_column_is_split_between_its_neighbours() -> None:
    place = 280 / 18
    shares = split_columns(torch.tensor([place * 4.5, place * 5.25, 0.0, 280.0, float("nan")]), 18)
    assert shares[0, 4] == pytest.approx(1.0, abs=1e-5)
    assert shares[1, 4:6].tolist() == pytest.approx([0.25, 0.75], abs=1e-5)
    assert (float(shares[2, 0]), float(shares[3, 17])) == (1.0, 1.0)
    torch.testing.assert_close(shares.sum(1), torch.ones(5))


def test_what_is_unknown_does_not_count_and_the_rest_is_learned() -> None:
    network = Network(architecture=GRID, batch_norm=True)
    initialise(network, 0)
    images = np.random.default_rng(0).integers(0, 256, (3, 210, 280, 3), dtype=np.uint8)
    labels = torch.full((3, LABELS), float("nan"))
    assert network.auxiliary is not None
    grid = network.forward_grid(torch.from_numpy(images))
    heads = network.auxiliary(grid, network.shared(grid.flatten(1)))
    assert heads[0].shape == (3, 2, len(ROWS), 18)
    assert heads[1].shape == (3, len(AHEAD_M), CURVATURES)
    assert auxiliary_loss(heads, labels).item() == 0.0
    labels[1, 3] = 20.0
    auxiliary_loss(heads, labels).backward()  # type: ignore[no-untyped-call]  # torch's
    weight = network.auxiliary.columns.weight.grad
    assert weight is not None
    learned = weight.flatten(1).abs().sum(1) > 0
    assert learned.nonzero().flatten().tolist() == [3]


def test_curvature_ahead_comes_from_all_rounds_of_a_track() -> None:
    # A bend of 1/50 from 20 m on, seen by one round as far as 31 m; another track is straight.
    s = np.concatenate([np.arange(0, 32), np.arange(0, 32)]).astype(np.float32)
    number = np.repeat([0, 1], 32)
    curvature = np.where((s >= 20) & (number == 0), 0.02, 0.0).astype(np.float32)
    found = curvature_ahead(s, curvature, np.array(["bent", "straight"])[number], np.ones(len(s)))
    np.testing.assert_allclose(found[0], [0, 0, 0, 0, 0.02, 0.02, 0.02, NAN])
    np.testing.assert_allclose(found[12], [0, 0, 0.02, 0.02, 0.02, NAN, NAN, NAN])
    np.testing.assert_allclose(found[32], [0, 0, 0, 0, 0, 0, 0, NAN])


def test_hard_frames_lie_in_sharp_bends_and_near_a_change_of_class() -> None:
    s = np.arange(0.0, 200.0, 5.0, dtype=np.float32)
    heading = np.where(s < 101, 1, 0)  # straight, then left; seen to change at 102.5 m
    curvature = np.where(s < 180, 0.0, 1 / 50).astype(np.float32)
    tracks = np.array(["a"] * len(s))
    mixed = np.random.default_rng(0).permutation(len(s))
    found = hard_frames(s[mixed], curvature[mixed], heading[mixed], tracks)
    assert sorted(s[mixed][found]) == [95, 100, 105, 110, 180, 185, 190, 195]
    # No frame of another track, where nothing changes, is hard.
    assert not hard_frames(s, np.zeros_like(s), np.ones_like(heading), tracks).any()
    both = np.array(["a", "b"] * (len(s) // 2))
    alternating = np.where(both == "a", 0, 2)
    assert not hard_frames(s, np.zeros_like(s), alternating, both).any()
