"""Splits: making them, refusing leaks, and finding near-duplicates across sides."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.cli.maintain import split as split_command
from datagen.recording import Dataset, DatasetError, Labels, RoundInfo
from datagen.recording.folder import prepare, round_path
from datagen.recording.integrity.recover import recover
from datagen.recording.manifest import rebuild
from datagen.recording.near_duplicates import Tolerances, find_near_duplicates
from datagen.recording.split_report import SplitConfig, check_split, make_split
from datagen.recording.splits import Split, read_split, split_path, split_rounds, write_split
from tests.datagen.commands import datagen_here
from tests.datagen.conftest import Samples
from tests.datagen.recording.labels import labels_of
from trackfeatures.errors import UserError


def make_info(number: int, track: str, **changes: object) -> RoundInfo:
    info = RoundInfo(
        id=f"r{number:03d}",
        seed=number,
        track=track,
        lanes=2,
        split="",
        lights=("clear",),
        traffic=0,
        trajectory="weave",
        frames=10,
        speed_kmh=60.0,
        lane_width_m=4.0,
        content_hash=f"c{number}",
        path=Path(f"r{number:03d}.mcap"),
    )
    return replace(info, **changes)  # type: ignore[arg-type]  # the tests name its own fields


SIXTY_ROUNDS = [make_info(n, f"track-{n % 9}") for n in range(60)]


def make_labels(rng: np.random.Generator, count: int, rounds: int) -> Labels:
    """Frames on a short road, so that many are near each other."""
    return labels_of(
        count,
        angle=rng.normal(0.0, 0.05, count).astype(np.float32),
        to_middle=rng.uniform(-2.0, 2.0, count).astype(np.float32),
        s=rng.uniform(0.0, 100.0, count).astype(np.float32),
        light=rng.choice(["clear", "fog"], count),
        round=np.sort(rng.integers(0, rounds, count)),
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_by_round_every_track_is_on_both_sides_in_proportion(seed: int) -> None:
    split = split_rounds(SIXTY_ROUNDS, "round", 0.25, seed)
    assert (len(split.train), len(split.test)) == (45, 15)
    assert sorted(split.train + split.test) == [info.id for info in SIXTY_ROUNDS]
    track_of = {info.id: info.track for info in SIXTY_ROUNDS}
    tested = Counter(track_of[i] for i in split.test)
    assert set(tested) == {info.track for info in SIXTY_ROUNDS}
    assert max(tested.values()) <= 2
    assert split == split_rounds(SIXTY_ROUNDS, "round", 0.25, seed)
    assert split != split_rounds(SIXTY_ROUNDS, "round", 0.25, seed + 10)


def test_by_track_each_track_is_on_one_side_only() -> None:
    split = split_rounds(SIXTY_ROUNDS, "track", 0.34, 0)
    track_of = {info.id: info.track for info in SIXTY_ROUNDS}
    train, test = ({track_of[i] for i in side} for side in (split.train, split.test))
    assert not train & test
    assert (len(train), len(test)) == (6, 3)


def test_rounds_that_share_a_seed_or_content_stay_together() -> None:
    rounds = [make_info(n, "oval") for n in range(12)]
    rounds[7] = replace(rounds[7], seed=rounds[2].seed)
    rounds[9] = replace(rounds[9], content_hash=rounds[7].content_hash)
    for seed in range(20):
        split = split_rounds(rounds, "round", 0.3, seed)
        assert len({split.side(f"r{n:03d}") for n in (2, 7, 9)}) == 1
        assert 1 <= len(split.test) <= 6


@pytest.mark.parametrize(
    ("rounds", "by", "share", "what"),
    [
        (SIXTY_ROUNDS, "frame", 0.25, "cannot be divided by 'frame'; choose round or track"),
        (SIXTY_ROUNDS, "round", 0.0, "--test-share is 0; give a number"),
        (SIXTY_ROUNDS, "round", 1.5, "--test-share is 1.5; give a number"),
        (SIXTY_ROUNDS[:1], "round", 0.25, "1 rounds that share no seed or content are too few"),
        ([make_info(n, "oval") for n in range(9)], "track", 0.25, "1 tracks that share no seed"),
    ],
)
def test_impossible_splits_are_refused(
    rounds: list[RoundInfo], by: str, share: float, what: str
) -> None:
    with pytest.raises(DatasetError, match=what):
        split_rounds(rounds, by, share, 0)


@pytest.mark.parametrize("tolerances", [Tolerances(), Tolerances(3.0, 0.5, 2.0)])
def test_near_duplicates_equal_those_of_comparing_all_pairs(tolerances: Tolerances) -> None:
    rng = np.random.default_rng(0)
    rounds = [make_info(n, f"track-{n % 2}") for n in range(6)]
    labels = make_labels(rng, 1500, 6)
    test = labels.round % 3 == 0
    found = find_near_duplicates(labels, rounds, test, ~test, tolerances)
    tracks = np.array([info.track for info in rounds])[labels.round]
    scene = np.strings.add(tracks, labels.light)
    scale = (tolerances.s_m, tolerances.to_middle_m, np.radians(tolerances.angle_deg))
    place = np.stack([labels.s, labels.to_middle, labels.angle], axis=1) / np.array(scale)
    apart = np.abs(place[test][:, None] - place[~test][None]).max(axis=-1)
    apart[scene[test][:, None] != scene[~test][None]] = np.inf
    nearest = apart.min(axis=1)
    assert 0 < found.near == int((nearest <= 1).sum()) < found.frames == int(test.sum())
    worst = [pair.distance for pair in found.worst]
    assert worst == pytest.approx(np.sort(nearest)[: len(worst)], abs=1e-3)
    pair = found.worst[0]
    starts = np.searchsorted(labels.round, np.arange(6))
    one = starts[int(pair.round[1:])] + pair.frame
    other = starts[int(pair.other_round[1:])] + pair.other_frame
    assert np.abs(place[one] - place[other]).max() == pytest.approx(pair.distance, abs=1e-3)
    assert scene[one] == scene[other]


def test_an_empty_side_has_no_near_duplicates() -> None:
    labels = make_labels(np.random.default_rng(0), 50, 1)
    none = np.zeros(50, np.bool_)
    found = find_near_duplicates(labels, [make_info(0, "oval")], ~none, none, Tolerances())
    assert (found.frames, found.near, found.worst) == (50, 0, ())


def test_the_command_reports_equal_frames_on_both_sides(samples: Samples, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    prepare(folder)
    samples.add_round(folder, samples.header("r000"))
    samples.write(round_path(folder, "r001"), samples.header("r001"), samples.frames(40, 0)[:30])
    rebuild(folder, Split(("r000",), ("r001",)))
    done = datagen_here("split", str(folder), "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["made"] is False
    assert report["frames"] == {"train": 45, "test": 30}
    found = report["near_duplicates"]["test"]
    assert (found["frames"], found["near"], found["share"]) == (30, 30, 1.0)
    assert {pair["distance"] for pair in found["worst"]} == {0.0}
    text = datagen_here("split", str(folder)).stdout
    assert "test   1 rounds, 30 frames; 30 (100.0%) near-duplicates of train" in text
    assert "r001 frame 0 and r000 frame 0: a-track, 7.0 m, 0.00 of the tolerances apart" in text


def test_the_command_never_overwrites_a_split(dataset: Path) -> None:
    made = datagen_here(
        "split", str(dataset), "--name", "mine", "--by", "round", "--test-share", "0.4",
        "--seed", "2", "--near", "1,1,5", "--json",
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    report = json.loads(made.stdout)
    assert (report["made"], report["rounds"]) == (True, {"train": 2, "test": 1})
    split = read_split(split_path(dataset, "mine"))
    assert len(Dataset.open(dataset, "mine").select("test")) == 45 * len(split.test)
    again = datagen_here("split", str(dataset), "--name", "mine", "--by", "round")
    assert (again.returncode, again.stdout) == (1, "")
    assert "mine.json exists and stays as it is; choose another --name" in again.stderr
    assert read_split(split_path(dataset, "mine")) == split


def test_unseen_rounds_stay_unseen_in_a_new_split(samples: Samples, dataset: Path) -> None:
    samples.add_round(dataset, samples.header("r003"))
    write_split(split_path(dataset), Split(("r000", "r001"), ("r002",), unseen=("r003",)))
    make_split(dataset, "mine", SplitConfig("round", 0.4, 0, False))
    split = read_split(split_path(dataset, "mine"))
    assert split.unseen == ("r003",)
    assert sorted(split.train + split.test) == ["r000", "r001", "r002"]
    report = check_split(dataset, "mine", Tolerances(), made=True)
    assert (report.rounds["unseen"], report.near["unseen"].frames) == (1, 45)
    samples.add_round(dataset, samples.header("r004", seed=3), content_seed=9)
    with pytest.raises(DatasetError, match=r"seed 3 on both sides, (train|test) and unseen"):
        make_split(dataset, "leak", SplitConfig("round", 0.4, 0, False))
    assert not split_path(dataset, "leak").exists()


def test_unseen_rounds_stay_unseen_without_a_default_split(
    samples: Samples, tmp_path: Path, refused: Callable[..., str]
) -> None:
    folder = tmp_path / "data"
    prepare(folder)
    for n in range(6):
        samples.add_round(folder, samples.header(f"r{n:03d}"))
    entries = [{"id": f"r{n:03d}", "split": "unseen" if n > 3 else "train"} for n in range(6)]
    plan = folder / "plan.json"
    plan.write_text(json.dumps({"rounds": entries}))
    make_split(folder, "default", SplitConfig("round", 0.25, 0, with_recovered=False))
    split = read_split(split_path(folder))
    assert (split.unseen, len(split.train), len(split.test)) == (("r004", "r005"), 3, 1)
    split_path(folder).unlink()
    plan.write_text("{}")
    assert f"{plan} cannot be read" in refused("split", folder, "--by", "round")
    assert not split_path(folder).exists()


def damage_and_recover(path: Path) -> None:
    damaged = path.parents[2] / path.name
    path.rename(damaged)
    damaged.write_bytes(damaged.read_bytes()[:-20_000])
    recover(damaged, path)


def test_the_advice_for_a_recovered_round_can_be_followed(
    dataset: Path, refused: Callable[..., str]
) -> None:
    """Tests of `datagen collect` and `datagen merge` run them on a recovered round."""
    damage_and_recover(round_path(dataset, "r001"))
    advice = refused("info", dataset)
    assert "run the command that made the dataset (such as `datagen collect`" in advice
    path = split_path(dataset)
    assert f'or add "r001" to the list "recovered" in {path}' in advice
    path.write_text(json.dumps({**json.loads(path.read_text()), "recovered": ["r001"]}))
    assert datagen_here("info", dataset).returncode == 0


def test_a_new_split_has_recovered_rounds_only_on_request(dataset: Path) -> None:
    damage_and_recover(round_path(dataset, "r001"))
    arguments = ("split", str(dataset), "--by", "round", "--test-share", "0.5", "--name")
    assert datagen_here(*arguments, "without").returncode == 0
    assert read_split(split_path(dataset, "without")).side("r001") == ""
    assert datagen_here(*arguments, "with", "--with-recovered").returncode == 0
    split = read_split(split_path(dataset, "with"))
    assert split.side("r001") in ("train", "test")
    assert split.recovered == ("r001",)


def test_the_command_refuses_a_leak_with_a_one_line_error(dataset: Path) -> None:
    write_split(split_path(dataset, "leak"), Split(("r000", "r001"), ("r001", "r002")))
    done = datagen_here("split", str(dataset), "--name", "leak")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert "round r001 on both sides" in done.stderr


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"name": "nothing"}, "there is no split at"),
        ({"near": "1,2"}, "--near is '1,2'; give three numbers"),
        ({"near": "1,0,2"}, "give numbers above 0"),
        ({"by": "round", "name": "x", "seed": -1}, "--seed is -1; give 0 or more"),
        ({"test_share": 0.25}, "--test-share, --seed and --with-recovered belong to --by"),
        ({"seed": 0}, "belong to --by"),
        ({"with_recovered": True}, "belong to --by"),
    ],
)
def test_bad_options_are_refused(dataset: Path, options: dict[str, Any], what: str) -> None:
    with pytest.raises(UserError, match=what):
        split_command(dataset, **options)
