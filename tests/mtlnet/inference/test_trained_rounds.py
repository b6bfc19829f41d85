"""The rounds of a training in a model's card: short, and yet the questions about them have the same
answers as with a card that lists every round."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.recording import Dataset
from mtlnet.evaluation.evaluate import require_fit
from mtlnet.inference.model_card import ModelCard, ModelError, read_card
from mtlnet.inference.trained_rounds import Seeds, names_entry, shortened

LISTED = Path(__file__).parent / "card_format5.json"
"""The card of a model that the last program with format 5 made of 13 train rounds of seeds 0 to 12,
of which one was held out, and a test round of seed 13."""


@pytest.fixture(params=[5, 6])
def card(request: pytest.FixtureRequest, tmp_path: Path) -> ModelCard:
    """The card as format 5 lists the rounds, and as this program writes it."""
    shutil.copy(LISTED, tmp_path / "card.json")
    if request.param == 6:
        read_card(tmp_path).write(tmp_path)
    assert json.loads((tmp_path / "card.json").read_text())["format"] == request.param
    return read_card(tmp_path)


def test_seeds_are_a_set_written_as_ranges() -> None:
    seeds = Seeds.of([7, 3, 1, 2, 3])
    assert seeds.entry() == {"count": 4, "ranges": "1..3 7"}
    assert (seeds | Seeds.of([4, 6, 9])).entry() == {"count": 7, "ranges": "1..4 6..7 9"}
    assert Seeds.of([-3, -2]).entry() == {"count": 2, "ranges": "-3..-2"}
    assert Seeds.of([]).entry() == {"count": 0, "ranges": ""}


def test_seeds_answer_as_pythons_set_does() -> None:
    rng = np.random.default_rng(3)
    one, other = (set(rng.integers(-20, 120, 60).tolist()) for _ in range(2))
    joined = Seeds.read(Seeds.of(one).entry()) | Seeds.read(sorted(other))
    assert joined.count == len(one | other)
    asked = range(-30, 130)
    assert [seed in joined for seed in asked] == [seed in one | other for seed in asked]
    assert joined == Seeds.of(one | other)


def test_names_have_one_digest_in_any_order() -> None:
    found = names_entry(["b", "a"])
    # printf '["a", "b"]' | sha256sum
    digest = "3554d2b8a1e34099053865de8576d1460b807430ec8c6b85315c9607ba93d308"
    assert found == {"count": 2, "sha256": digest} == names_entry(["a", "b"])
    assert names_entry(["a", "c"]) != found
    assert names_entry(["a, b"])["sha256"] != digest


def test_a_card_that_lists_rounds_becomes_short(card: ModelCard) -> None:
    names = [f"r{number:03}" for number in range(14)]
    listed = json.loads(LISTED.read_text())["data"]
    assert listed["split"] == {"train": names[:13], "test": names[13:]}
    assert card.data["split"] == {"train": names_entry(names[:13]), "test": names_entry(names[13:])}
    assert card.data["held_out"] == names_entry(["r008"])
    assert card.data["seeds"] == {"count": 13, "ranges": "0..12"}
    assert card.uncertainty is not None
    assert card.uncertainty["held_out"] == names_entry(["r008"])
    kept = {*listed} - {"split", "held_out", "seeds"}
    assert {name: card.data[name] for name in kept} == {name: listed[name] for name in kept}
    assert shortened(card.data) == card.data


def test_rounds_that_the_model_was_trained_on_are_refused(card: ModelCard, dataset: Path) -> None:
    data = Dataset.open(dataset)
    message = (
        "model oldrun was trained on the round of seed 3, a test round of this data; it cannot be "
        "tested on it: use --split all, or other rounds"
    )
    with pytest.raises(ModelError) as refused:
        require_fit(card, data.select("test"), "test")
    assert str(refused.value) == message
    require_fit(card, data.select("test"), "all")
    with pytest.raises(ModelError, match="the round of seed 0, a test round"):
        require_fit(card, data.select("all"), "test")


def test_one_seed_decides(card: ModelCard, dataset: Path) -> None:
    frames = Dataset.open(dataset).select("test")  # of seed 3
    beside, among = (
        replace(card, data={**card.data, "seeds": Seeds.of(seeds).entry()})
        for seeds in ([0, 1, 2, 4], [2, 3, 4])
    )
    require_fit(beside, frames, "test")
    with pytest.raises(ModelError, match="the round of seed 3"):
        require_fit(among, frames, "test")


@pytest.mark.parametrize(
    "seeds",
    [
        {"count": 14, "ranges": "0..12"},
        {"count": 13, "ranges": "0-12"},
        {"count": 13, "ranges": "12..0"},
        {"count": 13, "ranges": f"0..{10**30}"},
        {"count": 13},
        13,
    ],
)
def test_a_damaged_list_of_seeds_is_refused(tmp_path: Path, seeds: Any) -> None:
    content = json.loads(LISTED.read_text())
    content["data"]["seeds"] = seeds
    (tmp_path / "card.json").write_text(json.dumps(content))
    with pytest.raises(ModelError, match=r"card\.json is damaged"):
        read_card(tmp_path)
