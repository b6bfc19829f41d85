"""Simulating recorded rounds again gives the recorded data."""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from datagen.recorder.record import simulate
from datagen.recorder.replay import differences, replay
from datagen.recording.errors import DatasetError
from datagen.recording.frame import EgoState
from datagen.recording.integrity.recover import IntactFrames, find_intact_frames
from datagen.recording.mcap.footer import read_summary
from datagen.recording.schema import messages
from tests.datagen.commands import datagen_here, make_small_plan, with_recovered
from tests.datagen.conftest import Samples, break_message_index


def test_a_replay_gives_the_same_labels_states_and_pixels(collected: Path) -> None:
    done = datagen_here(
        "verify", collected, "--level", "quick", "--replay", "5", "--pixels", "--json"
    )
    report = json.loads(done.stdout)
    assert (done.returncode, report["problems"]) == (0, [])
    assert report["replayed"] == ["round-000", "round-001"]


def test_a_replay_finds_another_round_under_the_same_name(
    collected: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    folder = shutil.copytree(collected, tmp_path / "data")
    plan = json.loads((folder / "plan.json").read_text())
    plan["rounds"][1]["speed_kmh"] += 0.5
    (folder / "plan.json").write_text(json.dumps(plan))
    names, problems = replay(folder, 2)
    assert names == ["round-000", "round-001"]
    labels, states = sorted(problems, reverse=True)
    assert labels.startswith("round-001.mcap: simulated again, /labels differs from frame ")
    assert states.startswith("round-001.mcap: simulated again, /ego/state differs from frame 0 on")
    (folder / "plan.json").unlink()
    assert "only a dataset with a plan" in refused(
        "verify", folder, "--level", "quick", "--replay", "1"
    )


def test_a_replay_finds_one_changed_bit_of_one_state(
    collected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = messages.ego_state
    asked: list[EgoState] = []

    def twenty_first_is_another(ego: EgoState) -> bytes:
        asked.append(ego)
        data = real(ego)
        return data[:-1] + bytes([data[-1] ^ 1]) if len(asked) == 21 else data

    monkeypatch.setattr(messages, "ego_state", twenty_first_is_another)
    names, (problem,) = replay(collected, 1)
    assert names == ["round-000"]
    assert "/ego/state differs from frame 20 on" in problem


def test_a_replay_compares_the_frames_that_a_recovered_round_still_has(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_the_start(data: bytes, frequency_hz: int) -> IntactFrames:
        found = find_intact_frames(data, frequency_hz)
        return replace(found, steps={n: step for n, step in found.steps.items() if n >= 5})

    monkeypatch.setattr("datagen.recording.integrity.recover.find_intact_frames", without_the_start)
    folder, _ = with_recovered(whole, tmp_path / "data")  # without the end, too
    for name in ("000", "002"):
        (folder / f"rounds/round-{name}.mcap").unlink()
    assert replay(folder, 1, pixels=True) == (["round-001"], [])
    real = messages.labels
    monkeypatch.setattr(messages, "labels", lambda frame: real(frame) + b"\0")
    _, (problem,) = replay(folder, 1)
    assert "/labels differs from frame 5 on" in problem


def test_a_replay_finds_that_a_round_holds_more_frames(
    collected: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_the_end(*arguments: Any) -> Iterator[Any]:
        *batches, last = simulate(*arguments)
        yield from [*batches, last[:-1]]

    monkeypatch.setattr("datagen.recorder.replay.simulate", without_the_end)
    _, problems = replay(collected, 1)
    (frames,) = {int(problem.split("from frame ")[1].split()[0]) for problem in problems}
    assert (len(problems), frames) == (2, 29)


@pytest.mark.parametrize("what", ["index", "message"])
def test_a_damaged_round_is_refused_by_a_replay(
    samples: Samples, tmp_path: Path, what: str
) -> None:
    """With `--level quick` nothing checks it before."""
    path = tmp_path / "r000.mcap"
    samples.write(path, samples.header(), samples.frames(20, seed=1))
    if what == "index":
        break_message_index(path, "/labels")
    else:
        data = bytearray(path.read_bytes())
        data[read_summary(memoryview(bytes(data))).chunks[0].start + 500] ^= 1
        path.write_bytes(data)
    (entry,) = make_small_plan(1, 20).rounds
    with pytest.raises(DatasetError, match=rf"r000\.mcap: .*{what}.*`datagen verify`"):
        list(differences(entry, path, None, pixels=False))


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--pixels"], "give --replay N, too"), (["--replay", "-1"], "--replay is -1")],
)
def test_options_of_a_replay_are_checked(
    collected: Path, refused: Callable[..., str], words: list[str], message: str
) -> None:
    assert message in refused("verify", collected, "--level", "quick", *words)
