"""The commands `simulator tracks` and `simulator centreline`, run as subprocesses."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from simulator.track.catalogue import OWN_TRACKS, find_track, list_tracks
from simulator.track.errors import UnknownTrack
from tests.typed import typed
from trackfeatures.errors import UserError

FIXTURES = Path(__file__).parent / "fixtures"


def simulator(*arguments: str) -> subprocess.CompletedProcess[str]:
    return typed("simulator", *arguments)


def test_tracks_json_lists_every_track() -> None:
    done = simulator("tracks", "--tracks-dir", str(FIXTURES), "--json")
    assert done.returncode == 0
    rows = {row["name"]: row for row in json.loads(done.stdout)}
    assert {path.stem for path in OWN_TRACKS.glob("*.toml")} <= set(rows)
    keys = {"name", "source", "length_m", "width_m", "min_radius_m", "z_range_m"}
    assert all(set(row) == keys for row in rows.values())
    ring = rows["version-3"]
    assert ring["source"] == "torcs"
    assert ring["length_m"] == pytest.approx(1237.9205, abs=1e-3)
    assert (ring["width_m"], ring["min_radius_m"]) == (20.0, 100.0)


def test_centreline_writes_the_csv_of_a_track_file(tmp_path: Path) -> None:
    out = tmp_path / "line.csv"
    done = simulator(
        "centreline", str(FIXTURES / "sticky-grade.xml"), "--step", "10", "--out", str(out)
    )
    assert done.returncode == 0
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert table.dtype.names == ("s", "x", "y", "z", "ang", "curv")
    assert table["z"][:11] == pytest.approx(np.arange(11) * 0.5)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("centreline", "mountan-pass", "--out", "x.csv"), "did you mean mountain-pass"),
        (("centreline", "no/such.xml", "--out", "x.csv"), "no/such.xml"),
        (("centreline", "oval", "--out", "/no/such/folder/x.csv"), "/no/such/folder"),
        (("centreline", "oval", "--step", "0", "--out", "x.csv"), "step 0"),
        (("centreline", "oval", "--out", "/dev/full"), "the disk is full"),
        (("centreline", "oval", "--out", "/tmp"), "/tmp is a folder"),
        (
            ("snapshot", "oval", "--out", "/no/such/folder/x.png"),
            "there is no folder /no/such/folder",
        ),
        (("snapshot", "oval", "--out", "x.png", "--light", "noon"), "unknown light 'noon'"),
        (("snapshot", "oval", "--out", "x.png", "--view", "up"), "unknown camera view 'up'"),
        (("snapshot", "oval", "--out", "x.png", "--kind", "depths"), "unknown kind of picture"),
        (("tracks", "--tracks-dir", "/no/such/folder"), "/no/such/folder"),
        (("link", "--camera", "280"), "--camera is '280'"),
        (("link", "--header", "/no/such/folder/x.h"), "/no/such/folder"),
    ],
)
def test_errors_are_one_line(arguments: tuple[str, ...], said: str) -> None:
    done = simulator(*arguments)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1
    assert said in done.stderr
    assert done.stdout == ""


def test_a_name_with_brackets_is_printed_verbatim(tmp_path: Path) -> None:
    folder = tmp_path / "[b]"
    folder.mkdir()
    (folder / "x[red].toml").write_bytes((OWN_TRACKS / "oval.toml").read_bytes())
    done = simulator("tracks", "--tracks-dir", str(folder))
    assert done.returncode == 0, done.stderr
    assert "x[red]" in done.stdout


@pytest.mark.parametrize("option", [("--seed", "-1"), ("--traffic", "-1"), ("--traffic", "500")])
def test_snapshot_options_out_of_range_are_refused(tmp_path: Path, option: tuple[str, str]) -> None:
    done = simulator("snapshot", "oval", "--out", str(tmp_path / "x.png"), *option)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert option[0] in done.stderr
    assert "or equal to" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("no_torcs_install")
def test_torcs_tracks_variable_may_name_the_folder_or_its_parent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "tracks" / "road" / "ring"
    folder.mkdir(parents=True)
    (folder / "ring.xml").write_bytes((FIXTURES / "version-3.xml").read_bytes())
    (tmp_path / "reference.csv").write_text("no track\n")
    for value in (tmp_path, tmp_path / "tracks"):
        monkeypatch.setenv("TORCS_TRACKS", str(value))
        assert find_track("ring").source == "torcs"
        assert "ring" in [track.name for track in list_tracks()]
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("TORCS_TRACKS", str(tmp_path / "nowhere"))
    assert find_track("oval").source == "own"
    assert "TORCS_TRACKS" in capsys.readouterr().err


@pytest.mark.usefixtures("no_torcs_install")
def test_unknown_track_names_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownTrack, match=r"no track 'g-track-3'.*--tracks-dir"):
        find_track("g-track-3", tmp_path)
    with pytest.raises(UserError, match="no folder"):
        find_track("g-track-3", tmp_path / "missing")
