"""Recovery of damaged rounds: it saves all frames outside the damage, and none inside it."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from datagen.recording import Dataset, DatasetError
from datagen.recording.folder import read_states, round_path, state_path
from datagen.recording.frame import Frame
from datagen.recording.integrity.recover import recover
from datagen.recording.integrity.verify import verify
from datagen.recording.manifest import rebuild
from datagen.recording.mcap.footer import read_summary
from datagen.recording.mcap.index import open_round
from datagen.recording.schema import topics
from datagen.recording.splits import Split
from tests.datagen.commands import datagen_here
from tests.datagen.conftest import Samples

FRAMES = 60


@pytest.fixture(scope="module")
def frames(samples: Samples) -> list[Frame]:
    return samples.frames(FRAMES, seed=3)


@pytest.fixture(scope="module")
def undamaged(
    samples: Samples, frames: list[Frame], tmp_path_factory: pytest.TempPathFactory
) -> bytes:
    """A round of several chunks."""
    path = tmp_path_factory.mktemp("undamaged") / "r007.mcap"
    samples.write(path, samples.header("r007"), frames)
    data = path.read_bytes()
    assert len(read_summary(memoryview(data)).chunks) >= 2
    return data


@pytest.fixture(scope="module")
def ends(undamaged: bytes, tmp_path_factory: pytest.TempPathFactory) -> list[int]:
    """The offset where each frame is complete: the end of its last message (official reader)."""
    path = tmp_path_factory.mktemp("ends") / "r.mcap"
    path.write_bytes(undamaged)
    with path.open("rb") as stream:
        last = [m.data for *_, m in make_reader(stream).iter_messages([topics.TRANSFORMS])]
    return [undamaged.index(payload) + len(payload) for payload in last]


def saved_frames(path: Path) -> list[int]:
    """Frame numbers of a recovered file, by the official reader."""
    with path.open("rb") as stream:
        found: dict[str, list[int]] = {}
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            found.setdefault(channel.topic, []).append(message.sequence)
    labels = found[topics.LABELS]
    assert all(found[topic] == labels for topic in topics.EVERY_STEP)
    assert all(a < b for a, b in pairwise(labels))
    return labels


def test_all_frames_before_a_cut_are_recovered(
    undamaged: bytes, ends: list[int], tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    cuts = [*rng.integers(ends[0], len(undamaged), 190).tolist(), *ends[10:15], ends[20] - 1]
    file, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    for cut in [*cuts, len(undamaged) - 1, len(undamaged) - 9, len(undamaged) - 60, len(undamaged)]:
        file.write_bytes(undamaged[:cut])
        done = recover(file, out)
        expected = sum(end <= cut for end in ends)
        assert (done.saved, saved_frames(out)) == (expected, list(range(expected))), cut
        # The number of frames is stored after the last frame; a cut before it removes the number.
        assert done.lost == 0 or expected < FRAMES
        out.unlink()


def test_garbage_and_zeros_after_a_cut_are_not_taken_for_frames(
    undamaged: bytes, ends: list[int], tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    file, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    for trial in range(40):
        cut = int(rng.integers(ends[0], ends[-1]))
        rest = (len(undamaged) - cut) if trial % 2 else int(rng.integers(1, 4000))
        tail = bytes(rest) if trial % 4 < 2 else rng.bytes(rest)
        file.write_bytes(undamaged[:cut] + tail)
        saved = recover(file, out).saved
        whole = sum(end <= cut for end in ends)
        # A frame that ends where the garbage begins may also be damaged, so it may be dropped.
        assert whole - 1 <= saved <= whole
        assert saved_frames(out) == list(range(saved))
        out.unlink()


def test_a_flipped_bit_loses_only_the_frames_of_its_chunk(
    undamaged: bytes, ends: list[int], tmp_path: Path
) -> None:
    rng = np.random.default_rng(3)
    file, out, whole = (tmp_path / f"{name}.mcap" for name in ("bad", "out", "whole"))
    whole.write_bytes(undamaged)
    original = open_round(whole).messages[topics.CAMERA]
    chunks = [chunk.start for chunk in read_summary(memoryview(undamaged)).chunks]
    begins = [chunks[0], *ends[:-1]]
    for _ in range(60):
        bad = bytearray(undamaged)
        at = int(rng.integers(chunks[0], len(undamaged)))
        hit = max(start for start in chunks if start <= at)
        after = min((start for start in chunks if start > at), default=len(undamaged))
        touched = [b < after and e > hit for b, e in zip(begins, ends, strict=True)]
        bad[at] ^= 1 << int(rng.integers(8))
        file.write_bytes(bad)
        done = recover(file, out)
        kept = saved_frames(out)
        assert done.saved + done.lost == FRAMES
        assert done.lost in (0, sum(touched))
        assert all(number in kept for number in range(FRAMES) if not touched[number])
        images = open_round(out).messages[topics.CAMERA]
        for i, number in enumerate(kept):
            assert images.payload(i) == original.payload(number)
        out.unlink()


def test_frames_that_were_lost_before_an_earlier_recovery_stay_counted(
    samples: Samples, frames: list[Frame], tmp_path: Path
) -> None:
    whole = tmp_path / "whole.mcap"
    samples.write(whole, samples.header("r007"), 3 * frames)
    data, lost = whole.read_bytes(), 0
    for turn, chunk in enumerate((0, -1)):
        bad = bytearray(data)
        bad[read_summary(memoryview(data)).chunks[chunk].start + 1000] ^= 1
        file, out = tmp_path / f"bad{turn}.mcap", tmp_path / f"out{turn}.mcap"
        file.write_bytes(bad)
        done = recover(file, out)
        assert (done.saved + done.lost, done.at_least) == (3 * FRAMES, False)
        assert done.lost > lost
        data, lost = out.read_bytes(), done.lost


def test_a_recovered_round_is_marked_and_can_be_read(
    samples: Samples, undamaged: bytes, frames: list[Frame], ends: list[int], dataset: Path
) -> None:
    path = round_path(dataset, "r007")
    file = dataset.parent / "r007.mcap"
    file.write_bytes(undamaged[: ends[39] + 10])
    done = recover(file, path)
    assert (done.saved, done.lost, done.at_least) == (40, 0, True)
    index = open_round(path)
    assert index.header == samples.header("r007")
    assert str(index.recovery) == "40 frames saved from r007.mcap, at least 0 lost"
    labels = Dataset.open(dataset).select("all").labels
    assert labels.to_middle[-40:].tolist() == [
        np.float32(frame.place.to_middle) for frame in frames[:40]
    ]
    assert state_path(dataset, "r007").is_file()


def test_verify_lists_a_recovered_round_and_splits_must_declare_it(
    undamaged: bytes, ends: list[int], dataset: Path
) -> None:
    file = dataset.parent / "r007.mcap"
    file.write_bytes(undamaged[: ends[39] + 10])
    recover(file, round_path(dataset, "r007"))
    report = verify(dataset, "quick")
    assert report.ok
    assert report.recovered == ("r007: 40 frames saved from r007.mcap, at least 0 lost",)
    assert [info.split for info in Dataset.open(dataset).rounds][-1] == ""
    with pytest.raises(DatasetError, match="r007 was recovered from a damaged file"):
        rebuild(dataset, Split(("r000", "r001", "r007"), ("r002",)))
    problems = verify(dataset, "quick").problems
    assert len(problems) == 1
    assert "r007 was recovered from a damaged file" in problems[0]
    asked = Split(("r000", "r001", "r007"), ("r002",), recovered=("r007",))
    assert rebuild(dataset, asked)["train"]["frames"] == 130
    assert verify(dataset, "deep").ok


def test_the_command_writes_to_the_folder_recovered(dataset: Path) -> None:
    path = round_path(dataset, "r001")
    path.write_bytes(path.read_bytes()[:-30_000])
    done = datagen_here("recover", str(path), "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["out"] == str(dataset / "recovered" / "r001.mcap")
    assert result["saved"] + result["lost"] == 45  # as recorded in the state file
    assert result["at_least"] is False
    assert 0 < result["saved"] == len(saved_frames(Path(result["out"])))
    again = datagen_here("recover", str(path))
    assert (again.returncode, again.stdout) == (1, "")
    assert again.stderr.endswith("exists; nothing was changed; choose another --out\n")
    aside = dataset.parent / "mine.mcap"
    done = datagen_here("recover", str(path), "--out", str(aside))
    assert done.stdout == f"{aside}: {result['saved']} frames saved, {result['lost']} lost\n"


def test_a_round_named_from_within_its_folder_is_recovered_as_a_round_of_the_dataset(
    samples: Samples, dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = round_path(dataset, "r001")
    path.write_bytes(path.read_bytes()[:-30_000])
    monkeypatch.chdir(path.parent)
    done = recover(Path("r001.mcap"))
    assert done.out == str(dataset / "recovered" / "r001.mcap")
    assert (done.saved + done.lost, done.at_least) == (samples.frames_a_round, False)
    path.unlink()
    again = recover(Path(done.out), Path("r001.mcap"))
    assert (again.saved, again.lost, again.at_least) == (done.saved, done.lost, False)
    assert read_states(dataset)["r001"].frames == done.saved


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "its first bytes"),
        (b"neither this nor that", "its first bytes"),
        (slice(300), "its first bytes|its header"),
        (slice(3000), "no intact frame"),
    ],
)
def test_a_file_without_intact_frames_is_refused(
    undamaged: bytes, content: bytes | slice, what: str, tmp_path: Path
) -> None:
    file = tmp_path / "r.mcap"
    file.write_bytes(content if isinstance(content, bytes) else undamaged[content])
    with pytest.raises(DatasetError, match=what):
        recover(file)
    assert [path.name for path in tmp_path.iterdir()] == ["r.mcap"]


def test_a_recovered_round_of_a_dataset_must_keep_its_name(undamaged: bytes, dataset: Path) -> None:
    file = dataset.parent / "r007.mcap"
    file.write_bytes(undamaged)
    with pytest.raises(DatasetError, match=r"expected r007\.mcap"):
        recover(file, round_path(dataset, "r008"))
    with pytest.raises(DatasetError, match=r"r001\.mcap exists"):
        recover(file, round_path(dataset, "r001"))


def test_a_missing_file_gives_a_one_line_error() -> None:
    done = datagen_here("recover", "/no/such/r.mcap")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "/no/such/r.mcap" in done.stderr
