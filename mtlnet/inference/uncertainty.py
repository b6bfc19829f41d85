"""The uncertainty head: a standard deviation for each feature, and an out-of-distribution score.

Standard deviations: two layers predict the logarithm of the standard deviation of the error of each
of `FEATURES` (Nix and Weigend 1994). Their inputs, all standardised, are the network's last shared
features (256,), the logarithms of the spreads (6,) if its heads are distributions over bins, and
the light of the image (10,) (`light_features`). Without the light the standard deviations are too
large in dusk and fog and too small in snow and heavy shadow. The network's nine outputs do not
change.

Out-of-distribution (OOD) score: the larger of two values. Each is scaled so that 1 is the limit of
what counts as known.

- The squared Mahalanobis distance of the image's texture features from those of the training frames
  (Lee et al. 2018). The last shared features do not serve: a network trained on roads maps other
  images near their mean. Measured on a model of 230 steps at 1 % false alarms: the last features
  detect 1 % of noise and text images, the texture features all of them.
- The square of the camera's pitch offset, predicted by two layers from the texture features of the
  image centre: a camera that looks up or down sees the same textures slightly higher or lower.

Computed in numpy; the exported graph computes the same.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from mtlnet.inference.model_card import UNCERTAINTY_WEIGHTS, ModelError
from mtlnet.inference.weights_file import read_weights
from runtime.files import atomic_write

FEATURES = (*tf.MARKINGS, "to_lane_centre", "angle")
"""Features that have a standard deviation, in m, and in rad for the angle."""
COLUMNS = len(FEATURES) + 1
CELL_ROWS, CELL_COLUMNS = 14, 8
BANDS = 3  # bands per cell; the pitch is predicted from the bands of the image centre
CENTRE_BANDS, CENTRE_COLUMNS = slice(9, 33), slice(2, 6)
PLANES = 5
CELL_VALUES = PLANES * CELL_ROWS * CELL_COLUMNS
CENTRE_VALUES = PLANES * 24 * 4
TEXTURE_VALUES = CELL_VALUES + CENTRE_VALUES
HALVES = 2  # upper and lower half of an image
LIGHT_VALUES = PLANES * HALVES
LIGHT_LIMIT = 3.0
"""Light features are clipped to this number of standard deviations of the training set, because the
head cannot extrapolate beyond them, especially for a model of one scene."""
SQRT_EPSILON = 1e-6
"""Added to a mean difference before the square root; the difference is 0 in a flat cell."""


@dataclass(frozen=True)
class UncertaintyHead:
    """Weights of the head: F inputs, H hidden units, D = len(FEATURES), C cell and M centre
    values."""

    centre: NDArray[np.float32]  # (F,)
    scale: NDArray[np.float32]  # (F,) z = (x - centre) * scale
    hidden_weight: NDArray[np.float32]  # (H, F)
    hidden_bias: NDArray[np.float32]  # (H,)
    weight: NDArray[np.float32]  # (D, H)
    bias: NDArray[np.float32]  # (D,) log(standard deviation) of m and rad
    low: NDArray[np.float32]  # (D,) lower limit of the logarithm, against extreme values
    high: NDArray[np.float32]  # (D,) upper limit of the logarithm
    texture_mean: NDArray[np.float32]  # (C,)
    texture_directions: NDArray[
        np.float32
    ]  # (C, C) distance = |directions (cells - mean)|^2; > 1: OOD
    pitch_centre: NDArray[np.float32]  # (M,)
    pitch_scale: NDArray[np.float32]  # (M,)
    pitch_hidden_weight: NDArray[np.float32]  # (H, M)
    pitch_hidden_bias: NDArray[np.float32]  # (H,)
    pitch_weight: NDArray[np.float32]  # (1, H)
    pitch_bias: NDArray[np.float32]  # (1,)

    def predict(self, x: NDArray[np.float32], textures: NDArray[np.float32]) -> NDArray[np.float32]:
        """Standard deviations and the OOD score, (N, D + 1).

        `x` (N, X): the network's inputs of this head; `textures` (N, C + M): see
        `texture_features`. A head fitted on fewer inputs reads only the first ones.
        """
        count = x.shape[1]
        if len(self.centre) > count:
            x = np.concatenate([x, light_features(textures)], 1)
        z = standardise(x[:, : len(self.centre)], self.centre, self.scale, count)
        hidden = np.maximum(z @ self.hidden_weight.T + self.hidden_bias, 0)
        log_std = (hidden @ self.weight.T + self.bias).clip(self.low, self.high)
        cells, centre = np.split(textures, [len(self.texture_mean)], 1)
        projected = (cells - self.texture_mean) @ self.texture_directions.T
        pitch = self.pitch_offset(centre)
        ood_score = np.maximum((projected**2).sum(1, keepdims=True), pitch**2)
        return np.concatenate([np.exp(log_std), ood_score], 1).astype(np.float32)

    def pitch_offset(self, centre: NDArray[np.float32]) -> NDArray[np.float32]:
        """Pitch of the camera relative to the training camera, (N, 1), positive downwards.

        `centre` (N, M): the texture features of the image centre. 1 is the limit of what counts as
        known.
        """
        z = (centre - self.pitch_centre) * self.pitch_scale
        hidden = np.maximum(z @ self.pitch_hidden_weight.T + self.pitch_hidden_bias, 0)
        offset: NDArray[np.float32] = hidden @ self.pitch_weight.T + self.pitch_bias
        return offset


TENSOR_NAMES = {"texture_mean": "usual", "texture_directions": "directions"} | {
    f"pitch_{name}": f"aim_{name}"
    for name in ("centre", "scale", "hidden_weight", "hidden_bias", "weight", "bias")
}
"""Tensor names in the file that differ from the fields' names."""


def texture_features(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Texture features (C + M,) of an image (H, W, 3): first all cells, then the bands of the
    centre.

    Each cell or band has mean colours, and the square roots of the mean absolute differences of
    brightness between horizontal and vertical neighbours. H and W must be multiples of the numbers
    of bands and columns.
    """
    pixels = image.astype(np.float32) * np.float32(1 / 127.5) - 1
    grey = pixels.mean(2, keepdims=True)
    across = np.abs(np.diff(grey, axis=1, append=grey[:, -1:]))
    down = np.abs(np.diff(grey, axis=0, append=grey[-1:]))
    bands, columns = CELL_ROWS * BANDS, CELL_COLUMNS
    height, width = image.shape[0] // bands, image.shape[1] // columns
    planes = np.concatenate([pixels, across, down], 2)
    narrow = planes.reshape(bands, height, columns, width, PLANES).mean((1, 3))
    cells = narrow.reshape(CELL_ROWS, BANDS, columns, PLANES).mean(1)
    parts = [cells, narrow[CENTRE_BANDS, CENTRE_COLUMNS].copy()]
    for part in parts:
        part[..., 3:] = np.sqrt(part[..., 3:] + SQRT_EPSILON)
    return np.concatenate([part.transpose(2, 0, 1).reshape(-1) for part in parts]).astype(
        np.float32
    )


def standardise(
    x: NDArray[np.float32], centre: NDArray[np.float32], scale: NDArray[np.float32], count: int
) -> NDArray[np.float32]:
    """Standardised inputs (N, F) of the standard deviations.

    The first `count` values are the network's; the others are the light, which is clipped.
    """
    z: NDArray[np.float32] = (x - centre) * scale
    z[:, count:] = z[:, count:].clip(-LIGHT_LIMIT, LIGHT_LIMIT)
    return z


def light_features(textures: NDArray[np.float32]) -> NDArray[np.float32]:
    """Light features (N, LIGHT_VALUES) from textures (N, C + M): the mean of each texture plane
    over the upper half, then over the lower half of the image."""
    cells = textures[:, :CELL_VALUES].reshape(len(textures), PLANES, HALVES, -1)
    light: NDArray[np.float32] = cells.mean(3).reshape(len(textures), LIGHT_VALUES)
    return light


@dataclass(frozen=True)
class FittedUncertainty:
    """An uncertainty head and the description of its fit, for the model card."""

    head: UncertaintyHead
    about: dict[str, Any]


def write_uncertainty_head(run: Path, head: UncertaintyHead) -> None:
    """Write the uncertainty head of a run, atomically."""
    from safetensors.numpy import save

    arrays = {
        TENSOR_NAMES.get(field.name, field.name): np.ascontiguousarray(getattr(head, field.name))
        for field in fields(UncertaintyHead)
    }
    atomic_write(run / UNCERTAINTY_WEIGHTS, save(arrays), fsync=True)


def read_uncertainty_head(run: Path) -> UncertaintyHead:
    """The uncertainty head of the model in `run`. Raises ModelError when it is damaged."""
    path = run / UNCERTAINTY_WEIGHTS
    names = {tensor: field for field, tensor in TENSOR_NAMES.items()}
    try:
        return UncertaintyHead(
            **{names.get(n, n): array for n, array in read_weights(path).items()}
        )
    except (ModelError, TypeError, OSError) as error:
        raise ModelError(f"{path} cannot be read ({error}); train the model again") from error
