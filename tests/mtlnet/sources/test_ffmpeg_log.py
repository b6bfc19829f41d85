"""FFmpeg's errors belong to the film that has them, also if several films are read at once."""

import re
import subprocess
import threading
from itertools import zip_longest
from pathlib import Path

import pytest

from mtlnet.sources.films import Film, read_film_header

CODECS = {
    "a.avi": ["-c:v", "mjpeg"],  # decoded in the thread that reads
    "a.mkv": ["-c:v", "libx264", "-preset", "ultrafast", "-bf", "0"],  # in threads of the decoder
}


@pytest.fixture(params=CODECS)
def films(tmp_path: Path, request: pytest.FixtureRequest) -> tuple[Path, Path]:
    """An intact film and a copy with changed bytes, of 60 pictures."""
    program = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    intact = tmp_path / request.param
    source = ["-f", "lavfi", "-i", "testsrc2=size=280x210:rate=10:duration=6"]
    command = [program, "-v", "error", *source, *CODECS[request.param], "-pix_fmt", "yuv420p"]
    subprocess.run([*command, str(intact)], check=True, stderr=subprocess.DEVNULL)
    content = bytearray(intact.read_bytes())
    for at in range(len(content) // 3, len(content) * 3 // 4, 4999):
        content[at : at + 40] = b"\xff" * 40
    damaged = tmp_path / f"damaged{intact.suffix}"
    damaged.write_bytes(content)
    return intact, damaged


def alone(path: Path) -> tuple[int, str]:
    film = Film(path)
    return len(list(film.pictures())), kind(film.fault)


def kind(fault: str) -> str:
    """The text of a fault without its place and reason, which depend on the decoder's threads."""
    return re.sub(r"near frame \d+ \(.*\):", "near", fault)


@pytest.mark.parametrize("damaged_first", [True, False])
def test_films_read_in_turn_have_their_own_faults(
    films: tuple[Path, Path], damaged_first: bool
) -> None:
    intact, damaged = films
    expected = {path: alone(path) for path in films}
    assert expected[intact] == (60, "")
    assert "is damaged near " in expected[damaged][1]
    order = (damaged, intact) if damaged_first else (intact, damaged)
    first, second = (Film(path) for path in order)
    pairs = list(zip_longest(first.pictures(), second.pictures()))
    for place, film in enumerate((first, second)):
        count = sum(pair[place] is not None for pair in pairs)
        assert (count, kind(film.fault)) == expected[film.path]


def test_a_header_read_in_between_hides_no_error(films: tuple[Path, Path]) -> None:
    intact, damaged = films
    film = Film(damaged)
    pictures = film.pictures()
    count = 0
    for _ in pictures:
        count += 1
        if count == 3:
            read_film_header(intact)
    assert (count, kind(film.fault)) == alone(damaged)


def test_films_read_in_threads_have_their_own_faults(films: tuple[Path, Path]) -> None:
    expected = [alone(path) for path in films] * 2
    found: list[tuple[int, str]] = [(0, "")] * 4

    def read(place: int) -> None:
        found[place] = alone(films[place % 2])

    threads = [threading.Thread(target=read, args=(place,)) for place in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == expected
