"""The frame rate: it selects the recorded steps and leaves the control rate at 20 Hz or above."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.planning.config import CollectConfig, TrackChoice
from datagen.planning.plan import CONTROL_HZ
from datagen.planning.planner import make_plan
from datagen.recording import Dataset
from datagen.view.steps import Steps
from simulator.world.control_rate import PHYSICS_HZ
from tests.datagen.commands import datagen_here

OPTIONS = ("--rounds", "1", "--tracks", "oval", "--lights", "clear", "--stretch", "0")


@pytest.mark.parametrize("hertz", [h for h in range(1, PHYSICS_HZ + 1) if PHYSICS_HZ % h == 0])
def test_the_control_rate_is_at_least_20_hz(hertz: int) -> None:
    wanted = CollectConfig(rounds=1, frames=1, seed=0, tracks=(TrackChoice("oval", "0"),))
    entry = make_plan(replace(wanted, frequency_hz=hertz)).rounds[0]
    control_hz = hertz * entry.steps_per_frame
    assert control_hz >= CONTROL_HZ
    assert PHYSICS_HZ % control_hz == 0
    assert (entry.steps_per_frame == 1) == (hertz >= CONTROL_HZ)


@pytest.mark.extended
def test_frames_at_4_hz_equal_every_fifth_frame_at_20_hz(tmp_path: Path) -> None:
    """The frame rate changes which steps are recorded, not how the car drives."""
    for name, options in {"all": ("--frames", "50"), "few": ("--frames", "10")}.items():
        hertz = ("--frequency", "4" if name == "few" else "20")
        done = datagen_here("collect", "--out", tmp_path / name, *OPTIONS, *options, *hertz)
        assert done.returncode == 0, done.stderr
    every, few = (Dataset.open(tmp_path / name).select("all") for name in ("all", "few"))
    np.testing.assert_array_equal(few.labels.s, every.labels.s[::5])
    np.testing.assert_array_equal(few.labels.angle, every.labels.angle[::5])
    np.testing.assert_array_equal(few.read_batch(range(10)), every.read_batch(range(0, 50, 5)))
    steps = Steps.open(few.rounds[0].path)
    assert [step.time_s for step in steps] == pytest.approx([0.25 * k for k in range(10)])
    done = datagen_here("verify", tmp_path / "few", "--level", "deep", "--replay", "1")
    assert done.returncode == 0, done.stderr + done.stdout
