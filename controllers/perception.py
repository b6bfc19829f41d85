"""How a drive perceives the road: the truth, a model in this process, or a service over HTTP.

Each is a function of the world as it stands; a fake in a test is a lambda.
"""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from trackfeatures import Heading, UserError

if TYPE_CHECKING:
    from simulator.camera import Camera
    from simulator.world.world import World

Image = NDArray[np.uint8]
JPEG_QUALITY = 95  # that of the recorded training images
LOOK_AHEAD_S = 0.1
"""The truth tells the curvature this far ahead: about what steering and tyres take to answer."""


@dataclass(frozen=True, slots=True)
class Perceived:
    """What is seen of the road at one moment; m, rad and 1/m, left positive."""

    to_lane_centre: float | None
    """None where no marking is seen."""
    angle: float
    heading: Heading
    curvature: float | None = None
    """Of the road just ahead; None where nobody tells."""


class Perceive(Protocol):
    """Reads the road off the world as it stands."""

    def __call__(self, world: "World") -> Perceived: ...


class FeatureModel(Protocol):
    """What `CameraPerception` asks of a network: its camera, and its answer to an image."""

    camera: dict[str, Any]

    def look(self, image: Image) -> dict[str, Any]:
        """The answer to an image (H, W, 3) RGB, as the service gives it."""
        ...

    def close(self) -> None: ...


def truth(lane_centre: float) -> Perceive:
    """The exact features, with the offset from the lane whose centre lies at `lane_centre` m."""

    def perceive(world: "World") -> Perceived:
        now = world.state
        ahead = now.s + LOOK_AHEAD_S * max(now.vx, 0.0)
        return Perceived(
            to_lane_centre=now.to_middle - lane_centre,
            angle=now.angle,
            heading=world.features().heading,
            curvature=world.road.track.curvature(ahead),
        )

    return perceive


class LocalModel:
    """The model of a run, in this process."""

    def __init__(self, run: str) -> None:
        from dataclasses import asdict

        from mtlnet.inference.engine import load_engine
        from mtlnet.inference.model_card import resolve_run
        from mtlnet.inference.prediction import decode_outputs

        self._engine = load_engine(resolve_run(run))
        self._interpret = decode_outputs
        self.camera: dict[str, Any] = asdict(self._engine.card.camera)

    def look(self, image: Image) -> dict[str, Any]:
        return self._interpret(self._engine(image)).as_json()

    def close(self) -> None:
        """Nothing to give back."""


class Service:
    """A perception service at `url`, which may be that of the service or of its /features."""

    def __init__(self, url: str) -> None:
        from serve.client import Client

        self._client = Client(url.rstrip("/").removesuffix("/features"))
        card = self._client.model()
        tf.require_version(str(card.get("definitions_version")), f"the service at {url}")
        if not isinstance(card.get("camera"), dict):
            raise UserError(f"the service at {url} does not say which camera its model saw through")
        self.camera: dict[str, Any] = card["camera"]

    def look(self, image: Image) -> dict[str, Any]:
        import simplejpeg

        body = simplejpeg.encode_jpeg(
            np.ascontiguousarray(image), quality=JPEG_QUALITY, colorsubsampling="420"
        )
        return self._client.features(body)

    def close(self) -> None:
        self._client.close()


class CameraPerception:
    """Perception by a camera on the car and a network that reads its images."""

    def __init__(self, camera: "Camera", vision: FeatureModel) -> None:
        self._camera = camera
        self._vision = vision

    def __call__(self, world: "World") -> Perceived:
        image = self._camera.render(world.body_pose(), world.traffic.poses())
        return read_answer(self._vision.look(image))


def read_answer(answer: dict[str, Any]) -> Perceived:
    """What an answer of the service says; UserError when it is none."""
    try:
        offset, angle = answer["to_lane_centre_m"], float(answer["angle_rad"])
        classes = answer["heading"]
        likeliest = max(Heading, key=lambda heading: float(classes[heading.name.lower()]))
        to_lane_centre = None if offset is None else float(offset)
        _finite(angle, to_lane_centre or 0.0, *(float(classes[h.name.lower()]) for h in Heading))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            "the service's answer lacks to_lane_centre_m, angle_rad or heading in finite numbers "
            f"({error!r}); is it a perception service of this version?"
        ) from error
    return Perceived(to_lane_centre, angle, likeliest)


def _finite(*values: float) -> None:
    # A NaN passes every comparison that would stop it, and would steer to full lock.
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{values} are not all finite")


class PerceptionSource:
    """A `Perceive` chosen by name, with what it holds open. A context manager."""

    def __init__(self, perceive: Perceive, *closing: Callable[[], None]) -> None:
        self.perceive = perceive
        self._stack = ExitStack()
        for close in closing:
            self._stack.callback(close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def open_eyes(
    perception: str, world: "World", *, model: str, lane_centre: float, light: str, seed: int
) -> PerceptionSource:
    """The perception named "truth", "model" or a service's address.

    Raises UserError for any other word, a missing model, or a service that is not there.
    """
    if perception == "truth":
        return PerceptionSource(truth(lane_centre))
    if perception == "model":
        vision: FeatureModel = LocalModel(model)
    elif ":" in perception:
        vision = Service(perception)
    else:
        raise UserError(
            f"perception {perception!r} is unknown; give truth, model, or the address of a "
            "service such as http://127.0.0.1:8000"
        )
    camera = _camera(vision.camera, world, light, seed)
    return PerceptionSource(CameraPerception(camera, vision), vision.close, camera.close)


def _camera(wanted: dict[str, Any], world: "World", light: str, seed: int) -> "Camera":
    """The camera a model saw through in training, on this road."""
    from simulator.camera import Camera, Light, Mount

    try:
        size = int(wanted["width"]), int(wanted["height"])
        place = {name: float(wanted[name]) for name in ("x", "y", "z", "pitch_deg", "fov_y_deg")}
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"the model's camera {wanted} is incomplete ({error!r})") from error
    sky = Light.named(light, np.random.default_rng([seed, 2]))
    return Camera(
        world.road, seed=seed, light=sky, mount=Mount(**place), width=size[0], height=size[1]
    )
