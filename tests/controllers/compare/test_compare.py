"""The comparison: its drives, its file, resumption, tables and page."""

import json
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

import controllers.compare.run as comparison
from controllers import registry
from controllers.compare import inputs
from controllers.compare.cells import Cell, cells
from controllers.compare.config import CompareConfig
from controllers.compare.inputs import fingerprints
from controllers.compare.run import compare
from controllers.laws.actor import SHIPPED, WEIGHTS, load_actor
from runtime.files import locked_folder
from simulator.track.catalogue import OWN_TRACKS, find_track
from simulator.world.errors import ContactsUnavailable
from tests.typed import error_line, typed
from trackfeatures import UserError

SHORT = {"tracks": "oval,town", "controllers": "lqr,torcs", "steps": 60}
LAW = """
class Law:
    def update(self, observation):
        return max(-1.0, min(2 * observation.angle - {gain} * observation.to_lane_centre, 1.0))
"""
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


def short(folder: Path, **changes: Any) -> CompareConfig:
    return CompareConfig(out=folder / "comparison", **{**SHORT, **changes})


class Counter:
    """Stores the cells that are driven; batches have one cell."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stop_after: int | None = None) -> None:
        self.cells: list[Cell] = []
        real = comparison.drive_cells

        def counted(*arguments: Any) -> Iterator[list[tuple[Cell, comparison.Driven]]]:
            for batch in real(*arguments):
                if len(self.cells) == stop_after:
                    raise KeyboardInterrupt
                self.cells += [cell for cell, _ in batch]
                yield batch

        monkeypatch.setattr("controllers.drive.many.CARS", 1)
        monkeypatch.setattr(comparison, "drive_cells", counted)


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


@pytest.mark.parametrize("place", ["{}/changing_law.py", "changing_law"])
def test_a_users_controller_is_driven_again_when_its_file_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    law = tmp_path / "changing_law.py"
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("sys.dont_write_bytecode", True)
    config = short(tmp_path, tracks="oval", controllers=f"{place.format(tmp_path)}:Law")
    counter, scores = Counter(monkeypatch), []
    for gain in (0.2, 0.2, 0.4):
        law.write_text(LAW.format(gain=gain))
        sys.modules.pop("changing_law", None)  # as in a new process
        scores.append(compare(config)["drives"][0]["result"]["score"])
    assert len(counter.cells) == 2
    assert scores[0] == scores[1] != scores[2]


@pytest.mark.parametrize("changed", ["_law", "_base"])
def test_a_controller_that_a_package_imports_is_driven_again_when_its_file_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str
) -> None:
    name = f"imported{changed}"  # a module of this process's own for each parameter
    package = tmp_path / name
    package.mkdir()
    (package / "__init__.py").write_text(f"from {name}._law import Law\n")
    (package / "_base.py").write_text(LAW.format(gain=0.2))
    (package / "_law.py").write_text(
        f"from {name}._base import Law as Base\nclass Law(Base):\n    pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    config = short(tmp_path, tracks="oval", controllers=f"{name}:Law")
    before = fingerprints(config, cells(config))
    with (package / f"{changed}.py").open("a") as file:
        file.write("# changed\n")
    assert fingerprints(config, cells(config)) != before


def test_a_trained_actor_is_driven_again_when_it_was_trained_further(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    actor = tmp_path / "rl"
    shutil.copytree(SHIPPED / "rl", actor)
    config = short(tmp_path, tracks="oval", controllers=str(actor))
    counter = Counter(monkeypatch)
    compare(config)
    compare(config)
    assert len(counter.cells) == 1
    weights = load_actor(actor).weights
    weights["b3"] = weights["b3"] + np.float32(0.1)
    (actor / WEIGHTS).write_bytes(save(weights))
    compare(config)
    assert len(counter.cells) == 2


def test_a_drive_on_a_model_depends_on_its_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = short(
        tmp_path, tracks="oval", controllers="lqr", perceptions="truth,model,http://service"
    )
    codes = []
    for weights in ("one", "other"):
        monkeypatch.setattr(inputs, "model_identity", lambda run, weights=weights: weights)
        monkeypatch.setattr(inputs, "service_identity", lambda url, weights=weights: weights)
        codes.append(list(fingerprints(config, cells(config)).values()))
    assert codes[0][0] == codes[1][0]
    assert len({codes[0][0], codes[0][1], codes[1][1]}) == 3
    assert codes[0][2] != codes[1][2]


def test_a_drive_of_a_shipped_actor_that_has_changed_is_driven_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = short(tmp_path, tracks="oval", controllers="rl,lqr")
    before = [*fingerprints(config, cells(config)).values()]
    shutil.copytree(SHIPPED / "rl-residual", tmp_path / "weights" / "rl")
    monkeypatch.setattr(registry, "SHIPPED", tmp_path / "weights")
    after = [*fingerprints(config, cells(config)).values()]
    assert before[0] != after[0]
    assert before[1] == after[1]


def test_a_drive_on_a_track_that_has_changed_is_driven_again(tmp_path: Path) -> None:
    tracks = tmp_path / "tracks"
    tracks.mkdir()
    codes = set()
    for name in ("oval", "town"):
        shutil.copy(OWN_TRACKS / f"{name}.toml", tracks / "mine.toml")
        config = short(tmp_path, tracks=str(tracks / "mine.toml"), controllers="lqr")
        codes |= {*fingerprints(config, cells(config)).values()}
    assert len(codes) == 2


def test_a_drive_on_another_surface_is_driven_again(tmp_path: Path) -> None:
    codes = set()
    for surface in ("concrete", "gravel"):
        text = (OWN_TRACKS / "oval.toml").read_text()
        changed = re.sub(r'^surface = ".*"$', f'surface = "{surface}"', text, flags=re.M)
        (tmp_path / "mine.toml").write_text(changed)
        config = short(tmp_path, tracks=str(tmp_path / "mine.toml"), controllers="lqr")
        codes |= {*fingerprints(config, cells(config)).values()}
    assert len(codes) == 2


@pytest.mark.parametrize(
    ("pattern", "text"), [("^look = .*$", 'look = "town"'), ("^kerbs = .*$", "kerbs = false")]
)
def test_a_drive_on_images_of_another_look_or_paint_is_driven_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pattern: str, text: str
) -> None:
    monkeypatch.setattr(inputs, "service_identity", lambda url: "same")
    track = tmp_path / "mine.toml"
    perceptions = "truth,model,http://service"
    config = short(tmp_path, tracks=str(track), controllers="lqr", perceptions=perceptions)
    before = (OWN_TRACKS / "circuit.toml").read_text()
    codes = []
    for content in (before, re.sub(pattern, text, before, flags=re.M)):
        track.write_text(content)
        codes.append([*fingerprints(config, cells(config)).values()])
    pairs = zip(*codes, strict=True)
    assert [one == other for one, other in pairs] == [True, False, False]


def test_a_drive_of_changed_control_laws_is_driven_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = short(tmp_path, tracks="oval", controllers="mpc-kalman")
    before = fingerprints(config, cells(config))
    shutil.copytree(registry.LAWS, tmp_path / "laws")
    with (tmp_path / "laws" / "delay.py").open("a") as file:
        file.write("# another delay\n")
    monkeypatch.setattr(registry, "LAWS", tmp_path / "laws")
    assert fingerprints(config, cells(config)) != before


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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("null", "is no file of `controllers tune`"),
        ("5", "is no file of `controllers tune`"),
        ("[]", "is no file of `controllers tune`"),
        ("{}", "has parameters of no controller, but not of lqr, torcs; name"),
        ('{"mpc": {"parameters": {}}}', "has parameters of mpc, but not of lqr, torcs; name"),
    ],
)
def test_a_file_without_parameters_of_the_controllers_is_refused(
    tmp_path: Path, content: str, message: str
) -> None:
    tuned = tmp_path / "t.json"
    tuned.write_text(f'{{"controllers": {content}}}')
    words = ("--controllers", "lqr,torcs", "--parameters", tuned, "--out", tmp_path / "out")
    refused = typed("controllers", "compare", "--tracks", "oval", "--steps", "40", *words)
    assert error_line(refused).startswith(f"error: {tuned} {message}")
    assert not (tmp_path / "out").exists()


def test_parameters_of_one_of_the_controllers_are_enough(tmp_path: Path) -> None:
    tuned = tmp_path / "t.json"
    tuned.write_text('{"controllers": {"lqr": {"parameters": {"offset": 9.0}}}}')
    config = short(tmp_path, tracks="oval", parameters=tuned)
    assert [inputs.parameters_of(config, name) for name in ("lqr", "torcs")] == [{"offset": 9}, {}]
    assert len(compare(config)["drives"]) == 2


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
