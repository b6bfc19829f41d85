"""What a processor is said to compute natively, from its flags, and how many cores may be used."""

import os
from pathlib import Path

import pytest

from runtime import processor

# Lines of /proc/cpuinfo as the kernel writes them, shortened.
PROCESSORS = {
    "avx2": ("flags\t\t: fpu sse4_2 avx avx2 bmi2", False, False),
    "avx512 with vnni": ("flags\t\t: avx2 avx512f avx512_vnni", False, True),
    "avx2 with vnni": ("flags\t\t: avx2 avx_vnni", False, True),
    "amx": ("flags\t\t: avx2 avx512_bf16 amx_bf16 amx_int8 avx512_vnni", True, True),
    "arm": ("Features\t: fp asimd asimddp bf16 i8mm", True, True),
    "old arm": ("Features\t: fp asimd", False, False),
    "without flags": ("Hardware\t: unknown", False, False),
}


@pytest.mark.parametrize("name", PROCESSORS)
def test_formats_of_a_processor(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line, bf16, int8 = PROCESSORS[name]
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"processor\t: 0\nmodel name\t: bf16 avx512_vnni\n{line}\n")
    monkeypatch.setattr(processor, "CPUINFO", cpuinfo)
    assert (processor.has_bf16(), processor.has_int8()) == (bf16, int8)


def test_nothing_is_native_where_the_kernel_lists_no_flags(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processor, "CPUINFO", tmp_path / "missing")
    assert not processor.has_bf16()
    assert not processor.has_int8()


@pytest.mark.parametrize(
    ("outer", "inner", "expected"),
    [
        ("max 100000", "max 100000", 8),
        ("max 100000", "250000 100000", 2),
        ("300000 100000", "max 100000", 3),
        ("50000 100000", "max 100000", 1),
        ("", None, 8),
    ],
)
def test_cores_are_limited_by_affinity_and_by_the_quotas_of_all_control_groups(
    outer: str,
    inner: str | None,
    expected: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    groups, own = tmp_path / "cgroup", tmp_path / "own"
    (groups / "system.slice" / "serve.service").mkdir(parents=True)
    (groups / "system.slice" / "cpu.max").write_text(outer + "\n")
    if inner is not None:
        (groups / "system.slice" / "serve.service" / "cpu.max").write_text(inner + "\n")
    own.write_text("1:cpu:/elsewhere\n0::/system.slice/serve.service\n")
    monkeypatch.setattr(processor, "OWN_CGROUP", own)
    monkeypatch.setattr(processor, "CGROUPS", groups)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    assert processor.usable_cores() == expected


def test_without_control_groups_the_affinity_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processor, "OWN_CGROUP", tmp_path / "missing")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1, 5})
    assert processor.usable_cores() == 2
