"""`examples/quickstart.ipynb` runs, and its outputs are kept."""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from traitlets.config import Config

NOTEBOOK = Path(__file__).parents[2] / "examples" / "quickstart.ipynb"
# What makes it small: source text of its cells, and what stands there in the test.
SMALL = {
    "MINUTES = 1.0": "MINUTES = 0.02",
    "--frames 200": "--frames 25",
    "range(300)": "range(15)",
}


@pytest.mark.slow
@pytest.mark.extended
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JUPYTER_DATA_DIR", str(tmp_path / "jupyter"))
    # Sockets in a folder: a TCP port that is free when it is chosen may be taken when the kernel
    # opens it, as other tests open ports too. A socket's path has at most 107 characters.
    sockets = tempfile.TemporaryDirectory(prefix="jupyter")
    over_files = Config({"KernelManager": {"transport": "ipc", "ip": f"{sockets.name}/kernel"}})
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    notebook = nbformat.read(NOTEBOOK, as_version=4)  # type: ignore[no-untyped-call]
    text = "".join(cell.source for cell in notebook.cells)
    assert [text.count(old) for old in SMALL] == [1] * len(SMALL)
    for cell in notebook.cells:
        for old, new in SMALL.items():
            cell.source = cell.source.replace(old, new)
    earlier = [tmp_path / folder / "quickstart" / "old" for folder in ("datasets", "runs")]
    for file in earlier:  # of a run with other settings, which must not be shown again
        file.parent.mkdir(parents=True)
        file.touch()
    where = {"metadata": {"path": str(tmp_path)}}
    with sockets:
        NotebookClient(
            notebook, timeout=300, kernel_name="python3", resources=where, config=over_files
        ).execute()
    assert not any(file.exists() for file in earlier)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed = "".join(output.text for output in outputs if output.output_type == "stream")
    assert "100 train frames, 50 test frames" in printed
    assert "as shipped: lane centre 0.0" in printed
    assert "15 steps" in printed
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 3


def test_the_notebook_keeps_its_outputs() -> None:
    cells = nbformat.read(NOTEBOOK, as_version=4).cells  # type: ignore[no-untyped-call]
    code = [cell for cell in cells if cell.cell_type == "code"]
    assert all(cell.outputs for cell in code[1:])
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    kept = "".join(str(cell.outputs) for cell in code)
    assert "error" not in {output.output_type for cell in code for output in cell.outputs}
    assert "/home/" not in kept
