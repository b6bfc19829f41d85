"""Perception in a closed loop: ground truth, a model in this process, or a service over HTTP.

Each is a function from the simulated world to `Perceived` (m, rad, 1/m; left positive).
"""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from trackfeatures import RoadClass, UserError
from trackfeatures.camera import CameraParameters

if TYPE_CHECKING:
    from simulator.camera import Camera
    from simulator.world.world import World

Image = NDArray[np.uint8]
JPEG_QUALITY = 95  # that of the recorded training images
LOOK_AHEAD_S = 0.1
"""The ground truth gives the curvature this far ahead: about the delay of steering and tyres."""


@dataclass(frozen=True, slots=True)
class Perceived:
    """What a controller receives of the road in one step."""

    to_lane_centre: float | None
    """m, left positive; None where no marking is visible."""
    angle: float
    """rad, positive when the car points to the right of the track."""
    heading: RoadClass
    curvature: float | None = None
    """1/m, left positive, of the road just ahead; None where it is not estimated."""
    lost_s: float = 0.0
    """s since an answer was due that came; this one is predicted from an older one. 0: it came."""
    offset_std_m: float | None = None
    """Standard deviation of the error of the answer's offset; None where it is not estimated."""
    angle_std_rad: float | None = None
    out_of_distribution: bool = False
    """Whether the image is unlike those that the model was trained on."""


class Perceive(Protocol):
    """Measures or estimates the road at the present state of the world."""

    def __call__(self, world: "World") -> Perceived: ...


class FeatureModel(Protocol):
    """What `CameraPerception` needs of a network: its camera, and its prediction for an image."""

    camera: CameraParameters

    def predict(self, image: Image) -> dict[str, Any]:
        """The prediction for an image (H, W, 3) RGB, in the format of the service's answers."""
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
        from mtlnet.inference.engine import load_engine
        from mtlnet.inference.model_card import resolve_run
        from mtlnet.inference.prediction import decode_outputs

        self._engine = load_engine(resolve_run(run))
        self._decode = decode_outputs
        self.camera: CameraParameters = self._engine.card.camera

    def predict(self, image: Image) -> dict[str, Any]:
        return self._decode(self._engine(image)).as_json()

    def close(self) -> None:
        """Nothing is held open."""


class ServiceModel:
    """The model of the perception service at `url`, with or without the path /features."""

    def __init__(self, url: str) -> None:
        from serve.client import Client

        self._client = Client(url.rstrip("/").removesuffix("/features"))
        card = self._client.model()
        tf.require_version(str(card.get("definitions_version")), f"the service at {url}")
        self.camera: CameraParameters = parse_camera(card.get("camera"))
        self.model_hash = str(card.get("model_hash"))

    def predict(self, image: Image) -> dict[str, Any]:
        import simplejpeg

        body = simplejpeg.encode_jpeg(
            np.ascontiguousarray(image), quality=JPEG_QUALITY, colorsubsampling="420"
        )
        return self._client.features(body)

    def close(self) -> None:
        self._client.close()


def parse_camera(content: Any) -> CameraParameters:
    """The camera in a service's model card. Raises UserError where it is missing or incomplete."""
    try:
        return CameraParameters(
            width=int(content["width"]),
            height=int(content["height"]),
            fov_y_deg=float(content["fov_y_deg"]),
            x=float(content["x"]),
            y=float(content["y"]),
            z=float(content["z"]),
            pitch_deg=float(content["pitch_deg"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"the service's model card gives no usable camera ({error!r}), found {content}; use a "
            "perception service of this version"
        ) from error


class CameraPerception:
    """Perception by a camera on the car and a network that reads its images."""

    def __init__(self, camera: "Camera", model: FeatureModel) -> None:
        self.camera = camera
        self._model = model
        self.image: Image | None = None
        """The last one."""
        self.answer: dict[str, Any] = {}
        """The model's to it, in the format of the service's answers."""

    def __call__(self, world: "World") -> Perceived:
        return self.read(self.ask(self.capture(world)))

    def capture(self, world: "World") -> Image:
        """The image of the present state; in the thread that opened the camera."""
        image: Image = self.camera.render(world.body_pose(), world.traffic.poses())
        self.image = image
        return image

    def ask(self, image: Image) -> dict[str, Any]:
        """The model's answer; in any one thread at a time."""
        return self._model.predict(image)

    def read(self, answer: dict[str, Any]) -> Perceived:
        """The quantities of an answer that steering needs."""
        self.answer = answer
        return parse_prediction(answer)


def parse_prediction(answer: dict[str, Any]) -> Perceived:
    """The quantities that steering needs. Raises UserError where one is missing or not finite."""
    try:
        offset, angle = answer["to_lane_centre_m"], float(answer["angle_rad"])
        probabilities = [float(answer["heading"][heading.name.lower()]) for heading in RoadClass]
        to_lane_centre = None if offset is None else float(offset)
        std = answer.get("std") or {}
        offset_std, angle_std = std.get("to_lane_centre"), std.get("angle")
        _require_finite(
            angle, to_lane_centre or 0.0, *probabilities, offset_std or 0.0, angle_std or 0.0
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            "the service's answer lacks to_lane_centre_m, angle_rad or heading in finite numbers "
            f"({error!r}); is it a perception service of this version?"
        ) from error
    return Perceived(
        to_lane_centre,
        angle,
        RoadClass(int(np.argmax(probabilities))),
        offset_std_m=offset_std,
        angle_std_rad=angle_std,
        out_of_distribution=bool(answer.get("out_of_distribution")),
    )


def _require_finite(*values: float) -> None:
    # A NaN passes every comparison meant to stop it, and would steer to full lock.
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{values} are not all finite")


class PerceptionSource:
    """A perception function and the resources it holds open. A context manager."""

    def __init__(self, perceive: Perceive, *closing: Callable[[], None]) -> None:
        self.perceive = perceive
        self._stack = ExitStack()
        for close in closing:
            self._stack.callback(close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


def check_perception(name: str, model: str) -> None:
    """Raise UserError for a perception of an unknown name, or a run `model` that is missing."""
    if name == "model":
        from mtlnet.inference.model_card import resolve_run

        resolve_run(model)
    elif name != "truth" and ":" not in name:
        raise UserError(
            f"perception {name!r} is unknown; give truth, model, or the address of a "
            "service such as http://127.0.0.1:8000"
        )


def open_perception(
    name: str, world: "World", *, model: str, lane_centre: float, light: str, seed: int
) -> PerceptionSource:
    """The perception named "truth", "model" or by a service's address.

    Raises UserError for any other name, a missing model, or a service that does not answer.
    """
    check_perception(name, model)
    if name == "truth":
        return PerceptionSource(truth(lane_centre))
    network: FeatureModel = LocalModel(model) if name == "model" else ServiceModel(name)
    from simulator.camera import open_camera

    camera = open_camera(world.road, network.camera, light=light, seed=seed)
    return PerceptionSource(CameraPerception(camera, network), network.close, camera.close)
