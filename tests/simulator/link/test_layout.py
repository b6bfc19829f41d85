"""The layout's tables, the C header generated from them, and its compilation."""

import shutil
import subprocess
import sys
from dataclasses import fields, replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from simulator.link import layout
from simulator.link.header import c_header
from simulator.link.layout import BLOCKS, COMMAND, STATE, image_bytes
from simulator.vehicle.state import CarState, Command

COMMITTED = Path(str(files("simulator.link").joinpath("c/driverview_link.h")))


def test_blocks_are_contiguous() -> None:
    end = 0
    for block in BLOCKS:
        assert block.offset == end
        end = block.end
        places = [place for place, _ in block.places.values()]
        sizes = [size for _, size in block.places.values()]
        assert places == np.concatenate([[0], np.cumsum(sizes)[:-1]]).tolist(), block.name
        assert sum(sizes) == block.dtype.itemsize
        assert block.dtype.itemsize % 64 == 0  # a cache line
    assert end == layout.IMAGE_OFFSET


def test_messages_begin_with_the_sequence_and_end_with_the_checksum() -> None:
    for block in (COMMAND, STATE):
        assert block.fields[0].name == "sequence"
        assert block.fields[0].kind == "u4"
        assert block.fields[-1].name == "check"


def test_every_state_and_command_field_is_in_the_layout() -> None:
    assert {f.name for f in fields(CarState)} <= {f.name for f in STATE.fields}
    assert {f.name for f in fields(Command)} <= {f.name for f in COMMAND.fields}


def test_layout_hash_changes_with_name_type_count_and_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = layout.layout_hash()
    first, second, *others = STATE.fields
    for changed in (
        (replace(first, name="renamed"), second, *others),
        (replace(first, kind="i4"), second, *others),
        (replace(first, count=2), second, *others),
        (second, first, *others),
    ):
        block = replace(STATE, fields=tuple(changed))
        monkeypatch.setattr(layout, "BLOCKS", (*BLOCKS[:-1], block))
        assert layout.layout_hash() != before
    monkeypatch.setattr(layout, "BLOCKS", BLOCKS)
    assert layout.layout_hash() == before


def test_image_size_is_rounded_up_to_whole_words() -> None:
    assert image_bytes(0, 0) == 0
    assert image_bytes(280, 210) == 176400
    assert image_bytes(9, 9) == 248  # 243 bytes


def test_committed_header_equals_the_generated_one() -> None:
    assert COMMITTED.read_text() == c_header(), (
        "run: simulator link --header simulator/link/c/driverview_link.h"
    )


def test_header_option_writes_the_header(tmp_path: Path) -> None:
    out = tmp_path / "link.h"
    command = [sys.executable, "-m", "simulator", "link", "--header", str(out)]
    subprocess.run(command, check=True, timeout=300)
    assert out.read_text() == c_header()


def test_c_field_offsets_equal_the_layouts(tmp_path: Path) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    rows = [(f"struct drvlink_{block.name}", f.name) for block in BLOCKS for f in block.fields]
    lines = [
        f'printf("%zu %zu\\n", offsetof({struct}, {name}), sizeof(({struct} *)0)->{name});'
        for struct, name in rows
    ]
    source = tmp_path / "places.c"
    source.write_text(
        '#include "driverview_link.h"\nint main(void) {\n' + "\n".join(lines) + "\nreturn 0;\n}\n"
    )
    program = tmp_path / "places"
    strict = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-D_GNU_SOURCE"]
    command = ["gcc", *strict, f"-I{COMMITTED.parent}", "-o", str(program), str(source), "-lm"]
    subprocess.run(command, check=True)
    printed = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    expected = [f"{place} {size}" for block in BLOCKS for place, size in block.places.values()]
    assert printed.splitlines() == expected


def test_a_header_with_a_wrong_offset_does_not_compile(tmp_path: Path) -> None:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    lying = c_header().replace("double ranges[19];", "double ranges[18];")
    assert lying != c_header()
    (tmp_path / "lying.c").write_text(lying)
    command = ["gcc", "-std=c11", "-D_GNU_SOURCE", "-fsyntax-only", str(tmp_path / "lying.c")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode != 0
    assert "offsetof(struct drvlink_state, ranges_traffic) == " in done.stderr


def test_the_header_compiles_as_cpp(tmp_path: Path) -> None:
    if shutil.which("g++") is None:
        pytest.skip("no g++ on this machine")
    source = tmp_path / "use.cpp"
    source.write_text('#include "driverview_link.h"\nint main() { return 0; }\n')
    strict = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-D_GNU_SOURCE", "-fsyntax-only"]
    subprocess.run(["g++", *strict, f"-I{COMMITTED.parent}", str(source)], check=True)
