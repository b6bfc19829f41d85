"""Reads camera files in YAML (our format, OpenCV, ROS, Kalibr) as `CameraParameters`; writes ours.

Our format has the fields of `CameraParameters`, with `height_above_road_m` in place of `z`. The
other formats describe only image size and lens. A file in one of them may also have the keys of our
format for the mount.
"""

import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from math import isfinite
from pathlib import Path
from typing import Any

import yaml

from runtime.files import atomic_write
from trackfeatures.camera import COEFFICIENTS, CameraError, CameraParameters
from trackfeatures.errors import UserError

HEIGHT = "height_above_road_m"
KEYS = (*(field.name for field in fields(CameraParameters)), HEIGHT)
MOUNT = ("x", "y", "z", HEIGHT, "roll_deg", "pitch_deg", "yaw_deg", "height_std")
NOT_ASSUMED: dict[str, Any] = {
    "matrix": None,
    "distortion": "none",
    "coefficients": (),
    "height_std": 0.0,
}
"""Values of these fields if a file omits them. Any other field that a file omits has the value of
the default camera."""
LIMITS_DEG = {"pitch_deg": 30.0, "roll_deg": 30.0, "yaw_deg": 180.0}
MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "K", "k", "mtx")
COEFFICIENT_KEYS = (
    "distortion_coefficients", "dist_coeffs", "dist_coeff", "distCoeffs", "D", "d", "dist",
)  # fmt: skip
SIZE_KEYS = (("image_width", "image_height"), ("width", "height"))
MODELS = {
    "none": "none",
    "plumb_bob": "opencv",
    "rational_polynomial": "opencv",
    "radtan": "opencv",
    "opencv": "opencv",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "fisheye": "fisheye",
    "kannala_brandt": "fisheye",
}
"""Names of distortion models in files, each with its name in `CameraParameters`."""
MAX_SKEW = 1e-3  # largest accepted skew of a camera matrix, as a fraction of the focal length

Note = Callable[[str], None]
"""A function that is called with a line of text for the user."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
    """A YAML loader that reads OpenCV's `!!opencv-matrix` as a mapping."""


def _matrix_of_opencv(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "an opencv-matrix is not a mapping")
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix_of_opencv)


def read_camera(
    path: Path, default: CameraParameters, note: Note | None = None
) -> CameraParameters:
    """Read the camera in a file of our format, OpenCV, ROS `camera_info` or Kalibr's camchain.

    Size, mount and field of view come from `default` if the file omits them. If the file describes
    no lens, the lens is a pinhole. `note` is called with a line about the values that were chosen
    or assumed. Raises UserError with a one-line message for a faulty file.
    """
    content = _load(path)
    try:
        kind, values = _values(content)
        camera = _checked(replace(default, **(NOT_ASSUMED | values)))
    except CameraError as error:
        raise UserError(f"{path}: {error}") from error
    if note is not None and kind:
        note(f"{path}: {kind}; {_mount_note(values, camera)}")
    return camera


def write_camera(path: Path, camera: CameraParameters, comment: str = "") -> None:
    """Write a camera file in our format, atomically; `read_camera` returns an equal camera. The
    file starts with `comment`, each line after a `#`."""
    values = {**dict.fromkeys(KEYS[:9], 0.0), **camera.as_dict()}
    if camera.matrix is not None:
        del values["fov_y_deg"]  # follows from the matrix
    if camera.height_above_road_m - CameraParameters.cg_height_m == camera.z:
        del values["z"]
        values[HEIGHT] = camera.height_above_road_m
    listed = {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}
    text = "".join(
        yaml.safe_dump({name: value}, default_flow_style=None if isinstance(value, list) else False)
        for name, value in listed.items()
    )
    above = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    atomic_write(path, (above + text).encode())


def _load(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
        # OpenCV's first line, `%YAML:1.0`, is not a valid YAML directive.
        found = yaml.load(re.sub(r"\A\ufeff?%YAML.*", "", text), _Loader)  # a SafeLoader
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise UserError(f"{path} cannot be read as a camera: {reason}") from error
    if not isinstance(found, dict) or not found:
        raise UserError(f"{path} describes no camera; give some of {', '.join(KEYS)}")
    return found


def _values(content: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the kind of a camera file with the YAML content `content` ("" for our format), and the
    fields of `CameraParameters` that the file contains."""
    if cameras := sorted(str(key) for key in content if re.fullmatch(r"cam\d+", str(key))):
        others = f" of {', '.join(cameras)}" if len(cameras) > 1 else ""
        return f"{cameras[0]}{others} of a Kalibr camchain", _kalibr(content, cameras[0])
    if any(key in content for key in MATRIX_KEYS):
        return "a calibration of OpenCV or ROS", _opencv(content)
    return "", _ours(content)


def _ours(content: dict[str, Any]) -> dict[str, Any]:
    unknown = [str(key) for key in content if key not in KEYS]
    if unknown:
        raise CameraError(f"the key {unknown[0]!r} is unknown; known keys are {', '.join(KEYS)}")
    values = _plain(content, ("width", "height", "fov_y_deg", *MOUNT))
    if "matrix" in content and not {"width", "height"} <= set(content):
        raise CameraError("the matrix is for images of an unknown size; give width and height too")
    for name in ("matrix", "coefficients"):
        if content.get(name) is not None:
            values[name] = tuple(_numbers(name, content[name]))
    if "distortion" in content:
        values["distortion"] = content["distortion"]
    return values


def _opencv(content: dict[str, Any]) -> dict[str, Any]:
    """Read the camera's fields from a calibration file of OpenCV or a `camera_info` of ROS."""
    key = next(key for key in MATRIX_KEYS if key in content)
    k = _numbers(key, content[key])
    if len(k) != 9:
        raise CameraError(f"{key} has {len(k)} numbers; give the 9 of a 3 x 3 matrix")
    scale = k[8]
    if k[0] * k[4] * scale == 0:
        raise CameraError(f"{key} is singular; give fx, fy and a last element other than 0")
    fx, skew, cx, tilt, fy, cy, *bottom = (value / scale for value in k)
    if max(abs(skew), abs(tilt)) > MAX_SKEW * abs(fx) or any(bottom[:2]):
        raise CameraError(f"{key} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; give such a matrix")
    name = next((key for key in COEFFICIENT_KEYS if key in content), None)
    if name is None:
        raise CameraError(
            f"the file has {key} but no distortion_coefficients; give them, zeros for none"
        )
    model = content.get("distortion_model", "fisheye" if content.get("fisheye_model") else "opencv")
    widths = [(w, h) for w, h in SIZE_KEYS if w in content and h in content]
    if not widths:
        raise CameraError(f"the file has {key} but no image size; give width and height in px")
    width, height = (_whole(size, content[size]) for size in widths[0])
    return {
        "width": width,
        "height": height,
        "matrix": (fx, fy, cx, cy),
        **read_distortion(model, _numbers(name, content[name])),
        **_plain(content, MOUNT),
    }


def _kalibr(content: dict[str, Any], name: str) -> dict[str, Any]:
    camera = content[name]
    if not isinstance(camera, dict) or camera.get("camera_model") != "pinhole":
        seen = camera.get("camera_model") if isinstance(camera, dict) else camera
        raise CameraError(f"{name}'s camera_model is {seen!r}; calibrate with pinhole-radtan or "
                          "pinhole-equi")  # fmt: skip
    for key in ("intrinsics", "resolution", "distortion_coeffs"):
        if key not in camera:
            raise CameraError(f"{name} has no {key}; give Kalibr's whole camchain")
    size = [_whole("resolution", value) for value in _numbers("resolution", camera["resolution"])]
    if len(size) != 2:
        raise CameraError(f"{name}'s resolution has {len(size)} numbers; give width and height")
    return {
        "width": size[0],
        "height": size[1],
        "matrix": tuple(_numbers("intrinsics", camera["intrinsics"])),
        **read_distortion(
            camera.get("distortion_model"),
            _numbers("distortion_coeffs", camera["distortion_coeffs"]),
        ),
        **_plain(content, MOUNT),
    }


def read_distortion(model: Any, given: list[float]) -> dict[str, Any]:
    """Return the fields `distortion` and `coefficients` of `CameraParameters` for a lens model (any
    key of `MODELS`) with the coefficients `given`; an empty dict for a pinhole.

    Raises CameraError for an unknown model.
    """
    if not isinstance(model, str) or model.lower() not in MODELS:
        known = ", ".join(MODELS)
        raise CameraError(f"the distortion model is {model!r}; known models are {known}")
    kind = MODELS[model.lower()]
    if kind == "opencv" and len(given) in (12, 14) and not any(given[8:]):
        given = given[:8]  # the thin-prism and tilt terms are 0
    if kind != "fisheye" and not any(given) and len(given) in (0, *COEFFICIENTS[kind]):
        return {}  # a pinhole
    return {"distortion": kind, "coefficients": tuple(given)}


def _plain(content: dict[str, Any], keys: Any) -> dict[str, Any]:
    """Return the numbers that `content` has under `keys`, by the names of the fields of
    `CameraParameters`. Keys that `content` does not contain are left out."""
    if HEIGHT in content and "z" in content:
        raise CameraError(f"the file has both z and {HEIGHT}; leave one out")
    values: dict[str, Any] = {}
    for key in (key for key in keys if key in content):
        value = content[key]
        if key in ("width", "height"):
            values[key] = _whole(key, value)
        elif key == HEIGHT:
            values["z"] = _number(key, value) - CameraParameters.cg_height_m
        else:
            values[key] = _number(key, value)
    return values


def _whole(name: str, value: Any) -> int:
    is_whole = value.is_integer() if isinstance(value, float) else isinstance(value, int)
    if isinstance(value, bool) or not is_whole:
        raise CameraError(f"{name} is {value!r}; give a whole number of pixels")
    return int(value)


def _number(name: str, value: Any) -> float:
    if isinstance(value, str):  # YAML 1.1 reads 1e-05 as text, and OpenCV writes .Nan
        try:
            value = float(value.removeprefix(".") if value[1:].isalpha() else value)
        except ValueError:
            raise CameraError(f"{name} is {value!r}; give a number") from None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CameraError(f"{name} is {value!r}; give a number")
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        raise CameraError(f"{name} is {str(value)[:9]}...; give a number below 1e308")
    return value


def _numbers(name: str, value: Any) -> list[float]:
    """Return the numbers in `value`, which is a list, a list of rows, or a matrix of OpenCV or ROS,
    as one flat list. Raises CameraError for anything else; `name` is the key, for the message."""
    if isinstance(value, dict):
        data = value.get("data")
        if data is None:
            raise CameraError(f"{name} has no data; give its numbers")
        found = _numbers(name, data)
        rows, columns = value.get("rows"), value.get("cols")
        if isinstance(rows, int) and isinstance(columns, int) and rows * columns != len(found):
            raise CameraError(
                f"{name} has {len(found)} numbers; its rows and cols make {rows * columns}"
            )
        return found
    if not isinstance(value, list):
        raise CameraError(f"{name} is {value!r}; give a list of numbers")
    found = [_number(name, each) for each in _flat(value)]
    for each in found:
        if not isfinite(each):
            raise CameraError(f"{name} holds {each}; give finite numbers")
    return found


def _flat(value: list[Any]) -> Iterator[Any]:
    for each in value:
        if isinstance(each, list):
            yield from _flat(each)
        else:
            yield each


def _checked(camera: CameraParameters) -> CameraParameters:
    finite = all(map(isfinite, (camera.x, camera.y, camera.z)))
    if min(camera.width, camera.height) < 1 or not (finite and camera.height_above_road_m > 0):
        raise CameraError(f"the camera {camera} is impossible; give size and height above 0")
    for name, limit in LIMITS_DEG.items():
        if not abs(getattr(camera, name)) <= limit:
            raise CameraError(f"{name} is {getattr(camera, name):g}; give {-limit:g} to {limit:g}")
    return camera


def _mount_note(values: dict[str, Any], camera: CameraParameters) -> str:
    if any(key in values for key in ("x", "y", "z", "roll_deg", "pitch_deg", "yaw_deg")):
        return f"the camera is {camera}"
    return (
        f"no mount is given, so {camera.height_above_road_m:g} m above the road and pitch "
        f"{camera.pitch_deg:g} deg are assumed; add {HEIGHT}, pitch_deg and yaw_deg"
    )
