"""Random episodes, one with images, are bit-identical in another process and vectorised."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "replay.py"


@pytest.mark.extended
@pytest.mark.slow
def test_random_episodes_are_bit_identical_in_another_process_and_vectorised(
    tmp_path: Path,
) -> None:
    out = tmp_path / "replay.json"
    command = [sys.executable, str(BENCHMARK), "--episodes", "5", "--json", str(out)]
    subprocess.run(command, check=True, capture_output=True)
    result = json.loads(out.read_text())
    assert result["different"] == {"another_process": [], "async_vector": []}
    assert (result["distinct"], result["with_pictures"]) == (5, 1)
    assert result["steps"] > 100
