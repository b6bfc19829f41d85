"""Films of all kinds, made by the FFmpeg program: damaged ones, and ones not shown as they are
stored."""

import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mtlnet.sources.films import Film, read_film_header
from mtlnet.sources.kinds import SourceKind, kind_of
from trackfeatures.errors import UserError

FRAMES = 20
PICTURES = ["-f", "lavfi", "-i", f"testsrc2=size=280x210:rate=10:duration={FRAMES / 10}"]
SOUND = ["-f", "lavfi", "-i", f"sine=duration={3 * FRAMES / 10}"]
H264 = ["-c:v", "libx264", "-preset", "ultrafast", "-pix_fmt", "yuv420p"]

Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """Run FFmpeg with arguments, the last of which is the name of the output file."""
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()

    def run(*arguments: str) -> Path:
        path = tmp_path / arguments[-1]
        command = [program, "-v", "error", "-y", *arguments[:-1], str(path)]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
        return path

    return run


def read(path: Path) -> tuple[list[int], str, list[NDArray[np.uint8]]]:
    film = Film(path)
    frames = list(film.pictures())
    pictures = [picture.image[..., ::-1] for picture in frames if picture.image is not None]
    return [picture.number for picture in frames], film.fault, pictures


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ([*H264], "a.mkv"),
        ([*SOUND, *H264, "-c:a", "aac"], "sound.mkv"),
        ([*SOUND, *H264, "-c:a", "aac"], "sound.mp4"),
        ([*H264, "-movflags", "frag_keyframe+empty_moov"], "fragments.mp4"),
        ([*H264], "a.ts"),
        ([*H264], "a.m2ts"),
        ([*H264], "a.h264"),
        (["-c:v", "libx265", "-x265-params", "log-level=none"], "a.hevc"),
        (["-c:v", "mpeg2video"], "a.mpg"),
        (["-c:v", "wmv2"], "a.wmv"),
        ([*H264], "a.flv"),
        (["-c:v", "libvpx-vp9", "-deadline", "realtime"], "a.webm"),
        (["-c:v", "libtheora"], "a.ogv"),
        (["-pix_fmt", "yuv420p"], "a.y4m"),
        (["-pix_fmt", "yuv411p", "-vf", "scale=281:211"], "odd.y4m"),
        (["-pix_fmt", "gray16", "-strict", "-1"], "grey.y4m"),
        (["-c:v", "mjpeg"], "a.mjpeg"),
        (["-c:v", "mjpeg"], "a.avi"),
        ([], "a.gif"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_every_frame_of_a_sound_film_is_read_whatever_its_name(
    make: Make, arguments: list[str], name: str
) -> None:
    film = make(*PICTURES, *arguments, name)
    assert read(film)[:2] == (list(range(FRAMES)), "")
    other = film.rename(os.fsdecode(bytes(film.parent) + b"/caf\xe9:%d #?*[\n.jpg"))
    if not name.endswith(".mjpeg"):  # it begins as an image does
        assert kind_of(other) is SourceKind.FILM
    assert read_film_header(other).fps in (10, 25)  # raw streams state no rate: FFmpeg takes 25
    assert len(read(other)[0]) == FRAMES


def test_frames_of_varying_duration_are_all_that_there_are(make: Make) -> None:
    film = make(
        *PICTURES, "-vf", "select='lt(n,5)+not(mod(n,5))'", "-fps_mode", "vfr", *H264, "a.mkv"
    )
    assert read_film_header(film).count > 8
    assert read(film)[:2] == (list(range(8)), "")


@pytest.mark.parametrize(
    ("arguments", "name", "fault"),
    [
        ([*H264, "-movflags", "faststart"], "a.mp4", r"ends after \d+ of 20 frames.*'mdat' ends"),
        ([*H264, "-movflags", "frag_keyframe+empty_moov", "-g", "5"], "f.mp4", "ends after"),
        (
            [*H264],
            "a.mkv",
            r"ends after \d+ of 20 frames; these frames were used .it breaks off: it sta",
        ),
        (["-c:v", "mjpeg"], "a.avi", r"ends after \d+ of 20 frames"),
        (["-c:v", "wmv2"], "a.wmv", r"ends after \d+ frames.*bytes and has"),
        (["-c:v", "libtheora"], "a.ogv", r"its last page is missing"),
        (["-pix_fmt", "yuv420p10", "-strict", "-1"], "a.y4m", r"its last frame has \d+ of 176406"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_film_that_breaks_off_says_so(
    make: Make, arguments: list[str], name: str, fault: str
) -> None:
    film = make(*PICTURES, *arguments, name)
    film.write_bytes(film.read_bytes()[: film.stat().st_size * 6 // 10])
    numbers, found, _ = read(film)
    assert 5 < len(numbers) < FRAMES
    assert re.search(fault, found)


@pytest.mark.parametrize(("arguments", "name"), [(H264, "a.ts"), (["-c:v", "mjpeg"], "a.mjpeg")])
def test_a_film_that_changes_its_size_ends_there(
    make: Make, arguments: list[str], name: str
) -> None:
    """OpenCV would scale the other pictures to the size of the first and so distort the view."""
    whole, small = (
        make(*PICTURES, *arguments, name),
        make(*PICTURES, "-s", "160x90", *arguments, f"s{name}"),
    )
    both = whole.with_name(f"both{name}")
    both.write_bytes(whole.read_bytes() + small.read_bytes())
    numbers, fault, _ = read(both)
    assert numbers == list(range(len(numbers)))
    assert FRAMES - 4 < len(numbers) <= FRAMES  # a decoder with several threads reports it earlier
    size = r"160 x (90|96) px, those before it are 280 x 210 px and were used"
    assert re.search(rf"both{name}: picture {len(numbers)} is {size}", fault)
    again = whole.with_name(f"twice{name}")
    again.write_bytes(whole.read_bytes() * 2)
    assert read(again)[:2] == (list(range(2 * FRAMES)), "")


@pytest.mark.parametrize("name", ["a.mp4", "a.ts", "a.mkv", "a.mjpeg.avi"])
def test_damage_within_a_film_is_told_and_the_rest_is_read(make: Make, name: str) -> None:
    codec = ["-c:v", "mjpeg"] if "mjpeg" in name else H264
    film = make(*PICTURES, *codec, "-movflags", "faststart", name)
    content = bytearray(film.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 1500] = np.random.default_rng(0).bytes(1500)
    film.write_bytes(content)
    numbers, fault, _ = read(film)
    assert len(numbers) >= 8
    assert f"{film} is damaged near frame" in fault


def test_a_codec_without_a_decoder_is_named(make: Make) -> None:
    film = make(*PICTURES, "-c:v", "libsvtav1", "-preset", "12", "-pix_fmt", "yuv420p", "a.mp4")
    numbers, fault, _ = read(film)
    if not numbers:  # a build of OpenCV may have one
        assert "this build of OpenCV has no decoder for AV1; convert it" in fault


def test_a_film_is_shown_as_its_header_says(make: Make) -> None:
    """Frames are rotated, have square pixels, and start at the film's start."""
    plain = make(*PICTURES, *H264, "plain.mp4")
    first = read(plain)[2][0]
    turned = read(make("-display_rotation", "180", "-i", str(plain), "-c", "copy", "t.mp4"))[2][0]
    assert np.array_equal(turned, first[::-1, ::-1])
    upright = read(make("-display_rotation", "90", "-i", str(plain), "-c", "copy", "u.mp4"))[2][0]
    assert upright.shape == (280, 210, 3)
    narrow = make(*PICTURES, "-vf", "scale=140:210,setsar=2/1", *H264, "narrow.mp4")
    widened = read(narrow)[2][0]
    assert widened.shape == first.shape
    assert np.abs(widened.astype(int) - first).mean() < 8
    both = make("-display_rotation", "90", "-i", str(narrow), "-c", "copy", "both.mp4")
    assert read(both)[2][0].shape == (280, 210, 3)
    cut = make("-ss", "0.85", "-i", str(plain), "-c", "copy", "cut.mp4")
    numbers, fault, pictures = read(cut)
    assert (numbers, fault) == (list(range(11)), "")
    assert np.array_equal(pictures[0], read(plain)[2][9])


@pytest.mark.parametrize("matrix", ["bt709", "smpte170m"])
@pytest.mark.parametrize("value_range", ["tv", "pc"])
def test_range_and_matrix_of_the_colours_are_those_of_the_header(
    make: Make, tmp_path: Path, matrix: str, value_range: str
) -> None:
    colours = np.array([[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 0, 255], [30, 90, 60]])
    scene = np.repeat(np.repeat(colours[None].astype(np.uint8), 70, 1), 210, 0)
    cv2.imwrite(str(tmp_path / "scene.png"), scene[..., ::-1])
    scale = f"scale=out_color_matrix={matrix.replace('smpte170m', 'bt601')}:out_range={value_range}"
    tags = f"format=yuv420p,setparams=colorspace={matrix}:range={value_range}"
    film = make(
        "-i", str(tmp_path / "scene.png"), "-vf", f"{scale},{tags}", *H264, "-crf", "5", "a.mp4"
    )
    shown = read(film)[2][0][105, 35::70].astype(int)
    assert np.abs(shown - colours).max() <= 4


@pytest.mark.parametrize(
    ("arguments", "name", "message"),
    [
        (["-display_hflip"], "a.mp4", "its header mirrors the picture; convert it"),
        (["-display_hflip"], "a.mkv", "its header mirrors or tilts the picture"),
        (["-display_vflip"], "a.mkv", "its header mirrors or tilts the picture"),
        (["-display_rotation", "45"], "a.mp4", "its header turns the picture by"),
    ],
)
def test_what_cannot_be_shown_as_the_header_says_is_refused(
    make: Make, arguments: list[str], name: str, message: str
) -> None:
    plain = make(*PICTURES, *H264, "plain.mp4")
    with pytest.raises(UserError, match=message):
        read_film_header(make(*arguments, "-i", str(plain), "-c", "copy", name))


@pytest.mark.parametrize(
    ("arguments", "name"),
    [(H264, "a.nut"), (["-c:v", "mpeg2video", "-r", "25"], "a.mxf"), (["-c:v", "vp8"], "a.ivf")],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_rare_containers_are_known_by_name(make: Make, arguments: list[str], name: str) -> None:
    film = make(*PICTURES, *arguments, name)
    assert kind_of(film) is SourceKind.FILM
    assert len(read(film)[0]) >= FRAMES


def test_interlaced_pictures_are_not_taken_for_black_ones(make: Make) -> None:
    """OpenCV 5 returns black pictures without an error; older versions return complete ones."""
    film = make(
        *PICTURES, "-vf", "tinterlace=interleave_top", "-flags", "+ilme+ildct", "-c:v",
        "mpeg2video", "a.mpg",
    )  # fmt: skip
    try:
        shown, refused = float(np.mean(read(film)[2])), ""
    except UserError as error:
        shown, refused = 0.0, str(error)
    assert shown > 50 or "its pictures are interlaced, which this build of OpenCV" in refused


def test_a_picture_cut_by_the_container_is_refused(make: Make) -> None:
    """A Matroska header with PixelCropTop; FFmpeg writes none, so a Void element becomes one."""
    film = make(*PICTURES, "-vf", "crop=280:210", *H264, "-metadata", "a=b", "a.mkv")
    content = film.read_bytes()
    assert kind_of(film) is SourceKind.FILM
    video = content.index(b"\xb0\x82\x01\x18\xba\x81\xd2")  # PixelWidth 280, PixelHeight 210
    # The element after the height is overwritten by PixelCropTop = 9.
    rest = content[video + 7 : video + 11]
    changed = content[: video + 7] + b"\x54\xbb\x81\x09" + content[video + 7 + len(rest) :]
    film.write_bytes(changed)
    with pytest.raises(UserError, match=r"a part of the picture only .PixelCrop"):
        read_film_header(film)


@pytest.mark.parametrize("kind", ["empty", "sound", "folder", "pipe"])
def test_what_is_no_film_is_said(make: Make, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.mp4"
    if kind == "sound":
        make(*SOUND, "-c:a", "aac", "a.mp4")
    elif kind == "empty":
        path.touch()
    elif kind == "folder":
        path.mkdir()
    else:
        os.mkfifo(path)
    expected = (
        "is a folder, a pipe or a device" if kind in ("folder", "pipe") else "cannot be opened"
    )
    with pytest.raises(UserError, match=expected):
        read_film_header(path)
