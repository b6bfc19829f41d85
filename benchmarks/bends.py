"""Errors of a model's angle in bends of random roads, by radius and change of curvature.

Run: `python benchmarks/bends.py [--model default] [--views 1] [--roads 20] [--turned-m 0]
[--json FILE]`.
A car at rest stands at even distances on the middle of random roads, in clear light, without
traffic. It is parallel to the road or, with `--turned-m M`, turned out of the bend by M times the
curvature: a car that drives along a bend slowly is turned by about 1.2 m times the curvature,
because its centre of gravity is in front of its rear axle. The roads have one lane of 4 m. Their
seeds start at `--seed`; no training uses them. A pose is steady if the curvature from the car to
8 m ahead changes by at most 15 % (or 0.0005 1/m). The radius of a pose is that of the sharpest
curvature on these 8 m. The bias along the bend is the mean error, positive if the answer exceeds
the true angle in the direction of the bend.
The road below the car is not in the picture: the first visible point of the road is 2.5 m ahead of
the centre of gravity. So each row also has the mean absolute error of an answer that knows the
visible road exactly and assumes that its first curvature continues back to the car
(`visible_rad`).
Claim: mean absolute errors of steady poses and of poses at a change of curvature as in `CLAIM`, and
biases of at most a third of these.
"""

import sys
from math import radians, tan
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from numpy.typing import NDArray

from benchmarks.claims.outcome import conclude, run_command
from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import resolve_run
from mtlnet.inference.prediction import decode_outputs
from simulator.camera import open_camera
from simulator.camera.snapshot import standing_pose
from simulator.track.catalogue import find_track
from simulator.track.random_roads.road import random_name
from simulator.track.road import Road
from trackfeatures.camera import CameraParameters

FloatArray = NDArray[np.float64]

AHEAD_M = 8.0
STEP_M = 0.25
CLAIM: dict[str, tuple[float, float]] = {
    "over 300 m": (0.003, 0.010),
    "100 to 300 m": (0.003, 0.010),
    "50 to 100 m": (0.006, 0.010),
    "25 to 50 m": (0.006, 0.010),
    "under 25 m": (0.012, 0.015),
}
"""Largest mean absolute errors, rad, of steady poses and of poses at a change, by radius."""
LIMITS_M = (300.0, 100.0, 50.0, 25.0)
SHARE_OF_BIAS = 1 / 3
MIN_POSES = 20  # fewer poses are reported, but decide no claim


def main(
    model: str = "default",
    views: int = 1,
    roads: int = 20,
    seed: int = 771_000,
    spacing: float = 12.0,
    turned_m: float = 0.0,
    json: Path | None = None,
) -> None:
    engine = load_engine(resolve_run(model), precision="f32", views=views)
    parts, hidden_m = [], first_visible_m(engine.card.camera)
    for number in range(roads):
        road = Road(find_track(random_name(seed + number)))
        camera = open_camera(road, engine.card.camera, light="clear", seed=seed + number)
        try:
            for s in np.arange(0.0, road.track.length_m, spacing).tolist():
                angle = turned_m * road.track.curvature(s)
                picture = camera.render(standing_pose(road, s, 0.0, angle), np.zeros((0, 6)))
                answer = decode_outputs(engine(picture)).as_json()["angle_rad"]
                unknown = hidden_turn(road, s, hidden_m)
                parts.append((answer - angle, *_bend(road, s), unknown))
        finally:
            camera.close()
    error, curvature, steady, unknown = np.array(parts).T
    rows = table(error, curvature, steady > 0, unknown)
    asked = {"model": model, "views": views, "roads": roads, "turned_m": turned_m}
    figures = {**asked, "poses": len(parts), "table": rows}
    conclude(figures, json, all(row["reached"] is not False for row in rows))


def _bend(road: Road, s: float) -> tuple[float, float]:
    """Return the sharpest curvature, 1/m, from `s` to 8 m ahead, and 1 if the curvature is steady
    there, else 0."""
    length = road.track.length_m
    places = np.arange(0.0, AHEAD_M + STEP_M / 2, STEP_M)
    found = np.array([road.track.curvature((s + x) % length) for x in places.tolist()])
    sharpest = float(found[np.abs(found).argmax()])
    return sharpest, float(np.ptp(found) <= max(0.15 * abs(sharpest), 5e-4))


def first_visible_m(camera: CameraParameters) -> float:
    """Return the distance (m) from the centre of gravity to the first visible point of a flat road,
    for a camera whose centre row is horizontal."""
    return camera.x + camera.height_above_road_m / tan(radians(camera.fov_y_deg / 2))


def hidden_turn(road: Road, s: float, hidden_m: float) -> float:
    """Return the error (rad) of the direction of the road at `s` if it is computed from the visible
    road: its direction and its curvature `hidden_m` m ahead, which is assumed to be constant from
    there back to `s`."""
    length = road.track.length_m
    places = np.linspace(0.0, hidden_m, 28)
    found = np.array([road.track.curvature((s + x) % length) for x in places.tolist()])
    return float(found[-1] * hidden_m - np.trapezoid(found, places))


def table(
    error: FloatArray,
    curvature: FloatArray,
    steady: NDArray[np.bool_],
    unknown: FloatArray,
) -> list[dict[str, Any]]:
    """Return a row for each class of radius, steady or not: number of poses, mean absolute error
    and bias along the bend (rad), the mean absolute error from the visible road alone (rad), and
    whether the claim was reached (None: too few poses).

    `error` (N,): answered minus true angle, rad; `curvature` (N,): sharpest curvature, 1/m;
    `steady` (N,); `unknown` (N,): results of `hidden_turn`, rad.
    """
    radius = 1 / np.maximum(np.abs(curvature), 1e-9)
    number = np.searchsorted(-np.array(LIMITS_M), -radius, side="right")
    rows = []
    for place, (name, claims) in enumerate(CLAIM.items()):
        for claim, kind in zip(claims, ("steady", "change"), strict=True):
            here = (number == place) & (steady == (kind == "steady"))
            row: dict[str, Any] = {"radius": name, "kind": kind, "poses": int(here.sum())}
            row["reached"] = None
            if here.any():
                mean = float(np.abs(error[here]).mean())
                bias = float((error[here] * np.sign(curvature[here])).mean())
                good = mean <= claim and abs(bias) <= SHARE_OF_BIAS * claim
                visible = float(np.abs(unknown[here]).mean())
                row |= {"mean_rad": round(mean, 4), "bias_rad": round(bias, 4), "claim_rad": claim}
                row["visible_rad"] = round(visible, 4)
                if here.sum() >= MIN_POSES:
                    row["reached"] = good
            rows.append(row)
    return rows


if __name__ == "__main__":
    run_command(main)
