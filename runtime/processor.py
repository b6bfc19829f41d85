"""Finds out whether this processor has instructions for bf16 and for int8 numbers, without which a
network in these formats is slow, and how many of its cores this process may use.

The instructions are listed as flags in /proc/cpuinfo. On systems other than Linux this file does
not exist, so the processor counts as having none of them.
"""

import os
from functools import cache
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
OWN_CGROUP, CGROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
BF16_FLAGS = {"avx512_bf16", "amx_bf16", "bf16"}
INT8_FLAGS = {"avx512_vnni", "avx_vnni", "avx_vnni_int8", "amx_int8", "i8mm", "asimddp"}
"""Flags of instructions that sum products of 8-bit numbers in 32 bits. Without these instructions
an x86 processor saturates sums of two products at 16 bits. `i8mm` and `asimddp` (dot products) are
flags of ARM processors."""


def has_bf16() -> bool:
    """Whether the processor multiplies bfloat16 natively."""
    return not BF16_FLAGS.isdisjoint(flags(CPUINFO))


def has_int8() -> bool:
    """Whether the processor multiplies and sums 8-bit integers natively."""
    return not INT8_FLAGS.isdisjoint(flags(CPUINFO))


@cache
def flags(cpuinfo: Path) -> frozenset[str]:
    """Return the flags (x86) or features (ARM) of the first processor in the file `cpuinfo`, or an
    empty set if this file does not exist."""
    if not cpuinfo.is_file():
        return frozenset()
    for line in cpuinfo.read_text().splitlines():
        name, _, values = line.partition(":")
        if name.strip() in ("flags", "Features"):
            return frozenset(values.split())
    return frozenset()


def usable_cores() -> int:
    """Return the number of cores that this process may use, at least 1.

    It is limited by the process's affinity and by the CPU quotas of its control groups (cgroup v2;
    Docker's `--cpus`, CPUQuota of systemd), rounded down.
    """
    counts = [len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()]
    for group in _control_groups():
        try:
            quota_us, period_us = (group / "cpu.max").read_text().split()
            counts.append(int(quota_us) // int(period_us))
        except (OSError, ValueError):  # no such file, or "max" instead of a quota
            continue
    return max(min(count or 1 for count in counts), 1)


def _control_groups() -> list[Path]:
    """The folders of this process's control group (cgroup v2) and of all groups around it."""
    if not OWN_CGROUP.is_file():
        return []
    found = [line[3:] for line in OWN_CGROUP.read_text().splitlines() if line.startswith("0::")]
    path = CGROUPS / found[0].strip("/") if found else CGROUPS
    return [group for group in (path, *path.parents) if group.is_relative_to(CGROUPS)]
