"""Training with torch in a process that renders: the LLVMs of Mesa and triton must not clash."""

import subprocess
import sys

import pytest

RENDER_THEN_TRAIN = """
from simulator.camera import Camera, Light
from trackfeatures.camera import CameraParameters
from simulator.track.catalogue import find_track
from simulator.track.road import Road
import numpy as np
light = Light.named("clear", np.random.default_rng(0))
road, size = Road(find_track("oval")), CameraParameters(64, 48)
with Camera(road, size, seed=0, light=light) as camera:
    picture = camera.render(np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0]))
import torch
weight = torch.nn.Parameter(torch.ones(3))
optimiser = torch.optim.AdamW([weight])  # the first optimiser imports torch's compiler and triton
weight.sum().backward()
optimiser.step()
print(picture.shape, bool((weight < 1).all()))
"""


@pytest.mark.extended
def test_torch_trains_in_a_process_that_has_rendered() -> None:
    done = subprocess.run(
        [sys.executable, "-c", RENDER_THEN_TRAIN], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split("\n")[-2] == "(48, 64, 3) True"
