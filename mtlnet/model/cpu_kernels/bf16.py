"""Whether bf16 is quick on this CPU."""

from functools import cache
from pathlib import Path


@cache
def cpu_has_bf16() -> bool:
    """Whether the CPU multiplies bf16 natively (AVX512-BF16 or AMX); others are slower in it."""
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return False
    text = info.read_text()
    return "avx512_bf16" in text or "amx_bf16" in text
