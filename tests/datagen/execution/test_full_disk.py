"""Collection on a full disk, and into folders without write permission."""

import ctypes
import errno
import json
import os
import resource
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from datagen.execution.collect import collect, initialise_folder, require_matching_folder
from datagen.recorder.job import FatalError
from datagen.recording.folder import read_states
from datagen.recording.integrity.verify import verify
from tests.datagen.commands import SHORT, attempted, datagen, make_jobs, make_small_plan

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1  # <linux/prctl.h>, <linux/capability.h>


@pytest.mark.parametrize("failing", range(5))
def test_collection_resumes_after_a_disk_that_was_full_from_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    """Each write before the first round fails once; afterwards the same command succeeds."""
    folder = tmp_path / "data"
    plan = make_small_plan(1, 10)
    synced: list[Path] = []

    def full(path: Path) -> None:
        synced.append(path)
        if len(synced) > failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("runtime.files.fsync_path", full)
        with pytest.raises(OSError, match="No space left"):
            collect(plan, folder, workers=1)
    require_matching_folder(folder, plan)
    initialise_folder(folder, plan)
    assert json.loads((folder / "plan.json").read_text())["hash"] == plan.hash


def test_a_folder_without_permission_gives_a_one_line_error(tmp_path: Path) -> None:
    """As root, the child process drops the capability to ignore file modes."""

    def drop_capability() -> None:
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, 0, 0, 0)

    tmp_path.chmod(0o555)
    (plain := tmp_path.with_name("plain")).mkdir()
    plain.chmod(0o555)
    for folder in (tmp_path / "new", plain):
        done = datagen("collect", *SHORT, "--out", folder, preexec_fn=drop_capability)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
        assert done.stderr.startswith("error: no permission to write or read: ")
        assert str(folder) in done.stderr
    assert not list(plain.iterdir())


@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EACCES])
def test_a_full_disk_leaves_no_file_of_the_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: int
) -> None:
    def full(*args: object) -> None:
        raise OSError(reason, os.strerror(reason))

    (job,) = make_jobs(tmp_path, rounds=1, frames=10)
    monkeypatch.setattr("datagen.recorder.record.RoundWriter.add", full)
    message = attempted(job)
    assert isinstance(message, FatalError)
    assert isinstance(message.error, OSError)
    assert message.error.errno == reason
    assert not list((tmp_path / ".partial").iterdir())
    assert not list(tmp_path.glob("rounds/*"))


@pytest.mark.extended
def test_a_write_error_gives_one_line_and_keeps_finished_rounds(collected: Path) -> None:
    """A limit on the file size stands in for a full disk: the same write fails."""
    lost = collected / "rounds" / "round-001.mcap"
    before = lost.read_bytes()
    lost.unlink()
    limit = 400_000
    done = datagen(
        "collect", *SHORT, "--out", collected,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )  # fmt: skip
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert errors == [f"error: {os.strerror(errno.EFBIG)}: {collected}"]
    assert "Traceback" not in done.stderr
    assert list(read_states(collected)) == ["round-000"]
    assert not (collected / ".partial").exists()
    assert datagen("collect", *SHORT, "--out", collected).returncode == 0
    assert lost.read_bytes() == before


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MB: one and a half rounds of 40 frames."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "none", disk])
    if mounted.returncode:
        pytest.skip("only root may mount a small file system")
    yield disk
    subprocess.run(["umount", disk], check=True)


@pytest.mark.extended
@pytest.mark.skipif(shutil.which("mount") is None, reason="there is no mount command")
def test_a_small_file_system_that_fills_up_keeps_finished_rounds(small_disk: Path) -> None:
    args = ["--rounds", "3", "--frames", "40", "--tracks", "circuit", "--workers", "1"]
    folder = small_disk / "data"
    done = datagen("collect", *args, "--out", folder)
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if "error" in line]
    assert errors[0].startswith("error: the disk is full: ")
    assert (len(errors), "Traceback" in done.stderr) == (1, False)
    (kept,) = read_states(folder)
    before = (folder / "rounds" / f"{kept}.mcap").stat().st_mtime_ns
    assert not (folder / ".partial").exists()
    subprocess.run(["mount", "-o", "remount,size=20m", small_disk], check=True)
    again = datagen("collect", *args, "--out", folder, "--json")
    assert json.loads(again.stdout)["recorded_frames"] == 80
    assert (folder / "rounds" / f"{kept}.mcap").stat().st_mtime_ns == before
    assert verify(folder, "full").ok
