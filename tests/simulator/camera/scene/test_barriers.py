"""The barriers stand beside the road: none crosses it."""

import numpy as np
import pytest

from simulator.camera.scene import barriers, road_mesh
from simulator.camera.scene.terrain import Survey, build
from simulator.camera.scene.themes import find_theme
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.varied.look import Roadside


@pytest.mark.parametrize("name", ["circuit", "oval", "town", "random:7"])
def test_no_barrier_crosses_the_road(name: str) -> None:
    """One strip holds both sides; the triangles that join them at the start line have no area."""
    road = Road(find_track(name))
    survey, theme = Survey.of(road), find_theme(road.track.look)
    terrain = build(road, survey, theme, np.random.default_rng(1))
    ground = road_mesh.Ground.of(road, survey.line, terrain)
    rng = np.random.default_rng(5)
    surface = barriers.build(road, ground.mesh, theme, rng, Roadside())
    corners = surface.vertices[:, :3].astype(np.float64)[surface.indices.reshape(-1, 3)]
    near = np.linalg.norm(corners - corners[:1, :1], axis=2).max(1) < 200.0  # of the start line
    corners = corners[near]
    places = [road.track.project(x, y)[1] for x, y, _ in corners.reshape(-1, 3).tolist()]
    offsets = np.array(places).reshape(-1, 3)
    joins = (offsets.max(1) > 0.0) & (offsets.min(1) < 0.0)
    first, second = corners[joins, 1] - corners[joins, 0], corners[joins, 2] - corners[joins, 0]
    areas = 0.5 * np.linalg.norm(np.cross(first, second), axis=1)
    assert len(areas)
    assert areas.max() < 1e-3
