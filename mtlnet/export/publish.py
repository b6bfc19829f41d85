"""Publishes the model in a run's own folder when training ends: weights, OpenVINO graph, card.

The graph is first compared with torch on frames of the dataset. Then all files are moved into place
together, the card last, so that a run without a card has no finished model. Without OpenVINO no
graph is written; an engine then converts the weights when it loads them, which needs torch.
"""

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor

import trackfeatures as tf
from mtlnet.architecture import HEIGHT, WIDTH
from mtlnet.inference.engine import best_precision, has_openvino, run_graph
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import (
    CARD,
    GRAPH,
    GRAPH_WEIGHTS,
    MODEL_FILES,
    UNCERTAINTY_WEIGHTS,
    WEIGHTS,
    ModelCard,
    ModelError,
)
from mtlnet.inference.prediction import COLUMNS, OUTPUTS
from mtlnet.model.network import Network, fold, load_network, predict_images
from mtlnet.model.openvino_graph import TOLERANCE, UNCERTAINTY_TOLERANCE, write_graph
from mtlnet.model.served import ServedNetwork
from mtlnet.model.uncertainty_head import FittedUncertainty, UncertaintyHead
from runtime.files import atomic_write, file_hash, replaced_files
from trackfeatures.camera import CameraParameters
from trackfeatures.names import to_name

PACKAGES = ("driverview", "torch", "openvino", "numpy")
LEAST_OOD_SCORE = 1e-3
"""Least out-of-distribution score by which a difference is divided in a comparison. A model of a
single training image gives that image a score of 0, apart from rounding; an image with a score
above 1 is out of distribution."""


@dataclass(frozen=True)
class Provenance:
    """The settings and data with which a network was trained; fields of the model card."""

    camera: CameraParameters = field(default_factory=CameraParameters)
    alpha: tuple[float, float, float] = (0.3, 0.2, 0.5)
    recipe: str = "fast"
    iterations: int = 0
    batch: int = 32
    seed: int = 0
    data: dict[str, Any] = field(default_factory=dict)


def publish(
    network: Network,
    run: Path,
    images: NDArray[np.uint8],
    provenance: Provenance | None = None,
    uncertainty: FittedUncertainty | None = None,
) -> ModelCard:
    """Write the finished model to the folder `run`: weights with batch normalisation folded into
    them, graph, uncertainty head and card. Returns the card.

    `images` (N, 210, 280, 3): frames on which the graph is compared with torch. `provenance`:
    settings and data for the card. Without `uncertainty` the model predicts no standard deviations.
    Without OpenVINO the run gets no graph, and nothing is compared. Raises ModelError when the
    graph differs by more than the tolerances of `mtlnet.model.openvino_graph`. After an error the
    run has the model that it had before.
    """
    folded = fold(network)
    weights = {name: t.contiguous() for name, t in folded.state_dict().items()}
    head = None if uncertainty is None else uncertainty.head
    origin = provenance or Provenance()
    with replaced_files(run, last=CARD) as staged:
        files = write_model(staged, folded.architecture.name, weights, head)
        check = {"frames": 0.0}
        if GRAPH in files:
            check = compare_graph(folded, staged, images, head)
            _require_equal(run, check)
        card = ModelCard(
            name=to_name(run.resolve().name),
            network=folded.architecture.name,
            definitions_version=tf.VERSION,
            program_version=package_versions()["driverview"],
            **{field.name: getattr(origin, field.name) for field in fields(origin)},
            versions=package_versions(),
            files=files,
            export_check=check,
            golden=golden_outputs(folded),
            uncertainty=None if uncertainty is None else uncertainty.about,
        )
        card.write(staged)
    return card


def write_model(
    folder: Path,
    network: str,
    weights: dict[str, Tensor],
    head: UncertaintyHead | None,
    *,
    narrow: bool = False,
) -> dict[str, str]:
    """Write a model's weights, graph and uncertainty `head` to `folder`; returns the SHA-256 of
    each file by its name.

    `network`: name of the architecture; `weights`: tensors by name, with batch normalisation
    folded. Without OpenVINO no graph is written. `narrow`: weights that are float16 are stored as
    float16 in the graph too, not as float32.
    """
    names: tuple[str, ...] = MODEL_FILES if has_openvino() else (WEIGHTS,)
    atomic_write(folder / WEIGHTS, save(weights), fsync=True)
    if head is not None:
        names = (*names, UNCERTAINTY_WEIGHTS)
        atomic_write(folder / UNCERTAINTY_WEIGHTS, head.to_bytes(), fsync=True)
    if GRAPH in names:
        read = load_network(folder / WEIGHTS, network)
        write_graph(read, folder / GRAPH, folder / GRAPH_WEIGHTS, head, narrow=narrow)
    return {name: file_hash(folder / name) for name in names}


def golden_outputs(network: Network) -> tuple[float, ...]:
    """Return the nine outputs of a network, whose batch normalisation is folded, for the golden
    image, a fixed test image."""
    images = golden_image(WIDTH, HEIGHT)[None]
    return tuple(map(float, predict_images(network, images)[0]))


def _require_equal(run: Path, check: dict[str, float]) -> None:
    limits = {"openvino_f32_max": TOLERANCE, "openvino_f32_uncertainty": UNCERTAINTY_TOLERANCE}
    for name, limit in limits.items():
        if not check.get(name, 0.0) <= limit:  # not `>`, so that a NaN fails too
            raise ModelError(
                f"the exported graph {run / GRAPH} differs from torch by {check[name]:.2g} "
                f"({name}), at most {limit:g} is expected: the model is not published; report this "
                "as a fault"
            )


def export_text(check: Mapping[str, float]) -> str:
    """Return a text about a card's `export_check`, whose number of frames is 0 if OpenVINO is not
    installed."""
    if not check["frames"]:
        return "weights alone: OpenVINO, which writes the graph, is not installed"
    differences = [f"{name} {value:.2g}" for name, value in check.items() if name != "frames"]
    return (
        f"exported and compared with torch on {check['frames']:.0f} frames, largest difference: "
        f"{', '.join(differences)}"
    )


def compare_graph(
    network: Network, run: Path, images: NDArray[np.uint8], head: UncertaintyHead | None = None
) -> dict[str, float]:
    """Compare the graph in the folder `run` with torch in float32 on `images` (N, H, W, 3). Returns
    the number of frames and, for each precision of the graph, the largest differences.

    `openvino_PRECISION_max`: absolute, of the nine outputs and the probabilities of absence;
    `openvino_PRECISION_uncertainty`: relative, of the uncertainty head's outputs. The difference of
    an out-of-distribution score is divided by at least 0.001, because a score can be 0.
    """
    with torch.inference_mode():
        expected = ServedNetwork(network, head)(torch.from_numpy(images)).numpy()
    uncertain = np.zeros(expected.shape[1], bool)
    uncertain[OUTPUTS : OUTPUTS + (COLUMNS if head is not None else 0)] = True
    reference = expected[:, uncertain].copy()
    reference[:, -1:] = np.maximum(reference[:, -1:], LEAST_OOD_SCORE)
    differences = {"frames": float(len(images))}
    for precision in dict.fromkeys(("f32", best_precision())):
        try:
            outputs = run_graph(run / GRAPH, precision, images)
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ModelError(
                f"OpenVINO cannot load {run / GRAPH}, just written ({reason}): the model is not "
                "published; is the disk full?"
            ) from error
        apart = np.abs(outputs - expected)
        differences[f"openvino_{precision}_max"] = float(apart[:, ~uncertain].max())
        if head is not None:
            relative = apart[:, uncertain] / reference
            differences[f"openvino_{precision}_uncertainty"] = float(relative.max())
    return differences


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which a model's values depend, by
    name."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "unknown"
    return versions
