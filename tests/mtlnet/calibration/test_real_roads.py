"""The pitch of one real drive, from consecutive pictures; nothing was tuned on it."""

from pathlib import Path

import pytest

from benchmarks.calibration import REAL_CLAIM_DEG, real_pitch

FOLDER = Path(__file__).parents[4] / "shared" / "real_roads"


@pytest.mark.skipif(not FOLDER.is_dir(), reason="needs ../shared/real_roads")
def test_the_pitch_is_that_of_the_labels_horizon() -> None:
    found = real_pitch(FOLDER)
    assert found is not None
    assert found["pitch_deg"] == pytest.approx(found["labels_pitch_deg"], abs=REAL_CLAIM_DEG)
