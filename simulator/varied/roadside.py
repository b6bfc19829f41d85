"""What stands close to the road in one scene. Defaults are today's pictures."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Roadside:
    """What stands close to the road in one scene; see ranges.toml, section [roadside]."""

    gap_m: float = -1.0
    """From the asphalt to the barriers, at least; negative: they stand where cars hit them."""
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
    """Distance of cars parked beside the asphalt, on the average; 0: none."""
    bridge_every_m: float = 0.0
    """Distance of bridges over the road; 0: as the track's scenery has it."""
    dry: float = 0.0
    """How much of the grass is yellow, beyond the scenery's share."""
