"""The camera, which renders a road and its cars. World frame, metres, radians."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulator.arrays import FloatArray
from simulator.camera.core import optics
from simulator.camera.core.context import FRAME_BINDING, NIGHT, Graphics, graphics
from simulator.camera.core.lens_view import LensView
from simulator.camera.core.render_modes import CLASS, COLOUR, DEPTH, ViewRequest
from simulator.camera.lens.imaging import Imaging
from simulator.camera.scene.cars import Cars, shared_cars
from simulator.camera.scene.light import Light
from simulator.camera.scene.precipitation import Precipitation
from simulator.camera.scene.scene import Scene, VisibleScene
from simulator.camera.scene.sky import Sky
from simulator.camera.scene.terrain import Survey
from simulator.camera.scene.varied_light import lit_as
from simulator.track.road import Road
from simulator.varied.look import RoadLook
from simulator.vehicle.car import CarParameters
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

Picture = NDArray[Any]

MAX_SIZE = 4096
DRIVER_CAMERA = CameraParameters()
_OWN_PAINT = 0
PARKED_REACH_M = 110.0
"""Distance (m) from the camera beyond which parked cars are not drawn."""
HEADLIGHT_AT = (2.1, 0.0, 0.4)
"""Position, in the body frame in m, of the one light source that replaces both headlights."""


def check_size(width: int, height: int) -> None:
    """Raises UserError unless `width` and `height` are from 8 to MAX_SIZE (4096) px."""
    if not (8 <= width <= MAX_SIZE and 8 <= height <= MAX_SIZE):
        raise UserError(f"picture size {width} x {height}; each side must be 8 to {MAX_SIZE} px")


@dataclass(frozen=True)
class _LoadedScene:
    """One scene under one light in graphics memory; `frame` (56,) is its uniform block `Frame`."""

    light: Light
    scene: Scene
    sky: Sky
    precipitation: Precipitation | None
    frame: NDArray[np.float32]
    first_paint: int
    cars: Cars
    imaging: Imaging | None
    """Effects of cabin, lens and sensor; None: the rendered picture is recorded unchanged."""


@dataclass(frozen=True)
class _Shot:
    """The content of one picture: eye, visible scene, visible cars (n, 6) nearest first."""

    eye: optics.Eye
    seen: VisibleScene
    cars: FloatArray
    paints: list[int]


class Camera:
    """A camera on a car that draws one scene of `road`: the random scenery of `seed` under `light`.
    `look` is the random paint, surface and roadside of `--roads varied`; None for `--roads paper`.

    The `scenes` scenes used last stay in graphics memory. All cameras of a process share one OpenGL
    context (see `context`). Any thread may use them, but only one thread draws at a time.
    The same road, seed, light, look, pose and cars give the same bytes on the same renderer. Raises
    UserError for a picture size out of range, NoRendererError without EGL, and ForkedRendererError
    in a process that was forked from a process with a camera.
    """

    def __init__(
        self,
        road: Road,
        parameters: CameraParameters = DRIVER_CAMERA,
        *,
        seed: int,
        light: Light,
        look: RoadLook | None = None,
        scenes: int = 1,
    ) -> None:
        check_size(parameters.width, parameters.height)
        self.road, self.parameters = road, parameters
        self.width, self.height = parameters.width, parameters.height
        self.intrinsics: FloatArray = parameters.intrinsics()
        distorted = parameters.distortion != "none"
        self._lens = LensView.of(parameters, MAX_SIZE) if distorted else None
        self._drawn = parameters if self._lens is None else self._lens.drawn
        self._drawn_intrinsics: FloatArray = self._drawn.intrinsics()
        self._graphics: Graphics = graphics()
        self._survey = Survey.of(road)
        self._cache_size = scenes
        self._cache: dict[tuple[int, Light, RoadLook | None], _LoadedScene] = {}
        self._current: _LoadedScene | None = None
        self._last_s: float | None = None
        self.change_scene(seed, light, look)

    @property
    def light(self) -> Light:
        """The light of the current scene."""
        return self._loaded.light

    def change_scene(self, seed: int, light: Light, look: RoadLook | None = None) -> None:
        """From now on draw the scene of the road that `seed`, `light` and `look` determine."""
        with self._graphics.turns:
            self._current = None
            found = self._cache.pop((seed, light, look), None)
            if found is None:
                while len(self._cache) >= self._cache_size:
                    del self._cache[next(iter(self._cache))]
                self._graphics.free_unused()
                found = self._load_scene(seed, light, look)
            # The least recently used scene comes first and is released next.
            self._cache[seed, light, look] = self._current = found

    def _load_scene(self, seed: int, light: Light, look: RoadLook | None) -> _LoadedScene:
        graphics = self._graphics
        if look:
            light = lit_as(light, look.light, look.surface.tone)
        frame = np.concatenate([np.zeros(24), *_light_rows(light), np.zeros(8)]).astype(np.float32)
        self._set_frame(frame, optics.eye_of(self.parameters, np.zeros(6), "front"))
        scene = Scene(graphics, self.road, self._survey, seed, light, look)
        return _LoadedScene(
            light,
            scene,
            # The sky is rendered with the light of the bound uniform block `Frame`.
            Sky(graphics, light.weather, float(self._drawn_intrinsics[0, 0])),
            Precipitation(graphics, light, seed) if light.falling > 0.0 else None,
            frame,
            # Cars of different rounds differ in colour; index 0 is the ego car's colour.
            first_paint=1 + seed % 5,
            cars=shared_cars(graphics, *([NIGHT] if look and look.light.night else [])),
            imaging=Imaging(look, light, self.parameters, scene.bridges, self.road.track.length_m)
            if look
            else None,
        )

    def render(
        self, body_pose: ArrayLike, others: ArrayLike | None = None, view: str = "front"
    ) -> Picture:
        """Draw `view`, one of VIEWS, from a car at `body_pose`; returns (height, width, 3) uint8
        RGB.

        `body_pose` (6,) is x, y, z, roll, pitch, yaw of the centre of gravity (m, rad). `others`
        (n, 6) are the poses of other cars, with z on the ground below each car. For a car that
        jumps from place to place use `render_views` with `near_s`.
        """
        return self._views(body_pose, others, {view: ViewRequest(view)})[view]

    def render_views(
        self,
        body_pose: ArrayLike,
        others: ArrayLike | None = None,
        views: Sequence[str] = ("front",),
        *,
        near_s: float | None = None,
    ) -> dict[str, Picture]:
        """Draw `views` from one pose (arguments as in `render`); returns the pictures by name.

        The name of a view (one of VIEWS) requests the colour picture (height, width, 3) uint8 RGB;
        "VIEW:depth" the distance along the optical axis (height, width) float32, m, inf in the sky;
        "VIEW:class" the index into CLASSES (height, width) uint8. Depth and class show the surface
        at the pixel's centre, without leaves and hedges less than half opaque. `near_s` is the
        car's approximate position (m) along the road, to distinguish a bridge from the road below
        it; None means the position in the last picture. Raises UserError for an unknown name.
        """
        self._last_s = self._last_s if near_s is None else near_s
        return self._views(body_pose, others, {name: ViewRequest.of(name) for name in views})

    def _views(
        self, body_pose: ArrayLike, others: ArrayLike | None, wanted: dict[str, ViewRequest]
    ) -> dict[str, Picture]:
        with self._graphics.turns:
            return self._draw_views(body_pose, others, wanted)

    def _draw_views(
        self, body_pose: ArrayLike, others: ArrayLike | None, wanted: dict[str, ViewRequest]
    ) -> dict[str, Picture]:
        taken: dict[ViewRequest, Picture] = {}
        for view in dict.fromkeys(each.view for each in wanted.values()):
            kinds = {each.kind for each in wanted.values() if each.view == view}
            shot = self._prepare(body_pose, others, view)
            if COLOUR in kinds:
                taken[ViewRequest(view)] = self._recorded(self._draw_colours(shot), shot, view)
            if kinds - {COLOUR}:
                labels = self._draw_labels(shot)
                taken[ViewRequest(view, DEPTH)] = np.ascontiguousarray(labels[..., 0])
                taken[ViewRequest(view, CLASS)] = labels[..., 1].astype(np.uint8)
        return {name: taken[each] for name, each in wanted.items()}

    def _prepare(self, body_pose: ArrayLike, others: ArrayLike | None, view: str) -> _Shot:
        """Fill the uniforms for a view, and cull the parts of the scene outside it."""
        loaded = self._loaded
        eye = optics.eye_of(self.parameters, body_pose, view)
        self._set_headlights(loaded.frame, np.asarray(body_pose, dtype=np.float64), eye)
        self._set_frame(loaded.frame, eye)
        planes = optics.frustum(eye, self._drawn_intrinsics, self._drawn.width, self._drawn.height)
        cars, paints = self._cars_in_view(body_pose, others, view)
        chosen = loaded.cars.visible(cars, eye.place, planes)
        return _Shot(
            eye, loaded.scene.visible(eye, planes), cars[chosen], [paints[k] for k in chosen]
        )

    def _draw_colours(self, shot: _Shot) -> NDArray[np.uint8]:
        loaded, place = self._loaded, shot.eye.place
        target = self._graphics.targets.of(self._drawn.width, self._drawn.height, labels=False)
        self._graphics.begin(target)
        loaded.cars.draw(shot.cars, shot.paints, place, labels=False)
        loaded.scene.draw(shot.seen, labels=False)
        loaded.sky.draw()
        self._graphics.blend()
        loaded.cars.draw_shadows(shot.cars, place, loaded.light)
        loaded.scene.draw_blended(shot.seen)
        if loaded.precipitation is not None:
            loaded.precipitation.draw(shot.eye, self._drawn_intrinsics[0, 0])
        drawn = target.colours()
        return drawn if self._lens is None else self._lens.colours(drawn)

    def _recorded(self, picture: NDArray[np.uint8], shot: _Shot, view: str) -> NDArray[np.uint8]:
        """Apply lens, cabin and sensor effects to a driver view; return other views unchanged."""
        imaging = self._loaded.imaging
        if imaging is None or view != "front":
            return picture
        return imaging.developed(picture, shot.eye, self._s_of(*shot.eye.place[:2].tolist()))

    def _draw_labels(self, shot: _Shot) -> NDArray[np.float32]:
        """Draw depth and class (height, width, 2) of the scene without rain and snow."""
        target = self._graphics.targets.of(self._drawn.width, self._drawn.height, labels=True)
        self._graphics.begin(target, labels=True)
        self._loaded.cars.draw(shot.cars, shot.paints, shot.eye.place, labels=True)
        self._loaded.scene.draw(shot.seen, labels=True)
        drawn = target.labels()
        return drawn if self._lens is None else self._lens.labels(drawn)

    def extrinsics(self, view: str = "front", body_pose: ArrayLike = (0.0,) * 6) -> FloatArray:
        """Return the matrix E (4, 4) from the body frame to the camera frame
        (x right, y down, z ahead; m).

        E is constant for views mounted on the car. The views `chase` and `top` stay level, so their
        matrices depend on the roll and pitch of `body_pose` (6,). With the matrix K of
        `intrinsics`, K @ (E @ (x, y, z, 1))[:3] is depth * (u, v, 1), before lens distortion.
        Raises UserError for an unknown view.
        """
        return optics.extrinsics(self.parameters, body_pose, view)

    def project(
        self, points: ArrayLike, body_pose: ArrayLike, view: str = "front"
    ) -> tuple[FloatArray, FloatArray]:
        """Project world points (N, 3) m: returns pixels (N, 2) (u right, v down) and depth (N,) m.
        Pixels are NaN for points behind the eye and outside the lens's field of view."""
        eye = optics.eye_of(self.parameters, body_pose, view)
        return optics.project(eye, self.parameters, points)

    def close(self) -> None:
        """Free the graphics memory, now or when the thread that is drawing has finished. A closed
        camera cannot render."""
        self._cache, self._current = {}, None
        self._graphics.turns.free_if_idle()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def shadow_fraction(self, body_pose: ArrayLike, near_s: float | None = None) -> float:
        """Return the share (0 to 1) of the asphalt up to 30 m ahead of the car that is in hard
        shadow. `near_s`: as in `render_views`."""
        self._last_s = self._last_s if near_s is None else near_s
        s = self._s_of(*np.asarray(body_pose, dtype=np.float64)[:2].tolist())
        return self._loaded.scene.mask.fraction(s, self.road.half_asphalt)

    def _s_of(self, x: float, y: float) -> float:
        """Return the distance s (m) along the road of the point (x, y) (m, world)."""
        self._last_s, _ = self.road.track.project(x, y, self._last_s)
        return self._last_s

    def _cars_in_view(
        self, body_pose: ArrayLike, others: ArrayLike | None, view: str
    ) -> tuple[FloatArray, list[int]]:
        """Return poses (n, 6), on the ground, and paint indices of the cars to draw."""
        poses = np.asarray(() if others is None else others, dtype=np.float64).reshape(-1, 6)
        first = self._loaded.first_paint
        paints = [first + k for k in range(len(poses))]
        parked = self._loaded.scene.parked
        if len(parked):
            place = np.asarray(body_pose, dtype=np.float64)[:2]
            near = np.hypot(*(parked[:, :2] - place).T) < PARKED_REACH_M
            poses = np.vstack([poses, parked[near]])
            paints += np.flatnonzero(near).tolist()
        if view in ("chase", "top"):
            own = np.asarray(body_pose, dtype=np.float64).copy()
            own[:3] -= optics.rotation(*own[3:])[:, 2] * CarParameters.cg_height
            poses, paints = np.vstack([poses, own]), [*paints, _OWN_PAINT]
        return poses, paints

    @property
    def _loaded(self) -> _LoadedScene:
        if self._current is None:
            raise RuntimeError("this camera is closed; make a new one")
        return self._current

    def _set_headlights(
        self, block: NDArray[np.float32], body_pose: FloatArray, eye: optics.Eye
    ) -> None:
        """Write position and direction of the headlights into `block`, the block `Frame`."""
        turn = optics.rotation(*body_pose[3:].tolist())
        block[48:51] = body_pose[:3] + turn @ np.array(HEADLIGHT_AT) - eye.place
        block[52:55] = turn[:, 0]

    def _set_frame(self, block: NDArray[np.float32], eye: optics.Eye) -> None:
        """Write the eye's projection into `block`, the uniform block `Frame`, and bind it."""
        drawn = self._drawn
        clip = optics.clip_matrix(eye, self._drawn_intrinsics, drawn.width, drawn.height)
        block[:16] = clip.T.reshape(-1)
        block[16:19], block[20:23] = eye.place, eye.axes[2]
        self._graphics.frame.write(block.tobytes())
        self._graphics.frame.bind_to_uniform_block(FRAME_BINDING)


def open_camera(road: Road, parameters: CameraParameters, *, light: str, seed: int) -> Camera:
    """Make a camera for `light`, one of the kinds of light. `seed` determines the scenery, the
    parameters of the light and, on a road of `--roads varied`, the random paint, surface and
    roadside."""
    drawn = Light.named(light, np.random.default_rng([seed, 2]))
    look = RoadLook.drawn(seed) if road.carriageway else None
    return Camera(road, parameters, seed=seed, light=drawn, look=look)


def _light_rows(light: Light) -> list[tuple[float, ...]]:
    """Return the rows (4 floats each) of the uniform block `Frame` that describe light and air."""
    return [
        (*light.sun_direction, light.shade),
        (*light.sun, light.exposure),
        (*light.sky, light.haze_per_km / 1000.0 / math.log(2.0)),
        (*light.zenith, light.clouds),
        (*light.horizon, light.cover),
        (*light.haze, 0.0),
    ]
