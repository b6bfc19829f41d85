"""The Python interface: `from mtlnet import load`, then `load("default").predict("image.jpg")`."""

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from numbers import Real
from pathlib import Path
from threading import Lock
from typing import Any, TypedDict, Unpack, overload

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.engine import Engine, load_engine, parse_kind, parse_precision
from mtlnet.inference.image_decoding.decode import decode_file, read_whole_image
from mtlnet.inference.model_card import ModelCard, resolve_run
from mtlnet.inference.overlay import draw_markings
from mtlnet.inference.prediction import Prediction
from mtlnet.inference.rectification import Rectification, read_camera
from mtlnet.predict.lenses import with_lens
from mtlnet.predict.run import answer, first_of
from mtlnet.predict.writers import draw_prediction
from mtlnet.sources.find import NO_TOPIC, Source, find_sources
from mtlnet.sources.kinds import SourceKind
from mtlnet.sources.pictures import Lens, Picture, fit
from mtlnet.sources.read import SourceImage, read_sources
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

Image = NDArray[np.uint8]
Bytes = bytes | bytearray | memoryview
OneImage = str | Path | Bytes | Image
"""An image: a file, the bytes of a file (JPEG, PNG, ...), or pixels (H, W, 3) uint8 RGB."""
ACCEPTED = (
    "a file, folder or pattern, a webcam (as text, such as '0') or stream, the bytes of an image "
    "file, pixels as a numpy array (height, width, 3) of uint8 RGB, or a list of images"
)

log = logging.getLogger("mtlnet")


@dataclass(frozen=True, kw_only=True)
class Features(Prediction):
    """The track features of one image. It has all attributes of `Prediction`, and the image's
    camera."""

    source: SourceImage
    """The image in the model's view, with its name and time."""
    camera: CameraParameters
    """The camera that took the image. Its size in px can differ from the image's."""
    model_camera: CameraParameters
    """The camera that the model was trained with."""

    @property
    def name(self) -> str:
        """Name of the image: its file, or `film.mp4#12` for frame 12 of a film. Empty for an image
        that was given as bytes or pixels."""
        return self.source.name

    @property
    def time_s(self) -> float | None:
        """Time of the image, s: since the start of its film or recorded round, or since 1970 for an
        image of a stream, webcam or ROS 2 bag. None if it is unknown."""
        return self.source.time_s

    def draw(self, image: OneImage | None = None) -> Image:
        """Draw the features; returns a picture (H, W, 3), uint8 RGB.

        `image`: the image that was given to `predict`, in any size with the same aspect ratio; the
        markings are drawn on a copy of this image, as straight lines on a flat road. None: the
        result is the image in the model's view, with the markings, a view from above and the
        features as text.
        """
        if image is None:
            return draw_prediction(self.source, self, self.model_camera)
        pixels = _pixels(image)
        height, width = pixels.shape[:2]
        if self.source.lens is None:  # cropped to the model's aspect ratio
            camera = replace(self.camera, width=width, height=height)
        else:
            camera = self.camera.resized(width, height)
        return draw_markings(pixels, camera, self)


class Options(TypedDict, total=False):
    """The keyword arguments of `Model.predict`."""

    camera: str | Path | CameraParameters | None
    fov_y_deg: float | None
    topic: str


class Model:
    """A trained model. Several threads can call the same model; their images are predicted one at a
    time."""

    def __init__(
        self,
        run: Path,
        engine: str = "openvino",
        precision: str | None = None,
        threads: int = 1,
        *,
        views: int = 1,
    ) -> None:
        self.folder = run
        self._options = (parse_kind(engine), parse_precision(precision))
        self._views = views
        self._engine = self._load(threads)
        self._lock = Lock()

    def _load(self, threads: int = 1) -> Engine:
        return load_engine(self.folder, *self._options, threads=threads, views=self._views)

    @property
    def card(self) -> ModelCard:
        """The model card: network, camera, training data, hashes of the files."""
        return self._engine.card

    @property
    def camera(self) -> CameraParameters:
        """The camera that the model was trained with."""
        return self.card.camera

    @overload
    def predict(self, source: Bytes | Image, **options: Unpack[Options]) -> Features: ...

    @overload
    def predict(self, source: Sequence[OneImage], **options: Unpack[Options]) -> list[Features]: ...

    @overload
    def predict(self, source: str | Path, **options: Unpack[Options]) -> Any: ...

    def predict(
        self,
        source: OneImage | Sequence[OneImage],
        *,
        camera: str | Path | CameraParameters | None = None,
        fov_y_deg: float | None = None,
        topic: str = "",
    ) -> Any:
        """Predict the features of one image, of a list of images, or of all images of a source.

        For an image file, its bytes, or pixels (H, W, 3) uint8 RGB, the result is `Features`; for a
        list of images it is a list of `Features`. For a film, folder, pattern, recorded round, ROS
        2 bag, webcam number or address of a stream (all as text, as for `mtlnet predict`) it is an
        iterator, which reads and predicts image by image. `camera`: a camera file or
        CameraParameters of the images; "model": the model's camera took them; None: as with
        "model", except that the camera of a film or stream is estimated from its pictures, and that
        the camera that a recording states is used. `fov_y_deg`: vertical field of view of the
        images in degrees, if no `camera` is given; not for a recorded round.
        `topic`: topic with the pictures of a recording.

        Raises UserError for a source of another type or that cannot be used (ImageError for one
        image), and for options that do not apply to it. An iterator raises UserError after the last
        image, if any image could not be used. Messages about files that are skipped and about
        cameras that are found go to the logger `mtlnet`.
        """
        lens = self._lens(camera, fov_y_deg)
        if isinstance(source, str | Path):
            sources = find_sources([str(source)], log.info, topic)
            if [(s.path, s.kind) for s in sources] != [(Path(source), SourceKind.IMAGE)]:
                return self._all(sources, lens, own=camera is not None)
            if sources[0].problem:
                raise UserError(sources[0].problem)
        elif topic:
            raise UserError(f"topic {topic!r}: {NO_TOPIC}")
        if isinstance(source, str | Path | Bytes | np.ndarray):
            return self._one(source, lens)
        if not isinstance(source, Iterable):
            raise _not_accepted(source)
        return [self._one(image, lens) for image in source]

    __call__ = predict

    def _lens(self, camera: str | Path | CameraParameters | None, fov_y_deg: float | None) -> Lens:
        if camera is None or (isinstance(camera, str) and camera == "model"):
            if fov_y_deg is None:
                return None
            if not isinstance(fov_y_deg, Real) or not 0 < fov_y_deg < 180:
                raise UserError(f"fov_y_deg is {fov_y_deg!r}; give degrees above 0 and below 180")
            return float(fov_y_deg)  # from a number of numpy
        if fov_y_deg is not None:
            raise UserError("the camera holds the field of view; leave fov_y_deg out")
        if not isinstance(camera, CameraParameters | str | Path):
            raise UserError(f"the camera is {camera!r}; give a camera file or CameraParameters")
        if not isinstance(camera, CameraParameters):
            camera = read_camera(Path(camera), self.camera, log.info)
        return Rectification(camera, self.camera)

    def _one(self, image: OneImage, lens: Lens) -> Features:
        name = str(image) if isinstance(image, str | Path) else ""
        small = fit(Picture(0, _pixels(image)), self.camera, lens)
        known = lens if isinstance(lens, Rectification) else None
        return self._answer(SourceImage(name, None, small, lens=known), lens)

    def _all(self, sources: list[Source], lens: Lens, *, own: bool) -> Iterator[Features]:
        """`own`: no camera is estimated or taken from a recording."""
        options = {"calibrate": not own, "stated": not own}
        found = [with_lens(s, self.camera, lens, log.info, **options) for s in sources]
        unusable: list[str] = []
        items = read_sources(found, self.camera)
        try:
            for item in items:
                if item.image is None:
                    unusable.append(item.error)
                else:
                    yield self._answer(item, lens)
        finally:
            items.close()
        if unusable:
            raise UserError(first_of(unusable))

    def _answer(self, item: SourceImage, lens: Lens) -> Features:
        with self._lock:
            prediction = answer(self._engine, item)
        values = (getattr(prediction, field.name) for field in fields(Prediction))
        camera = _camera(item, lens, self.camera)
        return Features(*values, source=item, camera=camera, model_camera=self.camera)

    def evaluate(
        self,
        data: str | Path,
        split: str = "test",
        *,
        every: int = 1,
        copies: str = "",
        page: str | Path | None = None,
    ) -> dict[str, Any]:
        """Return the errors on a dataset in m and rad, with the keys that `mtlnet evaluate --json`
        prints.

        `data`: a folder of recorded rounds, or of pictures with a `labels.csv`. `split`: train,
        test, unseen or all. `every`: use every n-th frame. `copies`: "mirrored,turned" also
        evaluates mirrored and turned copies of pictures. `page`: an HTML file to write. Raises
        UserError for data that cannot be read or do not fit the model.
        """
        from mtlnet.evaluation.evaluate import evaluate

        engines = [self._load() for _ in range(os.cpu_count() or 1)]
        written = None if page is None else Path(page)
        return evaluate(engines, Path(data), split, page=written, every=every, copies=copies)

    def export(
        self,
        form: str = "openvino",
        precision: str = "f32",
        *,
        data: str | Path | None = None,
        out: str | Path | None = None,
        frames: int = 64,
    ) -> dict[str, Any]:
        """Write the model in another format and compare it with torch, as `mtlnet export` does. An
        ONNX model has no standard deviations and no out-of-distribution score.

        `form`: "onnx" or "openvino"; `precision`: "f32", "bf16" or "int8". `data`: the dataset of
        the comparison, from which `frames` frames are taken; None: the training data (a shipped
        model has no training data, so `data` is required for it). `out`: the folder to write; None:
        a folder in `export/` of the model's folder. Returns the result of `mtlnet export --json`.
        Raises UserError for an unsupported export and for missing data, ModelError when an f32
        export differs from torch by more than the tolerance.
        """
        from mtlnet.export.convert import export_model

        checked, written = (None if path is None else Path(path) for path in (data, out))
        return export_model(self.folder, form, precision, checked, written, frames)


def load(
    model: str | Path = "default",
    *,
    engine: str = "openvino",
    precision: str | None = None,
    threads: int = 1,
    views: int = 1,
) -> Model:
    """Load a model for prediction.

    `model`: a shipped model ("default", or "varied" for real roads and lanes of 2.8 to 4.3 m), the
    name of a run in `runs/`, or the folder of a run. `engine`: "openvino" or "torch". `precision`:
    "int8", "bf16" or "f32"; None: int8 if the model has an int8 graph whose additional errors are
    within the limits that `mtlnet export` checks, else bf16 if the processor supports bf16, else
    f32. `threads`: number of CPU threads that compute one image. `views`: number of views of each
    image whose answers are averaged: 1, the image alone; 2, also its mirror image; 6, also both of
    these turned to the left and to the right. The time is proportional to the number of views.
    Raises ModelError when the model is missing or damaged.
    """
    run = resolve_run(str(model))
    return Model(run, engine, precision, threads, views=views)


def _pixels(image: OneImage) -> Image:
    """Return the pixels (H, W, 3) uint8 RGB of one image. Raises ImageError or UserError."""
    if isinstance(image, Bytes):
        return decode_file(bytes(image))
    if isinstance(image, str | Path):
        return read_whole_image(Path(image))
    if not isinstance(image, np.ndarray):
        raise _not_accepted(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise UserError(
            f"the pixels are {image.dtype} of shape {image.shape}; give uint8 RGB of shape "
            "(height, width, 3)"
        )
    return image


def _not_accepted(source: object) -> UserError:
    return UserError(f"an input is of type {type(source).__name__}; give {ACCEPTED}")


def _camera(item: SourceImage, lens: Lens, model: CameraParameters) -> CameraParameters:
    """Return the camera that took an image: the image's own, or `model` with the given lens."""
    if item.lens is not None:
        return item.lens.source
    return replace(model, fov_y_deg=lens) if isinstance(lens, float | int) else model
