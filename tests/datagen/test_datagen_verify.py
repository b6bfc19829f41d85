"""What verification finds, level by level; whatever it is given, it reports and never raises."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.recording import Dataset
from datagen.recording.checksums import wrong_checksums
from datagen.recording.folder import round_path, state_path
from datagen.recording.splits import Split, split_path, write_split
from datagen.recording.verify import verify
from tests.datagen.conftest import Samples


@pytest.mark.parametrize("level", ["quick", "full", "deep"])
def test_a_good_dataset_is_in_order_at_every_level(dataset: Path, level: str) -> None:
    report = verify(dataset, level)
    assert (report.ok, report.rounds, report.frames, report.problems) == (True, 3, 135, ())


def test_a_flipped_byte_in_an_image_is_found_by_full(dataset: Path) -> None:
    frames = Dataset.open(dataset).select("all")
    path = round_path(dataset, "r001")
    image = bytes(frames.jpeg(45 + 20))
    data = bytearray(path.read_bytes())
    data[data.index(image) + len(image) // 2] ^= 0x10
    path.write_bytes(data)
    assert verify(dataset, "quick").ok
    problems = verify(dataset, "full").problems
    assert all(problem.startswith("r001.mcap: ") for problem in problems)
    for expected in ("sha256 differs", "CRC", "content hash differs"):
        assert any(expected in problem for problem in problems)


def test_a_truncated_file_is_found_by_quick(dataset: Path) -> None:
    path = round_path(dataset, "r002")
    path.write_bytes(path.read_bytes()[:-1000])
    report = verify(dataset, "quick")
    assert not report.ok
    assert len(report.problems) == 1
    assert "its end is missing" in report.problems[0]


@pytest.mark.parametrize("content", [b"", b"not an mcap file at all" * 9, b"\x89MCAP0\r\n" * 9])
def test_a_foreign_file_is_reported(dataset: Path, content: bytes) -> None:
    (dataset / "rounds" / "zz.mcap").write_bytes(content)
    for level in ("quick", "full", "deep"):
        report = verify(dataset, level)
        (problem,) = report.problems
        assert problem.startswith(f"{dataset}/rounds/zz.mcap is damaged or not a recorded round (")
        assert problem.endswith("delete it and run the same `datagen collect` again")
        assert report.frames == 135


@pytest.mark.parametrize("level", ["quick", "full", "deep"])
def test_what_is_no_readable_file_is_reported(dataset: Path, level: str) -> None:
    (dataset / "rounds" / "folder.mcap").mkdir()
    (dataset / "rounds" / "nowhere.mcap").symlink_to("/no/such/file")
    (dataset / "splits" / "folder.json").mkdir()
    report = verify(dataset, level)
    assert (report.rounds, report.frames) == (5, 135)
    assert [p.removeprefix(f"{dataset}/").split()[0] for p in report.problems] == [
        "rounds/folder.mcap",
        "rounds/nowhere.mcap",
        "splits/folder.json",
    ]
    assert "cannot be read (No such file" in report.problems[1]
    assert "cannot be read (Is a directory" in report.problems[2]


def test_a_disk_that_fails_while_it_is_read_is_reported(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*args: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("datagen.recording.check.file_sha256", broken)
    assert verify(dataset, "full").problems[0] == "r000.mcap: cannot be read (Input/output error)"
    monkeypatch.setattr("datagen.recording.folder.RoundState.read", broken)
    assert "state/r000.json cannot be read" in verify(dataset, "quick").problems[0]


def test_missing_rounds_states_and_folders_are_reported(dataset: Path, tmp_path: Path) -> None:
    round_path(dataset, "r000").unlink()
    state_path(dataset, "r001").unlink()
    state_path(dataset, "r002").write_text("{}")
    problems = " / ".join(verify(dataset, "quick").problems)
    assert "r000.mcap is missing" in problems
    assert "r001.mcap: no state file" in problems
    assert "r002.json is no round state" in problems
    assert "holds no recorded rounds" in verify(tmp_path / "nothing", "quick").problems[0]


def test_labels_that_do_not_follow_from_the_offset_are_found_by_deep(
    samples: Samples, dataset: Path
) -> None:
    frames = samples.frames(20, seed=9)
    shifted = [
        replace(f, place=replace(f.place, to_middle=f.place.to_middle + 0.1)) for f in frames
    ]
    samples.write(round_path(dataset, "r000"), samples.header("r000"), shifted)
    assert any("do not follow from the offset" in p for p in verify(dataset, "deep").problems)


def test_a_dropped_distance_is_found_by_deep(samples: Samples, dataset: Path) -> None:
    frames = [
        replace(f, features=replace(f.features, ml=None, mr=None, l=None, m=None, r=None))
        for f in samples.frames(20, seed=9)
    ]
    samples.write(round_path(dataset, "r000"), samples.header("r000"), frames)
    problems = " / ".join(verify(dataset, "deep").problems)
    assert "labels do not follow from the offset" in problems
    assert "lane indices" not in problems


def test_images_of_another_size_are_found_by_deep(samples: Samples, dataset: Path) -> None:
    frames = [replace(f, image=f.image[:20, :20]) for f in samples.frames(3, seed=9)]
    samples.write(round_path(dataset, "r000"), samples.header("r000"), frames)
    problems = verify(dataset, "deep").problems
    assert sum("20x20 px where 56x42" in p for p in problems) == 3


def test_a_leaking_split_and_one_of_other_definitions_are_reported(dataset: Path) -> None:
    write_split(split_path(dataset), Split(("r000", "r001"), ("r001",)))
    path = split_path(dataset, "old")
    path.write_text(json.dumps({"definitions": "0-old", "train": [], "test": []}))
    problems = verify(dataset, "quick").problems
    assert len(problems) == 2
    assert "round r001 on both sides" in problems[0]
    assert "0-old" in problems[1]


def test_random_damage_never_raises_and_is_always_found_without_any_hash_beside_it(
    dataset: Path,
) -> None:
    state_path(dataset, "r000").unlink()  # with its sha256, every damage would be found anyway
    rng = np.random.default_rng(0)
    path = round_path(dataset, "r000")
    good = path.read_bytes()
    for trial in range(60):
        bad = bytearray(good)
        # Half of the trials aim at the index at the end, where a wrong number leads far.
        low = 0 if trial % 2 else len(good) - 4000
        for at in rng.integers(low, len(good), 4):
            bad[at] ^= int(rng.integers(1, 256))
        if trial % 5 == 0:
            del bad[int(rng.integers(len(bad))) :]
        path.write_bytes(bad)
        assert _other_than_state(verify(dataset, "deep").problems)
        assert _other_than_state(verify(dataset, "full").problems)


def test_a_changed_byte_is_found_wherever_it_is(samples: Samples, tmp_path: Path) -> None:
    """The file's own checksums leave no byte out."""
    path = tmp_path / "small.mcap"
    samples.write(path, samples.header(), samples.frames(2, seed=1))
    good = path.read_bytes()
    assert list(wrong_checksums(path)) == []
    edges = [*range(200), *range(len(good) - 3000, len(good) - 8)]  # the end's magic: by open_round
    for at in (*edges, *range(200, len(good) - 3000, 97)):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0x20]) + good[at + 1 :])
        assert list(wrong_checksums(path)), at


def _other_than_state(problems: Iterable[str]) -> list[str]:
    return [problem for problem in problems if "no state file" not in problem]
