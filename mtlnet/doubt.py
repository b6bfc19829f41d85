"""How far an answer is to be trusted: a standard deviation a feature, and how strange the image is.

A small second head reads the network's last shared features x (256,), standardised to z, and gives
the standard deviation of the error of each of `FEATURES` by two layers, as a logarithm (Nix and
Weigend 1994). The network's own nine outputs are left as they are.

The novelty of an image is the squared Mahalanobis distance of its `texture` from the training
frames (Lee et al. 2018), in units of the largest that counts as known. Of the texture, not of the
last features: a network that has learned to see a road answers anything else with features near
their mean. Measured on a model of 230 steps, at 1 % false alarms: 1 % of noise and text found by
the last features, all of it by the texture.

In numpy; the exported graph computes the same.
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
ROWS_OF_CELLS, COLUMNS_OF_CELLS = 14, 8
TEXTURE = 5 * ROWS_OF_CELLS * COLUMNS_OF_CELLS
SMALLEST = 1e-6
"""Of a mean difference before its root: a flat cell has none."""

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
    usual: Numbers  # (T,) the mean texture
    directions: Numbers  # (K, T) novelty = |directions (texture - usual)|^2; above 1: strange

    def assess(self, x: Numbers, textures: Numbers) -> Numbers:
        """Last shared features (N, F), textures (N, T) -> (N, D + 1): deviations, novelty."""
        z = (x - self.centre) * self.scale
        hidden = np.maximum(z @ self.hidden_weight.T + self.hidden_bias, 0)
        logarithm = (hidden @ self.weight.T + self.bias).clip(self.low, self.high)
        along = (textures - self.usual) @ self.directions.T
        novelty = (along**2).sum(1, keepdims=True)
        return np.concatenate([np.exp(logarithm), novelty], 1).astype(np.float32)


def texture(image: NDArray[np.uint8]) -> Numbers:
    """What an image (H, W, 3) is made of, cell by cell (T,): colours, and the roots of the mean
    differences of brightness between neighbours, across and down. H, W: multiples of the cells."""
    pixels = image.astype(np.float32) * np.float32(1 / 127.5) - 1
    grey = pixels.mean(2, keepdims=True)
    across = np.abs(np.diff(grey, axis=1, append=grey[:, -1:]))
    down = np.abs(np.diff(grey, axis=0, append=grey[-1:]))
    height, width = image.shape[0] // ROWS_OF_CELLS, image.shape[1] // COLUMNS_OF_CELLS
    planes = np.concatenate([pixels, across, down], 2)
    cells = planes.reshape(ROWS_OF_CELLS, height, COLUMNS_OF_CELLS, width, 5).mean((1, 3))
    cells[..., 3:] = np.sqrt(cells[..., 3:] + SMALLEST)
    return np.ascontiguousarray(cells.transpose(2, 0, 1)).reshape(-1).astype(np.float32)


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
