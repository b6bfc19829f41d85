"""The example in the README of a WebDataset export."""

from pathlib import Path
from typing import Any

import pytest

from datagen.recording.folder import prepare
from datagen.recording.manifest import rebuild
from datagen.recording.splits import Split
from tests.datagen.commands import datagen_here
from tests.datagen.conftest import FRAMES, Samples


@pytest.mark.parametrize("codec", ["jpeg", "png"])
def test_the_example_prints_every_frame(
    samples: Samples,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    codec: str,
) -> None:
    folder, out = tmp_path / "data", tmp_path / "out"
    prepare(folder)
    samples.add_round(folder, samples.header("r000", codec=codec))
    rebuild(folder, Split(train=("r000",), test=()))
    assert datagen_here("export", folder, "--out", out).returncode == 0
    code = (out / "README.md").read_text().split("```python\n")[1].split("```")[0]
    assert max(map(len, code.splitlines())) <= 100
    monkeypatch.chdir(out)
    names: dict[str, Any] = {}
    exec(code, names)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == FRAMES
    assert lines[-1] == f"(42, 56, 3) {names['about']['labels']['to_lane_centre']}"
