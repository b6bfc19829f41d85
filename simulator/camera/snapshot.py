"""Writes a contact sheet of a road: driver views along it, with the true markings drawn over them.

simulator snapshot TRACK --out sheet.png --view chase --kind class --light rain
"""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.files import atomic_write, check_folder
from simulator.arrays import FloatArray
from simulator.camera import overlay
from simulator.camera.core.camera import Camera
from simulator.camera.core.render_modes import CLASS, CLASSES, COLOUR, DEPTH, ViewRequest
from simulator.camera.scene.light import KINDS, Light, check_light
from simulator.track.road import Road
from simulator.varied.look import RoadLook
from simulator.vehicle.car import CarParameters
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

Picture = NDArray[np.uint8]

WIDTH, HEIGHT, COLUMNS = 480, 360, 4
DRIVER_VIEWS = 14
_FONT, _FONT_SIZE, _WHITE = cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255)
Colour = tuple[int, int, int]
CAR_GAP_M = (12.0, 60.0)
CLASS_COLOURS: dict[str, tuple[int, int, int]] = {
    "road": (88, 88, 94),
    "marking": (250, 250, 250),
    "car": (222, 45, 38),
    "ground": (96, 148, 66),
    "sky": (128, 186, 255),
    "object": (232, 156, 30),
}
NEAREST_M, FARTHEST_M = 2.0, 500.0
"""Depths of the first and the last colour of the logarithmic depth scale."""
_NO_DEPTH = (12, 12, 16)


@dataclass(frozen=True)
class Shot:
    """One picture of the sheet: pose of the car (m, rad), view, light and kind of image."""

    s: float
    to_middle: float
    angle: float
    view: str
    light: str
    kind: str = COLOUR


def write_contact_sheet(
    road: Road,
    out: Path,
    *,
    seed: int,
    traffic: int,
    light: str | None = None,
    view: str | None = None,
    kind: str = COLOUR,
    camera: CameraParameters | None = None,
) -> None:
    """Write a PNG of 16 views at points all round `road`.

    All pictures show `view`; None gives 14 driver views, one chase view and one top view. All
    pictures are in the kind of light `light`; with None every second picture is in clear light and
    the rest cycle through the other kinds. With `kind` "colour" the right half of each picture has
    the true markings drawn thinly over the painted ones; "depth" and "class" are in false colours.
    `traffic` is the number of cars ahead in each picture. `camera` is the lens, scaled to a width
    of 480 px; None gives the driver camera. A road of `--roads varied` has another look in each
    kind of light, and sets the height of the driver camera. An existing file is replaced only when
    the new one is complete. Raises UserError if `out` is not a PNG file, its folder does not exist,
    or light, view or kind is unknown, and OSError if the file cannot be written.
    """
    if out.suffix.lower() != ".png":
        raise UserError(f"{out}: the contact sheet is a PNG file; give a name that ends in .png")
    check_folder(out)  # checked before rendering, which takes several seconds
    if light is not None:
        check_light(light)
    ViewRequest.of(f"{view or 'front'}:{kind}")
    lens = _lens(road, camera)
    shots = [
        replace(shot, kind=kind, view=view or shot.view)
        for shot in _shots(road, light, np.random.default_rng([seed, 10]))
    ]
    pictures: list[Picture | None] = [None] * len(shots)
    for number, kind in enumerate(dict.fromkeys(shot.light for shot in shots)):
        drawn = Light.named(kind, np.random.default_rng([seed, 11]))
        look = RoadLook.drawn(seed, number) if road.carriageway else None
        with Camera(road, lens, seed=seed, light=drawn, look=look) as renderer:
            for k, shot in enumerate(shots):
                if shot.light == kind:
                    rng = np.random.default_rng([seed, 12, k])
                    pictures[k] = render_shot(renderer, road, shot, traffic, rng)
    made = [picture for picture in pictures if picture is not None]
    rows = [np.hstack(made[k : k + COLUMNS]) for k in range(0, len(made), COLUMNS)]
    done, png = cv2.imencode(".png", cv2.cvtColor(np.vstack(rows), cv2.COLOR_RGB2BGR))
    if not done:
        raise UserError(f"{out}: the contact sheet could not be encoded as PNG")
    atomic_write(out, png.tobytes())


def _lens(road: Road, camera: CameraParameters | None) -> CameraParameters:
    """Return the camera of a sheet: `camera` scaled to WIDTH or, if it is None, the driver camera,
    on a varied road at the random camera height of that road."""
    if camera is not None:
        return camera.resized(WIDTH, round(WIDTH * camera.height / camera.width))
    lens = CameraParameters(WIDTH, HEIGHT)
    if road.carriageway is None:
        return lens
    return replace(lens, z=road.carriageway.camera_height_m - CameraParameters.cg_height_m)


def render_shot(
    camera: Camera, road: Road, shot: Shot, traffic: int, rng: np.random.Generator
) -> Picture:
    """Draw `shot` with a caption and `traffic` cars ahead, random by `rng`; returns the picture
    (H, W, 3) uint8 RGB. A colour picture shows the true markings on its right half."""
    pose = standing_pose(road, shot.s, shot.to_middle, shot.angle)
    cars = _cars_ahead(road, shot, traffic, rng)
    name = f"{shot.view}:{shot.kind}"
    picture = colourise(camera.render_views(pose, cars, [name])[name], shot.kind)
    if shot.kind == COLOUR:
        lines = overlay.marking_polylines(camera, road, (shot.s, pose), view=shot.view)
        half = camera.width // 2
        picture[:, half:] = overlay.draw(picture, lines)[:, half:]
    caption = (
        f"{road.track.name}  s {shot.s:.0f} m  {shot.view}  {shot.light}  "
        f"d {shot.to_middle:+.1f} m  {np.degrees(shot.angle):+.0f} deg"
    )
    _write(picture, caption, (8, camera.height - 10), _WHITE)
    _write_legend(picture, shot.kind)
    return picture


def _write_legend(picture: Picture, kind: str) -> None:
    """Write the colours' meaning into a depth or class picture."""
    if kind == DEPTH:
        _write(picture, f"red {NEAREST_M:.0f} m ... blue {FARTHEST_M:.0f} m", (8, 18), _WHITE)
    x = 8
    for name in CLASSES if kind == CLASS else ():
        x += _write(picture, name, (x, 18), CLASS_COLOURS[name]) + 10


def _write(picture: Picture, text: str, place: tuple[int, int], colour: Colour) -> int:
    """Write `text` with a shadow at `place` (x, y) px; returns its width in px."""
    for shade, shift in (((0, 0, 0), 1), (colour, 0)):
        at = (place[0] + shift, place[1] + shift)
        cv2.putText(picture, text, at, _FONT, _FONT_SIZE, shade, 1, cv2.LINE_AA)
    return int(cv2.getTextSize(text, _FONT, _FONT_SIZE, 1)[0][0])


def standing_pose(
    road: Road,
    s: float,
    to_middle: float,
    angle: float = 0.0,
    height: float = CarParameters.cg_height,
) -> FloatArray:
    """Return the pose (6,) of a car at `s`, `to_middle` (m) and `angle` (rad) on the road plane;
    its origin is `height` m above the plane, along the plane's normal."""
    track = road.track
    place = track.at(s, to_middle)
    here = np.array([place.x, place.y, place.z], dtype=np.float64)
    ahead, behind = track.at(s + 0.05, to_middle), track.at(s - 0.05, to_middle)
    left, right = track.at(s, to_middle + 0.5), track.at(s, to_middle - 0.5)
    along = np.array([ahead.x - behind.x, ahead.y - behind.y, ahead.z - behind.z])
    across = np.array([left.x - right.x, left.y - right.y, left.z - right.z])
    normal = np.cross(along, across)
    normal /= np.linalg.norm(normal)
    yaw = float(place.heading) - angle
    # Euler angles (Rz Ry Rx) of the body whose x axis lies in the road plane at this yaw.
    flat = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    x_axis = np.array([flat[0], flat[1], -(flat @ normal) / normal[2]])
    x_axis /= np.linalg.norm(x_axis)
    y_axis = np.cross(normal, x_axis)
    pitch = -float(np.arcsin(np.clip(x_axis[2], -1.0, 1.0)))
    roll = float(np.arctan2(y_axis[2], normal[2]))
    return np.array([*(here + normal * height), roll, pitch, yaw])


def _shots(road: Road, light: str | None, rng: np.random.Generator) -> list[Shot]:
    """Return DRIVER_VIEWS driver views, a chase view and a top view at points round the road."""
    length = road.track.length_m
    places = (np.arange(DRIVER_VIEWS + 2) + rng.uniform(0.0, 1.0)) * length / (DRIVER_VIEWS + 2)
    reach = road.lanes * road.lane_width / 2 - 1.0
    shots = []
    for k, s in enumerate(places):
        view = "chase" if k == DRIVER_VIEWS else "top" if k == DRIVER_VIEWS + 1 else "front"
        offset = float(rng.uniform(-reach, reach))
        angle = float(rng.normal(0.0, 0.06)) if view == "front" else 0.0
        # Every other picture is in clear light; the rest cycle through the other kinds.
        turn = "clear" if k % 2 == 0 else KINDS[1 + (k // 2) % (len(KINDS) - 1)]
        shots.append(Shot(float(s), offset, angle, view, light or turn))
    return shots


def _cars_ahead(road: Road, shot: Shot, count: int, rng: np.random.Generator) -> FloatArray:
    """Return poses (count, 6) of random cars in lanes ahead, at least 12 m apart."""
    ahead = np.cumsum(rng.uniform(*CAR_GAP_M, count))
    lanes = rng.integers(0, road.lanes, count)
    first = (road.lanes - 1) * road.lane_width / 2
    poses = [
        standing_pose(road, shot.s + gap, first - lane * road.lane_width, height=0.0)
        for gap, lane in zip(ahead, lanes, strict=True)
    ]
    return np.array(poses).reshape(-1, 6)


def colourise(picture: NDArray[np.generic], kind: str) -> Picture:
    """Return `picture` of `kind` "depth" (red near, blue far, black sky) or "class" (CLASS_COLOURS)
    in false colours; a picture of kind "colour" is returned unchanged."""
    if kind == DEPTH:
        return _depth_colours(np.asarray(picture, dtype=np.float64))
    if kind == CLASS:
        palette = np.array([CLASS_COLOURS[name] for name in CLASSES], dtype=np.uint8)
        return np.asarray(palette[np.asarray(picture, dtype=np.uint8)])
    return np.asarray(picture, dtype=np.uint8)


def _depth_colours(depth: FloatArray) -> Picture:
    """Return depths (H, W) in m as colours (H, W, 3), red near, blue far, sky black."""
    share = np.log(np.clip(depth, NEAREST_M, FARTHEST_M) / NEAREST_M)
    level = np.rint(255.0 * (1.0 - share / np.log(FARTHEST_M / NEAREST_M))).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    return np.where(np.isinf(depth)[..., None], np.array(_NO_DEPTH), colours).astype(np.uint8)
