from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Heading(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LEFT: _ClassVar[Heading]
    STRAIGHT: _ClassVar[Heading]
    RIGHT: _ClassVar[Heading]
LEFT: Heading
STRAIGHT: Heading
RIGHT: Heading

class TrackFeatures(_message.Message):
    __slots__ = ("to_marking_ml", "to_marking_mr", "to_marking_l", "to_marking_m", "to_marking_r", "to_lane_centre", "angle", "heading", "lanes", "lane_index", "curvature", "to_middle", "s")
    TO_MARKING_ML_FIELD_NUMBER: _ClassVar[int]
    TO_MARKING_MR_FIELD_NUMBER: _ClassVar[int]
    TO_MARKING_L_FIELD_NUMBER: _ClassVar[int]
    TO_MARKING_M_FIELD_NUMBER: _ClassVar[int]
    TO_MARKING_R_FIELD_NUMBER: _ClassVar[int]
    TO_LANE_CENTRE_FIELD_NUMBER: _ClassVar[int]
    ANGLE_FIELD_NUMBER: _ClassVar[int]
    HEADING_FIELD_NUMBER: _ClassVar[int]
    LANES_FIELD_NUMBER: _ClassVar[int]
    LANE_INDEX_FIELD_NUMBER: _ClassVar[int]
    CURVATURE_FIELD_NUMBER: _ClassVar[int]
    TO_MIDDLE_FIELD_NUMBER: _ClassVar[int]
    S_FIELD_NUMBER: _ClassVar[int]
    to_marking_ml: float
    to_marking_mr: float
    to_marking_l: float
    to_marking_m: float
    to_marking_r: float
    to_lane_centre: float
    angle: float
    heading: Heading
    lanes: int
    lane_index: int
    curvature: float
    to_middle: float
    s: float
    def __init__(self, to_marking_ml: _Optional[float] = ..., to_marking_mr: _Optional[float] = ..., to_marking_l: _Optional[float] = ..., to_marking_m: _Optional[float] = ..., to_marking_r: _Optional[float] = ..., to_lane_centre: _Optional[float] = ..., angle: _Optional[float] = ..., heading: _Optional[_Union[Heading, str]] = ..., lanes: _Optional[int] = ..., lane_index: _Optional[int] = ..., curvature: _Optional[float] = ..., to_middle: _Optional[float] = ..., s: _Optional[float] = ...) -> None: ...

class VehicleState(_message.Message):
    __slots__ = ("x", "y", "z", "yaw", "pitch", "roll", "vx", "vy", "yaw_rate", "shadow_fraction")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    PITCH_FIELD_NUMBER: _ClassVar[int]
    ROLL_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    YAW_RATE_FIELD_NUMBER: _ClassVar[int]
    SHADOW_FRACTION_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    yaw: float
    pitch: float
    roll: float
    vx: float
    vy: float
    yaw_rate: float
    shadow_fraction: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., yaw: _Optional[float] = ..., pitch: _Optional[float] = ..., roll: _Optional[float] = ..., vx: _Optional[float] = ..., vy: _Optional[float] = ..., yaw_rate: _Optional[float] = ..., shadow_fraction: _Optional[float] = ...) -> None: ...

class Sensors(_message.Message):
    __slots__ = ("range", "angle", "speed", "speed_x", "speed_y", "engine_rotation", "odometer", "lap_time", "wheel_spin")
    RANGE_FIELD_NUMBER: _ClassVar[int]
    ANGLE_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    SPEED_X_FIELD_NUMBER: _ClassVar[int]
    SPEED_Y_FIELD_NUMBER: _ClassVar[int]
    ENGINE_ROTATION_FIELD_NUMBER: _ClassVar[int]
    ODOMETER_FIELD_NUMBER: _ClassVar[int]
    LAP_TIME_FIELD_NUMBER: _ClassVar[int]
    WHEEL_SPIN_FIELD_NUMBER: _ClassVar[int]
    range: _containers.RepeatedScalarFieldContainer[float]
    angle: float
    speed: float
    speed_x: float
    speed_y: float
    engine_rotation: float
    odometer: float
    lap_time: float
    wheel_spin: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, range: _Optional[_Iterable[float]] = ..., angle: _Optional[float] = ..., speed: _Optional[float] = ..., speed_x: _Optional[float] = ..., speed_y: _Optional[float] = ..., engine_rotation: _Optional[float] = ..., odometer: _Optional[float] = ..., lap_time: _Optional[float] = ..., wheel_spin: _Optional[_Iterable[float]] = ...) -> None: ...

class Command(_message.Message):
    __slots__ = ("steer", "throttle", "brake", "gear")
    STEER_FIELD_NUMBER: _ClassVar[int]
    THROTTLE_FIELD_NUMBER: _ClassVar[int]
    BRAKE_FIELD_NUMBER: _ClassVar[int]
    GEAR_FIELD_NUMBER: _ClassVar[int]
    steer: float
    throttle: float
    brake: float
    gear: int
    def __init__(self, steer: _Optional[float] = ..., throttle: _Optional[float] = ..., brake: _Optional[float] = ..., gear: _Optional[int] = ...) -> None: ...
