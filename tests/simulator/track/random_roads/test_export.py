"""A random road as TOML reads back as the same track, and can be edited."""

from pathlib import Path

import numpy as np
import pytest

from simulator.track.catalogue import find_track, read_track
from tests.typed import error_line, typed


@pytest.mark.parametrize("seed", [0, 7, 12, 31])
def test_an_exported_road_reads_back_as_the_same_track(seed: int, tmp_path: Path) -> None:
    out = tmp_path / "mine.toml"
    done = typed("simulator", "tracks", "export", f"random:{seed}", "--out", out)
    assert done.returncode == 0, done.stderr
    assert out.read_text().startswith(f"# random:{seed}: a random road of the kind ")
    track, read = find_track(f"random:{seed}"), read_track(out)
    assert read.content_hash == track.content_hash
    assert np.array_equal(read.arrays(), track.arrays())
    for name in ("look", "surface", "width", "markings"):
        assert getattr(read, name) == getattr(track, name)
    assert (track.name, read.name) == (f"random:{seed}", "mine")


def test_any_number_that_is_changed_changes_the_hash(tmp_path: Path) -> None:
    path = tmp_path / "road.toml"
    typed("simulator", "tracks", "export", "random:7", "--out", path)
    text, hashes = path.read_text(), {find_track("random:7").content_hash}
    for key, number in (("length", "0.002"), ("grade", "0.01"), ("width", "0.1"), ("angle", "0")):
        line = next(line for line in text.splitlines() if line.startswith(f"{key} = "))
        value = round(float(line.split(" = ")[1]) + float(number), 3)
        path.write_text(text.replace(line, f"{key} = {value}", 1))
        hashes.add(read_track(path).content_hash)
    assert len(hashes) == 4  # adding 0 to an angle changes nothing


def test_the_file_is_called_after_the_road(tmp_path: Path) -> None:
    done = typed("simulator", "tracks", "export", "random:5", folder=tmp_path)
    assert done.returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["random-5.toml"]
    assert done.stderr.strip() == "random-5.toml"


@pytest.mark.parametrize("name", ["oval", "random", "random:-1"])
def test_only_random_roads_are_exported(name: str, tmp_path: Path) -> None:
    done = typed("simulator", "tracks", "export", name, folder=tmp_path)
    assert done.returncode == 1
    assert error_line(done).startswith(f"error: {name!r} names no random road; give random:SEED")
    assert not list(tmp_path.iterdir())


def test_the_list_of_tracks_mentions_random_roads() -> None:
    assert "random:SEED" in typed("simulator", "tracks").stderr
