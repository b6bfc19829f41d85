"""The model that ships with the project: its files, and its errors on a track it has never seen."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from mtlnet.export.ship import write_page
from mtlnet.inference.engine import INT8, int8_graph, load_engine, read_export
from mtlnet.inference.model_card import ModelError, read_card, resolve_run
from mtlnet.inference.shipped_models import SHIPPED, SHIPPED_FILES
from mtlnet.inference.trained_rounds import Seeds
from runtime.files import file_hash
from tests.typed import typed

MAX_BYTES = {"default": 32_000_000, "varied": 25_000_000}
"""Weights 12 MB and served graph 12 MB; "default" has an int8 graph of 7 MB, too."""


def command(*arguments: str) -> Any:
    """The result of one of the project's commands with --json."""
    done = typed(*arguments, "--json")
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", ["default", "varied"])
def test_a_shipped_model_is_found_by_name_and_has_the_hashes_in_the_code(name: str) -> None:
    run = resolve_run(name)
    assert run == SHIPPED.parent / name
    card, hashes = read_card(run), SHIPPED_FILES[name]
    assert card.name == name
    assert card.files == hashes
    assert {file: file_hash(run / file) for file in hashes} == hashes
    files = [path for path in run.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < MAX_BYTES[name]
    assert "/" not in card.data["path"]
    assert card.model_hash in (run / "README.md").read_text()


def test_a_users_run_comes_before_the_shipped_model_varied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("runs/varied").mkdir(parents=True)
    assert resolve_run("varied") == Path("runs/varied")


def test_the_shipped_int8_graph_passed_its_gate_and_is_used() -> None:
    card, about = read_card(SHIPPED), read_export(SHIPPED / INT8)
    assert about is not None
    assert about["model_hash"] == card.model_hash
    for gate, native, largest in (("gate", True, 0.001), ("other_gate", False, 0.0011)):
        assert about[gate]["passed"]
        assert about[gate]["native_int8"] is native
        assert about[gate]["split"] == "test"
        assert about[gate]["frames"] >= 12_000
        assert max(about[gate]["worse"].values()) < largest
    graph = int8_graph(SHIPPED, card)  # its hashes
    assert graph.is_file()
    assert load_engine(SHIPPED).precision == "int8"  # on all processors


def test_other_weights_in_the_place_of_the_shipped_ones_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "default"
    shutil.copytree(SHIPPED, run)
    monkeypatch.setattr("mtlnet.inference.model_card.SHIPPED", run)
    assert load_engine(resolve_run("default")).card == read_card(SHIPPED)
    card = json.loads((run / "card.json").read_text())
    card["files"]["model.safetensors"] = "0" * 64
    (run / "card.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match="does not hold the weights of this version"):
        read_card(resolve_run("default"))


def test_the_card_of_the_shipped_model_is_short() -> None:
    card = read_card(SHIPPED)
    assert len((SHIPPED / "card.json").read_text().splitlines()) < 300
    assert json.loads((SHIPPED / "card.json").read_text())["data"] == card.data
    assert Seeds.read(card.data["seeds"]).count > 1000


def test_the_page_of_the_shipped_model_has_the_figures_of_its_card_and_its_int8_graph(
    tmp_path: Path,
) -> None:
    """Without the notes and evaluations, which only its author has."""
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    head, int8 = write_page(tmp_path, []).read_text().split("## The int8 graph")
    found = (SHIPPED / "README.md").read_text()
    assert found.startswith(head.rstrip())
    assert f"## The int8 graph{int8.rstrip()}\n" in found
    for gate, processor in (("gate", "with"), ("other_gate", "without")):
        worse = read_export(SHIPPED / INT8)[gate]["worse"]  # type: ignore[index]
        part = int8.split(f"On a processor {processor} int8 instructions")[1].split("On a")[0]
        assert f"| `ml` (m) | {worse['ml']:+.4f} | 0.003 |" in part
        assert f"| `angle` (rad) | {worse['angle']:+.5f} | 0.0002 |" in part
        assert f"| wrong class (points) | {100 * worse['accuracy']:+.2f} | 0.1 |" in part


@pytest.mark.slow
def test_the_shipped_model_reads_a_track_it_has_never_seen(tmp_path: Path) -> None:
    data = str(tmp_path / "data")
    rounds = ("--rounds=3", "--frames=40", "--frequency=4", "--stretch=0", "--workers=1")
    where = ("--split", "unseen", "--tracks", "coast", "--lights", "clear,overcast", "--seed", "9")
    command("datagen", "collect", "--out", data, *rounds, *where)
    found = command("mtlnet", "evaluate", "--data", data, "--split", "unseen")
    assert found["frames"] == 120
    assert found["errors"]["ml"]["median"] < 0.08
    assert found["errors"]["to_lane_centre"]["mean"] < 0.25
    assert found["errors"]["angle"]["mean"] < 0.025
    assert found["heading_accuracy"] > 0.75
