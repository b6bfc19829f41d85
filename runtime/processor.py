"""Finds out whether this processor has instructions for bf16 and for int8 numbers. Without these
instructions a network in these formats is slow.

The instructions are listed as flags in /proc/cpuinfo. On systems other than Linux this file does
not exist, so the processor counts as having none of them.
"""

from functools import cache
from pathlib import Path

CPUINFO = Path("/proc/cpuinfo")
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
