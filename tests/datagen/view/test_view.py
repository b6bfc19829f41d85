"""`datagen view`: contents of the page and of Rerun's file, and reading by other viewers."""

import base64
import json
import re
import signal
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest
from rerun.chunk import RrdReader
from typer.testing import CliRunner

from datagen.cli import app
from datagen.recording.dataset import Dataset
from datagen.recording.integrity.recover import recover
from datagen.recording.mcap.footer import read_summary
from datagen.recording.names import PLACED
from datagen.recording.schema.messages import CAMERA_FRAME, EGO
from datagen.recording.schema.topics import MESSAGE_TYPES
from datagen.view import rerun as rerun_log
from datagen.view.contents import Contents
from datagen.view.html_page import page
from tests.datagen.commands import datagen_here
from tests.datagen.conftest import FRAMES, Samples, break_message_index

Refused = Callable[..., str]


@pytest.fixture
def recorded(dataset: Path) -> Path:
    return dataset / "rounds/r001.mcap"


def view(*args: object) -> str:
    done = CliRunner().invoke(app, ["view", *map(str, args)])
    assert done.exit_code == 0, done.exception
    return done.stdout


def read_page(text: str) -> dict[str, Any]:
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def test_the_contents_are_what_was_recorded(recorded: Path, dataset: Path) -> None:
    contents = Contents.open(recorded)
    labels = Dataset.open(dataset).select("train").labels
    series = {name: column for plot in contents.plots for name, column in plot.series.items()}
    for i, name in enumerate(("ml", "mr", "l", "m", "r")):
        shown = np.array([np.nan if v is None else v for v in series[name]])
        assert shown == pytest.approx(labels.distances[FRAMES:, i], nan_ok=True)
    assert series["speed"] == pytest.approx([54.0] * FRAMES)  # 15 m/s
    assert series["steer"] == pytest.approx([0.1] * FRAMES)
    assert contents.pose(3).position.tolist() == [1.0, 2.0, 0.3]
    assert contents.pose(3, CAMERA_FRAME).position.tolist() == [0.75, 0.0, 0.95]
    assert [len(line) for line in contents.markings(0)] == [12, 8]
    assert len(contents.boxes(0)) == 2
    assert contents.boxes(0, EGO)[0].size.tolist() == [4.52, 1.94, 1.10]
    assert contents.scene["left"].shape == (10, 3)
    assert "a-track, 2 lanes, 2 other cars, clear, weave, 60 km/h; 45 frames, 2.25 s" in (
        contents.about
    )


def test_the_title_of_a_round_without_a_drive_has_no_speed(
    samples: Samples, tmp_path: Path
) -> None:
    path = tmp_path / "r001.mcap"
    samples.write(path, samples.header("r001", trajectory=PLACED), samples.frames(40, seed=1))
    assert Contents.open(path).about == (
        "r001: a-track, 2 lanes, 2 other cars, clear, placed; 40 frames"
    )


def test_a_recovered_round_without_the_lines_of_the_track_is_shown(
    samples: Samples, tmp_path: Path
) -> None:
    """They are in the first chunk only."""
    whole, out = tmp_path / "r001.mcap", tmp_path / "out.mcap"
    samples.write(whole, samples.header("r001"), samples.frames(60, seed=1))
    data = bytearray(whole.read_bytes())
    data[read_summary(memoryview(data)).chunks[0].start + 1000] ^= 1
    whole.write_bytes(data)
    saved = recover(whole, out).saved
    assert Contents.open(out).scene == {}
    page_file, rerun_file = tmp_path / "round.html", tmp_path / "round.rrd"
    assert json.loads(view(out, "--html", page_file, "--json"))["frames"] == saved
    assert read_page(page_file.read_text())["lines"] == []
    assert json.loads(view(out, "--save", rerun_file, "--json"))["frames"] == saved


def test_the_page_holds_images_markings_and_series_in_step(
    recorded: Path, tmp_path: Path, dataset: Path
) -> None:
    out = tmp_path / "round.html"
    told = json.loads(view(recorded, "--html", out, "--json"))
    assert told == {"round": "r001", "frames": FRAMES, "shown": str(out)}
    text = out.read_text()
    assert not re.search(r'(src|href)="(?!data:)|https?://', text)  # it needs no other file
    data = read_page(text)
    frames = Dataset.open(dataset).select("train")
    assert [frame["step"] for frame in data["frames"]] == list(range(FRAMES))
    for frame in data["frames"]:
        kind, image = frame["image"].split(",")
        assert kind == "data:image/jpeg;base64"
        assert base64.b64decode(image) == bytes(frames.jpeg(FRAMES + frame["step"]))
        assert [len(line) for line in frame["markings"]] == [24, 16]
        assert frame["car"][:2] == [1.0, 2.0]
        assert len(frame["traffic"]) == 2
    distances = data["plots"][0]["series"]["m"]
    assert [v is None for v in distances] == np.isnan(frames.labels.distances[FRAMES:, 3]).tolist()
    assert data["times"][20] == 1.0
    assert len(data["lines"][0]) == 20


@pytest.mark.parametrize("option", ["--html", "--save"])
def test_the_recording_is_not_overwritten(option: str, recorded: Path, refused: Refused) -> None:
    before = recorded.read_bytes()
    assert "is a file to read" in refused("view", recorded, option, recorded)
    assert recorded.read_bytes() == before


def test_a_long_round_is_subsampled_in_images_not_in_plots(recorded: Path) -> None:
    text = page(Contents.open(recorded), max_frames=10)
    data = read_page(text)
    assert [frame["step"] for frame in data["frames"]] == list(range(0, FRAMES, 5))
    assert len(data["plots"][0]["series"]["ml"]) == FRAMES
    assert "one image in 5 steps" in text


def rows(path: Path, static: bool) -> Counter[str]:
    counts: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        if chunk.is_static == static:
            counts[chunk.entity_path] += chunk.num_rows
    return counts


def test_reruns_file_holds_every_frame_on_every_entity(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "round.rrd"
    assert str(out) in view(recorded, "--save", out)
    moving, still = rows(out, static=False), rows(out, static=True)
    contents = Contents.open(recorded)
    for entity in (
        rerun_log.IMAGE, rerun_log.MARKINGS, rerun_log.CAR, rerun_log.TRAFFIC, rerun_log.CAPTION,
    ):  # fmt: skip
        assert moving[f"/{entity}"] == FRAMES
    for plot in contents.plots:
        for name, column in plot.series.items():
            present = sum(value is not None for value in column)
            assert moving[f"/{rerun_log.plot_entity(plot)}/{name}"] == present
    for entity in (rerun_log.CAMERA, rerun_log.BODY, f"{rerun_log.TRACK}/left", rerun_log.ABOUT):
        assert still[f"/{entity}"] >= 1
    assert len(RrdReader(out).blueprints()) == 1
    assert not list(tmp_path.glob("*.partial"))


def test_rerun_shows_the_recorded_values(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "round.rrd"
    view(recorded, "--save", out)
    contents = Contents.open(recorded)
    found: dict[str, list[Any]] = {"image": [], "angle": []}
    for chunk in RrdReader(out).stream():
        name = chunk.entity_path.split("/")[-1]
        if name in found and not chunk.is_static:
            batch = chunk.to_record_batch()
            (column,) = (c for c in batch.schema.names if c.endswith((":blob", ":scalars")))
            times = [t.total_seconds() for t in batch.column("time").to_pylist()]
            found[name] += list(zip(times, batch.column(column).to_pylist(), strict=True))
    images = sorted(found["image"])
    assert [time for time, _ in images] == pytest.approx(contents.steps.times_s)
    assert [bytes(blob[0]) for _, blob in images] == [bytes(s.image) for s in contents.steps]
    angles = [value[0] for _, value in sorted(found["angle"])]
    assert angles == [step.labels.angle for step in contents.steps]


def test_rerun_opens_our_rounds_by_itself(recorded: Path, tmp_path: Path) -> None:
    """Rerun's own MCAP loader reads image, calibration, transforms and our messages."""
    out = tmp_path / "own.rrd"
    convert = ["rerun", "mcap", "convert", str(recorded), "-o", str(out)]
    program = Path(sys.executable).with_name("rerun")
    subprocess.run([str(program), *convert[1:]], check=True, capture_output=True, timeout=300)
    counts, columns = rows(out, static=False), set()
    for chunk in RrdReader(out).stream():
        columns |= {f"{chunk.entity_path} {n}" for n in chunk.to_record_batch().schema.names}
    for topic in ("/camera/front", "/camera/front/annotations", "/labels", "/command"):
        assert counts[topic] == FRAMES
    assert {
        "/camera/front EncodedImage:blob", "/camera/front/calibration Pinhole:resolution",
        "/tf Transform3D:translation", "/labels driverview.TrackFeatures:message",
    } <= columns  # fmt: skip


def test_the_web_viewer_is_served_until_interrupted(recorded: Path) -> None:
    port = free_port()
    command = [sys.executable, "-m", "datagen", "view", str(recorded), "--web", "--json"]
    with subprocess.Popen(
        [*command, "--port", str(port)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        told = ""
        while not told.endswith("}\n"):
            told += process.stdout.readline()
        address = json.loads(told)["shown"]
        assert address == (
            f"http://localhost:{port}/?url=rerun%2Bhttp://127.0.0.1:{port + 1}/proxy"
        )
        assert b"rerun" in urlopen(address, timeout=120).read().lower()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=120) == 130


def free_port() -> int:
    """A free port whose next port is free as well."""
    while True:
        with socket.socket() as one, socket.socket() as other:
            one.bind(("", 0))
            port = int(one.getsockname()[1])
            try:
                other.bind(("", port + 1))
            except OSError:
                continue
            return port


def test_rounds_that_cannot_be_shown_are_refused_with_a_one_line_error(
    recorded: Path, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    page_file = tmp_path / "a.html"
    line = refused("view", recorded, "--html", page_file, "--save", tmp_path / "a.rrd")
    assert "give one of them" in line
    assert "there is no folder" in refused("view", recorded, "--html", tmp_path / "no/a.html")
    folder = recorded.parents[1]
    assert f"such as {folder}/rounds/r000.mcap" in refused("view", folder, "--html", page_file)
    assert "No such file" in refused("view", tmp_path / "no.mcap", "--html", page_file)
    (tmp_path / "bad.mcap").write_bytes(recorded.read_bytes()[:5000])
    assert "is damaged" in refused("view", tmp_path / "bad.mcap", "--html", page_file)
    assert not page_file.exists()
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "there is no screen" in refused("view", recorded)
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert f"port {port} cannot be used" in refused("view", recorded, "--web", "--port", port)
    monkeypatch.setattr("datagen.view.show.find_spec", lambda name: None)
    assert "driverview[view]" in refused("view", recorded)


def test_a_damaged_message_index_is_refused_with_a_one_line_error(
    dataset: Path, recorded: Path, tmp_path: Path, refused: Refused
) -> None:
    break_message_index(recorded, "/command")
    assert Dataset.open(dataset).rounds  # it does not read this index
    for command in (
        ("view", recorded, "--html", tmp_path / "page.html"),
        ("export", dataset, "--out", tmp_path / "out"),
        ("export", dataset, "--out", tmp_path / "out", "--format", "lerobot"),
        ("stats", dataset),
    ):
        assert f"{recorded}: the message index of /command is damaged" in refused(*command)


def test_an_incomplete_rerun_file_is_deleted(
    recorded: Path, tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datagen.view.rerun.log", lambda contents, recording: None)
    line = refused("view", recorded, "--save", tmp_path / "a.rrd")
    assert "0 of 45 images arrived" in line
    assert list(tmp_path.glob("a.rrd*")) == []


def layout() -> dict[str, Any]:
    text = files("datagen.recording.schema").joinpath("layouts/foxglove.json").read_text()
    found: dict[str, Any] = json.loads(text)
    return found


def strings(value: object) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, part in value.items():
            yield key
            yield from strings(part)
    elif isinstance(value, list):
        for part in value:
            yield from strings(part)


def test_foxgloves_layout_shows_topics_and_fields_that_exist() -> None:
    panels = layout()["configById"]
    paths = [text for text in strings(panels) if text.startswith("/")]
    assert len(paths) > 15
    for path in paths:
        topic, _, field = path.partition(".")
        assert topic in MESSAGE_TYPES, path
        if field:
            assert field in MESSAGE_TYPES[topic].DESCRIPTOR.fields_by_name, path
    assert panels["3D!world"]["followTf"] == EGO


def test_foxgloves_layout_places_exactly_the_panels_it_configures() -> None:
    content = layout()
    placed = [text for text in strings(content["layout"]) if "!" in text]
    assert sorted(placed) == sorted(content["configById"])


def test_a_port_is_refused_without_web(dataset: Path) -> None:
    path = dataset / "rounds" / "r000.mcap"
    done = datagen_here("view", path, "--port", "9090", "--html", dataset.parent / "a.html")
    assert (done.returncode, done.stdout) == (1, "")
    assert "--port is the port of --web; give both, or none" in done.stderr
