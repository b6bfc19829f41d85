"""Worlds that are created, reset and closed do not leak memory."""

import gc
import os
from pathlib import Path

from simulator.track.catalogue import find_track
from simulator.track.road import Road
from simulator.world.world import World

MAKES = 15


def resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def test_closing_a_world_frees_its_memory() -> None:
    road = Road(find_track("oval"))

    def make() -> None:
        for _ in range(MAKES):
            with World(road, traffic=2) as world:
                world.reset(seed=0)

    def growth_mib() -> float:
        before = resident_mib()
        make()
        gc.collect()
        return resident_mib() - before

    make()
    gc.collect()
    # PyBullet 3.2.7 never gives back a mesh's lists: with walls as meshes it was 1 MiB a world.
    # A leak grows every time; memory of earlier tests may grow the heap once.
    assert min(growth_mib() for _ in range(3)) < 0.15 * MAKES
