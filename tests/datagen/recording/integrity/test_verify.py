"""Verification at each level: faults that it finds; it reports bad files and never raises."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from datagen.recording import Dataset, DatasetError
from datagen.recording.folder import round_path, state_path
from datagen.recording.integrity.verify import verify
from datagen.recording.manifest import rebuild
from datagen.recording.mcap.scan import scan
from datagen.recording.round_metadata import RoundHeader
from datagen.recording.schema import topics
from datagen.recording.splits import Split, split_path, write_split
from tests.datagen.commands import datagen_here
from tests.datagen.conftest import Samples


@pytest.mark.parametrize("level", ["quick", "full", "deep"])
def test_a_good_dataset_has_no_problems_at_any_level(dataset: Path, level: str) -> None:
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
def test_a_file_that_is_not_mcap_is_reported(dataset: Path, content: bytes) -> None:
    (dataset / "rounds" / "zz.mcap").write_bytes(content)
    for level in ("quick", "full", "deep"):
        report = verify(dataset, level)
        (problem,) = report.problems
        assert problem.startswith(f"{dataset}/rounds/zz.mcap is damaged or not a recorded round (")
        assert "delete it and run the command that made the dataset (such as `datagen" in problem
        assert report.frames == 135


@pytest.mark.parametrize("level", ["quick", "full", "deep"])
def test_folders_and_broken_links_in_place_of_files_are_reported(dataset: Path, level: str) -> None:
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


def test_a_read_error_of_the_disk_is_reported(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*args: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("datagen.recording.integrity.round_checks.scan", broken)
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


def test_images_of_another_size_are_found_by_deep(samples: Samples, dataset: Path) -> None:
    frames = [replace(f, image=f.image[:20, :20]) for f in samples.frames(3, seed=9)]
    samples.write(round_path(dataset, "r000"), samples.header("r000"), frames)
    problems = verify(dataset, "deep").problems
    assert sum("20x20 px, expected 56x42 px" in p for p in problems) == 3


def test_a_leaking_split_and_one_of_other_definitions_are_reported(dataset: Path) -> None:
    write_split(split_path(dataset), Split(("r000", "r001"), ("r001",)))
    path = split_path(dataset, "old")
    path.write_text(json.dumps({"definitions": "0-old", "train": [], "test": []}))
    problems = verify(dataset, "quick").problems
    assert len(problems) == 2
    assert "round r001 on both sides" in problems[0]
    assert "0-old" in problems[1]


def test_random_damage_never_raises_and_is_found_without_state_files(
    dataset: Path,
) -> None:
    state_path(dataset, "r000").unlink()  # its sha256 would reveal any damage
    rng = np.random.default_rng(0)
    path = round_path(dataset, "r000")
    good = path.read_bytes()
    for trial in range(60):
        bad = bytearray(good)
        # Half of the trials damage the index at the end, where a wrong number has large effects.
        low = 0 if trial % 2 else len(good) - 4000
        for at in rng.integers(low, len(good), 4):
            bad[at] ^= int(rng.integers(1, 256))
        if trial % 5 == 0:
            del bad[int(rng.integers(len(bad))) :]
        path.write_bytes(bad)
        assert _other_than_state(verify(dataset, "deep").problems)
        assert _other_than_state(verify(dataset, "full").problems)


def test_scan_finds_any_changed_byte(samples: Samples, tmp_path: Path) -> None:
    """The checksums in the file cover every byte."""
    path = tmp_path / "small.mcap"
    samples.write(path, samples.header(), samples.frames(2, seed=1))
    good = path.read_bytes()
    assert scan(path, lambda *_: None).problems == []
    edges = [*range(0, 200, 3), *range(len(good) - 3000, len(good) - 8, 7)]  # the magic: open_round
    for at in (*edges, *range(200, len(good) - 3000, 97)):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0x20]) + good[at + 1 :])
        assert scan(path, lambda *_: None).problems, at


@pytest.mark.parametrize("where", ["rounds", "state", "splits", "proto", "manifest.json"])
def test_verify_finds_any_flipped_bit(dataset: Path, where: str) -> None:
    rng = np.random.default_rng(5)
    files = sorted(p for p in dataset.rglob("*") if p.is_file())
    files = [p for p in files if p.relative_to(dataset).parts[0] == where]
    for _ in range(40):
        path = files[int(rng.integers(len(files)))]
        good = path.read_bytes()
        bad = bytearray(good)
        at, bit = int(rng.integers(len(bad))), int(rng.integers(8))
        bad[at] ^= 1 << bit
        path.write_bytes(bad)
        report = verify(dataset, "full")
        assert not report.ok, f"bit {bit} of byte {at} of {path.name}"
        path.write_bytes(good)
    assert verify(dataset, "full").ok


def test_swapped_files_are_reported(dataset: Path) -> None:
    one, other, aside = (round_path(dataset, name) for name in ("r000", "r001", "aside"))
    one.rename(aside)
    other.rename(one)
    aside.rename(other)
    for level in ("quick", "full"):
        problems = " / ".join(verify(dataset, level).problems)
        assert "r000.mcap: its id is r001, its state file says r000" in problems
        assert "r001.mcap holds round r000: files were swapped, copied or renamed" in problems


def test_a_copied_round_is_reported(dataset: Path) -> None:
    round_path(dataset, "r009").write_bytes(round_path(dataset, "r001").read_bytes())
    problems = " / ".join(verify(dataset, "quick").problems)
    assert "r009.mcap: no state file holds its hashes" in problems
    assert "r009.mcap holds round r001" in problems
    assert "r009.mcap has the same images and labels as r001.mcap" in problems


@pytest.mark.parametrize("name", ["rounds/r000.mcap", "state/r000.json"])
def test_a_copy_with_a_space_in_its_name_is_reported(dataset: Path, name: str) -> None:
    copy = (dataset / name).with_stem("r000 (1)")
    copy.write_bytes((dataset / name).read_bytes())
    round_path(dataset, "r001").write_bytes(b"bad")
    problems = " / ".join(verify(dataset, "quick").problems)
    assert "r001.mcap is damaged" in problems
    if name.startswith("rounds"):
        round_path(dataset, "r001").unlink()
        with pytest.raises(DatasetError, match=r"r000\.mcap.* both hold round r000; keep one"):
            Dataset.open(dataset)
        assert "r000 (1).mcap holds round r000: files were swapped, copied" in problems
    else:
        assert "r000 (1).mcap is missing: state/r000 (1).json lists it" in problems


def test_an_mcap_file_that_is_no_round_is_reported_as_such(dataset: Path) -> None:
    path = dataset / "rounds" / "drive.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("pose", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped
    (dataset / "rounds" / "notes.txt").write_text("remember the milk")
    for level in ("quick", "full", "deep"):
        found = verify(dataset, level).problems
        assert found == (
            f"{path} is an MCAP file but no round of driverview (it has no metadata "
            "driverview.round); move it elsewhere",
            f"{dataset}/rounds/notes.txt is no round (expected *.mcap); move it elsewhere",
        )


def test_a_round_of_other_definitions_is_reported(samples: Samples, dataset: Path) -> None:
    samples.add_round(dataset, samples.header("r003", definitions="0-old"))
    (problem,) = verify(dataset, "full").problems
    assert problem.startswith("r003.mcap: recorded under definitions 0-old, this program has ")


@pytest.mark.parametrize("change", [{"camera": None}, {"weather": '"mild"'}], ids=["less", "more"])
def test_a_round_with_the_header_of_another_version_is_reported(
    samples: Samples, dataset: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, str | None]
) -> None:
    ours = RoundHeader.to_metadata

    def theirs(header: RoundHeader) -> dict[str, str]:
        values = {**ours(header), "program": '"driverview 0.0.9"', **change}
        return {name: value for name, value in values.items() if value is not None}

    path = round_path(dataset, "r001")
    with monkeypatch.context() as patched:
        patched.setattr(RoundHeader, "to_metadata", theirs)
        samples.write(path, samples.header("r001"), samples.frames(5, seed=1))
    (problem,) = verify(dataset, "quick").problems
    assert problem.startswith(f"{path} was written by another version of this program (")
    assert "driverview 0.0.9" in problem


def test_splits_with_missing_or_repeated_rounds_are_reported(dataset: Path) -> None:
    write_split(split_path(dataset), Split(("r000", "r001", "r000"), ("r002", "r007")))
    problems = verify(dataset, "quick").problems
    assert [p.removeprefix(str(split_path(dataset))) for p in problems] == [
        " names round r000 twice",
        " names round r007, which does not exist",
    ]


def test_a_missing_manifest_and_changed_files_are_found_by_full(dataset: Path) -> None:
    proto = dataset / "proto" / "driverview.proto"
    proto.write_text(proto.read_text() + "// changed\n")
    (problem,) = verify(dataset, "full").problems
    assert problem.startswith(f"proto/driverview.proto in {dataset}: other content than manifest")
    (dataset / "manifest.json").unlink()
    assert "there is no" in verify(dataset, "full").problems[0]
    assert verify(dataset, "quick").ok


def test_a_changed_split_is_found_with_the_command_that_mends_it(dataset: Path) -> None:
    write_split(split_path(dataset), Split(("r001", "r002"), ("r000",)))
    (problem,) = verify(dataset, "full").problems
    assert "run the command that made the dataset (such as `datagen collect`" in problem
    rebuild(dataset, Split(("r001", "r002"), ("r000",)))  # as that command does
    assert verify(dataset, "full").ok


def test_a_gap_in_log_times_is_found(
    samples: Samples, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def jumping(step: int, frequency_hz: int) -> int:
        return topics.EPOCH_NS + (step + 3 * (step > 20)) * topics.NANOSECONDS // frequency_hz

    with monkeypatch.context() as patched:
        patched.setattr("datagen.recording.schema.topics.log_time_ns", jumping)
        samples.add_round(dataset, samples.header("r003"))
    problems = verify(dataset, "full").problems
    assert "r003.mcap: frame 21 on /labels is at 1.200 s, expected at 1.050 s" in problems
    assert verify(dataset, "quick").ok


def test_the_datasets_hash_is_in_the_report(dataset: Path) -> None:
    report = verify(dataset, "quick")
    assert report.content_hash == Dataset.open(dataset).content_hash
    round_path(dataset, "r001").write_bytes(b"")
    assert verify(dataset, "quick").content_hash is None


def _other_than_state(problems: Iterable[str]) -> list[str]:
    return [problem for problem in problems if "no state file" not in problem]


def test_tracks_are_refused_without_replay(dataset: Path) -> None:
    done = datagen_here("verify", dataset, "--tracks-dir", dataset)
    assert (done.returncode, done.stdout) == (1, "")
    assert "--tracks-dir has the tracks of --replay; give --replay N, too" in done.stderr
