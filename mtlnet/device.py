"""Where a run computes."""

import re
from functools import cache
from pathlib import Path

import torch

from mtlnet.together import ALONE, Part
from trackfeatures.errors import UserError


def choose_device(name: str, part: Part = ALONE) -> torch.device:
    """The device called `name`; "auto": a GPU where there is one."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and part.local > 1:
        name = f"cuda:{part.local_rank}"
    if not re.fullmatch(r"cpu|cuda(:\d{1,3})?", name):
        raise UserError(f"--device {name!r} is not known; use auto, cpu, cuda or cuda:NUMBER")
    device = torch.device(name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UserError(f"--device {name}: torch finds no GPU here; use --device cpu")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(f"--device {name}: torch finds {torch.cuda.device_count()} GPU(s) here")
    return device


@cache
def cpu_has_bf16() -> bool:
    """Whether the CPU multiplies bf16 natively (AVX512-BF16 or AMX); elsewhere it is slower."""
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return False
    text = info.read_text()
    return "avx512_bf16" in text or "amx_bf16" in text
