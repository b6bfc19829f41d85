"""Fitting the second head of a trained network (`mtlnet.inference.uncertainty`), the network itself
frozen.

Errors on frames the network has learned from are too small to learn doubt from, so some train
rounds are kept out of training: from them come the temperatures of the head and the limit of
novelty.
"""

import hashlib
import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import trackfeatures as tf
from datagen.recording import Dataset, Frames
from mtlnet.data.loader import Images
from mtlnet.evaluation.metrics import coverage, signed_errors
from mtlnet.export.openvino_graph import build_feature_graph
from mtlnet.inference.engine import best_precision
from mtlnet.inference.prediction import OUTPUTS
from mtlnet.inference.uncertainty import (
    CELL_VALUES,
    FEATURES,
    TEXTURE_VALUES,
    FittedUncertainty,
    UncertaintyHead,
    texture,
)
from mtlnet.model.network import HEIGHT, WIDTH, Network
from mtlnet.uncertainty_fit.camera_pitch import fit_aim, turn_frames
from trackfeatures.camera import CameraParameters

HELD_OUT_SHARE = 1 / 12
LEAST_ROUNDS = 8
"""With fewer train rounds none can be spared: doubt is then fitted to what was learned from."""
FALSE_ALARMS = 0.01
"""Share of known frames that are called out of distribution, half of them for their texture."""
LEARNED_FRAMES, HELD_OUT_FRAMES = 3_000, 4_000  # at most so many are looked at
HIDDEN = 32
STEPS, BATCH, RATE, DECAY = 250, 256, 1e-2, 3e-2
FOLDS = 3
LEAST_ACTIVE = 30  # frames from which a feature has a temperature of its own
CHUNK = 32  # images through the network at once
LEAST_SHARE, MOST_SHARE = 0.1, 20.0  # limits of a standard deviation, as a share of the usual one
COVERED = 0.6827  # of a normal distribution, within one standard deviation
LEAST_SPREAD = 0.05
"""Of a texture's cell: one that happens to be flat in all training frames may differ as much."""
RIDGE = 0.02
"""Added to the variance along each direction (of standardised textures): narrow ones are noise."""

Numbers = NDArray[np.float32]


def hold_out(dataset: Dataset) -> tuple[Frames, Frames | None]:
    """The train rounds of a dataset: those to learn from, and those kept for fitting doubt.

    The same for the same rounds, whatever their order; one of a track and light that several have
    is kept before one of its own kind.
    """
    rounds = [info for info in dataset.rounds if info.split == "train"]
    ids = {info.id: {info.track, *info.lights} for info in rounds}
    if len(ids) < LEAST_ROUNDS:
        return dataset.select("train"), None
    kept: list[str] = []
    order = sorted(ids, key=lambda name: hashlib.sha256(name.encode()).digest())
    for _ in range(round(len(ids) * HELD_OUT_SHARE) or 1):
        seen = [kind for name in kept for kind in ids[name]]
        left = [name for name in order if name not in kept]
        kept.append(min(left, key=lambda name: sum(seen.count(kind) for kind in ids[name])))
    return _frames(dataset, [n for n in ids if n not in kept]), _frames(dataset, kept)


def _frames(dataset: Dataset, names: list[str]) -> Frames:
    chosen = [i for i, info in enumerate(dataset.rounds) if info.id in names]
    return Frames(
        [dataset.rounds[i] for i in chosen], [dataset.indexes[i] for i in chosen], dataset.camera
    )


@dataclass(frozen=True)
class Seen:
    """Frames as a frozen network sees them.

    Last shared features (N, F), errors (N, D) in m and rad, textures (N, T).

    An error is NaN where the label or, for `to_lane_centre`, the answer has none.
    """

    x: Numbers
    error: Numbers
    texture: Numbers


def fit_uncertainty_head(
    network: Network,
    learned: Images,
    held_out: Images | None,
    seed: int,
    camera: CameraParameters | None = None,
) -> FittedUncertainty:
    """The second head of `network` (folded), fitted on frames held out of its training.

    Without any, on those learned from: it then trusts the network too much, and the card says so.
    """
    known = look(network, learned, LEARNED_FRAMES)
    judged = None if held_out is None else look(network, held_out, HELD_OUT_FRAMES)
    centre, scale = known.x.mean(0), 1 / np.maximum(known.x.std(0), 1e-3)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the head is small: threads would only wait for each other
    standard = None if judged is None else replace(judged, x=(judged.x - centre) * scale)
    head = fit_head((known.x - centre) * scale, known.error, seed, standard)
    seen, limits = known.texture, None if judged is None else judged.texture
    if limits is None:  # without any, every second one of the known
        seen, limits = seen[::2], seen[1::2]
    turned = turn_frames(learned, camera or CameraParameters(), seed)
    aim = fit_aim(seen[:, CELL_VALUES:], turned, limits[:, CELL_VALUES:], FALSE_ALARMS / 2, seed)
    torch.set_num_threads(threads)
    usual, directions = novelty(seen[:, :CELL_VALUES], limits[:, :CELL_VALUES], FALSE_ALARMS / 2)
    strange = {"usual": usual, "directions": directions, **aim}
    doubt = UncertaintyHead(centre, scale.astype(np.float32), **head, **strange)
    judged = judged or known
    about = {
        "features": list(FEATURES),
        "held_out": [info.id for info in held_out.rounds] if isinstance(held_out, Frames) else [],
        "frames": len(judged.x),
        "false_alarm_rate": FALSE_ALARMS,
        "coverage": coverage(doubt.assess(judged.x, judged.texture)[:, :-1], judged.error),
    }
    return FittedUncertainty(doubt, about)


def look(network: Network, frames: Images, most: int) -> Seen:
    """What `network` sees in up to `most` frames, evenly spread, in the precision it answers in.

    By OpenVINO, a request a core: three times as fast as torch in float32.
    """
    chosen = np.linspace(0, len(frames) - 1, min(most, len(frames))).astype(np.int64)
    x = np.empty((len(chosen), network.architecture.shared[-1]), np.float32)
    outputs = np.empty((len(chosen), OUTPUTS), np.float32)
    textures = np.empty((len(chosen), TEXTURE_VALUES), np.float32)

    def note(request: Any, row: int) -> None:
        outputs[row] = request.get_output_tensor(0).data[0]
        x[row] = request.get_output_tensor(1).data[0]

    queue = _requests(network)
    queue.set_callback(note)
    images = np.empty((CHUNK, HEIGHT, WIDTH, 3), np.uint8)
    for first in range(0, len(chosen), CHUNK):
        rows = chosen[first : first + CHUNK]
        for row, image in enumerate(frames.read_batch(rows, images[: len(rows)])):
            queue.start_async([image[None].copy()], first + row)
            textures[first + row] = texture(image)
        queue.wait_all()
    labels = frames.labels
    error = signed_errors(outputs, labels.distances[chosen], labels.angle[chosen])
    return Seen(x, error.astype(np.float32), textures)


def _requests(network: Network) -> Any:
    """As many requests at once as there are cores, of one thread each."""
    import openvino

    core = openvino.Core()
    cores = os.cpu_count() or 1
    options = {
        "INFERENCE_PRECISION_HINT": best_precision(core),
        "INFERENCE_NUM_THREADS": cores,
        "NUM_STREAMS": cores,
        "ENABLE_CPU_PINNING": False,
    }
    return openvino.AsyncInferQueue(core.compile_model(build_feature_graph(network), "CPU", options))


def novelty(
    known: Numbers, held_out: Numbers, false_alarms: float = FALSE_ALARMS
) -> tuple[Numbers, Numbers]:
    """The mean texture (C,), and directions (C, C) so long that `false_alarms` of the textures
    held out reach 1."""
    usual, spread = known.mean(0), np.maximum(known.std(0), LEAST_SPREAD)
    variance, axes = np.linalg.eigh(np.cov((known - usual) / spread, rowvar=False))
    directions = (axes / np.sqrt(np.maximum(variance, 0) + RIDGE)).T / spread
    sizes = (((held_out - usual) @ directions.T) ** 2).sum(1)
    limit = max(float(np.quantile(sizes, 1 - false_alarms)), 1e-6)
    return usual, np.asarray(directions / np.sqrt(limit), np.float32)


def fit_head(z: Numbers, error: Numbers, seed: int, held_out: Seen | None) -> dict[str, Numbers]:
    """The layers of the second head, as `UncertaintyHead` names them, for errors (N, D) at features
    z (N, F).

    It learns from all frames, `held_out` (its `x` standardised) among them. Each part of those is
    also judged by a head that has not seen it: from these answers come the temperatures, which
    make `COVERED` of the errors smaller than one deviation.
    """
    first_judged = 0 if held_out is None else len(z)
    if held_out is not None:
        z, error = np.concatenate([z, held_out.x]), np.concatenate([error, held_out.error])
    usual = _usual(error)
    scaled, x = torch.from_numpy(error / usual), torch.from_numpy(z.astype(np.float32))
    everything = np.arange(len(z))
    # In order, so that a part is rounds, not single frames.
    parts = np.array_split(everything[first_judged:], FOLDS)
    unseen = torch.full_like(scaled, torch.nan)
    for part in parts:
        others = np.setdiff1d(everything, part)
        unseen[part] = _fit(x[others], scaled[others], seed)(x[part]).detach()
    ratio = (scaled / torch.exp(unseen)).abs().numpy()
    temperature = _temperatures(ratio)
    first, second = _fit(x, scaled, seed).layers
    return {
        "hidden_weight": first.weight.detach().numpy(),
        "hidden_bias": first.bias.detach().numpy(),
        "weight": second.weight.detach().numpy(),
        "bias": (second.bias.detach().numpy() + np.log(usual * temperature)).astype(np.float32),
        "low": np.log(usual * LEAST_SHARE).astype(np.float32),
        "high": np.log(usual * MOST_SHARE).astype(np.float32),
    }


def _usual(error: Numbers) -> Numbers:
    """The size (D,) of each error over all frames; of a range where no frame had the feature."""
    spans = [tf.RANGES[name if name in tf.RANGES else "m"] for name in FEATURES]
    none = np.array([(span.hi - span.lo) / 4 for span in spans])
    present = ~np.isnan(error)
    squares = np.where(present, error, 0.0) ** 2
    size = np.sqrt(squares.sum(0) / np.maximum(present.sum(0), 1))
    return np.where(present.any(0), np.maximum(size, 1e-6), none).astype(np.float32)


def _temperatures(ratio: Numbers) -> Numbers:
    """What makes `COVERED` of the ratios (N, D) smaller than 1; that of the others for a feature
    that was hardly ever active."""
    present = [column[~np.isnan(column)] for column in ratio.T]
    found = np.array(
        [np.quantile(c, COVERED) if len(c) >= LEAST_ACTIVE else np.nan for c in present]
    )
    others = np.nanmedian(found) if np.isfinite(found).any() else 1.0
    return np.maximum(np.where(np.isnan(found), others, found), 1e-3).astype(np.float32)


def _fit(z: Tensor, error: Tensor, seed: int) -> "_Head":
    """Two layers z (N, F) -> log deviations (N, D), of the best likelihood of the errors."""
    generator = torch.Generator().manual_seed(seed)
    layers = _Head(z.shape[1], generator)
    optimiser = torch.optim.AdamW(layers.parameters(), RATE, weight_decay=DECAY)
    steps = min(STEPS, len(z) // 4)  # a few frames are soon learned by heart
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1))
    present = (~error.isnan()).float()
    squares = error.nan_to_num() ** 2
    for _ in range(steps):
        rows = torch.randint(len(z), (min(BATCH, len(z)),), generator=generator)
        logarithm = layers(z[rows])
        terms = logarithm + 0.5 * squares[rows] * torch.exp(-2 * logarithm)
        loss = (terms * present[rows]).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    return layers


class _Head(nn.Module):
    """Two layers, the second of which begins at nothing: at the usual size of each error."""

    def __init__(self, size: int, generator: torch.Generator) -> None:
        super().__init__()
        self.layers = nn.Linear(size, HIDDEN), nn.Linear(HIDDEN, len(FEATURES))
        self.first, self.second = self.layers
        with torch.no_grad():
            self.first.weight.normal_(0.0, size**-0.5, generator=generator)
            for parameter in (self.first.bias, self.second.weight, self.second.bias):
                parameter.zero_()

    def forward(self, z: Tensor) -> Tensor:
        logarithm: Tensor = self.second(self.first(z).relu())
        return logarithm
