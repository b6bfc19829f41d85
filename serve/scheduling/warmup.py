"""Check of a loaded model before it answers any client.

The engine is run on the golden image of `mtlnet.inference.model_card`; the model card holds the
float32 outputs of torch for that image, computed when the model was published.
"""

import numpy as np

from mtlnet.inference.engine import Engine
from mtlnet.inference.model_card import ModelError, golden_image
from mtlnet.inference.prediction import OUTPUTS

WARM_UP_RUNS = 3  # the first runs allocate memory and choose kernels
# Largest difference of any output (coded, or a probability) from the published one: about the
# rounding error of that precision, far below the effect of damaged weights. Measured for bf16
# against f32 on a model trained for ten minutes: 0.0002 on the golden image; on 1500 test frames
# 0.0003 in the median, 0.018 at most (a probability between two headings).
# int8 rounds more, and the golden image is unlike the images it was calibrated on.
TOLERANCE = {"f32": 2e-3, "bf16": 0.03, "int8": 0.1}


def warm_up(engine: Engine) -> None:
    """Run `engine` a few times; raise ModelError unless its outputs equal the published ones."""
    card = engine.card
    image = golden_image(card.camera.width, card.camera.height)
    for _ in range(WARM_UP_RUNS):
        outputs = engine(image)[:OUTPUTS]
    expected = np.asarray(card.golden, np.float32)
    if outputs.shape != expected.shape:
        raise ModelError(
            f"the engine gives {outputs.shape} numbers for the golden image, the card of "
            f"{card.name} holds {expected.shape}; train the model again"
        )
    difference = float(np.abs(outputs - expected).max())
    tolerance = TOLERANCE[engine.precision]
    # Written so that NaN fails too.
    if not difference <= tolerance:
        raise ModelError(
            f"the outputs for the golden image differ by {difference:.2g} from the published ones, "
            f"at most {tolerance:g} is expected in {engine.precision}: the weights or the engine "
            "are damaged; restore the run or train it again"
        )
