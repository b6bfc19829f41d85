"""How far an answer is to be trusted: a standard deviation a feature, and how strange the image is.

A small second head reads the network's last shared features x (256,), standardised to z, and gives
the standard deviation of the error of each of `FEATURES` by two layers, as a logarithm (Nix and
Weigend 1994). The network's own nine outputs are left as they are.

The novelty of an image is the squared Mahalanobis distance of its `texture` from the training
frames (Lee et al. 2018), in units of the largest that counts as known. Of the texture, not of the
last features: a network that has learned to see a road answers anything else with features near
their mean. Measured on a model of 230 steps, at 1 % false alarms: 1 % of noise and text found by
the last features, all of it by the texture.

A camera that looks up or down shows the same textures a little higher or lower. From the middle of
the picture two layers tell how far (`mtlnet.uncertainty_fit.camera_pitch`), in units of what counts
as known too; the greater of both squares is the novelty.

In numpy; the exported graph computes the same.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.model_card import DOUBT, ModelError
from runtime.files import atomic_write

FEATURES = (*tf.MARKINGS, "to_lane_centre", "angle")
"""What has a standard deviation: m, and rad for the angle."""
COLUMNS = len(FEATURES) + 1
ROWS_OF_CELLS, COLUMNS_OF_CELLS = 14, 8
BANDS = 3  # in the height of a cell: aims are read from them, in the middle of the picture
MIDDLE_BANDS, MIDDLE_COLUMNS = slice(9, 33), slice(2, 6)
PLANES = 5
CELLS = PLANES * ROWS_OF_CELLS * COLUMNS_OF_CELLS
MIDDLE = PLANES * 24 * 4
TEXTURE = CELLS + MIDDLE
SMALLEST = 1e-6
"""Of a mean difference before its root: a flat cell has none."""

Numbers = NDArray[np.float32]


@dataclass(frozen=True)
class UncertaintyHead:
    """The second head's weights: F features, H hidden units, K directions; D = len(FEATURES)."""

    centre: Numbers  # (F,)
    scale: Numbers  # (F,) z = (x - centre) * scale
    hidden_weight: Numbers  # (H, F)
    hidden_bias: Numbers  # (H,)
    weight: Numbers  # (D, H)
    bias: Numbers  # (D,) log(standard deviation) of m and rad
    low: Numbers  # (D,) limits of that logarithm: an image unlike any before says nothing...
    high: Numbers  # (D,) ...of use beyond them
    usual: Numbers  # (C,) the mean of the textures' cells
    directions: Numbers  # (K, C) novelty = |directions (cells - usual)|^2; above 1: strange
    aim_centre: Numbers  # (M,) of the middle
    aim_scale: Numbers  # (M,)
    aim_hidden_weight: Numbers  # (H, M)
    aim_hidden_bias: Numbers  # (H,)
    aim_weight: Numbers  # (1, H) how far down the camera looks, so that...
    aim_bias: Numbers  # (1,) ...novelty = aim^2

    def assess(self, x: Numbers, textures: Numbers) -> Numbers:
        """Last shared features (N, F), textures (N, T) -> (N, D + 1): deviations, novelty."""
        z = (x - self.centre) * self.scale
        hidden = np.maximum(z @ self.hidden_weight.T + self.hidden_bias, 0)
        logarithm = (hidden @ self.weight.T + self.bias).clip(self.low, self.high)
        cells, middle = np.split(textures, [len(self.usual)], 1)
        along = (cells - self.usual) @ self.directions.T
        aim = self.aim(middle)
        novelty = np.maximum((along**2).sum(1, keepdims=True), aim**2)
        return np.concatenate([np.exp(logarithm), novelty], 1).astype(np.float32)

    def aim(self, middle: Numbers) -> Numbers:
        """How far down, beyond their own, cameras of these middles (N, M) look: (N, 1)."""
        z = (middle - self.aim_centre) * self.aim_scale
        hidden = np.maximum(z @ self.aim_hidden_weight.T + self.aim_hidden_bias, 0)
        off: Numbers = hidden @ self.aim_weight.T + self.aim_bias
        return off


def texture(image: NDArray[np.uint8]) -> Numbers:
    """What an image (H, W, 3) is made of (T,): cell by cell, then band by band in its middle.

    Colours, and the roots of the mean differences of brightness between neighbours, across and
    down. H, W: multiples of the bands and cells.
    """
    pixels = image.astype(np.float32) * np.float32(1 / 127.5) - 1
    grey = pixels.mean(2, keepdims=True)
    across = np.abs(np.diff(grey, axis=1, append=grey[:, -1:]))
    down = np.abs(np.diff(grey, axis=0, append=grey[-1:]))
    bands, columns = ROWS_OF_CELLS * BANDS, COLUMNS_OF_CELLS
    height, width = image.shape[0] // bands, image.shape[1] // columns
    planes = np.concatenate([pixels, across, down], 2)
    narrow = planes.reshape(bands, height, columns, width, PLANES).mean((1, 3))
    cells = narrow.reshape(ROWS_OF_CELLS, BANDS, columns, PLANES).mean(1)
    parts = [cells, narrow[MIDDLE_BANDS, MIDDLE_COLUMNS].copy()]
    for part in parts:
        part[..., 3:] = np.sqrt(part[..., 3:] + SMALLEST)
    return np.concatenate([part.transpose(2, 0, 1).reshape(-1) for part in parts]).astype(
        np.float32
    )


@dataclass(frozen=True)
class FittedDoubt:
    """A second head and what the model's card says of it."""

    head: UncertaintyHead
    about: dict[str, Any]


def write_doubt(run: Path, doubt: UncertaintyHead) -> None:
    """Write the second head of a run, whole or not at all."""
    from safetensors.numpy import save

    arrays = {f.name: np.ascontiguousarray(getattr(doubt, f.name)) for f in fields(UncertaintyHead)}
    atomic_write(run / DOUBT, save(arrays), fsync=True)


def read_doubt(run: Path) -> UncertaintyHead:
    """The second head of the model in `run`; ModelError when it is damaged."""
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        return UncertaintyHead(**load_file(run / DOUBT))
    except (SafetensorError, TypeError, OSError) as error:
        raise ModelError(f"{run / DOUBT} cannot be read ({error}); train the model anew") from error
