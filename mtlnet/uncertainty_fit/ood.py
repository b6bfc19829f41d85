"""Fits the out-of-distribution score: texture distance and camera pitch.

The pitch regressor needs images of cameras with other pitches. They are made from training frames
by homographies, which are exact for a rotation about the optical centre (Hartley and Zisserman
2004, section 8.4). Only views whose image centre lies within the frame are used, so that no
extrapolated border is visible.

The field of view of these images varies too but is not predicted: on a straight flat road a wider
view looks like the view of a higher camera, except for the length of dashes. A regressor of the
field of view was tried; it detected only 2 to 5 % of the frames with another field of view.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mtlnet.data.augment.geometric import rotation_homography
from mtlnet.data.loader import Images
from mtlnet.model.textures import (
    BANDS,
    CELL_COLUMNS,
    CELL_ROWS,
    CELL_VALUES,
    CENTRE_BANDS,
    CENTRE_COLUMNS,
    texture_features,
)
from mtlnet.model.uncertainty_head import TwoLayers
from trackfeatures.camera import CameraParameters

MIN_SPREAD = 0.05
"""Lower limit of a texture value's standard deviation, because a cell of the image can be without
texture in all training frames."""
RIDGE = 0.02
"""Added to the variance along each principal axis of standardised textures, against overfitting."""
MAX_PITCH_RAD, MAX_LOG_ZOOM = 0.26, 0.5
"""Limits of the random views: pitch (rad, 15 degrees), and logarithm of the ratio of the tangents
of half the field of view."""
PITCH_FRAMES, VIEWS_PER_FRAME = 1_500, 2
CELL_NOISE = 1 / 255
"""Half a grey level, on the scale -1 to 1 of the texture features. If all training images are
equal, an image that differs from them by this much in each cell is not out of distribution."""
PITCH_UNIT_RAD = 0.1  # unit of the regression target
MIN_PITCH_LIMIT_RAD = 0.02
"""A predicted pitch whose absolute value (rad) is below this limit is never out of distribution,
even if the pitches predicted for the held-out frames, when these are few, vary less."""
HIDDEN = 64


@dataclass(frozen=True)
class FitSettings:
    """Settings of the training of a small regressor with AdamW: `steps` batches of `batch` rows."""

    steps: int
    batch: int
    learning_rate: float
    weight_decay: float


FIT = FitSettings(steps=800, batch=256, learning_rate=3e-3, weight_decay=0.1)


def fit_texture_distance(
    known: NDArray[np.float32], held_out: NDArray[np.float32], false_alarm_rate: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Fit the Mahalanobis distance of texture values (N, C) on the frames `known`. Returns the mean
    (C,) and a matrix of directions (C, C): the squared distance of x is |directions (x - mean)|^2.

    The directions are scaled so that the squared distance exceeds 1 in at most a share
    `false_alarm_rate` of the frames `held_out`.
    """
    mean, spread = known.mean(0), np.maximum(known.std(0), MIN_SPREAD)
    covariance = np.cov((known - mean) / spread, rowvar=False, ddof=min(1, len(known) - 1))
    variance, axes = np.linalg.eigh(covariance)
    directions = (axes / np.sqrt(np.maximum(variance, 0) + RIDGE)).T / spread
    squared = (((held_out - mean) @ directions.T) ** 2).sum(1)
    limit = max(
        float(np.quantile(squared, 1 - false_alarm_rate)), CELL_NOISE**2 * (directions**2).sum()
    )
    return mean, np.asarray(directions / np.sqrt(limit), np.float32)


def draw_view(camera: CameraParameters, rng: np.random.Generator) -> tuple[float, float]:
    """Return a random pitch (rad, positive downwards) and zoom of a view whose image centre lies
    within the frame. The zoom is the logarithm of the ratio of the tangents of half the field of
    view."""
    while True:
        pitch = rng.uniform(-MAX_PITCH_RAD, MAX_PITCH_RAD)
        log_zoom = rng.uniform(-MAX_LOG_ZOOM, MAX_LOG_ZOOM)
        if _centre_in_frame(camera, pitch, log_zoom):
            return pitch, log_zoom


def view_homography(camera: CameraParameters, pitch: float, log_zoom: float) -> NDArray[np.float64]:
    """Return the homography (3, 3) from pixels of `camera` to pixels of a camera with another view.

    The second camera is pitched down by `pitch` (rad), and the tangents of half its field of view
    are exp(`log_zoom`) times as large.
    """
    u0, v0 = (camera.width - 1) / 2, (camera.height - 1) / 2
    scale = np.exp(-log_zoom)
    zoom = np.array([[scale, 0, u0 * (1 - scale)], [0, scale, v0 * (1 - scale)], [0, 0, 1]])
    homography: NDArray[np.float64] = zoom @ rotation_homography(camera, 0.0, pitch)
    return homography


def _centre_in_frame(camera: CameraParameters, pitch: float, log_zoom: float) -> bool:
    band = camera.height // (CELL_ROWS * BANDS)
    cell = camera.width // CELL_COLUMNS
    # `stop` is one pixel beyond the centre: differences use the next pixel.
    x = np.array([CENTRE_COLUMNS.start, CENTRE_COLUMNS.stop]) * cell
    y = np.array([CENTRE_BANDS.start, CENTRE_BANDS.stop]) * band
    corners = np.array([[a, b, 1] for a in x for b in y]).T
    u, v, w = np.linalg.inv(view_homography(camera, pitch, log_zoom)) @ corners
    u, v = u / w, v / w
    inside = (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
    return bool(inside.all() and (w > 0).all())


def pitched_views(
    frames: Images, camera: CameraParameters, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the texture features (N, M) of the image centre for frames warped to other pitches,
    and the pitches (N,) relative to `camera`, rad, positive downwards."""
    rng = np.random.default_rng([seed, 4])
    chosen = np.linspace(0, len(frames) - 1, min(PITCH_FRAMES, len(frames))).astype(np.int64)
    image = np.empty((1, camera.height, camera.width, 3), np.uint8)
    size = (camera.width, camera.height)
    centres, pitches = [], []
    for row in chosen:
        frames.read_batch(np.array([row]), image)
        for _ in range(VIEWS_PER_FRAME):
            pitch, log_zoom = draw_view(camera, rng)
            homography = view_homography(camera, pitch, log_zoom)
            view = cv2.warpPerspective(
                image[0], homography, size, borderMode=cv2.BORDER_REFLECT_101
            )
            textures = texture_features(torch.from_numpy(view.astype(np.uint8, copy=False)[None]))
            centres.append(textures[0, CELL_VALUES:].numpy())
            pitches.append(pitch)
    return np.array(centres), np.array(pitches, np.float32)


def fit_pitch_offset(
    known: NDArray[np.float32],
    views: tuple[NDArray[np.float32], NDArray[np.float32]],
    held_out: NDArray[np.float32],
    false_alarm_rate: float,
    seed: int,
) -> dict[str, NDArray[np.float32]]:
    """Fit the two layers that predict the camera's pitch from centre texture features; returns
    their tensors by name, a part of the state of `UncertaintyHead`.

    `known` (N, M), `held_out` (K, M): centre texture features of unchanged frames; `views`: the
    result of `pitched_views`, features (V, M) and pitches (V,) in rad. The prediction is shifted
    and scaled so that its median over the held-out frames is 0, and its absolute value exceeds 1 in
    at most a share `false_alarm_rate` of them.
    """
    x = np.concatenate([known, views[0]])
    target = np.concatenate([np.zeros(len(known), np.float32), views[1] / PITCH_UNIT_RAD])[:, None]
    centre, scale = x.mean(0), 1 / np.maximum(x.std(0), 0.02)
    hidden_weight, hidden_bias, weight, bias = _train(
        torch.from_numpy((x - centre) * scale), torch.from_numpy(target), seed
    )
    hidden = np.maximum(((held_out - centre) * scale) @ hidden_weight.T + hidden_bias, 0)
    predicted = hidden @ weight.T + bias
    zero = np.median(predicted)
    limit = max(
        float(np.quantile(np.abs(predicted - zero), 1 - false_alarm_rate)),
        MIN_PITCH_LIMIT_RAD / PITCH_UNIT_RAD,
    )
    return {
        "pitch_centre": centre.astype(np.float32),
        "pitch_scale": scale.astype(np.float32),
        "pitch.first.weight": hidden_weight,
        "pitch.first.bias": hidden_bias,
        "pitch.second.weight": (weight / limit).astype(np.float32),
        "pitch.second.bias": ((bias - zero) / limit).astype(np.float32),
    }


def _train(z: Tensor, target: Tensor, seed: int) -> list[NDArray[np.float32]]:
    """Fit two layers from `z` (N, M) to `target` (N, 1) with the smooth L1 loss; returns weight and
    bias of the first and of the second layer."""
    generator = torch.Generator().manual_seed(seed)
    layers = TwoLayers(z.shape[1], HIDDEN, 1)
    with torch.no_grad():
        for layer in (layers.first, layers.second):
            layer.weight.normal_(0.0, layer.in_features**-0.5, generator=generator)
            layer.bias.zero_()

    def loss(rows: Tensor) -> Tensor:
        return nn.functional.smooth_l1_loss(layers(z[rows]), target[rows], beta=0.1)

    parameters = list(layers.parameters())
    minimise(loss, parameters, len(z), FIT, generator)
    return [parameter.detach().numpy() for parameter in parameters]


def minimise(
    loss: Callable[[Tensor], Tensor],
    parameters: Iterable[nn.Parameter],
    count: int,
    settings: FitSettings,
    generator: torch.Generator,
) -> None:
    """Minimise `loss(rows)` over the `parameters`; `rows` (batch,) are random indices of `count`
    samples. The optimiser is AdamW, with a learning rate that falls to 0 along a cosine.
    """
    optimizer = torch.optim.AdamW(
        parameters, settings.learning_rate, weight_decay=settings.weight_decay, fused=True
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(settings.steps, 1))
    for _ in range(settings.steps):
        value = loss(torch.randint(count, (min(settings.batch, count),), generator=generator))
        optimizer.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        optimizer.step()
        schedule.step()
