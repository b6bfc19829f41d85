"""Drawing varied roads: deterministic, within the declared ranges, exact through JSON."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from simulator.varied.carriageway import APPARENT_WIDTH_M, MODEL_HEIGHT_M, Carriageway
from simulator.varied.draw import draw, generator, ranges, rebuilt
from simulator.varied.look import RoadLook

SEEDS = range(300)


def test_values_are_drawn_in_the_order_of_the_file() -> None:
    tables: dict[str, dict[str, Any]] = {
        "a": {"x": [0.0, 2.0], "n": [1, 3], "y": "x", "z": {"sometimes": 0.0, "value": [5.0, 6.0]}},
        "b": {"like": "a", "c": {"one_of": ["p", "q"], "weights": [0.0, 1.0]}, "d": {"share": 1.0}},
    }
    rng = np.random.default_rng(3)
    expected = {"x": rng.uniform(0.0, 2.0), "n": int(rng.integers(1, 4))}
    drawn = draw(tables, "b", np.random.default_rng(3))
    assert drawn == {**expected, "y": expected["x"], "z": 0.0, "c": "q", "d": True}


def test_a_section_has_a_generator_of_its_own() -> None:
    drawn = [generator(5, "paint").uniform() for _ in range(2)]
    assert drawn[0] == drawn[1]
    others = {generator(5, "lens").uniform(), generator(6, "paint").uniform()}
    assert drawn[0] not in others | {generator(5, "paint", 1).uniform()}


def test_carriageways_keep_the_ranges() -> None:
    low, high = APPARENT_WIDTH_M
    for seed in SEEDS:
        lanes = 1 + seed % 3
        road = Carriageway.drawn(seed, lanes)
        assert 2.8 <= road.lane_width_m <= 4.3
        assert 0.9 <= road.camera_height_m <= 2.2
        apparent = MODEL_HEIGHT_M * road.lane_width_m / road.camera_height_m
        assert low - 1e-3 <= apparent <= high + 1e-3
        assert len(road.markings) == lanes + 1
        for shoulder, marking in zip(
            road.shoulders_m, (road.markings[0], road.markings[-1]), strict=True
        ):
            assert 0.0 <= shoulder <= 3.0
            assert marking.lines or shoulder == 0.0
            for line in marking.lines:  # the whole width of the paint is on the asphalt
                assert abs(line.offset_m) + line.width_m / 2 < shoulder
        # What is left of every lane between the lines that bound it.
        for left, right in zip(road.markings, road.markings[1:], strict=False):
            assert road.lane_width_m + left.right_m - right.left_m >= 2.7 - 1e-9


def test_looks_are_exact_through_json() -> None:
    for seed in range(20):
        look, road = RoadLook.drawn(seed, 2), Carriageway.drawn(seed, 3)
        assert look == RoadLook.drawn(seed, 2)
        assert RoadLook.from_dict(json.loads(json.dumps(look.as_dict()))) == look
        assert Carriageway.from_dict(json.loads(json.dumps(asdict(road)))) == road
        assert hash(look) == hash(RoadLook.drawn(seed, 2))


def test_unknown_values_are_refused() -> None:
    with pytest.raises(ValueError, match="'surprise'"):
        rebuilt(RoadLook, {"surprise": 1})


def test_every_value_of_a_look_is_declared() -> None:
    """A field without a range would keep its default for ever."""
    for section in ("paint", "surface", "roadside", "light", "lens", "cabin"):
        assert set(asdict(RoadLook())[section]) <= set(ranges()[section])
