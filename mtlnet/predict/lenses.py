"""Finds the camera that took the pictures of a source, for `mtlnet predict`.

The camera that the user gives has precedence, then the camera that a recording states, then the
camera estimated from the pictures of the drive (`mtlnet.calibration`).
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mtlnet.calibration.drive import calibrate_film
from mtlnet.calibration.film import DriveCalibration, DriveEstimate
from mtlnet.calibration.lens import KnownLens, find_lens
from mtlnet.calibration.mount import NotCalibrated
from mtlnet.inference.image_decoding.crop import crop_box
from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.inference.rectification import Rectification
from mtlnet.sources.find import Note, Source
from mtlnet.sources.kinds import SourceKind
from mtlnet.sources.pictures import Lens, Picture
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

FILM_S = 60.0
"""Duration at the start of a film from which its camera is estimated, s."""
FIRST_S, AGAIN = 15.0, 2.0
"""The camera of a stream is estimated `FIRST_S` seconds after its first picture, and again whenever
the time since the first picture has grown by the factor `AGAIN`."""


class _ModelsOwn(Exception):
    """Raised for pictures of the size of the model's own camera, whose camera is not estimated."""


def with_lens(
    source: Source,
    model: CameraParameters,
    given: Lens,
    note: Note,
    *,
    calibrate: bool = False,
    stated: bool = True,
) -> Source:
    """Return `source` with the camera that took its pictures: `given`, else with `stated` the
    camera that a recording states, else with `calibrate` a camera estimated from the pictures of
    the film or stream, else the camera `model` of the model.

    `given` is a rectification from this camera to the model's, the vertical field of view in
    degrees, or None. For a field of view, `calibrate` estimates only the mount. `note` is called
    with a line about the camera that was found.
    """
    if isinstance(given, Rectification) or source.problem or source.kind is SourceKind.ROUND:
        return replace(source, lens=given)
    is_recording = source.kind is SourceKind.RECORDING and source.opened is not None
    if stated and given is None and is_recording:
        found = _stated(source, model, note)
        if found is not None:
            return found
    if calibrate and source.kind is SourceKind.FILM:
        return replace(source, lens=_of_film(source, model, given, note))
    if calibrate and source.kind is SourceKind.STREAM:
        return replace(source, lens=DriveLens(source.name, model, given, note))
    return replace(source, lens=given)


def _stated(source: Source, model: CameraParameters, note: Note) -> Source | None:
    """The recording with the lens of the camera that it states; None if it states no usable
    camera."""
    from mtlnet.sources.recordings.cameras import is_models
    from mtlnet.sources.recordings.recording import Recording

    assert isinstance(source.opened, Recording)
    camera, about = source.opened.camera(model)
    if camera is not None and is_models(camera, model):
        return source
    if about:
        note(about)
    if camera is None:
        return None
    return replace(source, lens=Rectification(camera, model))


def _lens(size: tuple[int, int], model: CameraParameters, fov_y_deg: float | None) -> KnownLens:
    """Lens of pictures of `size` (width, height), px. Raises _ModelsOwn for the model's size."""
    if size == (model.width, model.height):
        raise _ModelsOwn
    return find_lens(size, model, fov_y_deg=fov_y_deg)


def _of_film(source: Source, model: CameraParameters, given: float | None, note: Note) -> Lens:
    """The lens estimated from the film's first `FILM_S` seconds; the assumed lens if that fails."""
    assumed: Lens = given

    def make_lens(size: tuple[int, int]) -> KnownLens:
        nonlocal assumed
        known = _lens(size, model, given)
        assumed = _assumed(known, model, given)
        return known

    try:
        drive = calibrate_film(source.path, make_lens, longest_s=FILM_S)
        return _rectification(drive.found, model, drive.shown, source.name, note)
    except _ModelsOwn:
        return given
    except (NotCalibrated, ImageError) as error:
        note(_failed(source.name, error, assumed))
    except (UserError, OSError):  # reported where the film is read
        pass
    return assumed


def _assumed(known: KnownLens, model: CameraParameters, given: float | None) -> Lens:
    """The lens while no mount is known: `given`, a crop to the model's view. A picture that shows
    less than this view cannot be cropped to it; its lens is a rectification from `known` with the
    mount of the model's camera."""
    camera = known.camera
    try:
        crop_box(camera.width, camera.height, model, given)
    except ImageError:
        mounted = replace(camera, z=model.z, pitch_deg=model.pitch_deg)
        return Rectification(mounted, model)
    return given


def _rectification(
    found: DriveEstimate,
    model: CameraParameters,
    shown: list[NDArray[np.uint8]],
    name: str,
    note: Note,
) -> Rectification:
    """Rectification from an estimated camera to the model's. Raises ImageError when the camera
    shows too little of the model's view in the first picture of `shown`."""
    lens = Rectification(found.camera, model)
    for picture in shown[:1]:
        lens.image(picture)
    note(f"{name}: camera found: {found.about()}")
    return lens


def _failed(name: str, error: Exception, assumed: Lens) -> str:
    reason = str(error).removeprefix(f"{name}: ")
    mount = isinstance(assumed, Rectification)
    what = "the mount of the model's camera" if mount else "the model's own"
    if isinstance(assumed, float | int):
        what += f" with a field of view of {assumed:g} deg"
    return f"{name}: no camera found ({reason}); {what} is assumed; --camera gives another"


class DriveLens:
    """Finds the camera of a stream while its pictures arrive. Before the camera is found, the lens
    is `given`, a vertical field of view in degrees, or None for the model's camera; for pictures
    that show less than the model's view it is a rectification with the mount of the model's
    camera."""

    def __init__(self, name: str, model: CameraParameters, given: float | None, note: Note) -> None:
        self._name, self._model, self._given, self._note = name, model, given, note
        self._lens: Lens = given
        self._calibration: DriveCalibration | None = None
        self._start_s = 0.0
        self._wait_s = FIRST_S
        self._found = False
        self._done = False

    def at(self, picture: Picture) -> Lens:
        """Return the lens for `picture`. Must be called for each picture in order, because it also
        estimates the camera."""
        if not self._done and picture.image is not None and picture.time_s is not None:
            self._take(picture.image, picture.time_s, picture.bgr)
        return self._lens

    def _take(self, image: NDArray[np.uint8], time_s: float, bgr: bool) -> None:
        if self._calibration is None:
            try:
                lens = _lens((image.shape[1], image.shape[0]), self._model, self._given)
            except _ModelsOwn:
                self._done = True
                return
            self._lens = _assumed(lens, self._model, self._given)
            self._calibration = DriveCalibration(lens)
            self._start_s = time_s
        self._calibration.add(image, time_s, bgr=bgr)
        if time_s - self._start_s >= self._wait_s:
            self._wait_s *= AGAIN
            self._look(self._calibration, image, bgr)

    def _look(self, calibration: DriveCalibration, image: NDArray[np.uint8], bgr: bool) -> None:
        if bgr:
            image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        try:
            found = calibration.estimate()
            self._lens = _rectification(found, self._model, [image], self._name, self._note)
            self._found = True
        except (NotCalibrated, ImageError) as error:
            if not self._found:
                self._note(_failed(self._name, error, self._lens) + "; looked for again later")
