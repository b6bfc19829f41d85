"""The dataset on whose frames an export is compared with torch."""

import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest

import mtlnet.export.convert
from datagen.recording.errors import DatasetError
from datagen.recording.mcap.footer import read_summary
from datagen.recording.splits import Split, split_path, write_split
from mtlnet.export.convert import export_model
from mtlnet.inference.model_card import ModelError, resolve_run
from trackfeatures.errors import UserError


@pytest.mark.parametrize("model", ["default", "varied"])
def test_a_model_without_its_dataset_asks_for_data(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=rf"model {model} was trained.* is not here; .*--data DIR"):
        export_model(resolve_run(model), "onnx", "f32", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_int8_is_not_begun_if_its_gate_cannot_be_evaluated(
    published: Path, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the new graph, without a gate, would replace one that has passed its gate."""
    started = Mock(side_effect=AssertionError("quantised"))
    monkeypatch.setattr(mtlnet.export.convert, "_quantised", started)
    data = tmp_path / "data"
    shutil.copytree(dataset, data)
    write_split(split_path(data), Split(("r001", "r002", "r003"), ("r000",)))
    with pytest.raises(ModelError, match="trained on the round of seed 0, a test round"):
        export_model(published, "openvino", "int8", data, frames=4)
    write_split(split_path(data), Split(("r000", "r001", "r002"), ("r003",)))
    path = data / "rounds" / "r003.mcap"
    content = bytearray(path.read_bytes())
    content[read_summary(memoryview(path.read_bytes())).chunks[-1].start + 20_000] ^= 0x10
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"images in .* cannot be decoded"):
        export_model(published, "openvino", "int8", data, frames=1)
    assert not started.called
