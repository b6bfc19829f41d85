"""The ablation: the paper's rows, figures over seeds, and resuming after an interruption."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mtlnet.ablation.run
from mtlnet.ablation.config import AblationConfig, parse_seeds
from mtlnet.ablation.plan import (
    PAPER_ROWS,
    Run,
    ablation_rows,
    best,
    finish_runs,
    plan_runs,
    require_same_settings,
    table,
    training_curve,
)
from mtlnet.ablation.run import ablate, page, write_result
from mtlnet.inference.curves import COLUMNS as CURVE_COLUMNS
from mtlnet.inference.model_card import CARD, ModelCard, read_card
from mtlnet.training.config import TrainConfig
from mtlnet.training.loop import Stopped
from tests.mtlnet.page import Page
from trackfeatures.errors import UserError

ALPHAS = {row.name: row.alpha for row in PAPER_ROWS}


class FakeTraining:
    """Writes the files of training and evaluation, and records the calls of `train`."""

    def __init__(self, card: ModelCard, stop_at: int = 99) -> None:
        self.card = card
        self.stop_at = stop_at
        self.trained: list[tuple[str, bool]] = []

    def train(self, config: TrainConfig, resumed: dict[str, Any] | None) -> None:
        self.trained.append((config.out.name, resumed is not None))
        if resumed is None:
            config.out.mkdir(parents=True)
            stored = {**vars(config), "data": str(config.data), "out": str(config.out)}
            content = {"definitions": self.card.definitions_version, "config": stored, "data": {}}
            (config.out / "config.json").write_text(json.dumps(content))
        (config.out / "checkpoints").mkdir(exist_ok=True)
        if len(self.trained) == self.stop_at:
            raise Stopped("here")
        points = [
            ",".join(
                str(v) for v in (s, s / 10, 1e-3, 50.0, 10 / s * config.seed, 1 / s, 2, 3, 1, 1, 1)
            )
            for s in range(10, 410, 10)
        ]
        (config.out / "curves.csv").write_text("\n".join([",".join(CURVE_COLUMNS), *points, ""]))
        replace(self.card, name=config.out.name, alpha=config.alpha).write(config.out)

    def evaluate(self, run: Path, config: AblationConfig) -> dict[str, Any]:
        seed = int(run.name[-1])
        marking = dict.fromkeys(("ml", "mr", "l", "m"), 0.1 * seed)
        return {
            "model_hash": read_card(run).model_hash,
            "frames": 24,
            "coded": {
                "distance": 0.01 * seed,
                "angle": 0.02,
                "distance_absolute": 0.1 * seed,
                "angle_absolute": 0.05,
            },
            "mae_m": {**marking, "r": None},
            "to_lane_centre_mae_m": 0.3,
            "angle_mae_rad": 0.004,
            "heading_accuracy": 0.9 if "mtl-2" in run.name else 0.8,
        }


@pytest.fixture
def card(published: Path) -> ModelCard:
    return read_card(published)


def settings(tmp_path: Path, **changes: Any) -> AblationConfig:
    values = {"iterations": 400, "seeds": (1, 3), **changes}
    return AblationConfig(tmp_path / "ablation", data=Path("data"), **values)


def finish_all(config: AblationConfig, fake: FakeTraining) -> list[Run]:
    runs = plan_runs(config, ablation_rows())
    require_same_settings(config, "hash")
    assert list(finish_runs(config, runs, fake.train, fake.evaluate)) == runs
    return runs


def test_the_rows_are_those_of_the_paper() -> None:
    assert [ALPHAS[f"mtl-{n}"] for n in (1, 2, 3, 4)] == [
        (0.1, 0.1, 0.2),
        (0.2, 0.2, 0.6),
        (0.3, 0.2, 0.5),
        (0.5, 0.3, 0.2),
    ]
    assert [list(ALPHAS[n]) for n in ("distance", "angle", "type")] == np.eye(3).tolist()
    assert [row.network for row in ablation_rows()[7:]] == ["deepdriving", "mobilenet_v3_small"]
    assert ablation_rows("regnet_y_400mf")[7].alpha == (1, 1, 0)
    with pytest.raises(UserError, match="mtl is not a backbone"):
        ablation_rows("mtl")
    chosen = ablation_rows(only="mtl-3, distance,deepdriving")
    assert [row.name for row in chosen] == ["distance", "mtl-3", "deepdriving"]
    with pytest.raises(UserError, match="there is no row 'all' in the ablation; choose from dist"):
        ablation_rows(only="all")


def test_figures_have_mean_and_deviation_over_the_seeds(tmp_path: Path, card: ModelCard) -> None:
    runs = finish_all(settings(tmp_path), FakeTraining(card))
    entries = {entry["row"]["name"]: entry for entry in table(ablation_rows(), runs)}
    distance = entries["distance"]["figures"]
    # Seeds 1 and 3: 0.1 and 0.3, sample standard deviation 0.2 / sqrt(2).
    assert distance["distance_absolute"]["mean"] == pytest.approx(0.2)
    assert distance["distance_absolute"]["std"] == pytest.approx(0.2 / 2**0.5)
    assert distance["angle_absolute"] is distance["accuracy"] is distance["angle"] is None
    assert entries["deepdriving"]["figures"]["accuracy"] is None
    assert entries["mtl-1"]["figures"]["mr"]["values"] == pytest.approx([0.1, 0.3])
    assert entries["mtl-1"]["figures"]["r"] is None
    assert best(list(entries.values()), "accuracy") == [*entries].index("mtl-2")
    curve = training_curve(runs, ablation_rows()[0], "distance")
    assert curve is not None
    steps, losses = curve
    assert (steps[0], steps[-1], losses.shape) == (10, 400, (2, 40))
    np.testing.assert_allclose(losses[:, 9], [0.1, 0.3])


def test_an_interrupted_ablation_is_resumed(tmp_path: Path, card: ModelCard) -> None:
    config, fake = settings(tmp_path), FakeTraining(card, stop_at=3)
    runs = plan_runs(config, ablation_rows())
    require_same_settings(config, "hash")
    with pytest.raises(Stopped):
        list(finish_runs(config, runs, fake.train, fake.evaluate))
    assert [run.state for run in runs[:4]] == ["finished", "finished", "stopped", "new"]
    kept = (runs[0].folder / CARD).stat().st_mtime_ns
    again = FakeTraining(card)
    finish_all(config, again)
    assert again.trained[:2] == [("type-seed1", True), ("mtl-1-seed1", False)]
    assert len(again.trained) == len(runs) - 2
    assert (runs[0].folder / CARD).stat().st_mtime_ns == kept
    assert not list(config.out.glob("runs/*/checkpoints"))
    # A seed more: only its runs are trained.
    more = FakeTraining(card)
    finish_all(replace(config, seeds=(1, 3, 2)), more)
    assert [name for name, _ in more.trained] == [f"{row.name}-seed2" for row in ablation_rows()]


def test_other_settings_are_refused(tmp_path: Path) -> None:
    config = settings(tmp_path)
    require_same_settings(config, "hash")
    with pytest.raises(UserError, match="made with iterations 400, now it is 500"):
        require_same_settings(replace(config, iterations=500), "hash")
    with pytest.raises(UserError, match="content_hash hash, now it is other"):
        require_same_settings(config, "other")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("")
    with pytest.raises(UserError, match="holds other files"):
        require_same_settings(replace(config, out=tmp_path / "mine"), "hash")
    for text, seen in (
        ("1,x", "not a list of whole numbers"),
        ("1,1", "different"),
        ("", "not a list of whole numbers"),
    ):
        with pytest.raises(UserError, match=seen):
            settings(tmp_path, seeds=parse_seeds(text))


def test_the_page_shows_the_table_beside_that_of_the_paper(tmp_path: Path, card: ModelCard) -> None:
    config = settings(tmp_path)
    runs = finish_all(config, FakeTraining(card))
    result = write_result(config, ablation_rows(), runs)
    assert json.loads((config.out / "ablation.json").read_text()) == json.loads(json.dumps(result))
    text = (config.out / "ablation.html").read_text()
    found = Page(text)
    rows = found.rows(0)
    assert rows[1][:4] == ["Distance alone", "1, 0, 0", "0.2000 ± 0.1414", "0.06771"]
    ours = ["0.2000 ± 0.1414", "0.05000 ± 0.00000", "80.00 ± 0.00"]
    assert [rows[6][i] for i in (2, 4, 6)] == ours
    assert [rows[6][i] for i in (3, 5, 7)] == ["0.02253", "0.01150", "98.78"]
    assert "Recipe fast trains on Huber losses" in " ".join(text.split())
    paper = page(replace(config, recipe="paper"), result["rows"], ablation_rows(), runs)
    assert "Recipe paper trains on squared errors" in " ".join(paper.split())
    # Four alphas and the line of the single task in each of three charts.
    assert len(found.all("path", "curve")) == 12
    assert len(found.all("path", "level")) == 3
    found.require_self_contained()


def test_an_unfinished_ablation_has_a_page(tmp_path: Path) -> None:
    config = settings(tmp_path)
    require_same_settings(config, "hash")
    result = write_result(config, ablation_rows(), plan_runs(config, ablation_rows()))
    assert [row["seeds"] for row in result["rows"]] == [[]] * 9
    assert "0 of 18 runs" in (config.out / "ablation.html").read_text()


def test_a_dry_run_estimates_the_time_and_writes_nothing(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def seconds(_config: AblationConfig, name: str, *_: object) -> float:
        return 0.5 if name == "mtl" else 1.0

    monkeypatch.setattr(mtlnet.ablation.run, "step_seconds", seconds)
    config = replace(settings(tmp_path), data=dataset)
    result = ablate(config, ablation_rows(), dry_run=True)
    assert result["seconds"] == 2 * 400 * (7 * 0.5 + 2 * 1.0)
    assert not config.out.exists()


def test_steps_are_timed(dataset: Path, tmp_path: Path) -> None:
    from datagen.recording import Dataset

    config = replace(settings(tmp_path), data=dataset, batch=2, threads=1)
    assert 1e-4 < mtlnet.ablation.run.step_seconds(config, "mtl", [], Dataset.open(dataset)) < 600


@pytest.mark.extended
def test_two_rows_are_trained_and_evaluated(dataset: Path, tmp_path: Path) -> None:
    config = replace(settings(tmp_path, iterations=10, seeds=(1,)), data=dataset, batch=2)
    result = ablate(config, [ablation_rows()[0], ablation_rows()[5]])
    single, multi = result["rows"]
    assert single["figures"]["accuracy"] is None
    assert 0 <= multi["figures"]["accuracy"]["mean"] <= 1
    assert multi["frames"] == 5  # every fifth of 24
    text = (config.out / "ablation.html").read_text()
    assert "2 of 2 runs of 10 iterations" in text


@pytest.mark.parametrize(
    ("changes", "seen"),
    [
        ({"batch": 1}, "--batch is 1"),
        ({"iterations": 0}, "--iterations is 0"),
        ({"threads": -1}, "--threads is -1"),
    ],
)
def test_a_refused_option_leaves_no_settings(
    dataset: Path, tmp_path: Path, changes: dict[str, int], seen: str
) -> None:
    """With settings the corrected command would be refused."""
    config = replace(settings(tmp_path, seeds=(1,), **changes), data=dataset)
    with pytest.raises(UserError, match=seen):
        ablate(config, ablation_rows(only="mtl-1"))
    assert not config.out.exists()
    with pytest.raises(UserError, match="tune starts from a finished model; give --recipe fast or"):
        replace(config, recipe="tune")
