"""Objects close to the road in one scene. The defaults change nothing."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Roadside:
    """Objects close to the road in one scene; see ranges.toml, section [roadside]."""

    gap_m: float = -1.0
    """Least distance from the asphalt to the barriers; negative: they stand where cars hit them."""
    left: str = ""
    """Kind of the barrier on the left of the road (see `camera.scene.barriers`); "": by sections,
    as the track's scenery has it."""
    right: str = ""
    height: float = 1.0
    """Factor on the height of walls, crops and snow banks."""
    trees: float = 1.0
    """Factor on the number of trees."""
    tunnel: bool = False
    """Trees stand in dense rows behind the barriers, and their crowns close over the road."""
    parked_every_m: float = 0.0
    """Mean distance between cars parked beside the asphalt; 0: no cars."""
    bridge_every_m: float = 0.0
    """Distance between bridges over the road; 0: the distance of the track's scenery."""
    dry: float = 0.0
    """Share of the grass that is yellow, in addition to the scenery's share."""
