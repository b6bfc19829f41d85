"""`mtlnet export --gate-only`: the gate of an int8 graph on the other kind of processor."""

import itertools
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from mtlnet.export.convert import export_model, write_export
from mtlnet.inference.engine import EXPORT_FILE, INT8, uses_int8
from mtlnet.inference.model_card import GRAPH, GRAPH_WEIGHTS, ModelError, read_card
from trackfeatures.errors import UserError

FILES = (GRAPH, GRAPH_WEIGHTS)


@pytest.fixture
def run(published: Path, tmp_path: Path) -> Path:
    """A model with files in the place of its int8 graph, which passed its gate with native int8."""
    found = tmp_path / "run"
    shutil.copytree(published, found)
    (found / INT8).mkdir(parents=True)
    for name in FILES:
        shutil.copy(found / name, found / INT8)
    write_export(found / INT8, read_card(found), FILES, gate={"passed": True, "native_int8": True})
    return found


def on_processor(monkeypatch: pytest.MonkeyPatch, *, native: bool) -> None:
    monkeypatch.setattr("mtlnet.inference.engine.has_int8", lambda: native)


def test_the_gate_of_the_own_kind_of_processor_decides(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    card = read_card(run)
    for first, other, native, swapped in itertools.product((True, False), repeat=4):
        gates = [{"passed": first, "native_int8": True}, {"passed": other, "native_int8": False}]
        one, two = gates[::-1] if swapped else gates
        write_export(run / INT8, card, FILES, gate=one, other_gate=two)
        on_processor(monkeypatch, native=native)
        assert uses_int8(run, card) is (first if native else other)


@pytest.mark.parametrize("native", [True, False])
def test_the_result_is_stored_beside_that_of_the_other_kind_and_replaces_its_own(
    run: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch, *, native: bool
) -> None:
    on_processor(monkeypatch, native=native)
    before = json.loads((run / INT8 / EXPORT_FILE).read_text())
    for passed in (False, True):
        gate: dict[str, Any] = {"passed": passed, "native_int8": native}
        monkeypatch.setattr("mtlnet.export.convert.judge", lambda *_, gate=gate: gate)
        found = export_model(run, "openvino", "int8", dataset, gate_only=True)
        assert found["gate"] == gate
        key = "gate" if native else "other_gate"
        assert json.loads((run / INT8 / EXPORT_FILE).read_text()) == {**before, key: gate}
        assert uses_int8(run, read_card(run)) is passed


def test_it_needs_an_int8_graph(run: Path, dataset: Path) -> None:
    with pytest.raises(UserError, match="f32 has no accuracy gate"):
        export_model(run, "openvino", "f32", dataset, gate_only=True)
    shutil.rmtree(run / INT8)
    with pytest.raises(ModelError, match="no int8 graph"):
        export_model(run, "openvino", "int8", dataset, gate_only=True)
