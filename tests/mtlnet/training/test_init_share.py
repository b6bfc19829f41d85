"""`--init-share`: the result is a weighted mean of the model before and after the training."""

import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from mtlnet.export.ship import write_page
from mtlnet.inference.model_card import WEIGHTS, ModelError, read_card
from mtlnet.train import start_training
from mtlnet.training.config import TrainConfig
from trackfeatures.errors import UserError

pytestmark = pytest.mark.usefixtures("short_fit", "no_graph")


def _options(dataset: Path, init: Path) -> dict[str, object]:
    return {
        "data": dataset,
        "init": str(init),
        "iterations": 2,
        "batch": 4,
        "device": "cpu",
        "threads": 1,
    }


def test_each_weight_is_the_mean_of_before_and_after(
    published: Path, dataset: Path, tmp_path: Path
) -> None:
    run, options = tmp_path / "run", _options(dataset, published)
    start_training(options, run, resume=False)
    before, after = load_file(published / WEIGHTS), load_file(run / WEIGHTS)
    assert "share" not in read_card(run).data["init"]

    start_training({"init_share": 0.25}, run, resume=True)
    _require_mean(run, before, after, 0.25)
    assert read_card(run).data["init"]["share"] == 0.25
    write_page(run, [])
    assert "counts 0.25, and the trained weight 0.75" in (run / "README.md").read_text()

    start_training({**options, "init_share": 0.25}, tmp_path / "once", resume=False)
    assert read_card(tmp_path / "once").model_hash == read_card(run).model_hash

    start_training({"init_share": 0.0}, run, resume=True)
    _require_mean(run, before, after, 0.0)
    assert "share" not in read_card(run).data["init"]


def _require_mean(
    run: Path, before: dict[str, torch.Tensor], after: dict[str, torch.Tensor], share: float
) -> None:
    mean = load_file(run / WEIGHTS)
    assert any(not torch.equal(before[name], after[name]) for name in after)
    for name, weight in mean.items():
        expected = share * before[name].double() + (1 - share) * after[name].double()
        torch.testing.assert_close(weight.double(), expected, rtol=1e-6, atol=1e-7)


def test_the_model_before_the_training_must_still_be_there(
    published: Path, dataset: Path, tmp_path: Path
) -> None:
    model, run = tmp_path / "model", tmp_path / "run"
    shutil.copytree(published, model)
    start_training(_options(dataset, model), run, resume=False)
    hash_before = read_card(run).model_hash
    shutil.rmtree(model)
    shutil.copytree(run, model)
    with pytest.raises(ModelError, match=r"--init-share, and the model .* is not the one"):
        start_training({"init_share": 0.5}, run, resume=True)
    assert read_card(run).model_hash == hash_before


def test_wrong_shares_are_refused(published: Path, dataset: Path, tmp_path: Path) -> None:
    for share in (-0.1, 1.0, float("nan")):
        with pytest.raises(UserError, match=r"give 0 or more, but less than 1"):
            TrainConfig(dataset, tmp_path, recipe="tune", init="default", init_share=share)
    with pytest.raises(UserError, match="--init-share needs a finished model"):
        TrainConfig(dataset, tmp_path, init_share=0.5)
    options = {**_options(dataset, published), "recipe": "continue", "network": "grid"}
    with pytest.raises(UserError, match="their weights have no mean"):
        start_training({**options, "init_share": 0.5}, tmp_path / "run", resume=False)
