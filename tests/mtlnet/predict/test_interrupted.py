"""The files of a `mtlnet predict` that a signal ends or kills before its last image."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from mtlnet.predict.mcap_writer import McapWriter
from mtlnet.predict.run import InputsLeftOut, answer, predict_files
from mtlnet.sources.read import SourceImage
from tests.mtlnet.predict.brightness_engine import BrightnessEngine, write_film


def test_sigterm_completes_film_and_recording(tmp_path: Path) -> None:
    film = write_film(tmp_path / "in.mp4", [30] * 1500)
    table, recorded, drawn = (tmp_path / name for name in ("a.jsonl", "a.mcap", "a.mp4"))
    outputs = [part for path in (table, recorded, drawn) for part in ("--out", str(path))]
    command = ["-m", "mtlnet", "predict", str(film), "--camera", "model", *outputs]
    with subprocess.Popen([sys.executable, *command], stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120.0
        while not table.is_file() or len(table.read_bytes().splitlines()) < 20:
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in told
    rows = len(table.read_text().splitlines())
    assert 20 <= rows < 1500
    assert cv2.VideoCapture(str(drawn)).get(cv2.CAP_PROP_FRAME_COUNT) == rows
    with recorded.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages(["/features"])
        assert len(list(messages)) == rows


def test_a_killed_recording_has_all_but_its_last_pictures(
    engine: BrightnessEngine, tmp_path: Path
) -> None:
    path, killed = tmp_path / "a.mcap", tmp_path / "killed.mcap"
    camera = engine.card.camera
    noise = np.random.default_rng(1).integers(0, 255, (camera.height, camera.width, 3), np.uint8)
    item = SourceImage("noise", 0, noise)
    with McapWriter(path, camera, fps=10.0) as writer:
        for _ in range(20):
            writer.write(item, answer(engine, item))
        killed.write_bytes(path.read_bytes())  # what the kernel has is what a killed process leaves
    with pytest.raises(InputsLeftOut, match="cut") as raised:
        predict_files(engine, [str(killed)])
    assert len(raised.value.results) >= 18  # of pictures with 60 kB
