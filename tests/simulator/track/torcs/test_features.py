"""Single features of the TORCS format, in a stadium with known dimensions:
100 m straights and bends of 50 m radius, `linear` profiles, 10 m wide."""

import math
from pathlib import Path

import pytest

from simulator.track.catalogue import find_track, list_tracks
from simulator.track.errors import TrackError
from simulator.track.geometry import Track
from simulator.track.toml_track import LOOKS
from simulator.track.torcs.appearance import WITHOUT_KERBS
from simulator.track.torcs.torcs import read_torcs

STADIUM = (Path(__file__).parents[1] / "fixtures" / "sticky-grade.xml").read_text()
BEND = 50.0 * math.pi
UP = '<attnum name="grade" val="5" unit="%"/>'
LINEAR = '<attstr name="profil" val="linear"/>'


def read(folder: Path, *changes: tuple[str, str], encoding: str = "utf-8") -> Track:
    """The stadium with each first occurrence of `old` replaced by `new`."""
    text = STADIUM
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "changed.xml"
    path.write_text(text, encoding=encoding)
    return read_torcs(path)


def z(track: Track, s: float, y: float = 0.0) -> float:
    return float(track.at(s, y).z)


def test_the_first_of_a_repeated_attribute_counts(tmp_path: Path) -> None:
    """As in ruudskogen, whose 3D model has the heights of the first attribute."""
    track = read(tmp_path, (UP, UP + '<attnum name="grade" val="-9" unit="%"/>'))
    assert z(track, 100.0) == pytest.approx(5.0)


def test_tangents_may_be_given_by_edge(tmp_path: Path) -> None:
    slopes = "".join(
        f'<attnum name="profil {end} tangent {edge}" val="{value}" unit="%"/>'
        for end, edge, value in (
            ("start", "left", 4), ("start", "right", -4), ("end", "left", 0), ("end", "right", 0)
        )
    )  # fmt: skip
    steps = '<attnum name="profil steps" val="2"/>'
    track = read(tmp_path, (UP + "\n        " + LINEAR, slopes + steps))
    # Half-way along a cubic with level ends a start slope t lifts by t L / 8.
    assert z(track, 50.0, 5.0) == pytest.approx(0.04 * 100.0 / 8)
    assert z(track, 50.0, -5.0) == pytest.approx(-0.04 * 100.0 / 8)


def test_start_heights_may_be_given_by_edge(tmp_path: Path) -> None:
    edges = (
        '<attnum name="z start left" val="1"/><attnum name="z start right" val="-1"/>'
        '<attnum name="z end left" val="1"/><attnum name="z end right" val="-1"/>'
    )
    home = '<attnum name="z end" val="0" unit="m"/>'
    track = read(tmp_path, (UP, edges), ('val="-10" unit="%"', 'val="0" unit="%"'), (home, edges))
    assert z(track, 30.0, 5.0) == pytest.approx(1.0)
    assert z(track, 30.0, -5.0) == pytest.approx(-1.0)
    assert z(track, 30.0) == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("steps", "count"),
    [
        ('<attnum name="profil steps" val="3"/>', 3),
        ('<attnum name="profil steps length" val="30"/>', 4),
        # A number of steps takes precedence over a length, a segment's length over the track's.
        (
            '<attnum name="profil steps" val="3"/><attnum name="profil steps length" val="30"/>',
            3,
        ),
        ("", 6),
    ],
)
def test_number_of_profile_steps(tmp_path: Path, steps: str, count: int) -> None:
    overall = '<attnum name="profil steps length" val="18" unit="m"/>'
    width = '<attnum name="width" val="10" unit="m"/>'
    track = read(tmp_path, (width, width + overall), (LINEAR, steps))
    assert list(track.s0[: count + 1]) == pytest.approx(
        [100.0 / count * i for i in range(count + 1)]
    )


def test_banking_of_one_end_only(tmp_path: Path) -> None:
    """With `banking end` alone, the banking starts with the end banking of the previous segment."""
    lean = '<attnum name="banking end" val="6" unit="deg"/>'
    level = '<attnum name="banking end" val="0" unit="deg"/>'
    home = '<attnum name="z end" val="0" unit="m"/>'
    track = read(tmp_path, (UP, UP + lean), (home, home + level))
    rise = math.tan(math.radians(6.0)) * 5.0
    assert z(track, 50.0, 5.0) - z(track, 50.0) == pytest.approx(rise / 2)
    assert z(track, 150.0, 5.0) - z(track, 150.0) == pytest.approx(rise)


@pytest.mark.parametrize(
    ("category", "surface", "kind", "looks"),
    [
        ("road", "asphalt", "asphalt", WITHOUT_KERBS),
        ("dirt", "asphalt", "gravel", ("gravel",)),
        ("road", "dirt-side-d2", "gravel", ("gravel",)),
        ("oval", "asphalt-lines", "asphalt", ("oval",)),
        ("road", "concrete", "concrete", WITHOUT_KERBS),
    ],
)
def test_surface_and_look_follow_the_file(
    tmp_path: Path, category: str, surface: str, kind: str, looks: tuple[str, ...]
) -> None:
    track = read(
        tmp_path,
        ('name="category" val="road"', f'name="category" val="{category}"'),
        ('name="surface" val="asphalt"', f'name="surface" val="{surface}"'),
    )
    assert track.surface == kind
    assert track.look in looks


@pytest.mark.parametrize(
    ("name", "look"),
    [
        ("street-1", "town"),
        ("alpine-3", "mountain"),
        ("e-speedway", "oval"),
        ("ruudskogen", "forest"),
        ("corkscrew", "coast"),
        ("eroad", "highway"),
    ],
)
def test_look_follows_words_in_the_name(tmp_path: Path, name: str, look: str) -> None:
    path = tmp_path / f"{name}.xml"
    path.write_text(STADIUM)
    assert read_torcs(path).look == look


def test_names_without_known_words_get_various_looks(tmp_path: Path) -> None:
    looks = []
    for number in range(12):
        path = tmp_path / f"g-track-{number}.xml"
        path.write_text(STADIUM)
        looks.append(read_torcs(path).look)
        assert read_torcs(path).look == looks[-1]
    assert set(looks) <= set(LOOKS)
    assert len(set(looks)) >= 3


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("ending", ["\n", "\r\n", "\r"])
def test_line_ends_and_encodings_do_not_matter(tmp_path: Path, encoding: str, ending: str) -> None:
    text = STADIUM.replace('encoding="UTF-8"', f'encoding="{encoding.upper()[:6].rstrip("-")}"')
    path = tmp_path / "lines.xml"
    path.write_bytes(text.replace("\n", ending).encode(encoding))
    assert read_torcs(path).length_m == pytest.approx(200.0 + 2 * BEND)


def test_surface_definitions_in_the_file_are_ignored(tmp_path: Path) -> None:
    """Surfaces defined in the file and the standard list do not change the track."""
    own = '&default-surfaces;<section name="dirt"><attnum name="width" val="99"/></section>'
    assert read(tmp_path, ("&default-surfaces;", own)).width == 10.0


def test_each_format_version_needs_its_segment_list(tmp_path: Path) -> None:
    with pytest.raises(TrackError, match="no section 'segments'"):
        read(tmp_path, ('name="version" val="4"', 'name="version" val="3"'))


@pytest.mark.usefixtures("no_torcs_install")
def test_an_installed_torcs_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, text in (("good", STADIUM), ("bad", STADIUM.replace("lft", "left"))):
        folder = tmp_path / "road" / name
        folder.mkdir(parents=True)
        (folder / f"{name}.xml").write_text(text)
    monkeypatch.setattr("simulator.track.catalogue.SYSTEM_TRACKS", tmp_path)
    assert find_track("good").length_m == pytest.approx(200.0 + 2 * BEND)
    assert [track.name for track in list_tracks() if track.source == "torcs"] == ["good"]
    warnings = capsys.readouterr().err.splitlines()
    assert len(warnings) == 1
    assert "'left', expected str, lft or rgt" in warnings[0]
