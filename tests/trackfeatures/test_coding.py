"""Coding: range ends, round trips, mirroring, lane offsets of a batch, versions."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import trackfeatures as tf

LANES = st.integers(1, 3)
WIDTHS = st.floats(2.7, 4.5)
OFFSETS = st.floats(-9.0, 9.0)
ANGLES = st.floats(-0.5, 0.5)


@pytest.mark.parametrize(
    ("name", "lo", "hi"),
    [
        ("ml", -5.5, -0.5),
        ("mr", 0.5, 5.5),
        ("l", -7.0, -1.5),
        ("m", -2.0, 3.5),
        ("r", 1.5, 7.0),
        ("angle", -0.5, 0.5),
    ],
)
def test_range_ends_are_coded_as_a_tenth_and_nine_tenths(name: str, lo: float, hi: float) -> None:
    column = tf.TARGETS.index(name)
    for value, expected in ((lo, 0.1), (hi, 0.9), ((lo + hi) / 2, 0.5)):
        values = np.zeros(6)
        values[column] = value
        coded = tf.encode(values[None, :5], values[5:])
        assert coded[0, column] == pytest.approx(expected)


def test_absent_distances_are_coded_as_the_outer_end() -> None:
    coded = tf.encode(np.full((1, 5), np.nan), [0.0])
    assert coded[0] == pytest.approx([0.1, 0.9, 0.1, 0.9, 0.9, 0.5])


def test_values_beyond_the_range_are_clipped_to_0_and_1() -> None:
    coded = tf.encode([[-90.0, 90.0, -90.0, 90.0, 90.0]], [7.0])
    assert coded[0] == pytest.approx([0, 1, 0, 1, 1, 1])


@given(LANES, WIDTHS, OFFSETS, ANGLES)
def test_decode_inverts_encode(lanes: int, width: float, to_middle: float, angle: float) -> None:
    truth = tf.measure(to_middle, angle, 0.0, 0.01, lanes, width)
    back = tf.decode_features(tf.encode_features(truth), truth.heading)
    assert back.angle == pytest.approx(angle, abs=1e-6)
    for name, distance in truth.distances.items():
        found = back.distances[name]
        assert (found is None) == (distance is None), name
        if distance is not None:
            assert found == pytest.approx(distance, abs=1e-5), name
    centre = truth.to_lane_centre
    assume(truth.m is None or abs(truth.m) > 1e-5)  # at m = 0 rounding decides which lane counts
    if centre is None:
        assert back.to_lane_centre is None
    else:
        assert back.to_lane_centre == pytest.approx(centre, abs=1e-5)


@given(LANES, WIDTHS, OFFSETS, ANGLES)
def test_mirror_coded_equals_encoding_the_mirrored_scene(
    lanes: int, width: float, to_middle: float, angle: float
) -> None:
    assume(min(abs(to_middle - tf.marking_offsets(lanes, width))) > 1e-9)
    scene = tf.measure(to_middle, angle, 0.01, 0.0, lanes, width)
    mirrored = tf.measure(-to_middle, -angle, -0.01, 0.0, lanes, width)
    coded = tf.encode_features(scene)[None]
    assert tf.mirror_coded(coded)[0] == pytest.approx(tf.encode_features(mirrored), abs=1e-6)
    assert tf.mirror_heading([scene.heading])[0] == mirrored.heading


@given(st.lists(st.tuples(LANES, WIDTHS, OFFSETS), min_size=1, max_size=20))
def test_localise_of_a_batch_equals_to_lane_centre_of_each(
    scenes: list[tuple[int, float, float]],
) -> None:
    features = [tf.measure(d, 0.0, 0.0, 0.0, lanes, width) for lanes, width, d in scenes]
    distances = np.array([list(f.distances.values()) for f in features], dtype=np.float64)
    expected = [np.nan if f.to_lane_centre is None else f.to_lane_centre for f in features]
    np.testing.assert_allclose(tf.localise(distances), expected, equal_nan=True)


def test_a_lane_pair_further_apart_than_the_limit_is_absent() -> None:
    distances, _ = tf.decode(tf.encode([[-2.8, 2.8, np.nan, np.nan, np.nan]], [0.0]))
    assert np.isnan(distances[0]).all()


def test_another_version_is_refused() -> None:
    tf.require_version(tf.VERSION, "the dataset")
    with pytest.raises(tf.DefinitionsMismatch, match="the dataset was made with version '0'"):
        tf.require_version("0", "the dataset")
