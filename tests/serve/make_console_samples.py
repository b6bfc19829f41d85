"""Makes the console's samples: frames of simulated rounds with their true features.

Run: `datagen collect --rounds 12 --frames 40 --seed 11 --out DIR \
--tracks highway,mountain-pass,forest,town,coast,countryside`, then
`python tests/serve/make_console_samples.py DIR`. The pixels depend slightly on the renderer.
"""

import json
import sys
from pathlib import Path

import numpy as np
import simplejpeg

import trackfeatures as tf
from datagen.recording import Dataset
from serve.api.console import FOLDER

FRAMES = {
    390: "avenue in hard shadow, two lanes",
    110: "coast under clouds, two lanes",
    30: "highway in rain, changing lanes",
    190: "forest in fog",
    230: "town in snow, close to the left marking",
    310: "mountain pass at dusk",
    350: "yellow left line, three lanes",
    150: "country road, one lane",
}
QUALITY = 90


def main() -> None:
    frames = Dataset.open(Path(sys.argv[1])).select("all")
    labels, samples = frames.labels, []
    for number, (frame, about) in enumerate(FRAMES.items(), start=1):
        name = f"sample-{number}.jpg"
        image = frames.image(frame)
        (FOLDER / name).write_bytes(
            simplejpeg.encode_jpeg(image, quality=QUALITY, colorsubsampling="420")
        )
        truth = {
            "distances_m": dict(
                zip(tf.MARKINGS, map(_number, labels.distances[frame]), strict=True)
            ),
            "to_lane_centre_m": _number(labels.to_lane_centre[frame]),
            "angle_rad": _number(labels.angle[frame]),
        }
        samples.append({"file": name, "about": about, "truth": truth})
    (FOLDER / "samples.json").write_text(json.dumps(samples, indent=1) + "\n")


def _number(value: np.float32) -> float | None:
    return None if np.isnan(value) else round(float(value), 4)


if __name__ == "__main__":
    main()
