"""How far an answer is to be trusted: a standard deviation a feature, and how strange the image is.

A small second head reads the network's last shared features x (256,), standardised to z. It gives
the standard deviation of the error of each of `FEATURES` by two layers, as a logarithm (Nix and
Weigend 1994), and the novelty of the image: the squared Mahalanobis distance of z from the
training frames (Lee et al. 2018), in units of the largest that counts as known. The network's
own nine outputs are left as they are. In numpy; the exported graph computes the same.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.card import DOUBT, ModelError
from mtlnet.whole import write_whole

FEATURES = (*tf.MARKINGS, "to_lane_centre", "angle")
"""What has a standard deviation: m, and rad for the angle."""
COLUMNS = len(FEATURES) + 1

Numbers = NDArray[np.float32]


@dataclass(frozen=True)
class Doubt:
    """The second head's weights: F features, H hidden units, K directions; D = len(FEATURES)."""

    centre: Numbers  # (F,)
    scale: Numbers  # (F,) z = (x - centre) * scale
    hidden_weight: Numbers  # (H, F)
    hidden_bias: Numbers  # (H,)
    weight: Numbers  # (D, H)
    bias: Numbers  # (D,) log(standard deviation) of m and rad
    low: Numbers  # (D,) limits of that logarithm: an image unlike any before says nothing...
    high: Numbers  # (D,) ...of use beyond them
    directions: Numbers  # (K, F) novelty = |directions z|^2; above 1: out of distribution

    def assess(self, x: Numbers) -> Numbers:
        """Last shared features (N, F) -> (N, D + 1): standard deviations (m, rad), novelty."""
        z = (x - self.centre) * self.scale
        hidden = np.maximum(z @ self.hidden_weight.T + self.hidden_bias, 0)
        logarithm = (hidden @ self.weight.T + self.bias).clip(self.low, self.high)
        novelty = ((z @ self.directions.T) ** 2).sum(1, keepdims=True)
        return np.concatenate([np.exp(logarithm), novelty], 1).astype(np.float32)


@dataclass(frozen=True)
class FittedDoubt:
    """A second head and what the model's card says of it."""

    head: Doubt
    about: dict[str, Any]


def write_doubt(run: Path, doubt: Doubt) -> None:
    """Write the second head of a run, whole or not at all."""
    from safetensors.numpy import save

    arrays = {f.name: np.ascontiguousarray(getattr(doubt, f.name)) for f in fields(Doubt)}
    write_whole(run / DOUBT, save(arrays))


def read_doubt(run: Path) -> Doubt:
    """The second head of the model in `run`; ModelError when it is damaged."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        return Doubt(**load_file(run / DOUBT))
    except (SafetensorError, TypeError, OSError) as error:
        raise ModelError(f"{run / DOUBT} cannot be read ({error}); train the model anew") from error
