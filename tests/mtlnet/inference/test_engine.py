"""The engines: agreement of OpenVINO and torch, damaged models, model cards, decoded outputs."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference import model_card
from mtlnet.inference.engine import EngineKind, load_engine
from mtlnet.inference.model_card import ModelError, read_card, resolve_run
from mtlnet.inference.prediction import OUTPUTS, decode_outputs
from tests.mtlnet.conftest import draw_road, require_close

IMAGE = np.random.default_rng(3).integers(0, 256, (210, 280, 3), dtype=np.uint8)


@pytest.fixture
def copy(published: Path, tmp_path: Path) -> Path:
    return shutil.copytree(published, tmp_path / "run")


def test_openvino_in_float32_matches_torch(published: Path) -> None:
    expected = load_engine(published, "torch")(IMAGE)
    outputs = load_engine(published, precision="f32")(IMAGE)
    np.testing.assert_allclose(outputs[:OUTPUTS], expected[:OUTPUTS], atol=2e-5)
    np.testing.assert_allclose(outputs[OUTPUTS:], expected[OUTPUTS:], rtol=5e-3)


def test_the_default_engine_is_within_2_cm_and_2_mrad_of_torch(published: Path) -> None:
    engine, reference = load_engine(published), load_engine(published, "torch")
    for offset in (-1.0, 0.0, 1.0):
        image = draw_road(offset, 0.03)
        require_close(engine(image), reference(image), metres=0.02, radians=0.002)


def test_outputs_are_those_of_the_image_and_stay_after_the_next_call(published: Path) -> None:
    engine = load_engine(published, precision="f32")
    first = engine(IMAGE)
    before = first.copy()
    other = engine(255 - IMAGE)
    assert engine(IMAGE).tolist() == first.tolist() == before.tolist() != other.tolist()


def test_images_of_another_size_or_type_are_refused(published: Path) -> None:
    for kind in ("openvino", "torch"):
        engine = load_engine(published, kind)
        others: list[NDArray[Any]] = [IMAGE[:100], IMAGE[..., 0], IMAGE.astype(np.float32)]
        for image in others:
            with pytest.raises(ModelError, match=r"takes uint8 RGB of shape \(210, 280, 3\)"):
                engine(image)


@pytest.mark.parametrize(
    ("kind", "other", "name"),
    [("openvino", "torch", "model.bin"), ("torch", "openvino", "model.safetensors")],
)
def test_damaged_files_are_refused(
    copy: Path, kind: EngineKind, other: EngineKind, name: str
) -> None:
    content = bytearray((copy / name).read_bytes())
    content[-1] ^= 1
    (copy / name).write_bytes(content)
    with pytest.raises(ModelError, match=f"{name} is damaged: its SHA-256"):
        load_engine(copy, kind)
    (copy / name).unlink()
    with pytest.raises(ModelError, match=f"{name} is missing"):
        load_engine(copy, kind)
    load_engine(copy, other)
    (copy / "card.json").write_text("{")
    with pytest.raises(ModelError, match=r"card\.json is damaged"):
        load_engine(copy)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"definitions_version": "0.0-other"}, tf.DefinitionsMismatch, r"0\.0-other"),
        ({"format": 1}, ModelError, "has format 1, this program reads 5 and 6"),
        ({"name": "../x"}, ModelError, "expected a name of letters"),
        ({"files": {"../../x": "0" * 64}}, ModelError, "expected a name of letters"),
    ],
)
def test_a_card_that_cannot_be_used_is_refused(
    copy: Path, changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    content = json.loads((copy / "card.json").read_text())
    (copy / "card.json").write_text(json.dumps({**content, **changes}))
    with pytest.raises(error, match=message):
        load_engine(copy)


def test_resolving_a_runs_name(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(model_card, "SHIPPED", tmp_path / "nothing")
    with pytest.raises(ModelError, match=r"no runs/latest"):
        resolve_run("default")
    with pytest.raises(ModelError, match="there is no run mine"):
        resolve_run("mine")
    Path("runs").mkdir()
    shutil.copytree(published, "runs/mine")
    Path("runs/latest").symlink_to("mine")
    for name in ("default", "latest", "runs/latest"):
        assert resolve_run(name) == tmp_path / "runs" / "mine"
    assert resolve_run("mine") == Path("runs/mine")
    monkeypatch.setattr(model_card, "SHIPPED", tmp_path / "runs" / "mine")
    Path("runs/latest").unlink()
    assert resolve_run("default") == tmp_path / "runs" / "mine"


def test_a_card_is_read_back_as_written(published: Path, tmp_path: Path) -> None:
    card = read_card(published)
    card.write(tmp_path)
    assert read_card(tmp_path) == card
    assert card.model_hash == card.files["model.safetensors"]


def test_decoding_nine_outputs() -> None:
    coded = tf.encode([[-1.0, 3.0, np.nan, -1.0, 3.0]], [0.05])[0]
    prediction = decode_outputs(np.concatenate([coded, [0.7, 0.2, 0.1]]).astype(np.float32))
    assert prediction.distances_m["ml"] == pytest.approx(-1.0, abs=1e-5)
    assert prediction.distances_m["l"] is None
    assert prediction.to_lane_centre_m == pytest.approx(1.0, abs=1e-5)
    assert prediction.angle_rad == pytest.approx(0.05, abs=1e-6)
    assert prediction.heading == pytest.approx({"left": 0.7, "straight": 0.2, "right": 0.1})
    assert list(prediction.as_json()) == [
        "distances_m", "to_lane_centre_m", "angle_rad", "heading",
        "std", "out_of_distribution", "absent",
    ]  # fmt: skip
    assert prediction.std is None
    assert prediction.out_of_distribution is None
    assert prediction.absent is None
    with pytest.raises(ValueError, match="9, 14, 17, 22 numbers"):
        decode_outputs(coded)


def test_decoding_uncertainty() -> None:
    coded = tf.encode([[-1.0, 3.0, np.nan, -1.0, 3.0]], [0.05])[0]
    std = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.01]
    for ood_score, expected in ((0.99, False), (1.01, True), (np.nan, True)):
        outputs = np.concatenate([coded, [0.7, 0.2, 0.1], std, [ood_score]]).astype(np.float32)
        prediction = decode_outputs(outputs)
        assert prediction.out_of_distribution is expected
        assert prediction.std == {
            "ml": pytest.approx(0.1), "mr": pytest.approx(0.2), "l": None, "m": pytest.approx(0.4),
            "r": pytest.approx(0.5), "to_lane_centre": pytest.approx(0.6),
            "angle": pytest.approx(0.01),
        }  # fmt: skip


@pytest.mark.parametrize("uncertainty", [(), (0.1,) * 7 + (1.5,)], ids=["alone", "with-std"])
def test_decoding_probabilities_of_absence(uncertainty: tuple[float, ...]) -> None:
    absent = [0.1, 0.1, 0.99, 0.7, 0.2]
    outputs = np.array([*[0.5] * 6, 0.7, 0.2, 0.1, *uncertainty, *absent], np.float32)
    prediction = decode_outputs(outputs)
    assert prediction.absent == pytest.approx(dict(zip(tf.MARKINGS, absent, strict=True)))
    assert (prediction.std is None) == (not uncertainty)
    assert prediction.out_of_distribution is (True if uncertainty else None)


def test_a_damaged_uncertainty_head_is_refused(copy: Path) -> None:
    (copy / "uncertainty.safetensors").write_bytes(b"rubbish")
    with pytest.raises(ModelError, match=r"uncertainty\.safetensors is damaged"):
        load_engine(copy, "torch")


def test_a_signal_after_an_engine_was_dropped_in_another_thread(published: Path) -> None:
    """OpenVINO gives the thread that loads its CPU plugin a signal stack, and unmaps it with the
    last reference; a later signal ended the process with SIGSEGV."""
    program = (
        "import signal, sys, threading\n"
        "from pathlib import Path\n"
        "from mtlnet.inference.engine import load_engine\n"
        "engines = [load_engine(Path(sys.argv[1]), 'openvino')]\n"
        "thread = threading.Thread(target=engines.clear)\n"
        "thread.start()\n"
        "thread.join()\n"
        "signal.signal(signal.SIGTERM, lambda *_: print('seen'))\n"
        "signal.raise_signal(signal.SIGTERM)\n"
    )
    command = [sys.executable, "-c", program, str(published)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, "seen\n"), ended.stderr


def test_a_processor_without_bf16_states_that_it_computes_in_float32(
    published: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mtlnet.inference.engine.best_precision", lambda: "f32")
    assert load_engine(published, precision="bf16").precision == "f32"
