"""Shared by the tests of recording: rounds made without a simulator, and datasets of them."""

import errno
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackfeatures as tf
from datagen.cli import main as datagen_main
from datagen.recording.folder import RoundState, partial_path, prepare, publish
from datagen.recording.frame import DriverCommand, EgoState, Frame, RoadPlace, SensorReadings
from datagen.recording.manifest import rebuild
from datagen.recording.mcap.footer import read_summary
from datagen.recording.mcap.writer import RoundWriter
from datagen.recording.round_metadata import RoundHeader, RoundResult
from datagen.recording.splits import Split
from tests.datagen.commands import ROUNDS, SHORT, datagen, datagen_here, recording_here
from trackfeatures.camera import CameraParameters

LANES = 2
CAMERA = CameraParameters(width=56, height=42)


FRAMES = 45


class Samples:
    """Makes headers, frames, rounds and dataset folders."""

    camera = CAMERA
    frames_a_round = FRAMES

    def header(self, round_id: str = "r000", **changes: Any) -> RoundHeader:
        header = RoundHeader(
            id=round_id,
            seed=int(round_id[1:]),
            track="a-track",
            track_hash="0" * 64,
            lanes=LANES,
            lane_width_m=4.0,
            traffic=2,
            trajectory="weave",
            lights=("clear",),
            speed_kmh=60.0,
            camera=CAMERA,
        )
        return replace(header, **changes)

    def frames(self, count: int, seed: int) -> list[Frame]:
        rng = np.random.default_rng(seed)
        return [_frame(rng) for _ in range(count)]

    def write(self, path: Path, header: RoundHeader, frames: list[Frame]) -> RoundResult:
        scene = {"left": np.arange(30.0).reshape(10, 3)}
        with RoundWriter(path, header, scene) as writer:
            for frame in frames:
                writer.add(frame)
            return writer.finish(laps=1, distance_m=12.5, mean_speed_kmh=60.0)

    def add_round(self, folder: Path, header: RoundHeader, content_seed: int | None = None) -> None:
        """A round as `datagen collect` leaves it; its frames follow from its seed."""
        partial = partial_path(folder, header.id)
        seed = header.seed if content_seed is None else content_seed
        result = self.write(partial, header, self.frames(FRAMES, seed))
        publish(folder, partial, RoundState.of(partial, header, result))

    def dataset(self, folder: Path) -> Path:
        """Two rounds to train, one to test."""
        prepare(folder)
        for number in range(3):
            self.add_round(folder, self.header(f"r{number:03d}"))
        rebuild(folder, Split(train=("r000", "r001"), test=("r002",)))
        return folder


def break_message_index(path: Path, topic: str) -> None:
    """Flip a bit in the opcode of the first message index of `topic`; no CRC covers it."""
    data = bytearray(path.read_bytes())
    summary = read_summary(memoryview(bytes(data)))
    data[summary.chunks[0].indexes[summary.channels[topic]]] ^= 0x10
    path.write_bytes(data)


@pytest.fixture
def refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Runs the command in this process; returns the one line of its error message."""

    def run(*args: object) -> str:
        monkeypatch.setattr(sys, "argv", ["datagen", *map(str, args)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            datagen_main()
        stdout, stderr = capsys.readouterr()
        assert (end.value.code, stdout, stderr.count("\n")) == (1, "", 1)
        return stderr

    return run


@pytest.fixture
def fill_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From its call on, no file can be written to the disk to its end."""

    def full(*args: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    return lambda: monkeypatch.setattr("runtime.files.fsync_path", full)


@pytest.fixture(scope="session")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short rounds; a test that changes them must restore them."""
    folder = tmp_path_factory.mktemp("collect") / "data"
    done = datagen("collect", *SHORT, "--out", folder, "--workers", "2", "--json")
    assert done.returncode == 0, done.stderr
    assert "pybullet" not in done.stderr
    result = json.loads(done.stdout)
    assert (result["rounds"], result["frames"], result["resets"]) == (2, 60, 0)
    assert result["frames_per_second"] == pytest.approx(60 / result["seconds"], rel=0.01, abs=0.01)
    return folder


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three rounds of the plan ROUNDS; tests do not change them."""
    folder = tmp_path_factory.mktemp("whole") / "whole"
    with recording_here():
        done = datagen_here("collect", *ROUNDS, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def recorded_here() -> Iterator[None]:
    with recording_here():
        yield


@pytest.fixture(scope="session")
def samples() -> Samples:
    return Samples()


@pytest.fixture
def dataset(samples: Samples, tmp_path: Path) -> Path:
    return samples.dataset(tmp_path / "data")


def _frame(rng: np.random.Generator) -> Frame:
    to_middle, angle = rng.uniform(-7.0, 7.0), rng.normal(0.0, 0.05)
    curvature, ahead = rng.normal(0.0, 0.01, 2)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    ramp = (rows * rng.uniform(1, 3) + columns * rng.uniform(1, 2)) % 256
    image = np.stack([ramp, ramp // 2, 255 - ramp], axis=-1).astype(np.uint8)
    return Frame(
        image=image,
        features=tf.measure(to_middle, angle, curvature, ahead, LANES, 4.0),
        place=RoadPlace(LANES, tf.lane_index(to_middle, LANES, 4.0), curvature, to_middle, 7.0),
        ego=EgoState(1.0, 2.0, 0.3, angle, 0.01, -0.02, 15.0, 0.1, 0.05, 0.25),
        command=DriverCommand(0.1, 0.2, 0.0, 3),
        sensors=SensorReadings(range=tuple(rng.uniform(0, 200, 19)), wheel_spin=(1, 2, 3, 4)),
        traffic=rng.uniform(-5, 5, (2, 6)),
        markings=(rng.uniform(0, 40, (12, 2)), rng.uniform(0, 40, (8, 2))),
    )
