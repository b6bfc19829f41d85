"""The model that ships with the project: its files, and its errors on a track it has never seen."""

import json
from pathlib import Path
from typing import Any

import pytest

from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import SHIPPED, SHIPPED_FILES, ModelError, read_card, resolve_run
from runtime.files import file_hash
from tests.typed import typed

MAX_BYTES = 18_000_000


def command(*arguments: str) -> Any:
    """The result of one of the project's commands with --json."""
    done = typed(*arguments, "--json")
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


def test_the_default_model_is_the_shipped_one_with_the_hashes_in_the_code() -> None:
    assert resolve_run("default") == SHIPPED
    card = read_card(SHIPPED)
    assert card.files == SHIPPED_FILES
    assert {name: file_hash(SHIPPED / name) for name in SHIPPED_FILES} == SHIPPED_FILES
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < MAX_BYTES
    assert "/" not in card.data["path"]
    assert card.model_hash in (SHIPPED / "README.md").read_text()


def test_other_weights_in_the_place_of_the_shipped_ones_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in SHIPPED.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr("mtlnet.inference.model_card.SHIPPED", tmp_path)
    assert load_engine(resolve_run("default")).card == read_card(SHIPPED)
    card = json.loads((tmp_path / "card.json").read_text())
    card["files"]["model.safetensors"] = "0" * 64
    (tmp_path / "card.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match="does not hold the weights of this version"):
        read_card(resolve_run("default"))


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
