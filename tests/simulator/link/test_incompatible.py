"""Segments of another version, byte order or size are refused by the Python and the C client."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulator.link import layout
from simulator.link.client import Link
from simulator.link.errors import LayoutMismatch, LinkError, NoServer
from simulator.link.handshake import ServerInfo, read_header, write_header
from simulator.link.layout import HEADER, Mode, segment_size
from simulator.link.segment import Segment, create

INFO = ServerInfo(
    track="næset",
    lanes=2,
    lane_width=3.5,
    track_length=1000.5,
    half_width=6.0,
    edge=6.5,
    steering_lock=0.36652,
    traffic=3,
    frequency_hz=40,
    mode=Mode.REALTIME,
    image_width=9,
    image_height=9,
    engine_pid=1234,
    beam_angles=tuple(float(i) for i in range(19)),
)


def stranger(name: str, change: Callable[[Any], None], extra: int = 0) -> Segment:
    segment = create(name, segment_size(9, 9) + extra)
    write_header(segment, INFO)
    change(np.frombuffer(segment.memory, HEADER.dtype, count=1)[0])
    segment.publish()
    return segment


def other(**values: Any) -> Callable[[Any], None]:
    def change(header: Any) -> None:
        for name, value in values.items():
            header[name] = value

    return change


def test_header_round_trip(name: str) -> None:
    segment = stranger(name, other())
    assert read_header(segment) == INFO
    segment.close()


BAD = [
    (other(version=2), 0, "layout 2 "),
    (other(layout_hash=1), 0, "0000000000000001"),
    (other(byte_order=0x04030201), 0, "other byte order"),
    (other(segment_size=1), 0, "its header says 1"),
    (other(image_bytes=8), 0, "its header says"),
    (other(), 4096, "its header says"),
]


@pytest.mark.parametrize(("change", "extra", "said"), BAD, ids=[said for _, _, said in BAD])
def test_both_clients_refuse_an_incompatible_segment(
    name: str, lap_program: Path, change: Callable[[Any], None], extra: int, said: str
) -> None:
    segment = stranger(name, change, extra)
    with pytest.raises(LayoutMismatch, match=said):
        Link(name)
    done = subprocess.run([str(lap_program), name], capture_output=True, text=True, timeout=300)
    segment.close()
    assert done.returncode == 1
    assert said in done.stderr


def test_a_refused_client_releases_its_lock(name: str) -> None:
    segment = stranger(name, other(version=2))
    for _ in range(2):
        with pytest.raises(LayoutMismatch):
            Link(name)
    assert not segment.peer_is_alive()
    segment.close()


def test_the_c_client_refuses_another_programs_memory_and_a_bad_name(
    name: str, lap_program: Path
) -> None:
    path = Path("/dev/shm") / name[1:]
    path.write_bytes(b"x" * 8192)
    for asked, said in ((name, "is no driverview link"), ("oval", "no name of a link: oval")):
        command = [str(lap_program), asked]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        assert done.returncode == 1
        assert said in done.stderr
    with pytest.raises(LinkError, match="is no link of this program"):
        Link(name)
    assert path.stat().st_size == 8192
    path.unlink()


def test_waiting_for_a_server_times_out(name: str) -> None:
    with pytest.raises(NoServer, match="simulator link --name"):
        Link(name, wait_s=0.1)


def test_an_old_c_program_is_told_to_recompile(
    oval: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A C client compiled with an older layout's header is told to recompile."""
    import shutil
    from importlib.resources import files

    from simulator.link.header import c_header

    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    with monkeypatch.context() as before:
        before.setattr(layout, "VERSION", 0)
        (tmp_path / "driverview_link.h").write_text(c_header())
    shutil.copy(str(files("simulator.link").joinpath("c/lap.c")), tmp_path / "lap.c")
    program = tmp_path / "lap"
    command = ["gcc", "-std=c11", "-D_GNU_SOURCE", "-o", str(program), str(tmp_path / "lap.c")]
    subprocess.run([*command, "-lm"], check=True)
    with Link(oval, wait_s=180.0):  # so that the server is there
        pass
    done = subprocess.run([str(program), oval], capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert "writes layout 1" in done.stderr
    assert "compiled for 0" in done.stderr
    assert "simulator link --header" in done.stderr
