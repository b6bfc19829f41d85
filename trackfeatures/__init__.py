"""The shared language of all parts: what a track feature is, its unit, sign, range and coding."""

from trackfeatures.coding import (
    decode,
    decode_features,
    decode_values,
    encode,
    encode_features,
    mirror_coded,
    mirror_heading,
)
from trackfeatures.definitions import (
    LANE_WIDTH_M,
    LANES,
    LOOK_AHEAD_M,
    MARKINGS,
    RANGES,
    TARGETS,
    VERSION,
    Heading,
    Range,
)
from trackfeatures.errors import DefinitionsMismatch, UserError, require_version
from trackfeatures.features import TrackFeatures
from trackfeatures.localise import localise
from trackfeatures.measure import (
    CentreLine,
    check_lanes,
    classify_heading,
    lane_centre,
    lane_index,
    marking_offsets,
    measure,
    measure_pose,
    wrap_angle,
)

__all__ = [
    "LANES",
    "LANE_WIDTH_M",
    "LOOK_AHEAD_M",
    "MARKINGS",
    "RANGES",
    "TARGETS",
    "VERSION",
    "CentreLine",
    "DefinitionsMismatch",
    "Heading",
    "Range",
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
    "localise",
    "marking_offsets",
    "measure",
    "measure_pose",
    "mirror_coded",
    "mirror_heading",
    "require_version",
    "wrap_angle",
]
