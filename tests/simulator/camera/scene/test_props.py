"""Buildings beside the road do not stand on it."""

import numpy as np
import pytest

from simulator.camera.bridges import bridges
from simulator.camera.scene import props, road_mesh
from simulator.camera.scene.terrain import Survey, build
from simulator.camera.scene.themes import themes
from simulator.track.catalogue import find_track
from simulator.track.road import Road

BUILDINGS = ("crowd", "facade", "tiles")
SEEDS = range(6)


@pytest.mark.parametrize("look", sorted(themes()))
def test_no_building_reaches_over_the_wall_line(look: str) -> None:
    road = Road(find_track("town", None), 1)  # the sharpest bend of town has a radius of 28 m
    survey = Survey.of(road)
    theme = themes()[look]
    inside = []
    for seed in SEEDS:
        ground = road_mesh.Ground.of(
            road, survey.line, build(road, survey, theme, np.random.default_rng([seed, 1]))
        )
        rng = np.random.default_rng([seed, 6])
        built = props.build(ground, theme, bridges.build(ground, theme, rng), rng)
        for material in BUILDINGS:
            if material in built:
                corners = built[material].vertices[:, :2].astype(np.float64)
                near = survey.line.distance(corners[:, 0], corners[:, 1])
                inside.append(float(np.sum(near < road.wall_offset)))
    assert sum(inside) == 0.0
