"""Fitting what tells how far up or down a picture's camera looks.

Nobody records with a wrong camera for this: training frames are turned and widened by homographies,
which is exact, whatever the scene (Hartley and Zisserman 2004, section 8.4). Only turns whose
middle of the picture lies within the frame are taken, so that no made-up border is ever seen.

The width of the view is varied but not told: a wider view of a straight road on a plane is that of
a camera further up, but for the length of dashes. Tried: it is told of 2 to 5 % of the frames.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mtlnet.data.augment.pipeline import homography
from mtlnet.data.loader import Images
from mtlnet.inference.uncertainty import (
    BANDS,
    CELL_VALUES,
    CELL_COLUMNS,
    CENTRE_BANDS,
    CENTRE_COLUMNS,
    CELL_ROWS,
    texture,
)
from trackfeatures.camera import CameraParameters

MOST_PITCH_RAD, MOST_WIDER = 0.26, 0.5
"""15 degrees, and so many times wider or narrower as a logarithm of the tangent."""
FRAMES, TURNED = 1_500, 2  # frames looked at, and how often each is turned
UNIT_RAD = 0.1  # what is learned is told in
LEAST_RAD = 0.02
"""Whatever few frames of one road say: turns up to this are not strange."""
HIDDEN, STEPS, BATCH, RATE, DECAY = 64, 800, 256, 3e-3, 0.1

Numbers = NDArray[np.float32]


@dataclass(frozen=True)
class Layer:
    """weight (N, M) and bias (N,)."""

    weight: Numbers
    bias: Numbers


def draw_aim(camera: CameraParameters, rng: np.random.Generator) -> tuple[float, float]:
    """Another aim: pitch (rad, down) and width (logarithm); the middle shows only what is there."""
    while True:
        pitch = rng.uniform(-MOST_PITCH_RAD, MOST_PITCH_RAD)
        wider = rng.uniform(-MOST_WIDER, MOST_WIDER)
        if _within(camera, pitch, wider):
            return pitch, wider


def aimed(camera: CameraParameters, pitch: float, wider: float) -> NDArray[np.float64]:
    """Where pixels go, (3, 3), when the camera looks `pitch` (rad) further down and sees
    exp(`wider`) times as far to the sides."""
    across, down = (camera.width - 1) / 2, (camera.height - 1) / 2
    by = np.exp(-wider)
    scale = np.array([[by, 0, across * (1 - by)], [0, by, down * (1 - by)], [0, 0, 1]])
    moved: NDArray[np.float64] = scale @ homography(camera, 0.0, pitch)
    return moved


def _within(camera: CameraParameters, pitch: float, wider: float) -> bool:
    band = camera.height // (CELL_ROWS * BANDS)
    cell = camera.width // CELL_COLUMNS
    # One pixel more: differences reach to the next.
    x = np.array([CENTRE_COLUMNS.start, CENTRE_COLUMNS.stop]) * cell
    y = np.array([CENTRE_BANDS.start, CENTRE_BANDS.stop]) * band
    corners = np.array([[a, b, 1] for a in x for b in y]).T
    u, v, w = np.linalg.inv(aimed(camera, pitch, wider)) @ corners
    u, v = u / w, v / w
    inside = (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
    return bool(inside.all() and (w > 0).all())


def turn_frames(frames: Images, camera: CameraParameters, seed: int) -> tuple[Numbers, Numbers]:
    """Middles (N, M) of frames seen by other cameras, and how far down these look (N,), rad."""
    rng = np.random.default_rng([seed, 4])
    chosen = np.linspace(0, len(frames) - 1, min(FRAMES, len(frames))).astype(np.int64)
    image = np.empty((1, camera.height, camera.width, 3), np.uint8)
    middles, pitches = [], []
    for row in chosen:
        frames.read_batch(np.array([row]), image)
        for _ in range(TURNED):
            aim = draw_aim(camera, rng)
            size = (camera.width, camera.height)
            turned = cv2.warpPerspective(
                image[0], aimed(camera, *aim), size, borderMode=cv2.BORDER_REFLECT_101
            )
            middles.append(texture(turned.astype(np.uint8, copy=False))[CELL_VALUES:])
            pitches.append(aim[0])
    return np.array(middles), np.array(pitches, np.float32)


def fit_aim(
    known: Numbers,
    turned: tuple[Numbers, Numbers],
    held_out: Numbers,
    false_alarms: float,
    seed: int,
) -> dict[str, Numbers]:
    """The layers that tell how far up or down a camera looks, as `UncertaintyHead` names them.

    From middles (N, M) of known frames and those of `turn_frames`. In units that `false_alarms` of
    the middles held out reach.
    """
    x = np.concatenate([known, turned[0]])
    target = np.concatenate([np.zeros(len(known), np.float32), turned[1] / UNIT_RAD])[:, None]
    centre, scale = x.mean(0), 1 / np.maximum(x.std(0), 0.02)
    first, second = _fit(torch.from_numpy((x - centre) * scale), torch.from_numpy(target), seed)
    hidden = np.maximum(((held_out - centre) * scale) @ first.weight.T + first.bias, 0)
    off = hidden @ second.weight.T + second.bias
    usual = np.median(off)
    limit = max(float(np.quantile(np.abs(off - usual), 1 - false_alarms)), LEAST_RAD / UNIT_RAD)
    return {
        "aim_centre": centre.astype(np.float32),
        "aim_scale": scale.astype(np.float32),
        "aim_hidden_weight": first.weight,
        "aim_hidden_bias": first.bias,
        "aim_weight": (second.weight / limit).astype(np.float32),
        "aim_bias": ((second.bias - usual) / limit).astype(np.float32),
    }


def _fit(z: torch.Tensor, target: torch.Tensor, seed: int) -> tuple["Layer", "Layer"]:
    """Two layers z (N, M) -> target (N, 1), with the least absolute errors."""
    generator = torch.Generator().manual_seed(seed)
    layers = torch.nn.Linear(z.shape[1], HIDDEN), torch.nn.Linear(HIDDEN, 1)
    with torch.no_grad():
        for layer in layers:
            layer.weight.normal_(0.0, layer.in_features**-0.5, generator=generator)
            layer.bias.zero_()
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    optimiser = torch.optim.AdamW(parameters, RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        rows = torch.randint(len(z), (min(BATCH, len(z)),), generator=generator)
        told = layers[1](layers[0](z[rows]).relu())
        loss = torch.nn.functional.smooth_l1_loss(told, target[rows], beta=0.1)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        optimiser.step()
        schedule.step()
    first, second = (
        Layer(layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers
    )
    return first, second
