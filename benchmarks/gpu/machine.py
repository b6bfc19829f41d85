"""Finds out what a machine lacks for a GPU run: packages, EGL on the GPU, TORCS's tracks, a GPU.

Each of these is found out by a separate Python process, so that this process uses no GPU memory and
no OpenGL context.
"""

import json
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.gpu.wheels import ROOT, missing_packages

TORCS_TRACK = "g-track-3"
SOFTWARE = ("llvmpipe", "softpipe", "swrast")
ASK_S = 120.0
NVIDIA_EGL = Path("/usr/local/nvidia/share/glvnd/egl_vendor.d/10_nvidia.json")
"""Description of NVIDIA's EGL driver in containers whose driver files are mounted there, where EGL
does not look by itself."""

GPU_QUESTION = """
import json, torch
found = {"torch": torch.__version__, "cuda": torch.version.cuda, "gpu": None, "gpu_bytes": 0}
if torch.cuda.is_available():
    about = torch.cuda.get_device_properties(0)
    found |= {"gpu": about.name, "gpu_bytes": about.total_memory}
print(json.dumps(found))
"""
EGL_QUESTION = """
import json
from simulator.camera.core.context import graphics
print(json.dumps({"renderer": graphics().context.info["GL_RENDERER"]}))
"""
TRACKS_QUESTION = f"""
import json
from simulator.track.catalogue import track_files
found = track_files(None)
print(json.dumps({{"tracks": len(found), "torcs": {TORCS_TRACK!r} in found}}))
"""


def describe_machine() -> dict[str, Any]:
    """Return the processor cores, Python, torch, GPU, renderer and tracks of this machine.

    `errors` in the result has a message for each Python program of a question that failed. The
    packages of the project must be installed.
    """
    found: dict[str, Any] = {
        "python": platform.python_version(),
        "cores": len(os.sched_getaffinity(0)),
        "gpu": None,
        "gpu_bytes": 0,
        "renderer": None,
        "tracks": 0,
        "torcs": False,
        "errors": {},
    }
    questions = {"gpu": GPU_QUESTION, "egl": EGL_QUESTION, "tracks": TRACKS_QUESTION}
    with ThreadPoolExecutor(len(questions)) as pool:
        answers = list(pool.map(ask, questions.values()))
    for name, answer in zip(questions, answers, strict=True):
        if isinstance(answer, str):
            found["errors"][name] = answer
        else:
            found |= answer
    return found


def ask(question: str) -> dict[str, Any] | str:
    """Run the Python program `question`; return its JSON, or the last line of its error."""
    command = [sys.executable, "-c", question]
    try:
        done = subprocess.run(
            command, cwd=ROOT, capture_output=True, text=True, timeout=ASK_S, check=False
        )
        answer: dict[str, Any] = json.loads(done.stdout)
    except subprocess.TimeoutExpired:
        return f"no answer within {ASK_S:g} s"
    except ValueError:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        return lines[-1]
    return answer


def missing(found: dict[str, Any], *, gpu: bool = True) -> list[str]:
    """Return a message for each thing that a machine lacks for a run. `found` is the machine's
    description, a result of `describe_machine`.

    `gpu`: whether the run needs a GPU.
    """
    errors: dict[str, str] = found["errors"]
    lacks = [f"{name}: {error}" for name, error in errors.items()]
    if not found["torcs"] and "tracks" not in errors:
        lacks.append(
            f"tracks: TORCS's ({TORCS_TRACK} and others) are not found; name their folder with "
            "--tracks or $TORCS_TRACKS"
        )
    if gpu and found["gpu"] is None and "gpu" not in errors:
        lacks.append(f"gpu: torch {found['torch']} finds none")
    renderer = found["renderer"]
    if gpu and renderer is not None and any(name in renderer for name in SOFTWARE):
        lacks.append(
            f"egl: OpenGL draws on {renderer}, not on the GPU; give the driver's file with "
            "__EGL_VENDOR_LIBRARY_FILENAMES"
        )
    return lacks


def missing_at_all(*, gpu: bool = True) -> tuple[dict[str, Any], list[str]]:
    """Return the description of this machine ({} if packages are missing), and a message for each
    thing that it lacks for a run. `gpu`: whether the run needs a GPU."""
    packages = missing_packages()
    if packages:
        named = ", ".join(packages)
        return {}, [f"packages: {named}; bring them with --wheels (--collect-wheels gathers them)"]
    found = describe_machine()
    return found, missing(found, gpu=gpu)


def set_paths(site: Path, tracks: Path | None) -> None:
    """Set the environment variables PYTHONPATH and TORCS_TRACKS for the commands of a run, and the
    driver of EGL if NVIDIA's is where containers have it."""
    paths = [str(ROOT), str(site), os.environ.get("PYTHONPATH", "")]
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    if tracks is not None:
        os.environ["TORCS_TRACKS"] = str(tracks.resolve())
    if NVIDIA_EGL.is_file():
        os.environ.setdefault("__EGL_VENDOR_LIBRARY_FILENAMES", str(NVIDIA_EGL))
