"""The comparison: its drives, its file, resumption, tables and page."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import controllers.compare.run as comparison
from controllers.compare.cells import cells
from controllers.compare.config import CompareConfig
from controllers.compare.run import compare
from runtime.files import locked_folder
from simulator.track.catalogue import find_track
from simulator.world.errors import ContactsUnavailable
from tests.controllers.compare.short_comparisons import Counter, short
from tests.typed import typed
from trackfeatures import UserError

BATCH_LAW = """
import numpy as np

class Single:
    def update(self, seen):
        return max(-1.0, min(2 * seen.angle - 0.2 * seen.to_lane_centre, 1.0))

class Batch:
    def update(self, seen):
        raise RuntimeError("not called")
    def update_batch(self, seen):
        return np.clip(2 * seen.angle - 0.2 * seen.to_lane_centre, -1.0, 1.0)

class Broken(Batch):
    calls = 0
    def update_batch(self, seen):
        steers = super().update_batch(seen)
        self.calls += 1
        if self.calls > 30 and len(seen) == 3:
            steers[1] = np.nan
        return steers
"""
BROKEN = (
    "1 of 3 drives have no result.*The first is {}/law.py:Broken on oval, truth, seed 1: "
    "update_batch returned nan for this car in control step 30; it must return"
)


def test_every_controller_drives_every_track_with_every_seed_and_disturbance() -> None:
    found = cells(CompareConfig(tracks="a,b", controllers="lqr,mpc", seeds=2, disturb=True))
    assert len(found) == len(set(found)) == 2 * 2 * 2 * 7
    assert {(cell.track, cell.seed) for cell in found} == {("a", 0), ("a", 1), ("b", 0), ("b", 1)}
    with pytest.raises(UserError, match="0 seeds"):
        cells(CompareConfig(seeds=0))
    with pytest.raises(UserError, match="--tracks names nothing"):
        cells(CompareConfig(tracks=" , "))


def test_an_interrupted_comparison_is_continued_and_drives_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = short(tmp_path)
    with monkeypatch.context() as patch:
        first = Counter(patch, stop_after=3)
        with pytest.raises(KeyboardInterrupt):
            compare(config)
    assert len(first.cells) == 3
    kept = json.loads((config.out / "results.json").read_text())
    assert len(kept["drives"]) == 3
    second = Counter(monkeypatch)
    content = compare(config)
    assert [set(second.cells), len(content["drives"])] == [{*cells(config)} - {*first.cells}, 4]
    assert second.cells[0].controller == "torcs"
    assert all(drive in content["drives"] for drive in kept["drives"])
    compare(config)
    assert len(second.cells) == 1
    # The file keeps all controllers; the returned content has only the requested ones.
    more = compare(replace(config, controllers="lqr-preview"))
    assert [drive["controller"] for drive in more["drives"]] == ["lqr-preview"] * 2
    assert len(json.loads((config.out / "results.json").read_text())["drives"]) == 6


def test_a_refused_comparison_leaves_no_folder(tmp_path: Path) -> None:
    config = short(tmp_path, tracks="oval", start_d=50.0)
    with pytest.raises(UserError, match="50"):
        compare(config)
    assert not config.out.exists()


def test_two_comparisons_do_not_write_to_one_folder(tmp_path: Path) -> None:
    config = short(tmp_path, tracks="oval")
    config.out.mkdir()
    with locked_folder(config.out), pytest.raises(UserError, match="another process is writing to"):
        compare(config)


def test_a_drive_that_ends_early_has_no_better_quadratic_reward(tmp_path: Path) -> None:
    law = tmp_path / "law.py"
    law.write_text("class Law:\n    def update(self, observation):\n        return 1.0\n")
    content = compare(short(tmp_path, tracks="oval", controllers=f"{law}:Law", steps=400))
    drive = content["drives"][0]
    missing = 400 - drive["result"]["steps"]
    assert missing > 100
    # Each missing step counts -2.
    assert drive["result"]["quadratic_per_step"] < -2.0 * missing / 400


def test_the_start_is_torcss_place_on_the_grid(tmp_path: Path) -> None:
    content = compare(short(tmp_path, tracks="oval", controllers="torcs"))
    expected = find_track("oval").width / 6
    assert content["drives"][0]["result"]["max_abs_d_m"] == pytest.approx(expected, abs=0.01)
    assert content["drives"][0]["curves"]["d"][0] == pytest.approx(-expected, abs=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 61}, "made with steps 60, now it is 61"),
        ({"controllers": "pid"}, "no controller 'pid'"),
        ({"tracks": "nowhere"}, "nowhere"),
        ({"controllers": "lqr", "perceptions": "truth,modle"}, "perception 'modle' is unknown"),
        ({"perceptions": "model", "views": 3}, "--views 3: give 1, 2 or 6"),
        ({"perceptions": "http://127.0.0.1:1", "views": 2}, "start the service at .*--views 2"),
    ],
)
def test_other_settings_and_unknown_names_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    config = short(tmp_path, tracks="oval", controllers="torcs")
    compare(config)
    before = (config.out / "results.json").read_bytes()
    with pytest.raises(UserError, match=message):
        compare(replace(config, **changes))
    assert (config.out / "results.json").read_bytes() == before


def test_all_drives_use_the_model_that_is_latest_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "runs" / "one").mkdir(parents=True)
    (tmp_path / "runs" / "latest").symlink_to("one")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(comparison, "fingerprints", lambda config, todo: dict.fromkeys(todo, ""))
    models: list[str] = []

    def no_drives(config: CompareConfig, *rest: Any) -> list[Any]:
        models.append(config.model)
        return []

    monkeypatch.setattr(comparison, "drive_cells", no_drives)
    with pytest.raises(KeyError):
        compare(short(tmp_path, tracks="oval", perceptions="model", model="latest"))
    assert models == [str(tmp_path / "runs" / "one")]


def test_results_from_before_the_option_views_are_continued(tmp_path: Path) -> None:
    config = short(tmp_path, tracks="oval", controllers="torcs")
    compare(config)
    path = config.out / "results.json"
    content = json.loads(path.read_text())
    assert content["settings"].pop("views") == 1
    path.write_text(json.dumps(content))
    compare(config)
    with pytest.raises(UserError, match="views"):
        compare(replace(config, views=2))


@pytest.mark.parametrize("drives", [None, {"drives": [{"track": "oval"}]}, {}])
def test_a_damaged_file_is_refused(tmp_path: Path, drives: dict[str, Any] | None) -> None:
    config = short(tmp_path)
    config.out.mkdir()
    settings = {name: getattr(config, name) for name in comparison.SETTINGS}
    content = {"version": comparison.VERSION, "settings": settings}
    text = "[1, 2" if drives is None else json.dumps(content | drives)
    (config.out / "results.json").write_text(text)
    with pytest.raises(UserError, match="holds no results"):
        compare(config)


def test_the_commands_print_json_and_tables(tmp_path: Path) -> None:
    options = ["--tracks", "oval", "--controllers", "torcs", "--steps", "40", "--out", tmp_path]
    done = typed("controllers", "compare", *options)
    assert done.returncode == 0, done.stderr
    assert "oval (40 steps)" in done.stdout
    content = json.loads(typed("controllers", "compare", *options, "--json").stdout)
    assert content["drives"][0]["result"]["steps"] == 40
    out = tmp_path / "tuned.json"
    options = ["--tracks", "oval", "--controllers", "lqr", "--steps", "40", "--out", out]
    done = typed("controllers", "tune", *options, "--budget", 2)
    assert done.returncode == 0, done.stderr
    assert "lqr: 0." in done.stdout


def test_a_users_controller_is_driven_in_a_batch_with_the_numbers_of_single_drives(
    tmp_path: Path,
) -> None:
    (tmp_path / "law.py").write_text(BATCH_LAW)
    options = {"tracks": "oval,town", "seeds": 2, "disturb": True, "steps": 60}
    found = [
        compare(short(tmp_path, controllers=f"{tmp_path}/law.py:{name}", **options))["drives"]
        for name in ("Single", "Batch")
    ]
    assert len(found[0]) == 2 * 2 * 7
    for one, many in zip(*found, strict=True):
        assert one.pop("controller") != many.pop("controller")
        assert one == many


def test_a_drive_whose_steering_is_no_number_is_named_and_the_others_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda process: {0})  # one batch
    (tmp_path / "law.py").write_text(BATCH_LAW)
    config = short(tmp_path, tracks="oval", controllers=f"{tmp_path}/law.py:Broken", seeds=3)
    with pytest.raises(UserError, match=BROKEN.format(tmp_path)):
        compare(config)
    drives = json.loads((config.out / "results.json").read_text())["drives"]
    whole = compare(replace(config, controllers=f"{tmp_path}/law.py:Batch"))["drives"]
    assert [drive["seed"] for drive in drives] == [0, 2]
    assert [drive["result"] for drive in drives] == [whole[k]["result"] for k in (0, 2)]


@pytest.mark.parametrize("batch", ["", "    def update_batch(self, seen):\n        return {}\n"])
def test_a_contact_without_pybullet_loses_only_its_own_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch: str
) -> None:
    law = "class Left:\n    def update(self, observation):\n        return 0.3\n"
    (tmp_path / "left.py").write_text(law + batch.format("0.3 + 0.0 * seen.angle"))
    crash = f"{tmp_path / 'left.py'}:Left"
    config = short(tmp_path, tracks="oval", controllers=f"{crash},torcs", steps=300)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pybullet", None)
        patch.delitem(sys.modules, "simulator.world.physics", raising=False)
        with pytest.raises(ContactsUnavailable, match=r"1 of 2 drives .*contacts need PyBullet"):
            compare(config)
    kept = json.loads((config.out / "results.json").read_text())["drives"]
    assert [drive["controller"] for drive in kept] == ["torcs"]
