"""The paper's protocol on small drives whose errors are painted into their images."""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer.testing
from numpy.typing import NDArray
from rich.console import Console

import trackfeatures as tf
from datagen.recording.frame import DriverCommand, EgoState, Frame, RoadPlace
from datagen.recording.mcap.writer import RoundWriter
from datagen.recording.names import MIDDLE
from datagen.recording.round_metadata import RoundHeader
from datagen.recording.splits import Split, split_path, write_split
from mtlnet import cli
from mtlnet.evaluation.protocol import darkest_intervals, evaluate_protocol
from mtlnet.evaluation.tables import protocol_table
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

CAMERA = CameraParameters(width=56, height=42)
TO_MIDDLE, ANGLE = 0.2, -0.01
FRAMES = 28
DARK = np.repeat([0, 1, 0, 1, 0, 1, 0], 4).astype(bool)
"""Three of the four intervals of four frames; frames 24 to 27 are the fourth, half as dark."""
SHADOW = np.where(DARK, 0.8, np.where(np.arange(FRAMES) >= 24, 0.5, 0.1))
MEAN = {
    "distances_m": [-2.0, 2.0, -4.0, 0.0, 4.0],
    "to_lane_centre_m": 0.0,
    "angle_rad": 0.0,
    "heading": 1,
}
FOUR = "g-track-3, heavy shadow: four darkest intervals"


class PaintedEngine:
    """Answers the truth plus as many mm and 0.1 mrad as the red of the image, and the class in its
    green."""

    kind, precision = "painted", "f32"

    def __init__(self, **data: Any) -> None:
        card = {"mean": MEAN, "seeds": [], "tracks": ["g-track-3"], **data}
        self.card = SimpleNamespace(camera=CAMERA, data=card, name="painted", model_hash="0")

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        error, heading = int(image[0, 0, 0]), int(image[0, 0, 1])
        answered = tf.measure(TO_MIDDLE + error / 1000, 0.0, 0.0, 0.0, 1, 4.0).distances.values()
        distances = [[np.nan if d is None else d for d in answered]]
        coded = tf.encode(distances, [ANGLE + error / 10_000])
        return np.concatenate([coded[0], np.eye(3)[heading]]).astype(np.float32)


def record(
    folder: Path, name: str, seed: int, errors: NDArray[Any], classes: NDArray[Any], **header: Any
) -> None:
    """A round on a straight road whose images hold these errors (N,) and answered classes (N,)."""
    values = {
        "track_hash": "0" * 64, "lanes": 1, "lane_width_m": 4.0, "traffic": 0, "codec": "png",
        "trajectory": MIDDLE, "speed_kmh": 65.0, "camera": CAMERA, **header,
    }  # fmt: skip
    path = folder / "rounds" / f"{name}.mcap"
    with RoundWriter(path, RoundHeader(id=name, seed=seed, **values), {}) as writer:
        for error, heading, shadow in zip(
            errors, classes, np.resize(SHADOW, len(errors)), strict=True
        ):
            image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
            image[..., 0], image[..., 1] = error, heading
            writer.add(
                Frame(
                    image=image,
                    features=tf.measure(TO_MIDDLE, ANGLE, 0.0, 0.0, 1, 4.0),
                    place=RoadPlace(1, 0, 0.0, TO_MIDDLE, 7.0),
                    ego=EgoState(
                        1.0, 2.0, 0.3, ANGLE, 0.0, 0.0, 18.0, 0.0, 0.0, shadow_fraction=shadow
                    ),
                    command=DriverCommand(0.0, 0.2, 0.0, 1),
                )
            )
        writer.finish()


@pytest.fixture
def rounds(tmp_path: Path) -> Path:
    """Drives with errors of 10 mm, 70 mm in the shade of g-track-3, 40 mm on dirt-3, and correct
    classes; another round with errors of 5 mm and seven of ten classes correct."""
    (tmp_path / "rounds").mkdir()
    (tmp_path / "splits").mkdir()
    straight = np.full(FRAMES, 1)
    shade = np.where((np.arange(FRAMES) >= 24) | DARK, 70, 10)
    for seed, (track, light, errors) in enumerate(
        [
            ("g-track-3", "clear", np.full(FRAMES, 10)),
            ("g-track-3", "heavy-shadow", shade),
            ("dirt-3", "clear", np.full(FRAMES, 40)),
            ("dirt-3", "heavy-shadow", np.full(FRAMES, 40)),
        ]
    ):
        name = f"drive-{track}-{light}"
        record(tmp_path, name, seed, errors, straight, track=track, lights=(light,))
    classes = np.repeat([1, 0], [7, 3])
    record(
        tmp_path, "round-000", 9, np.full(10, 5), classes,
        track="forza", lights=("clear",), trajectory="weave",
    )  # fmt: skip
    names = [f"drive-g-track-3-{light}" for light in ("clear", "heavy-shadow")]
    unseen = tuple(name.replace("g-track-3", "dirt-3") for name in names)
    write_split(split_path(tmp_path), Split((), (*names, "round-000"), unseen))
    return tmp_path


def evaluated(folder: Path, every: int = 1, **card: Any) -> dict[str, Any]:
    engine: Any = PaintedEngine(**card)
    return evaluate_protocol([engine], folder, "paper", every=every)


def test_each_figure_is_the_painted_error_beside_the_papers(rounds: Path) -> None:
    report = evaluated(rounds)
    table = report["protocol"]
    found = {
        name: (row["frames"], row["distance_m"], row["angle_rad"], row["heading_accuracy"])
        for name, row in table.items()
    }
    lap = (16 * 70 + 12 * 10) / FRAMES
    expected = {
        FOUR: (16, 0.070, 0.0070, 1.0),
        "g-track-3, heavy shadow": (FRAMES, lap / 1000, lap / 10_000, 1.0),
        "g-track-3, clear": (FRAMES, 0.010, 0.0010, 1.0),
        "dirt-3, clear": (FRAMES, 0.040, 0.0040, 1.0),
        "dirt-3, heavy shadow": (FRAMES, 0.040, 0.0040, 1.0),
        "nine tracks, held-out rounds": (10, 0.005, 0.0005, 0.7),
    }
    assert list(found) == list(expected)
    for name, figures in expected.items():
        assert found[name] == pytest.approx(figures, abs=2e-6), name
    assert table["dirt-3, clear"]["paper"] == {"distance_m": 0.107, "angle_rad": 0.004}
    assert table[FOUR]["paper"] == {"distance_m": 0.071, "angle_rad": 0.003}
    assert table["nine tracks, held-out rounds"]["paper"] == {"heading_accuracy": 0.9878}
    shaded = table["g-track-3, heavy shadow"]
    assert shaded["largest_distance_m"] == pytest.approx(0.070, abs=2e-6)
    assert shaded["largest_angle_rad"] == pytest.approx(0.0070, abs=2e-6)
    assert shaded["zero_distance_m"] == pytest.approx(TO_MIDDLE)
    assert shaded["zero_angle_rad"] == pytest.approx(-ANGLE)
    assert shaded["absent"] == 0
    assert [part["frames"] for part in table[FOUR]["intervals"]] == [4] * 4
    # The whole report, of the other rounds alone.
    assert (report["frames"], report["rounds"], report["heading_accuracy"]) == (10, 1, 0.7)
    assert list(report["by_track"]) == ["forza"]


def test_the_printed_table_has_the_papers_figures_in_brackets(rounds: Path) -> None:
    printed = protocol_table(evaluated(rounds))
    columns = [[str(cell) for cell in column.cells] for column in printed.columns]
    assert columns[2] == ["0.070 (0.071)", "0.044", "0.010", "0.040 (0.107)", "0.040", "0.005"]
    assert [cell.endswith(" (0.003)") for cell in columns[3]] == [True, *[False] * 5]
    assert columns[3][3].endswith(" (0.004)")
    assert columns[4][-1] == "70.0% (98.78%)"
    console = Console(width=80, record=True)
    console.print(printed)
    assert "…" not in console.export_text(), "a name is cut off"


def test_every_nth_frame_is_evaluated(rounds: Path) -> None:
    """Every second frame of 122: 14 of each drive, and 5 of the others."""
    table = evaluated(rounds, every=2)["protocol"]
    counts = [row["frames"] for row in table.values()]
    assert counts == [8, 14, 14, 14, 14, 5]
    assert table[FOUR]["distance_m"] == pytest.approx(0.070, abs=2e-6)


@pytest.mark.parametrize(
    ("every", "name"),
    [(1000, "g-track-3, heavy shadow"), (27, "the nine tracks")],
)
def test_frames_that_lack_a_drive_are_refused_before_the_first_prediction(
    rounds: Path, monkeypatch: pytest.MonkeyPatch, every: int, name: str
) -> None:
    monkeypatch.setattr("mtlnet.evaluation.protocol.predict_rounds", None)
    with pytest.raises(UserError, match=f"--every leaves no frame of {name}; give a smaller"):
        evaluated(rounds, every=every)


def test_the_darkest_intervals_are_in_order_and_apart() -> None:
    shadow = np.full(100, 0.3, np.float32)
    shadow[[*range(10, 20), *range(40, 50), *range(55, 65), *range(80, 90)]] = 0.7
    shadow[55:65] = 0.6
    starts = [int(rows[0]) for rows in darkest_intervals(shadow, 10)]
    assert starts == [10, 40, 55, 80]
    for count, window in ((100, 50), (7, 3), (28, 4)):
        rows = np.concatenate(darkest_intervals(np.ones(count, np.float32), window))
        assert len(rows) == 4 * min(window, count // 7)
        assert len(np.unique(rows)) == len(rows)


def without(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / "rounds" / f"{name}.mcap").unlink()


@pytest.mark.parametrize(
    ("change", "card", "message"),
    [
        (without("drive-dirt-3-clear"), {}, "holds 0 drives in the middle of dirt-3, clear"),
        (without("round-000"), {}, "no rounds of the nine tracks"),
        (None, {"seeds": [9]}, "was trained on the round of seed 9"),
        (None, {"tracks": ["dirt-3", "forza"]}, "was trained on track dirt-3"),
    ],
)
def test_other_rounds_and_models_that_saw_them_are_refused(
    rounds: Path, change: Callable[[Path], object] | None, card: dict[str, Any], message: str
) -> None:
    if change is not None:
        change(rounds)
    with pytest.raises(UserError, match=message):
        evaluated(rounds, **card)


def test_another_protocol_is_refused(rounds: Path) -> None:
    engine: Any = PaintedEngine()
    with pytest.raises(UserError, match="there is no protocol 'ours'; give paper"):
        evaluate_protocol([engine], rounds, "ours")
    with pytest.raises(UserError, match="--every is 0"):
        evaluated(rounds, every=0)


def test_the_command_prints_the_table_and_refuses_options_that_do_not_go_with_it(
    rounds: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "_load", lambda *_, **__: PaintedEngine())
    words = ["evaluate", "--protocol", "paper", "--data", str(rounds)]
    run = typer.testing.CliRunner().invoke
    printed = run(cli.app, [*words, "--json"])
    assert json.loads(printed.stdout)["protocol"][FOUR]["distance_m"] == pytest.approx(
        0.07, abs=1e-5
    )
    assert "0.107" in run(cli.app, words).stdout
    refused = run(cli.app, [*words, "--split", "all"]).exception
    assert "--protocol has its own rounds" in str(refused)
