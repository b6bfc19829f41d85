"""The plan: deterministic, balanced, and split without leaks."""

import hashlib
import json
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import trackfeatures as tf
from datagen.driving.trajectory import TRAJECTORIES
from datagen.planning.config import CollectConfig, TrackChoice, all_lights
from datagen.planning.plan import RoundPlan
from datagen.planning.planner import CAMERA_JITTER, make_plan
from datagen.planning.tracks import HELD_OUT, choose_tracks
from simulator.track.catalogue import track_files
from trackfeatures import UserError
from trackfeatures.camera import CameraParameters

LIGHTS = all_lights()
NINE = tuple(TrackChoice(f"track-{i}", f"{i}" * 64) for i in range(9))


def wanted(**changes: Any) -> CollectConfig:
    return replace(CollectConfig(tracks=NINE, stretch=0), **changes)


def test_equal_configs_give_equal_plans_and_other_configs_other_plans() -> None:
    plan = make_plan(wanted())
    assert plan == make_plan(wanted())
    others = [
        wanted(seed=1), wanted(rounds=61), wanted(frames=100), wanted(lanes=(1, 2)),
        wanted(codec="png"), wanted(tracks=(*NINE[:-1], TrackChoice("track-8", "f" * 64))),
    ]  # fmt: skip
    hashes = {plan.hash, *(make_plan(other).hash for other in others)}
    assert len(hashes) == 7


def test_a_prefix_leaves_room_for_the_number_of_the_last_round() -> None:
    rounds = make_plan(wanted(prefix="p" * 124, rounds=2)).rounds
    assert rounds[-1].id == "p" * 124 + "-001"
    for prefix, count in (("p" * 125, 2), ("p" * 124, 1001)):
        with pytest.raises(UserError, match=r"last round's name.*'p+'; .*128 characters"):
            wanted(prefix=prefix, rounds=count)


def test_sixty_rounds_cover_everything_evenly() -> None:
    rounds = make_plan(wanted()).rounds
    tracks = Counter(entry.track for entry in rounds)
    assert set(tracks.values()) == {6, 7}
    assert set(Counter(e.lanes for e in rounds).values()) <= {19, 20, 21}
    pairs = Counter((e.track, e.lanes) for e in rounds)
    assert len(pairs) == 27
    assert set(pairs.values()) <= {2, 3}
    assert set(Counter(e.traffic for e in rounds)) == set(range(9))
    for dealt, kinds in (("trajectory", TRAJECTORIES), ("lights", [(kind,) for kind in LIGHTS])):
        counts = Counter(getattr(e, dealt) for e in rounds)
        assert set(counts) == set(kinds)
        assert max(counts.values()) - min(counts.values()) <= 1
    assert 40 <= min(e.speed_kmh for e in rounds) < 41
    assert 74 < max(e.speed_kmh for e in rounds) <= 75
    for track in tracks:
        starts = sorted(e.start for e in rounds if e.track == track)
        assert max(b - a for a, b in pairwise(starts)) < 0.35


@pytest.mark.parametrize("seed", range(4))
def test_a_quarter_is_for_testing_and_every_track_and_lane_count_is_on_both_sides(
    seed: int,
) -> None:
    rounds = make_plan(wanted(seed=seed)).rounds
    sides = {side: [e for e in rounds if e.split == side] for side in ("train", "test")}
    assert len(sides["test"]) == 15
    for side in sides.values():
        assert {e.track for e in side} == {choice.name for choice in NINE}
        assert {e.lanes for e in side} == {1, 2, 3}
        assert {light for e in side for light in e.lights} == set(LIGHTS)
        assert {e.trajectory for e in side} == set(TRAJECTORIES)
    roads = {side: {(e.track, e.lanes) for e in sides[side]} for side in sides}
    assert roads["test"] <= roads["train"]  # each of the 27 roads has two or three rounds
    assert len({e.seed for e in rounds}) == 60
    assert not {e.seed for e in rounds} & {e.seed for e in make_plan(wanted(seed=seed + 1)).rounds}


def test_small_plans_keep_a_round_of_each_track_for_training() -> None:
    twelve = make_plan(wanted(rounds=12, tracks=NINE[:4])).rounds
    train = [e for e in twelve if e.split == "train"]
    assert {e.track for e in train} == {e.track for e in twelve}
    assert {e.track for e in twelve if e.split == "test"} == {e.track for e in twelve}
    assert [e.split for e in make_plan(wanted(rounds=1)).rounds] == ["train"]
    assert sorted(e.split for e in make_plan(wanted(rounds=2)).rounds) == ["test", "train"]
    assert {e.split for e in make_plan(wanted(test_share=0.0)).rounds} == {"train"}


@pytest.mark.parametrize(
    "changes",
    [{"rounds": 0}, {"frames": 0}, {"seed": -1}, {"seed": 10**12 + 1}, {"lanes": (4,)},
     {"lanes": ()}, {"tracks": ()}, {"test_share": 1.0}, {"lights": ("disco",)}, {"codec": "gif"},
     {"split": "seen"}, {"rounds": 600_000}],
)  # fmt: skip
def test_impossible_configs_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(tf.UserError):
        wanted(**changes)


def names_of(*args: Any, **options: Any) -> list[str]:
    return [choice.name for choice in choose_tracks(*args, **options)]


OWN = [
    "circuit", "forest", "gravel-valley", "highway", "mountain-pass", "oval", "ring-road", "town",
]  # fmt: skip


@pytest.mark.usefixtures("no_torcs_install")
def test_without_torcs_the_projects_own_tracks_are_driven() -> None:
    assert names_of((), None) == OWN
    (one,) = choose_tracks(("oval",), None)
    assert one.name == "oval"
    assert len(one.content_hash) == 64


@pytest.mark.usefixtures("no_torcs_install")
def test_all_torcs_tracks_that_are_found_are_driven_except_those_held_out(
    torcs_tracks: Path,
) -> None:
    assert names_of((), torcs_tracks) == sorted([*OWN, "dirt-1", "wheel-1"])
    assert names_of((), torcs_tracks, unseen=True) == ["coast", "countryside", "dirt-3"]


@pytest.mark.usefixtures("no_torcs_install")
def test_tracks_of_the_users_own_are_driven_when_they_are_named(torcs_tracks: Path) -> None:
    mine = torcs_tracks / "mine.toml"
    mine.write_bytes(track_files()["oval"].read_bytes())
    assert "mine" not in names_of((), torcs_tracks)
    assert names_of(("mine",), torcs_tracks) == ["mine"]
    assert names_of(("mine",), torcs_tracks, unseen=True) == ["mine"]


@pytest.fixture
def torcs_tracks(tmp_path: Path) -> Path:
    """The folder of a TORCS installation with three tracks."""
    sample = Path("tests/simulator/track/fixtures/version-3.xml").read_bytes()
    folder = tmp_path / "tracks"
    for name in ("dirt-1", "dirt-3", "wheel-1"):
        file = folder / name.partition("-")[0] / name / f"{name}.xml"
        file.parent.mkdir(parents=True)
        file.write_bytes(sample.replace(b"version-3", name.encode()))
    return folder


def test_jittered_cameras_differ_and_stay_near_the_nominal_camera() -> None:
    plan = make_plan(wanted(jitter_camera=True))
    about = wanted().camera
    for name, half in CAMERA_JITTER.items():
        values = [getattr(entry.camera, name) - getattr(about, name) for entry in plan.rounds]
        assert len({*values}) == 60
        assert max(map(abs, values)) <= half + 1e-4
        assert max(values) > 0.9 * half
        assert min(values) < -0.9 * half
    assert {entry.nominal_camera for entry in plan.rounds} == {about}
    assert {(e.camera.width, e.camera.x, e.camera.y) for e in plan.rounds} == {(280, 0.75, 0.0)}
    assert {entry.camera for entry in make_plan(wanted()).rounds} == {about}


def test_rounds_of_an_unseen_track_share_no_seed_with_those_to_train_on() -> None:
    plan = make_plan(wanted(split="unseen"))
    assert {entry.split for entry in plan.rounds} == {"unseen"}
    usual = {entry.seed for seed in range(3) for entry in make_plan(wanted(seed=seed)).rounds}
    assert not usual & {entry.seed for entry in plan.rounds}


def test_the_held_out_tracks_are_in_no_training_plan() -> None:
    usual = names_of((), None)
    unseen = names_of((), None, unseen=True)
    assert unseen == [name for name in HELD_OUT if name in track_files()]
    assert {"coast", "countryside"} <= set(unseen)
    assert not set(HELD_OUT) & set(usual)
    for name in usual:
        with pytest.raises(tf.UserError, match=f"track {name} is one of those to train on"):
            choose_tracks((name,), None, unseen=True)
    for name in unseen:
        assert names_of((name,), None, unseen=True) == [name]
        assert names_of((name,), None) == [name]  # in a training set by name only


def test_the_plan_hash_depends_on_the_program_version(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = make_plan(wanted())
    before = plan.hash
    monkeypatch.setattr("datagen.planning.plan.program", lambda: "driverview 99")
    assert plan.hash != before


@pytest.mark.parametrize(
    ("jitter", "expected"),
    [
        (False, "ad30b5c19bf71d8922a422f8483efaac163778e46324e917067236352a025861"),
        (True, "12972512819618551191104cb6edc1cca0ca85d0a043f986f14f3e73ec9d9203"),
    ],
)
def test_a_plan_of_the_default_camera_is_stored_as_before_cameras_had_lenses(
    jitter: bool, expected: str
) -> None:
    """Hashes of plans written before cameras had lenses; their datasets must stay resumable."""
    tracks = TrackChoice("oval", "0" * 64), TrackChoice("town", "1" * 64)
    config = CollectConfig(
        rounds=4, frames=300, seed=3, tracks=tracks, stretch=50, jitter_camera=jitter,
        lights=("clear", "rain"),
    )  # fmt: skip
    plan = make_plan(config).as_json()
    content = json.dumps([plan["wanted"], plan["rounds"]], sort_keys=True)
    assert hashlib.sha256(content.encode()).hexdigest() == expected


def test_a_plan_with_a_lens_is_read_back() -> None:
    lens = CameraParameters(
        matrix=(150.0, 150.0, 140.0, 100.0), distortion="opencv", coefficients=(-0.1, 0.0, 0.0, 0.0)
    )
    plan = make_plan(wanted(camera=lens))
    entry = json.loads(json.dumps(plan.as_json()))["rounds"][0]
    assert RoundPlan.from_json(entry) == plan.rounds[0]
    with pytest.raises(UserError, match="--jitter-camera varies the field of view"):
        wanted(camera=lens, jitter_camera=True)
