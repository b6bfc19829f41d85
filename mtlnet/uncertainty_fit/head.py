"""Fits the standard deviations of the uncertainty head (`mtlnet.model.uncertainty_head`).

A network's errors are smaller on frames of its training than on new frames. Therefore some train
rounds are held out of the training (`mtlnet.data.rounds.hold_out_rounds`); they determine the scale
of the standard deviations and the limit of the out-of-distribution score.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import trackfeatures as tf
from datagen.recording import Frames
from mtlnet.data.loader import Images
from mtlnet.data.rounds import (
    MIN_ROUNDS_TO_HOLD_OUT,
    hold_out_rounds,
    open_training_dataset,
    require_camera,
)
from mtlnet.evaluation.metrics import coverage
from mtlnet.inference.model_card import WEIGHTS, ModelError, read_card
from mtlnet.inference.prediction import FEATURES
from mtlnet.inference.trained_rounds import Seeds, names_entry
from mtlnet.model.network import Network, load_network
from mtlnet.model.textures import CELL_VALUES, HALVES
from mtlnet.model.uncertainty_head import (
    FittedUncertainty,
    TwoLayers,
    UncertaintyHead,
    standardise,
)
from mtlnet.uncertainty_fit.frame_outputs import FrameOutputs, run_on_frames
from mtlnet.uncertainty_fit.ood import (
    FitSettings,
    fit_pitch_offset,
    fit_texture_distance,
    minimise,
    pitched_views,
)
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

FALSE_ALARM_RATE = 0.01
"""Share of frames of the training distribution that are classified as out of distribution: half of
it by texture, half by pitch."""
MAX_TRAIN_FRAMES, MAX_HELD_OUT_FRAMES = 3_000, 24_000
HIDDEN = 32
FIT = FitSettings(steps=1_000, batch=256, learning_rate=1e-2, weight_decay=3e-2)
FOLDS = 8
MIN_FRAMES_TO_DIVIDE = 8
"""Without held-out frames, every second train frame determines the limits of the
out-of-distribution score, if there are at least this many train frames. With fewer train frames,
all of them determine the limits, because otherwise half of the train frames would be out of
distribution."""
MIN_PRESENT_FRAMES = 30  # least number of frames for a feature's own temperature
MIN_STD_SHARE, MAX_STD_SHARE = 0.01, 20.0
"""Limits of a standard deviation, relative to the RMS error. The lower limit is small, because a
few large errors determine the RMS error."""
MIN_FEATURE_STD_SHARE = 0.1
MIN_LIGHT_STD = np.repeat([0.1, 0.1, 0.1, 0.02, 0.02], HALVES)
"""Lower limits for the standard deviations of `light_features`: about half of their standard
deviations over all lights. The images of a training on one scene vary less, but another scene must
not be many standard deviations away."""
LOG_STD_LIMITS = (math.log(MIN_STD_SHARE), math.log(MAX_STD_SHARE))
COVERED = (0.6827, 0.9545)
"""Shares of a normal distribution within one and two standard deviations."""
FREEDOM = 3.0
"""Degrees of freedom of the Student t distribution that is fitted to the errors. Errors have
outliers, which would determine the standard deviations under a normal distribution (Lange, Little
and Taylor 1989). On test rounds 90 to 93 % of the errors were within two standard deviations, with
a normal distribution 85 to 91 % (docs/experiments/uncertainty.md)."""


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch compute on one thread, because the head is small and more threads are slower."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def fit_uncertainty_head(
    network: Network,
    train: Images,
    held_out: Images | None,
    seed: int,
    camera: CameraParameters | None = None,
) -> FittedUncertainty:
    """Fit the uncertainty head of `network` (folded) on its train frames and on held-out frames.

    Without held-out frames the head is fitted on the train frames alone, and its standard
    deviations are too small; the model card then lists no held-out rounds. In that case the light
    features are not inputs of the head, because a dataset with too few rounds for held-out rounds
    does not show enough sceneries. `camera`: the camera of the frames; None: the default camera.
    """
    count = network.architecture.uncertainty_inputs
    known = run_on_frames(network, train, MAX_TRAIN_FRAMES)
    if held_out is None:
        known = replace(known, x=known.x[:, :count])
    unseen = None if held_out is None else run_on_frames(network, held_out, MAX_HELD_OUT_FRAMES)
    centre, scale = standardisation(known.x, count)

    def standardised(x: NDArray[np.float32]) -> NDArray[np.float32]:
        tensor = torch.from_numpy
        found: NDArray[np.float32] = standardise(
            tensor(x), tensor(centre), tensor(scale), count
        ).numpy()
        return found

    with _one_thread():
        known_z = standardised(known.x)
        held_out_z = None if unseen is None else replace(unseen, x=standardised(unseen.x))
        std_layers = fit_std_layers(known_z, known.error, seed, held_out_z)
        textures = limiting = known.texture
        if unseen is not None:
            limiting = unseen.texture
        elif len(textures) >= MIN_FRAMES_TO_DIVIDE:
            textures, limiting = textures[::2], textures[1::2]
        views = pitched_views(train, camera or CameraParameters(), seed)
        rate = FALSE_ALARM_RATE / 2
        pitch_layers = fit_pitch_offset(
            textures[:, CELL_VALUES:], views, limiting[:, CELL_VALUES:], rate, seed
        )
    mean, directions = fit_texture_distance(
        textures[:, :CELL_VALUES], limiting[:, :CELL_VALUES], rate
    )
    arrays = {"centre": centre, "scale": scale, **std_layers, **pitch_layers}
    arrays |= {"texture_mean": mean, "texture_directions": directions}
    head = UncertaintyHead({name: torch.from_numpy(array) for name, array in arrays.items()})
    judged = unseen or known
    rounds = held_out.rounds if isinstance(held_out, Frames) else []
    found = head(torch.from_numpy(judged.x[:, :count]), torch.from_numpy(judged.texture)).numpy()
    about = {
        "features": list(FEATURES),
        "held_out": names_entry(info.id for info in rounds),
        "frames": len(judged.x),
        "false_alarm_rate": FALSE_ALARM_RATE,
        "coverage": coverage(found[:, :-1], judged.error),
    }
    return FittedUncertainty(head, about)


def refit_uncertainty_head(run: Path, data: Path) -> FittedUncertainty:
    """Fit the uncertainty head of the model in `run` again, on the train rounds of a dataset.

    `about` of the result also names the dataset, and the seeds and tracks of its train rounds.
    Raises ModelError for images of another camera, and for rounds on which the model was trained,
    because its errors on them are too small; UserError for a dataset with too few rounds.
    """
    card, dataset = read_card(run), open_training_dataset(data)
    # All rounds are new to the model, so the larger part takes the role of the held-out rounds.
    many, few = hold_out_rounds(dataset)
    if few is None:
        raise UserError(
            f"{data} has {len(many.rounds)} train rounds; standard deviations are fitted on "
            f"{MIN_ROUNDS_TO_HOLD_OUT} or more"
        )
    require_camera(card, dataset.camera)
    seeds = [info.seed for info in (*many.rounds, *few.rounds)]
    trained = Seeds.read(card.data["seeds"])
    seen = [seed for seed in seeds if seed in trained]
    if seen:
        raise ModelError(
            f"model {card.name} was trained on the round of seed {min(seen)} of {data}; collect "
            "rounds with another --seed"
        )
    network = load_network(run / WEIGHTS, card.network)
    fitted = fit_uncertainty_head(network, few, many, card.seed, card.camera)
    origin = {
        "data": dataset.path.name,
        "content_hash": dataset.content_hash,
        "seeds": Seeds.of(seeds).entry(),
        "tracks": sorted({info.track for info in (*many.rounds, *few.rounds)}),
    }
    return replace(fitted, about={**fitted.about, **origin})


def standardisation(
    x: NDArray[np.float32], count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute the mean (F,) and the inverse standard deviation (F,) of inputs `x` (N, F): the
    arguments `centre` and `scale` of `mtlnet.model.uncertainty_head.standardise`.

    The first `count` inputs come from the network, the remaining inputs are the light features. The
    standard deviation of an input from the network is raised to at least a tenth of the mean
    standard deviation of these inputs: otherwise a unit that is 0 on these frames could be
    thousands of standard deviations away on other frames. The standard deviation of a light feature
    is raised to at least 0.1 for a colour and 0.02 for a difference of brightness
    (`MIN_LIGHT_STD`).
    """
    std = x.std(0)
    floor = max(MIN_FEATURE_STD_SHARE * float(std[:count].mean()), 1e-3)
    least = np.concatenate([np.full(count, floor), MIN_LIGHT_STD[: x.shape[1] - count]])
    return x.mean(0), (1 / np.maximum(std, least)).astype(np.float32)


def fit_std_layers(
    z: NDArray[np.float32], error: NDArray[np.float32], seed: int, held_out: FrameOutputs | None
) -> dict[str, NDArray[np.float32]]:
    """Fit the layers that predict standard deviations; returns their tensors by name, a part of the
    state of `UncertaintyHead`.

    `z` (N, F): standardised inputs of the train frames; `error` (N, D): errors in m and rad;
    `held_out`: outputs on held-out frames, whose inputs `x` are standardised too. The layers are
    fitted on all frames. Temperature scaling (Guo et al. 2017) then brings the shares of errors
    within one and two standard deviations near 68 % and 95 %. For this, each of 8 parts of the
    held-out frames (without held-out frames, of the train frames) is predicted by layers fitted
    without this part.
    """
    first_judged = 0 if held_out is None else len(z)
    if held_out is not None:
        z, error = np.concatenate([z, held_out.x]), np.concatenate([error, held_out.error])
    rms = _rms_error(error)
    scaled, x = torch.from_numpy(error / rms), torch.from_numpy(z.astype(np.float32))
    everything = np.arange(len(z))
    # In order, so that a part consists of rounds instead of single frames.
    parts = np.array_split(everything[first_judged:], FOLDS)
    others = [np.setdiff1d(everything, part) for part in parts]
    count = min(map(len, others))  # the parts' sizes differ by at most one frame
    fits = _train(x, scaled, np.stack([rows[:count] for rows in others]), seed)
    log_std = torch.full_like(scaled, torch.nan)
    for number, part in enumerate(parts):
        log_std[part] = fits.take(number)(x[part])
    ratio = (scaled / torch.exp(log_std)).abs().numpy()
    temperature = _temperatures(ratio)
    layers = _train(x, scaled, everything[None], seed).take(0)
    return {
        "std.first.weight": layers.first.weight.numpy(),
        "std.first.bias": layers.first.bias.numpy(),
        "std.second.weight": layers.second.weight.numpy(),
        "std.second.bias": (layers.second.bias.numpy() + np.log(rms * temperature)).astype(
            np.float32
        ),
        "low": np.log(rms * MIN_STD_SHARE).astype(np.float32),
        "high": np.log(rms * MAX_STD_SHARE).astype(np.float32),
    }


def _rms_error(error: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the RMS (D,) of errors (N, D); for a feature that is never present, a quarter of its
    range."""
    spans = [tf.RANGES[name if name in tf.RANGES else "m"] for name in FEATURES]
    absent = np.array([(span.hi - span.lo) / 4 for span in spans])
    present = ~np.isnan(error)
    squares = np.where(present, error, 0.0) ** 2
    rms = np.sqrt(squares.sum(0) / np.maximum(present.sum(0), 1))
    return np.where(present.any(0), np.maximum(rms, 1e-6), absent).astype(np.float32)


def _temperatures(ratio: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the factors (D,) by which the predicted standard deviations are to be multiplied, from
    the `ratio` (N, D) of each error to its predicted standard deviation.

    A feature present in fewer than `MIN_PRESENT_FRAMES` frames gets the median factor of the other
    features.
    """
    present = [column[~np.isnan(column)] for column in ratio.T]
    found = np.array([_temperature(c) if len(c) >= MIN_PRESENT_FRAMES else np.nan for c in present])
    others = np.nanmedian(found) if np.isfinite(found).any() else 1.0
    return np.maximum(np.where(np.isnan(found), others, found), 1e-3).astype(np.float32)


def _temperature(ratio: NDArray[np.float32]) -> float:
    """Return the factor for the predicted standard deviations of one feature, from the `ratio` (N,)
    of each error to its predicted standard deviation.

    With this factor the shares of errors within one and two standard deviations are as close as
    possible to `COVERED`: the larger of the two deviations is minimal. Because of outliers no
    factor gives both shares; with the factor that gives the first share, the second is too small.
    """
    candidates = np.quantile(ratio, np.linspace(0.6, 0.9, 61))
    limits = np.outer([1.0, 2.0], candidates)
    within = np.searchsorted(np.sort(ratio), limits, side="right") / len(ratio)
    misses = np.abs(within - np.array(COVERED)[:, None]).max(0)
    return float(candidates[misses.argmin()])


def _train(z: Tensor, error: Tensor, members: NDArray[np.int64], seed: int) -> "_Fits":
    """Fit layers that compute, from inputs `z` (N, F), the logarithms (N, D) of the scales of the
    errors' t distributions, by maximum likelihood.

    `members` (K, M): the frames of each of K fits, which are computed together.
    """
    generator = torch.Generator().manual_seed(seed)
    fits = _Fits(len(members), z.shape[1], generator)
    present = (~error.isnan()).float()
    squares = error.nan_to_num() ** 2
    frames = torch.from_numpy(members)

    def loss(rows: Tensor) -> Tensor:
        chosen = frames[:, rows]
        log_std = fits(z[chosen]).clamp(*LOG_STD_LIMITS)
        squared_ratio = squares[chosen] * torch.exp(-2 * log_std)
        terms = log_std + 0.5 * (FREEDOM + 1) * torch.log1p(squared_ratio / FREEDOM)
        total: Tensor = (terms * present[chosen]).mean((1, 2)).sum()
        return total

    # Fewer steps for few frames, against overfitting.
    count = members.shape[1]
    settings = replace(FIT, steps=min(FIT.steps, count // 4))
    minimise(loss, fits.parameters(), count, settings, generator)
    return fits


class _Fits(nn.Module):
    """K pairs of two layers with a ReLU between them, (K, B, F) -> (K, B, D). Their initial result
    is 0: the predicted scale is the RMS of the errors."""

    def __init__(self, count: int, size: int, generator: torch.Generator) -> None:
        super().__init__()
        first = torch.empty(HIDDEN, size).normal_(0.0, size**-0.5, generator=generator)
        self.first = nn.Parameter(first.T.repeat(count, 1, 1))
        self.first_bias = nn.Parameter(torch.zeros(count, 1, HIDDEN))
        self.second = nn.Parameter(torch.zeros(count, HIDDEN, len(FEATURES)))
        self.second_bias = nn.Parameter(torch.zeros(count, 1, len(FEATURES)))

    def forward(self, z: Tensor) -> Tensor:
        hidden = torch.baddbmm(self.first_bias, z, self.first).relu()
        return torch.baddbmm(self.second_bias, hidden, self.second)

    def take(self, number: int) -> TwoLayers:
        """Return the layers of one fit."""
        layers = TwoLayers(self.first.shape[1], HIDDEN, len(FEATURES)).requires_grad_(False)
        for layer, weight, bias in (
            (layers.first, self.first, self.first_bias),
            (layers.second, self.second, self.second_bias),
        ):
            layer.weight.copy_(weight[number].detach().T)
            layer.bias.copy_(bias[number, 0].detach())
        return layers
