"""Raw pictures of ROS and Foxglove: the colours of each encoding; other encodings are refused."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mtlnet.inference.image_decoding.errors import ImageError
from mtlnet.sources.recordings.raw import decode_raw
from tests.mtlnet.sources.recorded import ros_image

GRADIENT = np.add.outer(np.arange(32), 2 * np.arange(40)).astype(np.uint8)
COLOURS = np.stack([GRADIENT, GRADIENT // 2, 255 - GRADIENT], axis=-1)


@pytest.mark.parametrize(
    ("encoding", "data", "shown"),
    [
        ("rgb8", COLOURS, COLOURS),
        ("bgr8", COLOURS[..., ::-1], COLOURS),
        ("8UC3", COLOURS[..., ::-1], COLOURS),
        ("rgba8", np.dstack([COLOURS, GRADIENT]), COLOURS),
        ("bgra8", np.dstack([COLOURS[..., ::-1], GRADIENT]), COLOURS),
        ("mono8", GRADIENT, np.dstack([GRADIENT] * 3)),
        ("mono16", GRADIENT.astype("<u2") * 256 + 7, np.dstack([GRADIENT] * 3)),
        ("mono16", GRADIENT.astype(">u2") * 256 + 7, np.dstack([GRADIENT] * 3)),
        ("rgb16", COLOURS.astype("<u2") * 256 + 7, COLOURS),
    ],
)
def test_encodings_are_read_to_the_same_colours(
    encoding: str, data: NDArray[Any], shown: NDArray[np.uint8]
) -> None:
    fields = ros_image(np.ascontiguousarray(data), encoding, padding=5)
    found = decode_raw(
        fields["data"], encoding, 40, 32, fields["step"], big_endian=bool(fields["is_bigendian"])
    )
    assert np.array_equal(found, shown)


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_bayer_pattern_has_its_colours(order: str, bits: int) -> None:
    """With a plain colour, each sample is the value of its pixel's filter."""
    colour = {"r": 200, "g": 120, "b": 40}
    tile = np.array([colour[name] for name in order], np.uint8).reshape(2, 2)
    data = np.tile(tile, (16, 20))
    if bits == 16:
        data = (data.astype("<u2") * 256).view(np.uint8)
    found = decode_raw(data.ravel(), f"bayer_{order}{bits}", 40, 32, 0, big_endian=False)
    assert np.array_equal(np.unique(found.reshape(-1, 3), axis=0), [[200, 120, 40]])


@pytest.mark.parametrize(("encoding", "order"), [("yuyv", "YUYV"), ("yuv422", "UYVY")])
def test_yuv_of_a_grey_and_a_red_picture(encoding: str, order: str) -> None:
    """Studio range of BT.601: Y 16 to 235; red is Y 82, U 90, V 240."""
    for yuv, rgb in (((126, 128, 128), (128, 128, 128)), ((82, 90, 240), (255, 1, 0))):
        sample = dict(zip("YUV", yuv, strict=True))
        row = np.array([sample[name] for name in order], np.uint8)
        found = decode_raw(np.tile(row, 32 * 20), encoding, 40, 32, 0, big_endian=False)
        assert np.abs(found.astype(int) - rgb).max() <= 2


@pytest.mark.parametrize(
    ("encoding", "length", "message"),
    [
        ("32FC1", 5120, r"'32FC1' .of depths or measurements. is not supported"),
        ("16UC1", 2560, r"'16UC1' .of depths"),
        ("jpeg", 100, "'jpeg' is not supported; supported are 8UC1"),
        ("rgb8", 3839, r"3839 bytes in rows of 120 do not hold 40 x 32 px of rgb8; 3840 bytes"),
    ],
)
def test_what_is_no_picture_is_refused(encoding: str, length: int, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        decode_raw(np.zeros(length, np.uint8), encoding, 40, 32, 0, big_endian=False)


@pytest.mark.parametrize("encoding", ["uyvy", "yuv422", "yuyv", "yuv422_yuy2"])
def test_an_odd_width_of_shared_colours_is_refused(encoding: str) -> None:
    with pytest.raises(ImageError, match=rf"width of 41 px is odd, and two pixels of {encoding}"):
        decode_raw(np.zeros(41 * 32 * 2, np.uint8), encoding, 41, 32, 0, big_endian=False)
