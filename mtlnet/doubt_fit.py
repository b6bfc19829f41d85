"""Fitting the second head of a trained network (`mtlnet.doubt`), the network itself frozen.

Errors on frames the network has learned from are too small to learn doubt from, so some train
rounds are kept out of training. The head is fitted to the errors there, by Gaussian likelihood; its
temperatures and the limit of novelty come from there too.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import trackfeatures as tf
from datagen.recording import Dataset, Frames
from mtlnet.doubt import FEATURES, Doubt, FittedDoubt
from mtlnet.errors import coverage, signed_errors
from mtlnet.loader import Images
from mtlnet.network import HEIGHT, WIDTH, Network, describe_images

HELD_OUT_SHARE = 1 / 12
LEAST_ROUNDS = 8
"""With fewer train rounds none can be spared: doubt is then fitted to what was learned from."""
FALSE_ALARMS = 0.01
"""Share of known frames that are called out of distribution."""
LEARNED_FRAMES, HELD_OUT_FRAMES = 3_000, 4_000  # at most so many are looked at
HIDDEN = 32
STEPS, BATCH, RATE, DECAY = 250, 256, 1e-2, 3e-2
FOLDS = 3
CHUNK = 32  # images through the network at once
LEAST_SHARE, MOST_SHARE = 0.1, 20.0  # limits of a standard deviation, as a share of the usual one
COVERED = 0.6827  # of a normal distribution, within one standard deviation
RIDGE = 0.05
"""Added to the variance along each direction (of standardised features): narrow ones are noise."""

Numbers = NDArray[np.float32]


def hold_out(dataset: Dataset) -> tuple[Frames, Frames | None]:
    """The train rounds of a dataset: those to learn from, and those kept for fitting doubt.

    The same for the same rounds, whatever their order; one of a track and light that several have
    is kept before one of its own kind.
    """
    ids = {info.id: (info.track, info.light) for info in dataset.rounds if info.split == "train"}
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
    """Frames as a frozen network sees them: last shared features (N, F), errors (N, D), m and rad.

    An error is NaN where the label or, for `to_lane_centre`, the answer has none.
    """

    x: Numbers
    error: Numbers


def fit_doubt(network: Network, learned: Images, held_out: Images | None, seed: int) -> FittedDoubt:
    """The second head of `network` (folded), fitted on frames held out of its training.

    Without any, on those learned from: it then trusts the network too much, and the card says so.
    """
    known = look(network, learned, LEARNED_FRAMES)
    judged = known if held_out is None else look(network, held_out, HELD_OUT_FRAMES)
    centre, scale = known.x.mean(0), 1 / np.maximum(known.x.std(0), 1e-3)
    z = ((judged.x - centre) * scale).astype(np.float32)
    directions = novelty_directions((known.x - centre) * scale, z)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the head is small: threads would only wait for each other
    head = fit_head(z, judged.error, seed)
    torch.set_num_threads(threads)
    doubt = Doubt(centre, scale.astype(np.float32), **head, directions=directions)
    about = {
        "features": list(FEATURES),
        "held_out": [info.id for info in held_out.rounds] if isinstance(held_out, Frames) else [],
        "frames": len(z),
        "false_alarm_rate": FALSE_ALARMS,
        "coverage": coverage(doubt.assess(judged.x)[:, :-1], judged.error),
    }
    return FittedDoubt(doubt, about)


def look(network: Network, frames: Images, most: int) -> Seen:
    """What `network` sees in up to `most` frames, evenly spread."""
    count = min(most, len(frames))
    chosen = np.linspace(0, len(frames) - 1, count).astype(np.int64)
    images = np.empty((CHUNK, HEIGHT, WIDTH, 3), np.uint8)
    parts = []
    for first in range(0, count, CHUNK):
        rows = chosen[first : first + CHUNK]
        parts.append(describe_images(network, frames.read_batch(rows, images[: len(rows)])))
    x, outputs = (np.concatenate(column) for column in zip(*parts, strict=True))
    labels = frames.labels
    error = signed_errors(outputs, labels.distances[chosen], labels.angle[chosen])
    return Seen(x, error.astype(np.float32))


def novelty_directions(known: Numbers, held_out: Numbers) -> Numbers:
    """Directions (F, F) in which novelty is measured, so long that `FALSE_ALARMS` reach 1."""
    variance, axes = np.linalg.eigh(np.cov(known, rowvar=False))
    directions = (axes / np.sqrt(np.maximum(variance, 0) + RIDGE)).T
    novelty = ((held_out @ directions.T) ** 2).sum(1)
    limit = np.quantile(novelty, 1 - FALSE_ALARMS)
    return np.asarray(directions / np.sqrt(limit), np.float32)


def fit_head(z: Numbers, error: Numbers, seed: int) -> dict[str, Numbers]:
    """The layers of the second head, as `Doubt` names them, for errors (N, D) at features z (N, F).

    Each part of the frames is judged by a head that was fitted to the others: from these answers
    come the temperatures, which make `COVERED` of the errors smaller than one deviation.
    """
    usual = _usual(error)
    scaled = torch.from_numpy(error / usual)
    x = torch.from_numpy(z)
    parts = np.array_split(
        np.arange(len(z)), FOLDS
    )  # in order: a part is rounds, not single frames
    unseen = torch.empty_like(scaled)
    for part in parts:
        others = np.setdiff1d(np.arange(len(z)), part)
        unseen[part] = _fit(x[others], scaled[others], seed)(x[part]).detach()
    ratio = (scaled / torch.exp(unseen)).abs().numpy()
    temperature = np.array([_quantile(column, COVERED) for column in ratio.T], np.float32)
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


def _quantile(values: Numbers, share: float) -> float:
    present = values[~np.isnan(values)]
    return max(float(np.quantile(present, share)), 1e-3) if len(present) else 1.0


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
