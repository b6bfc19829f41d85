"""Which changed inputs of a comparison make its drives again: controllers, models, roads, tuned
parameters."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

import simulator
from controllers import registry
from controllers.compare import inputs
from controllers.compare.cells import cells
from controllers.compare.inputs import fingerprints
from controllers.compare.run import compare
from controllers.laws.actor import SHIPPED, WEIGHTS, load_actor
from simulator.track.catalogue import OWN_TRACKS
from tests.controllers.compare.short_comparisons import Counter, short
from tests.typed import error_line, typed

LAW = """
class Law:
    def update(self, observation):
        return max(-1.0, min(2 * observation.angle - {gain} * observation.to_lane_centre, 1.0))
"""


def test_drives_are_made_again_when_a_file_of_the_simulator_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, original = short(tmp_path, tracks="oval"), simulator.__path__[0]
    codes = []
    for changed in ("", "world/world.py", "camera/shaders/road.glsl", "link/server.py"):
        package = tmp_path / f"copy-{changed.replace('/', '-')}"
        shutil.copytree(original, package)
        if changed:
            with (package / changed).open("a") as file:
                file.write(" ")
        monkeypatch.setattr(simulator, "__path__", [str(package)])
        inputs.simulator_code.cache_clear()
        codes.append([*fingerprints(config, cells(config)).values()])
    monkeypatch.undo()
    inputs.simulator_code.cache_clear()
    same, *others = codes
    assert [found == same for found in others] == [False, False, True]


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
