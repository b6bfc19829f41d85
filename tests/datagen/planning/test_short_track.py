"""The plan for a track that is too short for the usual traffic."""

from pathlib import Path

import numpy as np
import pytest

from datagen.planning.class_balance import TrackForecast
from datagen.planning.config import CollectConfig
from datagen.planning.planner import make_plan
from datagen.planning.tracks import choose_tracks
from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.traffic.traffic import Traffic
from trackfeatures import UserError


def test_the_traffic_of_a_short_track_fits_on_it(tmp_path: Path) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    lines = [f"{26.3 * np.cos(a):.3f},{21.5 * np.sin(a):.3f},4,4\n" for a in angle]
    path = tmp_path / "kart.csv"
    path.write_text("".join(lines))
    tracks = choose_tracks((str(path),), None)
    config = CollectConfig(rounds=18, frames=20, tracks=tracks)
    plan = make_plan(config, TrackForecast.of(tracks, None))
    track = find_track(str(path))
    assert 145.0 < track.length_m < 155.0
    for entry, free in zip(plan.rounds, make_plan(config).rounds, strict=True):
        road = Road(track, entry.lanes)
        Traffic(road, entry.traffic, np.random.default_rng(0))
        if entry.traffic < free.traffic:
            with pytest.raises(UserError, match="ask for fewer"):
                Traffic(road, entry.traffic + 1, np.random.default_rng(0))
    assert max(entry.traffic for entry in plan.rounds if entry.lanes == 1) == 5
    assert max(entry.traffic for entry in plan.rounds) == 8
