"""Malformed or malicious track files raise one-line errors; files that they name stay closed."""

import math
import os
import re
from pathlib import Path

import pytest

from simulator.track.catalogue import list_tracks, read_track, track_files
from simulator.track.errors import TrackError
from simulator.track.torcs.torcs import read_torcs

FIXTURES = Path(__file__).parent / "fixtures"
STADIUM = (FIXTURES / "sticky-grade.xml").read_text()


def refused(path: Path, content: str | bytes) -> str:
    """The message about a track file of this content: one line that names the file."""
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(TrackError) as caught:
        read_track(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name="lg" val="100"', 'name="lg" val="0"', "lg 0"),
        ('name="lg" val="100"', 'name="lg" val="-5"', "lg -5"),
        ('name="lg" val="100"', 'name="lg" val="nan"', "'nan'"),
        ('name="lg" val="100"', 'name="lg" val="inf"', "'inf'"),
        ('name="lg" val="100"', 'name="lg" val="1e9"', "1e+09"),
        ('name="lg" val="100"', 'name="length" val="100"', "lg 0"),
        ('name="lg" val="100" unit="m"', 'name="lg" val="100" unit="furlong"', "furlong"),
        ('name="radius" val="50"', 'name="radius" val="-50"', "radius -50"),
        ('name="arc" val="180" unit="deg"', 'name="arc" val="180"', "deg"),
        ('name="arc" val="180"', 'name="arc" val="170"', "from their start"),
        ('name="arc" val="180"', 'name="arc" val="0"', "arc 0"),
        ('name="z end" val="0"', 'name="z end" val="2"', "2.00 m above or below"),
        ('name="type" val="str"', 'name="type" val="loop"', "'loop'"),
        ('name="width" val="10"', 'name="width" val="-10"', "-10 m wide"),
        ('name="version" val="4"', 'name="version" val="7"', "version 7"),
        ('name="Main Track"', 'name="Side Track"', "Main Track"),
        ('name="Track Segments"', 'name="Segments"', "Track Segments"),
        (
            '<attstr name="profil" val="linear"/>',
            '<attnum name="profil steps" val="1e12"/>',
            "steps",
        ),
    ],
)
def test_errors_name_the_invalid_value(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in STADIUM
    assert said in refused(tmp_path / "bad.xml", STADIUM.replace(old, new))


def test_a_track_with_a_gap_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "gap.xml"
    first = STADIUM.replace('name="lg" val="100"', 'name="lg" val="100.25"', 1)
    path.write_text(first)
    assert read_torcs(path).length_m == pytest.approx(200.25 + 100.0 * math.pi)
    wider = STADIUM.replace('name="lg" val="100"', 'name="lg" val="100.3"', 1)
    assert "0.30 m from their start" in refused(path, wider)


def test_a_track_without_segments_is_refused(tmp_path: Path) -> None:
    empty = STADIUM.replace('attstr name="type"', 'attstr name="kind"')
    assert "no segments" in refused(tmp_path / "empty.xml", empty)


def test_an_entity_expansion_bomb_is_refused(tmp_path: Path) -> None:
    levels = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    bomb = f'<!DOCTYPE params [<!ENTITY l0 "lol">{levels}]><params name="x">&l9;</params>'
    assert "entities" in refused(tmp_path / "bomb.xml", bomb)


@pytest.mark.parametrize("name", ["default-pits", "default-surfaces"])
def test_external_and_internal_entities_are_refused(tmp_path: Path, name: str) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text('<attstr name="read" val="yes"/>')
    # An internal entity with the name of TORCS's `default-surfaces` is not TORCS's entity.
    kind = f'SYSTEM "{secret}"' if name == "default-pits" else '"<section/>"'
    declared = f"<!ENTITY {name} {kind}>"
    text = f'<!DOCTYPE params [{declared}]><params name="x">&{name};</params>'
    assert "entities" in refused(tmp_path / "outside.xml", text)


def test_parameter_and_undeclared_entities_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "parameter.xml"
    text = '<!DOCTYPE params [<!ENTITY % p SYSTEM "file:///etc/passwd"> %p;]><params/>'
    assert "entities" in refused(path, text)
    refused(path, "<params>&undeclared;</params>")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not xml at all",
        STADIUM.encode()[: len(STADIUM) // 2],
        b"\x00\x01\x02\xff" * 50,
        b'<?xml version="1.0" encoding="no-such-code"?><params/>',
        b'<?xml version="1.0" encoding="UTF-8"?><params name="\xff\xfe"/>',
        b"<html><body/></html>",
        b"<params>" + b"<section>" * 200_000,
    ],
    ids=["empty", "text", "cut", "binary", "encoding", "utf8", "html", "nested"],
)
def test_files_that_are_no_track_are_refused(tmp_path: Path, content: bytes) -> None:
    refused(tmp_path / "broken.xml", content)


def test_a_file_over_the_size_limit_is_refused(tmp_path: Path) -> None:
    large = b"<params>" + b" " * (5 * 2**20) + b"</params>"
    assert "bytes" in refused(tmp_path / "large.xml", large)


@pytest.mark.usefixtures("no_torcs_install")
def test_a_bad_file_in_a_folder_is_skipped_with_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "good.xml").write_text(STADIUM)
    (tmp_path / "bad.xml").write_text("no")
    names = [track.name for track in list_tracks(tmp_path)]
    assert "good" in names
    assert "bad" not in names
    warnings = capsys.readouterr().err
    assert warnings.count("warning: ") == 1
    assert "bad.xml" in warnings


@pytest.mark.parametrize("encoding", ["undefined", "punycode", "no-such-code"])
def test_an_unknown_encoding_is_refused(tmp_path: Path, encoding: str) -> None:
    text = f'<?xml version="1.0" encoding="{encoding}"?>\n<params name="\u00e9"/>'
    assert "cannot be read as text" in refused(tmp_path / "odd.xml", text)


def test_named_pipes_are_skipped(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    for name in ("flat.csv", "deep/deep.xml"):
        os.mkfifo(tmp_path / name)
    assert not {"flat", "deep"} & set(track_files(tmp_path))


def test_a_number_beyond_all_floats_is_refused_and_the_listing_goes_on(tmp_path: Path) -> None:
    huge = "0x" + "f" * 300
    with_huge = re.sub('(name="width" val=")[^"]*', rf"\g<1>{huge}", STADIUM, count=1)
    assert with_huge != STADIUM
    assert refused(tmp_path / "huge.xml", with_huge)
    list_tracks(tmp_path)  # skips it
    assert refused(tmp_path / "long.toml", "width = 0x" + "f" * 6000)
