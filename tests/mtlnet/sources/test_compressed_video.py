"""`mtlnet predict` on Foxglove's `CompressedVideo`: one picture per message."""

import re
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from mtlnet.predict.run import predict_files
from mtlnet.sources.recordings.recording import open_recording
from tests.mtlnet.predict.brightness_engine import BrightnessEngine
from tests.mtlnet.sources.recorded import START_S, Message, write_foxglove
from tests.mtlnet.sources.test_recordings import answers
from trackfeatures.errors import UserError

CODECS = {"h264": "libx264", "h265": "libx265"}


def encoded(path: Path, form: str, size: str, options: str) -> Path:
    """A film of 8 pictures. `options`: those of the encoder, with colons between them."""
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    source = f"gradients=size={size}:rate=10:duration=0.8:speed=0.2:seed=3"
    codec = CODECS[form]
    quiet = f"log-level=none:{options}" if form == "h265" else options
    command = [program, "-v", "error", "-f", "lavfi", "-i", source, "-c:v", codec]
    command += [f"-{codec.removeprefix('lib')}-params", quiet, "-pix_fmt", "yuv420p", str(path)]
    subprocess.run(command, check=True)
    return path


def access_units(stream: bytes, form: str) -> list[bytes]:
    """The pictures of an Annex B stream with one slice per picture, each with the preceding
    units."""
    starts = [m.start() for m in re.finditer(rb"\x00?\x00\x00\x01", stream)] + [len(stream)]
    units, pending = [], b""
    for begin, end in pairwise(starts):
        unit = stream[begin:end]
        head = unit.lstrip(b"\0")[1]
        pending += unit
        is_picture = 1 <= head & 31 <= 5 if form == "h264" else (head >> 1 & 63) < 32
        if is_picture:
            units.append(pending)
            pending = b""
    return units


def messages_of(film: Path, form: str) -> list[Message]:
    return [
        ("/video", "CompressedVideo", {"data": unit, "format": form})
        for unit in access_units(film.read_bytes(), form)
    ]


@pytest.mark.parametrize("form", CODECS)
def test_compressed_video_gives_the_pictures_of_its_film(
    engine: BrightnessEngine, tmp_path: Path, form: str
) -> None:
    """One picture per message (Annex B), as Foxglove defines it."""
    film = encoded(tmp_path / f"a.{form.replace('h265', 'hevc')}", form, "560x420", "bframes=0")
    expected = answers(predict_files(engine, [str(film)]))
    assert len({row["angle_rad"] for row in expected}) > 4
    video = messages_of(film, form)
    assert len(video) == len(expected) == 8
    path = write_foxglove(tmp_path / "video.mcap", video)
    rows = predict_files(engine, [str(path)])
    assert answers(rows) == expected
    times = [row["time_s"] - START_S for row in rows]
    assert times == pytest.approx([0.05 * n for n in range(8)], abs=1e-6)
    late = write_foxglove(tmp_path / "late.mcap", video[1:])  # without its first key frame
    with pytest.raises(UserError, match=r"no frame of it .*can be decoded|cannot be decoded"):
        predict_files(engine, [str(late)])
    other = [("/video", "CompressedVideo", {"data": b"?", "format": "mpeg2"})]
    with pytest.raises(UserError, match="its format 'mpeg2' is not read; known are h264, h265"):
        predict_files(engine, [str(write_foxglove(tmp_path / "other.mcap", other))])


@pytest.mark.parametrize("form", CODECS)
def test_an_unreadable_message_loses_only_its_own_picture(tmp_path: Path, form: str) -> None:
    """All pictures are key frames, so each is decoded without the others."""
    name = f"a.{form.replace('h265', 'hevc')}"
    film = encoded(tmp_path / name, form, "160x120", "bframes=0:keyint=1")
    video = messages_of(film, form)
    whole = list(open_recording(write_foxglove(tmp_path / "a.mcap", video)).pictures())
    broken: Message = ("/video", "CompressedVideo", {"data": 5, "format": form})
    for lost in ((0,), (3,), (0, 4, 7)):
        messages = [broken if n in lost else one for n, one in enumerate(video)]
        path = write_foxglove(tmp_path / "b.mcap", messages, as_json=True)
        recording = open_recording(path)
        found = list(recording.pictures())
        assert [one.number for one in found] == [n for n in range(8) if n not in lost]
        for one in found:
            assert one.time_s == pytest.approx(START_S + 0.05 * one.number, abs=1e-6)
            np.testing.assert_array_equal(one.image, whole[one.number].image)
        assert f"{len(lost)} of 8 pictures cannot be decoded (the message is not a valid" in (
            recording.fault
        )
    only = write_foxglove(tmp_path / "c.mcap", [broken], as_json=True)
    with pytest.raises(UserError, match=r"none of its messages can be read .the message is not"):
        list(open_recording(only).pictures())
