"""A body's state relative to the track: position, orientation and speeds. SI units, rad.

Only this module computes the angle, track tangent minus yaw.
"""

import math

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.piece_table import CURVATURE, HEADING0, LENGTH, S0, Table, locate
from simulator.vehicle.dynamics import PIECE
from simulator.vehicle.orientation import rotation

# Indices into the track state (TRACK_STATE_SIZE,). TRACK_SPEED: speed along the track (m/s).
# UPRIGHT_COSINE: z of the body's up axis, 1 on a level road, below 0 upside down.
YAW, PITCH, ROLL, VX, VY, YAW_RATE = 0, 1, 2, 3, 4, 5
TRACK_S, TRACK_OFFSET, ANGLE, TRACK_CURVATURE, TRACK_SPEED, UPRIGHT_COSINE = 6, 7, 8, 9, 10, 11
TRACK_STATE_SIZE = 12


@compiled
def measure_track_state(
    table: Table, motion: FloatArray, memory: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (12,), the track state of a body with `motion` (13,). The search for the body's
    piece of the track starts at the piece stored in `memory` (8,), which is updated."""
    piece, s, to_middle = locate(table, motion[0], motion[1], int(memory[PIECE]))
    memory[PIECE] = piece
    curvature = table[piece, CURVATURE]
    along = min(max(s - table[piece, S0], 0.0), table[piece, LENGTH])
    tangent = table[piece, HEADING0] + curvature * along
    axes = rotation(motion[3:7])
    ahead, left, up = axes[0], axes[1], axes[2]
    yaw = math.atan2(ahead[1], ahead[0])
    angle = tangent - yaw
    angle -= 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))  # in (-pi, pi]
    out[YAW], out[ANGLE] = yaw, angle
    out[PITCH] = math.asin(max(-1.0, min(1.0, -ahead[2])))
    out[ROLL] = math.atan2(left[2], up[2])
    out[VX] = ahead[0] * motion[7] + ahead[1] * motion[8] + ahead[2] * motion[9]
    out[VY] = left[0] * motion[7] + left[1] * motion[8] + left[2] * motion[9]
    out[YAW_RATE] = up[0] * motion[10] + up[1] * motion[11] + up[2] * motion[12]
    out[TRACK_S], out[TRACK_OFFSET], out[TRACK_CURVATURE] = s, to_middle, curvature
    out[TRACK_SPEED] = math.cos(tangent) * motion[7] + math.sin(tangent) * motion[8]
    out[UPRIGHT_COSINE] = up[2]
