"""Labels of frames, without a recording."""

from typing import Any

import numpy as np

import trackfeatures as tf
from datagen.recording import Labels


def labels_of(count: int, **given: Any) -> Labels:
    """Labels of `count` frames on a straight one-lane road, with `given` columns."""
    zeros, whole = np.zeros(count, np.float32), np.zeros(count, np.int64)
    distances = np.asarray(given.get("distances", np.zeros((count, 5))), np.float32)
    columns = {
        "distances": distances,
        "heading": np.full(count, int(tf.RoadClass.STRAIGHT)),
        "lanes": whole + 1,
        "lane_index": whole,
        "to_lane_centre": tf.localise(distances).astype(np.float32),
        "light": np.full(count, "clear"),
        "round": whole,
    }
    for name in ("angle", "curvature", "to_middle", "s", "speed", "shadow_fraction"):
        columns[name] = zeros
    return Labels(**{**columns, **given, "distances": distances})
