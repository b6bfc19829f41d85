"""Checks a loaded model before it answers any client.

The engine processes a synthetic image of a road (`mtlnet.inference.golden_image`). The model card
contains the outputs of torch in float32 for this image, computed when the model was published.
"""

import numpy as np

from mtlnet.inference.engine import Engine, ViewAverage
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import ModelError
from mtlnet.inference.prediction import OUTPUTS

WARM_UP_RUNS = 3  # the first runs allocate memory and choose kernels
# Largest allowed difference of an output (coded value or probability) from the published output:
# about the rounding error of the precision, far below the effect of damaged weights. Measured for
# bf16 against f32, with a model trained for ten minutes: 0.0002 on the golden image; on 1500 test
# frames 0.0003 (median) and 0.018 (maximum, a probability between two classes of the road). int8
# has larger rounding errors, and the golden image is unlike its calibration images.
TOLERANCE = {"f32": 2e-3, "bf16": 0.03, "int8": 0.1}


def warm_up(engine: Engine) -> None:
    """Run `engine` three times on the synthetic image. Raises ModelError if an output differs from
    the published output by more than the tolerance of the engine's precision (TOLERANCE)."""
    card = engine.card
    image = golden_image(card.camera.width, card.camera.height)
    if isinstance(engine, ViewAverage):  # the published outputs are not averaged
        engine = engine.plain
    for _ in range(WARM_UP_RUNS):
        outputs = engine(image)[:OUTPUTS]
    expected = np.asarray(card.golden, np.float32)
    if outputs.shape != expected.shape:
        raise ModelError(
            f"the engine's outputs for the golden image have the shape {outputs.shape}, but those "
            f"in the card of {card.name} have {expected.shape}; train the model again"
        )
    difference = float(np.abs(outputs - expected).max())
    tolerance = TOLERANCE[engine.precision]
    # `not <=` instead of `>`, so that NaN fails too.
    if not difference <= tolerance:
        raise ModelError(
            f"the outputs for the golden image differ by {difference:.2g} from the published ones; "
            f"at most {tolerance:g} is expected in {engine.precision}. The weights or the engine "
            "are damaged: restore the run or train it again"
        )
