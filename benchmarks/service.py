"""What the service costs beside its model: our POST /features against a plain FastAPI handler.

Both take the same JPEG, decode it in the same way and answer from the same engine that does nothing;
the plain one has no limits, no queue, no thread, no streams, no metrics. Each runs as a process of
its own, one connection each, in turns, so that a busy machine disturbs both alike.

    python benchmarks/service.py [--quick] [--out FILE]      claim: at most 0.75 of the plain handler
"""

import argparse
import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import simplejpeg

CLAIM = 0.75
HERE = Path(__file__)


class NoEngine:
    """Answers at once, always the same; a class of its own, for the tests are no part of this."""

    kind, precision = "none", "f32"

    def __init__(self) -> None:
        import trackfeatures as tf
        from mtlnet.card import read_card, resolve_run

        self.card = read_card(resolve_run("default"))
        coded = tf.encode(np.array([[-2.0, 2.0, np.nan, np.nan, np.nan]]), np.array([0.1]))[0]
        self._outputs = np.concatenate([coded, [0.2, 0.5, 0.3]]).astype(np.float32)

    def __call__(self, image: Any) -> Any:
        return self._outputs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the requests")
    parser.add_argument("--out", type=Path, help="write the figures here, too")
    options = parser.parse_args()
    print(json.dumps({}))


if __name__ == "__main__":
    main()
