"""The uncertainty head: a standard deviation for each feature, and an out-of-distribution score.

Standard deviations: two layers on the network's last shared features (256,), on the logarithms of
the spreads (6,) where its heads are distributions over bins, and on the light of the image (10,)
(`light_features`), all standardised, predict the logarithm of the standard deviation of the error
of each of `FEATURES` (Nix and Weigend 1994). Without the light they are too large in dusk and fog
and too small in snow and heavy shadow. The network's nine outputs do not change.

Out-of-distribution (OOD) score: the larger of two values, each scaled so that 1 is the limit of
what counts as known.

- The squared Mahalanobis distance of the image's texture features from those of the training frames
  (Lee et al. 2018). Not of the last shared features: a network trained on roads maps other images
  near their mean. Measured on a model of 230 steps at 1 % false alarms: the last features detect
  1 % of noise and text images, the texture features all of them.
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
"""Features with a standard deviation: m, and rad for the angle."""
COLUMNS = len(FEATURES) + 1
CELL_ROWS, CELL_COLUMNS = 14, 8
BANDS = 3  # bands in the height of a cell; the pitch is predicted from those of the image centre
CENTRE_BANDS, CENTRE_COLUMNS = slice(9, 33), slice(2, 6)
PLANES = 5
CELL_VALUES = PLANES * CELL_ROWS * CELL_COLUMNS
CENTRE_VALUES = PLANES * 24 * 4
TEXTURE_VALUES = CELL_VALUES + CENTRE_VALUES
HALVES = 2  # the rows of an image above and below its middle
LIGHT_VALUES = PLANES * HALVES
LIGHT_LIMIT = 3.0
"""Light that is more standard deviations from the usual one counts as so many: nothing is known of
the errors there, above all by a model of one scene."""
SQRT_EPSILON = 1e-6
"""Added to a mean difference before its square root; the difference is 0 in a flat cell."""

Numbers = NDArray[np.float32]


@dataclass(frozen=True)
class UncertaintyHead:
    """Weights: F features, H hidden units, D = len(FEATURES), C cell and M centre values."""

    centre: Numbers  # (F,)
    scale: Numbers  # (F,) z = (x - centre) * scale
    hidden_weight: Numbers  # (H, F)
    hidden_bias: Numbers  # (H,)
    weight: Numbers  # (D, H)
    bias: Numbers  # (D,) log(standard deviation) of m and rad
    low: Numbers  # (D,) lower limit of that logarithm: unfamiliar images give extreme values
    high: Numbers  # (D,) upper limit
    texture_mean: Numbers  # (C,)
    texture_directions: Numbers  # (C, C) distance = |directions (cells - mean)|^2; > 1: OOD
    pitch_centre: Numbers  # (M,)
    pitch_scale: Numbers  # (M,)
    pitch_hidden_weight: Numbers  # (H, M)
    pitch_hidden_bias: Numbers  # (H,)
    pitch_weight: Numbers  # (1, H)
    pitch_bias: Numbers  # (1,)

    def predict(self, x: Numbers, textures: Numbers) -> Numbers:
        """Standard deviations and the OOD score, (N, D + 1).

        `x` (N, X): the network's inputs of this head; `textures` (N, C + M): see
        `texture_features`. A head fitted on fewer inputs reads the first ones.
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

    def pitch_offset(self, centre: Numbers) -> Numbers:
        """Pitch of the camera relative to the training camera, (N, 1), down positive.

        From the centre part of the texture features (N, M); 1 is the limit of what counts as known.
        """
        z = (centre - self.pitch_centre) * self.pitch_scale
        hidden = np.maximum(z @ self.pitch_hidden_weight.T + self.pitch_hidden_bias, 0)
        offset: Numbers = hidden @ self.pitch_weight.T + self.pitch_bias
        return offset


TENSOR_NAMES = {"texture_mean": "usual", "texture_directions": "directions"} | {
    f"pitch_{name}": f"aim_{name}"
    for name in ("centre", "scale", "hidden_weight", "hidden_bias", "weight", "bias")
}
"""Names of fields in the file, where they differ."""


def texture_features(image: NDArray[np.uint8]) -> Numbers:
    """Texture features (C + M,) of an image (H, W, 3): all cells, then the bands of the centre.

    Each has mean colours, and the square roots of the mean absolute differences of brightness
    between neighbouring pixels, across and down. H and W: multiples of the numbers of bands and
    columns.
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


def standardise(x: Numbers, centre: Numbers, scale: Numbers, count: int) -> Numbers:
    """What the standard deviations are predicted from, x (N, F), standardised.

    The first `count` values are the network's, the others the light, which is limited.
    """
    z: Numbers = (x - centre) * scale
    z[:, count:] = z[:, count:].clip(-LIGHT_LIMIT, LIGHT_LIMIT)
    return z


def light_features(textures: Numbers) -> Numbers:
    """Means (N, LIGHT_VALUES) over the cells of each half of an image, of textures (N, C + M): of
    each texture plane above the middle, then below it."""
    cells = textures[:, :CELL_VALUES].reshape(len(textures), PLANES, HALVES, -1)
    light: Numbers = cells.mean(3).reshape(len(textures), LIGHT_VALUES)
    return light


@dataclass(frozen=True)
class FittedUncertainty:
    """An uncertainty head and how it was fitted, for the model card."""

    head: UncertaintyHead
    about: dict[str, Any]


def write_uncertainty_head(run: Path, head: UncertaintyHead) -> None:
    """Write a run's uncertainty head, atomically."""
    from safetensors.numpy import save

    arrays = {
        TENSOR_NAMES.get(field.name, field.name): np.ascontiguousarray(getattr(head, field.name))
        for field in fields(UncertaintyHead)
    }
    atomic_write(run / UNCERTAINTY_WEIGHTS, save(arrays), fsync=True)


def read_uncertainty_head(run: Path) -> UncertaintyHead:
    """The uncertainty head of the model in `run`; ModelError when it is damaged."""
    path = run / UNCERTAINTY_WEIGHTS
    names = {tensor: field for field, tensor in TENSOR_NAMES.items()}
    try:
        return UncertaintyHead(
            **{names.get(n, n): array for n, array in read_weights(path).items()}
        )
    except (ModelError, TypeError, OSError) as error:
        raise ModelError(f"{path} cannot be read ({error}); train the model again") from error
