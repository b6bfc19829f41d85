"""Moves the ego car until its box overlaps a wall or a traffic car, in one compiled call.

World frame, SI units.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled
from simulator.arrays import FloatArray
from simulator.track.piece_table import Table, locate
from simulator.traffic.wreck import lane_motion
from simulator.vehicle.dynamics import DT, MOTION, PIECE, Work, compute_forces_at, forget_turn
from simulator.vehicle.orientation import fill_axes
from simulator.vehicle.rigid_body import integrate
from simulator.vehicle.surface import Ground
from simulator.world.boxes import BOX, box_radius, boxes_overlap, fill_car_box
from simulator.world.walls import WallTable, fill_panel_box


@compiled
def touches(
    params: NDArray[Any],
    other: NDArray[Any],
    table: Table,
    walls: WallTable,
    motion: FloatArray,
    at: tuple[int, float, float],
    others: FloatArray,
    move: FloatArray,
    share: float,
    dt: float,
    margin: float,
    radius: float,
) -> bool:
    """Return whether the ego car's box is within `margin` m of a wall or a traffic car.

    `params` and `other` are the `CarParameters.packed()` of the ego car and of a traffic car,
    `motion` (13,) is the ego car's motion and `at` its track coordinates (piece index, s,
    to_middle). `others` (n, 6) are the ground poses of the traffic at the start of the control step
    of `dt` s, and `move` (n, 6) is their change over the step, of which the fraction `share` is
    done. `radius` (m) is the largest distance of a point of the car's box from its centre of
    gravity, plus the margin.
    """
    _, s, d = at
    beside_wall = abs(d) > walls[0] - radius
    if not beside_wall and others.shape[0] == 0:
        return False
    own, their = np.empty(BOX), np.empty(BOX)
    fill_car_box(params[0], motion, own)
    if (
        beside_wall
        and fill_panel_box(table, walls, s, d, radius, their)
        and boxes_overlap(own, their, margin)
    ):
        return True
    reach = radius + box_radius(other[0])
    there = np.empty(MOTION)
    for i in range(others.shape[0]):
        dx = others[i, 0] + share * move[i, 0] - motion[0]
        dy = others[i, 1] + share * move[i, 1] - motion[1]
        if dx * dx + dy * dy < reach * reach:
            lane_motion(others[i], move[i], share, dt, there)
            fill_car_box(other[0], there, their)
            if boxes_overlap(own, their, margin):
                return True
    return False


@compiled
def advance_free(
    params: NDArray[Any],
    other: NDArray[Any],
    table: Table,
    ground: Ground,
    walls: WallTable,
    motion: FloatArray,
    memory: FloatArray,
    command: FloatArray,
    others: FloatArray,
    move: FloatArray,
    done: int,
    steps: int,
    margin: float,
    work: Work,
) -> int:
    """Advance the ego car from physics step `done` of `steps` until it touches something; arguments
    as in `touches` and `dynamics.compute_forces`. Returns the number of physics steps done at the
    end.

    In the first step, a gap of at most `margin` m counts as touching; in later steps only an
    overlap does. `work` is memory for the steps.
    """
    p, axes, wrench = params[0], work[0], work[5]
    forget_turn(work)
    own_radius = box_radius(p)
    while done < steps:
        share, dt, radius = done / steps, steps * DT, own_radius + margin
        at = locate(table, motion[0], motion[1], int(memory[PIECE]))
        beside_wall = abs(at[2]) > walls[0] - radius
        if (beside_wall or others.shape[0]) and touches(
            params, other, table, walls, motion, at, others, move, share, dt, margin, radius
        ):
            return done
        fill_axes(motion[3:7], axes)
        compute_forces_at(p, table, ground, at, motion, memory, command, work)
        integrate(p, axes, motion, wrench)
        margin = 0.0
        done += 1
    return done
