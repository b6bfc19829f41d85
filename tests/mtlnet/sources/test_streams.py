"""`mtlnet predict` on streams: an HTTP server in this process sends Motion JPEG, with faults."""

import json
import re
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from unittest.mock import Mock, patch

import cv2
import numpy as np
import pytest
import simplejpeg

from mtlnet.predict.run import InputsLeftOut, predict_files
from mtlnet.sources import streams
from mtlnet.sources.ffmpeg_log import DecodingErrors
from mtlnet.sources.find import Source
from mtlnet.sources.kinds import SourceKind
from mtlnet.sources.streams import Stream, is_live, shown_name
from tests.mtlnet.predict.brightness_engine import BrightnessEngine
from trackfeatures.errors import UserError

COUNT, STALL_S = 8, 1.0
HEAD = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"


class Camera(BaseHTTPRequestHandler):
    """The path names the server's action after five pictures: `end`, `stall`, `cut`, `smaller`."""

    protocol_version = "HTTP/1.0"
    stopped = threading.Event()

    def do_GET(self) -> None:
        mode = self.path.strip("/")
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        for number in range(COUNT):
            size = (210, 280) if mode == "smaller" and number > 4 else (420, 560)
            image = np.full((*size, 3), 30 * number, np.uint8)
            data = bytes(simplejpeg.encode_jpeg(image, quality=95))
            if number > 4 and mode == "stall":
                self.stopped.wait(5 * STALL_S)
                return
            if number > 4 and mode == "cut":
                self.wfile.write(HEAD % len(data) + data[: len(data) // 2])
                return
            self.wfile.write(HEAD % len(data) + data + b"\r\n")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Camera)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    Camera.stopped.set()
    server.shutdown()


def test_a_stream_is_answered_to_its_end(
    engine: BrightnessEngine, address: str, tmp_path: Path
) -> None:
    begin, notes = time.time(), list[str]()
    name = f"{address}/end"
    rows = predict_files(engine, [name], [tmp_path / "rows.jsonl"], note=notes.append)
    assert [row["image"] for row in rows] == [f"{name}#{n}" for n in range(COUNT)]
    angles = [30 * n / 255 - 0.5 for n in range(COUNT)]
    assert [row["angle_rad"] for row in rows] == pytest.approx(angles, abs=5e-3)
    times = [row["time_s"] for row in rows]
    assert begin <= times[0] <= times[-1] <= time.time()
    assert times == sorted(times)
    assert notes == [f"{name} ended after {COUNT} pictures"]


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        ("stall", r"sent nothing for 1 s after 5 pictures; these pictures were used"),
        ("cut", r"ended after 6 pictures; 1 of its pictures came damaged and may be wrong \(.+\)"),
        ("smaller", r"picture 5 is 280 x 210 px, those before it are 560 x 420 px and were used"),
    ],
)
def test_a_stream_that_fails_keeps_its_answers(
    engine: BrightnessEngine,
    address: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mode: str,
    message: str,
) -> None:
    monkeypatch.setattr(streams, "STALL_S", STALL_S)
    table = tmp_path / "rows.jsonl"
    with pytest.raises(InputsLeftOut, match=message) as raised:
        predict_files(engine, [f"{address}/{mode}"], [table])
    rows = [json.loads(line) for line in table.read_text().splitlines()]
    assert len(rows) == len(raised.value.results) >= 5
    found = [row["angle_rad"] for row in rows[:5]]
    assert found == pytest.approx([30 * n / 255 - 0.5 for n in range(5)], abs=5e-3)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("20241128120000", "webcam 20241128120000 is no webcam; give its number"),
        ("/dev/video-front", "/dev/video-front is no webcam"),
        ("/dev/video0/x", "/dev/video0/x is no webcam"),
        ("rtsp://me:word@[::1/x", r"^rtsp://\[::1/x cannot be opened as a stream"),
        ("a" * 300, "there is no image file a+|cannot be read .File name too long"),
    ],
)
def test_a_wrong_name_leaves_the_other_inputs(
    engine: BrightnessEngine, tmp_path: Path, name: str, message: str
) -> None:
    picture = tmp_path / "a.jpg"
    picture.write_bytes(simplejpeg.encode_jpeg(np.zeros((210, 280, 3), np.uint8)))
    with pytest.raises(InputsLeftOut, match=message) as raised:
        predict_files(engine, [name, str(picture)])
    assert [row["image"] for row in raised.value.results] == [str(picture)]


@pytest.mark.slow
def test_a_stream_without_connection_that_stops_is_told(
    engine: BrightnessEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """H.264 in MPEG-TS over UDP: after the stall the decoder still returns the pictures that it has
    kept."""
    monkeypatch.setattr(streams, "STALL_S", STALL_S)
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        name = f"udp://127.0.0.1:{free.getsockname()[1]}"
    source = ["-re", "-f", "lavfi", "-i", "testsrc2=size=280x210:rate=20:duration=3"]
    codec = ["-c:v", "libx264", "-preset", "ultrafast", "-g", "5", "-pix_fmt", "yuv420p"]
    command = [program, "-v", "error", *source, *codec, "-f", "mpegts", f"{name}?pkt_size=1316"]
    with (
        subprocess.Popen(command),
        pytest.raises(InputsLeftOut, match=r"sent nothing for 1 s after \d+ pictures") as raised,
    ):
        predict_files(engine, [name])
    assert 20 < len(raised.value.results) <= 60


def test_ctrl_c_ends_a_stream_and_keeps_its_answers(engine: BrightnessEngine, address: str) -> None:
    def interrupt(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    notes: list[str] = []
    rows = predict_files(engine, [f"{address}/end"], report=interrupt, note=notes.append)
    assert len(rows) == 3
    assert notes == ["stopped after 3 images"]


@pytest.mark.parametrize("at", [3, 8])
def test_ctrl_c_in_a_film_before_a_stream_is_an_interruption(
    at: int, engine: BrightnessEngine, address: str, tmp_path: Path
) -> None:
    film = cv2.VideoWriter(
        str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (280, 210)
    )
    for _ in range(5):
        film.write(np.zeros((210, 280, 3), np.uint8))
    film.release()

    def interrupt(done: int, total: int) -> None:
        if done == at:
            raise KeyboardInterrupt

    inputs = [str(tmp_path / "a.avi"), f"{address}/end"]
    if at <= 5:
        with pytest.raises(KeyboardInterrupt):
            predict_files(engine, inputs, report=interrupt)
    else:
        assert len(predict_files(engine, inputs, report=interrupt)) == at - 1


def test_of_two_streams_the_second_is_announced(engine: BrightnessEngine, address: str) -> None:
    notes: list[str] = []
    rows = predict_files(engine, [f"{address}/end", f"{address}/end?2"], note=notes.append)
    assert len(rows) == 2 * COUNT
    assert notes[0] == (
        f"{address}/end?2 is read when {address}/end has ended; to read both now, use two commands"
    )


@pytest.mark.parametrize("count", [4, 100])  # 4: the fault is known, but its item is still waiting
def test_ctrl_c_tells_damaged_pictures(engine: BrightnessEngine, count: int) -> None:
    errors = DecodingErrors()
    numbers = iter(range(count))

    def read() -> tuple[bool, np.ndarray | None]:
        number = next(numbers, None)
        if number == 2:
            errors.add("[h264 @ 0x1] error while decoding MB 12 7")
        time.sleep(0.01)
        return number is not None, np.zeros((210, 280, 3), np.uint8)

    live = Stream("webcam 0", Mock(read=read), errors, ExitStack())
    source = Source(Path("0"), SourceKind.STREAM, 0, 30.0, address="webcam 0", opened=live)

    def interrupt(done: int, total: int) -> None:
        if done == 4:
            time.sleep(0.2)
            raise KeyboardInterrupt

    message = r"^webcam 0.* 1 .*came damaged and may be wrong \(error while .*; 3 images done$"
    with (
        patch("mtlnet.predict.run.find_sources", return_value=[source]),
        pytest.raises(InputsLeftOut, match=message) as raised,
    ):
        predict_files(engine, ["0"], report=interrupt)
    assert len(raised.value.results) == 3


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("file:///etc/hostname", "streams of kind file are not read; give one of rtsp, rtsps"),
        ("http://user:secret@127.0.0.1:9/a", r"^http://127.0.0.1:9/a cannot be opened as a stream"),
        ("rtsp://127.0.0.1:9/a", r"cannot be opened as a stream within 10 s \(.*refused"),
        ("63", "webcam 63 cannot be opened; the cameras of this machine are"),
    ],
)
def test_what_cannot_be_opened_is_told_once_and_leaves_earlier_answers(
    engine: BrightnessEngine, tmp_path: Path, given: str, message: str
) -> None:
    earlier = tmp_path / "answers.csv"
    earlier.write_text("yesterday")
    notes: list[str] = []
    with pytest.raises(UserError, match=message) as raised:
        predict_files(engine, [given], [earlier], note=notes.append)
    assert "secret" not in str(raised.value)
    assert notes == []
    assert earlier.read_text() == "yesterday"


def test_a_file_comes_before_a_webcam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert is_live("0")
    (tmp_path / "0").write_bytes(b"?")
    assert not is_live("0")
    assert [is_live(name) for name in ("a.mp4", "/dev/video2", "RTSP://a/b")] == [False, True, True]
    assert shown_name("rtsp://me:word@10.0.0.2:554/a?b=1") == "rtsp://10.0.0.2:554/a?b=1"
    for plain in ("rtsp://10.0.0.2/a?b", "http://cam:80/a@1", "http://cam/a@1", "rtsp://[::1]:5/a"):
        assert shown_name(plain) == plain
    for odd in "@/?#[":
        shown = shown_name(f"rtsp://me:wo{odd}rd@10.0.0.2/a")
        assert not re.search(r"wo|rd|me", shown), shown
        assert shown.endswith("10.0.0.2/a")
