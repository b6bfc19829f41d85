"""The engine of the tests of `mtlnet predict`."""

from pathlib import Path

import pytest

from mtlnet.inference.model_card import read_card
from tests.mtlnet.predict.brightness_engine import BrightnessEngine


@pytest.fixture
def engine(published: Path) -> BrightnessEngine:
    return BrightnessEngine(read_card(published))
