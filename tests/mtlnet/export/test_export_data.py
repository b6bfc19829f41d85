"""The dataset on whose frames an export is compared with torch."""

from pathlib import Path

import pytest

from mtlnet.export.convert import export_model
from mtlnet.inference.model_card import resolve_run
from trackfeatures.errors import UserError


@pytest.mark.parametrize("model", ["default", "varied"])
def test_a_model_without_its_dataset_asks_for_data(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=rf"model {model} was trained.* is not here; .*--data DIR"):
        export_model(resolve_run(model), "onnx", "f32", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
