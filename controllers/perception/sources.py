"""Sources of perception: ground truth, a model in this process, or a service over HTTP.

Each source is a function of the simulated world that returns `Perceived`.
"""

import json
import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from controllers.perception.perceived import Perceive, Perceived
from datagen.recording.images import encode
from trackfeatures import RoadClass, UserError
from trackfeatures.camera import CameraParameters

if TYPE_CHECKING:
    from simulator.camera import Camera
    from simulator.world.world import World

Image = NDArray[np.uint8]
LOOK_AHEAD_S = 0.1
"""The ground truth contains the curvature at the point that the car reaches after this time (s),
which is about the delay of steering and tyres."""


class FeatureModel(Protocol):
    """The part of a model that `CameraPerception` uses: its camera and its predictions."""

    camera: CameraParameters

    def predict(self, image: Image) -> dict[str, Any]:
        """Return the prediction for an RGB image (H, W, 3), with the members of a service's answer
        to POST /features."""

    def close(self) -> None:
        """Close the model's connection, if it has one."""


def truth(lane_centre: float) -> Perceive:
    """Return a perception that measures exactly; its offset is measured from the line `lane_centre`
    (m left of the track's centre)."""

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
    """The model of the run `run` (a folder or a name), computed in this process. Its answers are
    averaged over `views` views of each image (`mtlnet.inference.view_average`)."""

    def __init__(self, run: str, views: int = 1) -> None:
        from mtlnet.inference.engine import load_engine
        from mtlnet.inference.model_card import resolve_run
        from mtlnet.inference.prediction import decode_outputs

        self._engine = load_engine(resolve_run(run), views=views)
        self._decode = decode_outputs
        self.camera: CameraParameters = self._engine.card.camera

    def predict(self, image: Image) -> dict[str, Any]:
        return self._decode(self._engine(image)).as_json()

    def close(self) -> None:
        """Do nothing: the model has no connection."""


def model_identity(run: str) -> str:
    """Return what determines the answers of the `LocalModel` of the run `run` (a folder or a name)
    to an image, as JSON: the hashes of the model's files that its card states, its camera, and the
    precision on this processor, for int8 with the hashes of the int8 graph."""
    from mtlnet.inference.engine import INT8, default_precision, read_export
    from mtlnet.inference.model_card import read_card, resolve_run

    folder = resolve_run(run)
    card = read_card(folder)
    precision = default_precision(folder, card)
    export = read_export(folder / INT8) if precision == "int8" else None
    return json.dumps(
        [card.files, card.camera.as_dict(), precision, export and export["files"]], sort_keys=True
    )


class ServiceModel:
    """The model of the perception service at `url`; the path may end with /features.

    Raises UserError for a service that does not answer, and DefinitionsMismatch for a service with
    another version of the definitions.
    """

    def __init__(self, url: str) -> None:
        from serve.client import Client

        self._client = Client(url.rstrip("/").removesuffix("/features"))
        card = self._client.model()
        tf.require_version(str(card.get("definitions_version")), f"the service at {url}")
        self.camera: CameraParameters = parse_camera(card.get("camera"))
        known = ("files", "camera", "engine", "precision", "views", "int8_files")
        self.identity = json.dumps({name: card.get(name) for name in known})
        """Hashes of the model's files, its camera, and the library, precision, number of views and
        int8 graph with which the service computes its answers, as JSON."""

    def predict(self, image: Image) -> dict[str, Any]:
        return self._client.features(encode(image, "jpeg"))  # like the recorded training images

    def close(self) -> None:
        self._client.close()


def parse_camera(content: Any) -> CameraParameters:
    """Read the camera in a service's model card. `content` is a dictionary with the fields of
    `CameraParameters`, of which roll, yaw, lens and `height_std` may be missing.

    Raises UserError for a missing or unknown field and an impossible value.
    """
    try:
        sizes = {name: int(content[name]) for name in ("width", "height")}
        numbers = {name: float(content[name]) for name in ("fov_y_deg", "x", "y", "z", "pitch_deg")}
        turns = ("roll_deg", "yaw_deg", "height_std")
        numbers |= {name: float(content[name]) for name in turns if name in content}
        _require_finite(*numbers.values())
        return CameraParameters(**{**content, **sizes, **numbers})
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"the service's model card gives no usable camera ({error!r}), found {content}; use a "
            "perception service of this version"
        ) from error


class CameraPerception:
    """Perception by a camera on the car and a network that computes the features of its images."""

    def __init__(self, camera: "Camera", model: FeatureModel) -> None:
        self.camera = camera
        self._model = model
        self.image: Image | None = None
        """The last image, (H, W, 3) RGB."""
        self.answer: dict[str, Any] = {}
        """The model's answer to the last image, in the format of the service's answers."""

    def __call__(self, world: "World") -> Perceived:
        return self.read(self.ask(self.capture(world)))

    def capture(self, world: "World") -> Image:
        """Render the image (H, W, 3) RGB of the present state. Call it in the thread that opened
        the camera."""
        image: Image = self.camera.render(world.body_pose(), world.traffic.poses())
        self.image = image
        return image

    def ask(self, image: Image) -> dict[str, Any]:
        """Return the model's answer to `image` (H, W, 3) RGB, with the members of a service's
        answer. Call it in any thread, but not in two threads at once."""
        return self._model.predict(image)

    def read(self, answer: dict[str, Any]) -> Perceived:
        """Store a model's answer and convert it for a controller. Raises UserError for a missing or
        non-finite quantity."""
        self.answer = answer
        return parse_prediction(answer)


def parse_prediction(answer: dict[str, Any]) -> Perceived:
    """Convert a service's answer for a controller. Raises UserError for a missing or non-finite
    quantity."""
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
    # A NaN passes every comparison with a limit, and would steer to full lock.
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{values} are not all finite")


def check_perception(name: str, model: str, views: int = 1) -> None:
    """Raise UserError for an unknown perception `name`, or if `name` is "model" and there is no run
    `model`. Also raises UserError for a number `views` of averaged views other than 1, 2 or 6, and
    for more than one view of the images that a service answers."""
    from mtlnet.inference.view_average import check_count

    check_count(views)
    if name == "model":
        from mtlnet.inference.model_card import resolve_run

        resolve_run(model)
    elif ":" in name and views != 1:
        raise UserError(
            f"--views {views} is for --perception model; start the service at {name} with `serve "
            f"--views {views}` instead"
        )
    elif name != "truth" and ":" not in name:
        raise UserError(
            f"perception {name!r} is unknown; give truth, model, or the address of a "
            "service such as http://127.0.0.1:8000"
        )


@contextmanager
def open_perception(
    name: str,
    world: "World",
    *,
    model: str,
    lane_centre: float,
    light: str,
    seed: int,
    views: int = 1,
) -> Iterator[Perceive]:
    """Open the perception `name`: "truth", "model" (the run `model`, whose answers are averaged
    over `views` views of each image), or a service's address.

    `lane_centre` (m, left positive) is the centre of the lane to follow. The images have the light
    `light` (e.g. "clear") and random scenery by `seed`. Raises UserError for another name, a
    missing model, or a service that does not answer.
    """
    check_perception(name, model, views)
    if name == "truth":
        yield truth(lane_centre)
        return
    from simulator.camera import open_camera

    network: FeatureModel = LocalModel(model, views) if name == "model" else ServiceModel(name)
    with (
        closing(network),
        closing(open_camera(world.road, network.camera, light=light, seed=seed)) as camera,
    ):
        yield CameraPerception(camera, network)
