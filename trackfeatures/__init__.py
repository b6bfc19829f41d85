"""Definitions that all packages share: track features (units, signs, ranges, coding) and camera.

Modules that need numpy are imported at first use, so that `--help` of a command is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from trackfeatures.definitions import (
    IN_LANE_MARGIN_M,
    LANE_WIDTH_M,
    LANES,
    MARKINGS,
    ON_MARKING_REACH_M,
    RANGES,
    TARGETS,
    VERSION,
    Range,
    TrackFeatures,
    lane_offset,
)
from trackfeatures.errors import DefinitionsMismatch, UserError, require_version
from trackfeatures.road_class import LOOK_AHEAD_M, RoadClass, classify_heading

if TYPE_CHECKING:
    from trackfeatures.camera import CameraParameters
    from trackfeatures.coding import (
        decode,
        decode_features,
        decode_values,
        encode,
        encode_features,
        mirror_coded,
        mirror_heading,
    )
    from trackfeatures.measurement import (
        CentreLine,
        check_lanes,
        lane_centre,
        lane_index,
        localise,
        marking_offsets,
        measure,
        measure_pose,
        wrap_angle,
    )

__all__ = [
    "IN_LANE_MARGIN_M",
    "LANES",
    "LANE_WIDTH_M",
    "LOOK_AHEAD_M",
    "MARKINGS",
    "ON_MARKING_REACH_M",
    "RANGES",
    "TARGETS",
    "VERSION",
    "CameraParameters",
    "CentreLine",
    "DefinitionsMismatch",
    "Range",
    "RoadClass",
    "TrackFeatures",
    "UserError",
    "check_lanes",
    "classify_heading",
    "decode",
    "decode_features",
    "decode_values",
    "encode",
    "encode_features",
    "lane_centre",
    "lane_index",
    "lane_offset",
    "localise",
    "marking_offsets",
    "measure",
    "measure_pose",
    "mirror_coded",
    "mirror_heading",
    "require_version",
    "wrap_angle",
]

_NUMPY_MODULES = ("camera", "coding", "measurement")


def __getattr__(name: str) -> object:
    if name in __all__:
        for module in _NUMPY_MODULES:
            found = getattr(import_module(f"trackfeatures.{module}"), name, None)
            if found is not None:
                globals()[name] = found
                return found
    raise AttributeError(f"module 'trackfeatures' has no attribute {name!r}")
