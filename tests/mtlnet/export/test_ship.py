"""A model in half the bytes gives the answers of its run, and is refused when damaged."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.recording import Dataset
from mtlnet.architecture import HEIGHT, WIDTH
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.evaluation.metrics import GROUPS
from mtlnet.export.convert import write_export
from mtlnet.export.int8 import gate
from mtlnet.export.ship import half, ship_model, write_page
from mtlnet.inference.engine import INT8, load_engine
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import (
    CARD,
    GRAPH,
    GRAPH_WEIGHTS,
    UNCERTAINTY_WEIGHTS,
    WEIGHTS,
    ModelError,
    read_card,
)
from mtlnet.model.openvino_graph import TOLERANCE
from serve.scheduling.warmup import warm_up
from tests.mtlnet.conftest import write_dataset
from tests.mtlnet.test_cli import mtlnet, refused
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError


@pytest.fixture(scope="module")
def shipped(published: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("shipped") / "small"
    found = ship_model(published, out)
    assert found["check"]["from_torch"] <= TOLERANCE
    return out


def test_it_is_half_the_bytes_and_all_an_engine_needs(published: Path, shipped: Path) -> None:
    files = {WEIGHTS, GRAPH, GRAPH_WEIGHTS, UNCERTAINTY_WEIGHTS}
    assert {path.name for path in shipped.iterdir()} == {*files, CARD}
    sizes = [(folder / WEIGHTS).stat().st_size for folder in (published, shipped)]
    assert sizes[1] / sizes[0] == pytest.approx(0.5, abs=0.01)
    # The graph holds the same numbers: the network's in float16, those of its head in float32.
    head = (shipped / UNCERTAINTY_WEIGHTS).stat().st_size
    assert (shipped / GRAPH_WEIGHTS).stat().st_size == pytest.approx(sizes[1] + head, rel=0.01)
    card = read_card(shipped)
    assert card.name == "small"
    assert card.model_hash != read_card(published).model_hash
    engine, oracle = (load_engine(shipped, "openvino", "f32"), load_engine(shipped, "torch"))
    assert engine.card == card
    image = np.random.default_rng(0).integers(0, 256, (210, 280, 3), dtype=np.uint8)
    found, expected = engine(image), oracle(image)
    assert found.shape == (17,)
    np.testing.assert_allclose(found[:9], expected[:9], atol=TOLERANCE)
    np.testing.assert_allclose(found[9:], expected[9:], rtol=5e-3)


def test_its_golden_answer_is_its_own(published: Path, shipped: Path, tmp_path: Path) -> None:
    engine = load_engine(shipped, "openvino", "f32")
    answer = engine(golden_image(WIDTH, HEIGHT))[:9]
    np.testing.assert_allclose(answer, engine.card.golden, atol=TOLERANCE)
    assert engine.card.golden != read_card(published).golden
    warm_up(engine)
    changed = tmp_path / "changed"
    shutil.copytree(shipped, changed)
    first, *others = engine.card.golden
    replace(engine.card, golden=(first + 0.01, *others)).write(changed)
    with pytest.raises(ModelError, match=r"differ by 0\.01 from the published ones"):
        warm_up(load_engine(changed, "openvino", "f32"))


def test_it_answers_frames_as_the_run_did(published: Path, shipped: Path, dataset: Path) -> None:
    frame = Dataset.open(dataset).select("test").image(0)
    before, after = (load_engine(run, "openvino", "f32")(frame)[:9] for run in (published, shipped))
    assert 0 < np.abs(after - before).max() < 2e-3


def test_a_folder_with_any_name_holds_a_model(published: Path, tmp_path: Path) -> None:
    out = tmp_path / "my model v2"
    assert ship_model(published, out)["model"] == "my-model-v2"
    assert read_card(out).name == "my-model-v2"


def test_what_cannot_be_shipped(published: Path, shipped: Path) -> None:
    with pytest.raises(UserError, match="already holds a model"):
        ship_model(published, shipped)
    with pytest.raises(ModelError, match="fc0 holds a weight beyond float16"):
        half("fc0", torch.tensor([1.0, 7e4]))


@pytest.fixture(scope="module")
def later(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with nine train rounds that the model was not trained on."""
    return write_dataset(tmp_path_factory.mktemp("later"), 100, train_rounds=9, track="gamma")


def test_its_standard_deviations_are_fitted_anew_on_other_rounds(
    published: Path, shipped: Path, later: Path, tmp_path: Path
) -> None:
    out = tmp_path / "refitted"
    ship_model(published, out, later)
    card, earlier = read_card(out), read_card(shipped)
    assert card.files[WEIGHTS] == earlier.files[WEIGHTS]
    assert card.files[UNCERTAINTY_WEIGHTS] != earlier.files[UNCERTAINTY_WEIGHTS]
    assert card.uncertainty is not None
    assert (card.uncertainty["data"], card.uncertainty["held_out"]["count"]) == (later.name, 8)
    assert card.uncertainty["seeds"] == {"count": 9, "ranges": "100..108"}
    assert earlier.data["seeds"] == {"count": 3, "ranges": "0..2"}
    assert "tracks" not in card.uncertainty
    seen = {
        "seeds": {"count": 12, "ranges": "0..2 100..108"},
        "tracks": [*earlier.data["tracks"], "gamma"],
    }
    assert card.data == {**earlier.data, **seen}
    frame = Dataset.open(later).select("test").image(0)
    found, before = (load_engine(run, "openvino", "f32")(frame) for run in (out, shipped))
    np.testing.assert_allclose(found[9:], load_engine(out, "torch")(frame)[9:], rtol=5e-3)
    assert np.abs(found[9:] / before[9:] - 1).max() > 0.05
    with pytest.raises(
        ModelError, match=r"refitted was trained on the round of seed 100 of .*--seed"
    ):
        ship_model(out, tmp_path / "again", later)


def test_rounds_on_which_no_standard_deviations_are_fitted(
    published: Path, dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="has 3 train rounds; standard deviations are fitted on 8"):
        ship_model(published, tmp_path / "few", dataset)
    (tmp_path / "high").mkdir()
    camera = CameraParameters(z=1.4)
    high = write_dataset(tmp_path / "high", 200, train_rounds=8, camera=camera)
    with pytest.raises(ModelError, match=r"z 1\.4 instead of 0\.95"):
        ship_model(published, tmp_path / "other", high)
    assert not list(tmp_path.glob("*/model.safetensors"))


def test_the_page_of_a_shipped_model_has_the_figures_of_its_evaluations(
    shipped: Path, dataset: Path, tmp_path: Path
) -> None:
    engine = load_engine(shipped, "openvino", "f32")
    found = evaluate([engine], dataset, "test")
    file = tmp_path / "test.json"
    file.write_text(json.dumps(found))
    picture = tmp_path / "sheet.jpg"
    picture.write_bytes(b"a JPEG")
    notes = tmp_path / "notes.md"
    notes.write_text("Trained by hand.\n")
    page = write_page(shipped, [file], notes, picture).read_text()
    assert "![frames with the largest errors](worst.jpg)" in page
    assert (shipped / "worst.jpg").read_bytes() == b"a JPEG"
    for name in ("README.md", "worst.jpg"):
        (shipped / name).unlink()
    assert "Trained by hand." in page
    assert engine.card.model_hash in page
    error = found["errors"]["ml"]
    assert f"| `ml` (m) | {error['mean']:.3f} | {error['median']:.3f} |" in page
    assert f"Correct class of the road: {found['heading_accuracy']:.1%} of the" in page
    light = found["by_light"]["clear"]
    pair = ", ".join(f"{light['errors'][name]['mean']:.3f}" for name in ("ml", "mr"))
    assert f"| light: clear | {light['frames']} | {pair} |" in page
    rows = [line for line in page.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in rows} == {10, 12}, "every row has all its cells"

    assert "Earlier" not in page
    earlier = [{"frames": 250000, "content_hash": "c0ffee"}]
    tracks = ["oval", "random:12", "random:7", "town"]
    data = {**engine.card.data, "tracks": tracks, "earlier": earlier}
    continued = tmp_path / "continued"
    shutil.copytree(shipped, continued)
    replace(engine.card, data=data).write(continued)
    judged = gate(found, {**found, "angle_mae_rad": found["angle_mae_rad"] + 3e-4})
    (continued / INT8).mkdir(parents=True)
    write_export(continued / INT8, engine.card, (), gate=judged)
    page = write_page(continued, [file]).read_text()
    assert "frames of the tracks oval, town and of 2 random roads (content hash" in page
    assert "Earlier it was trained on 250000 other frames (content hash `c0ffee`)." in page
    assert "On a processor without int8 instructions the int8 graph failed its gate" in page
    assert "failed its gate on 24 test frames." in page
    assert "| `ml` (m) | +0.0000 | 0.003 |\n| `mr` (m) |" in page
    assert "| `angle` (rad) | +0.00030 | 0.0002 |\n| wrong class (points) | +0.00 | 0.1 |" in page
    write_export(continued / INT8, replace(engine.card, files={WEIGHTS: "0"}), (), gate=judged)
    assert "int8" not in write_page(continued, [file]).read_text()

    file.write_text(json.dumps({**found, "model_hash": "0" * 64}))
    with pytest.raises(UserError, match="other weights than these"):
        write_page(shipped, [file])
    for content in ("[]", json.dumps({"model_hash": engine.card.model_hash})):
        file.write_text(content)
        with pytest.raises(UserError, match="no result of"):
            write_page(shipped, [file])
    file.write_text(json.dumps({**found, "pictures": {"cases": 3}}))
    with pytest.raises(
        UserError, match=r"test\.json evaluates pictures of your own; the page shows"
    ):
        write_page(shipped, [file])


def test_files_and_options_that_the_page_cannot_use(
    shipped: Path, dataset: Path, tmp_path: Path
) -> None:
    found = evaluate([load_engine(shipped, "openvino", "f32")], dataset, "test", every=8)
    file, notes, model = (tmp_path / name for name in ("test.json", "notes.md", "model"))
    file.write_text(json.dumps(found))
    shutil.copytree(shipped, model)
    own = model / "README.md"
    ship = ("ship", "--out", model)
    judged = (*ship, "--evaluation", file, "--notes", notes)
    notes.write_bytes(b"caf\xe9")
    assert "notes.md is not UTF-8 (" in refused(*judged)
    notes.write_text("caf\u00e9", encoding="utf-8")
    belong = "--notes and --picture belong to --evaluation"
    assert belong in refused(*ship, "--notes", notes)
    assert belong in refused(*ship, "--picture", notes)
    assert "leave --model and --data out" in refused(*judged, "--model", "nothing")
    assert "leave --model and --data out" in refused(*judged, "--data", "nowhere")
    assert not own.exists()
    assert json.loads(mtlnet(*judged, "--json").stdout) == {"page": str(own)}
    before = own.read_bytes()
    assert "caf\u00e9" in before.decode()
    assert "README.md is a file to read" in refused(*judged[:-1], own)
    assert own.read_bytes() == before


def test_the_page_states_the_number_of_views(shipped: Path, dataset: Path, tmp_path: Path) -> None:
    found = evaluate([load_engine(shipped, "openvino", "f32", views=2)], dataset, "test", every=8)
    single, double = tmp_path / "1.json", tmp_path / "2.json"
    double.write_text(json.dumps(found))
    single.write_text(json.dumps({**found, "views": 1}))
    page = write_page(shipped, [single, double]).read_text()
    heading = "## Test rounds: 3 frames of 1 rounds, openvino f32"
    assert [line for line in page.splitlines() if line.startswith("## Test")] == [
        heading,
        f"{heading}, 2 views",
    ]
    assert "The number of views is stated if" in page
    assert "views" not in write_page(shipped, [single]).read_text()
    for part in (found, *(part for name in GROUPS for part in found[name].values())):
        del part["uncertainty"]  # as of a model without standard deviations
    single.write_text(json.dumps(found))
    assert write_page(shipped, [single]).read_text().count("| `ml` (m) |") == 1
    (shipped / "README.md").unlink()


def test_the_card_of_a_shipped_model_names_no_folder(published: Path, shipped: Path) -> None:
    assert read_card(published).data["path"] != read_card(shipped).data["path"]
    assert "/" not in read_card(shipped).data["path"]
