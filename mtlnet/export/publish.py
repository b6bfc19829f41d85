"""The end of a training run: the paper's network, its OpenVINO graph and its card, checked.

Nothing is said to be finished before the exported graph has answered real frames as torch does.
"""

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.torch import save

import trackfeatures as tf
from mtlnet.export.openvino_graph import UNCERTAINTY_TOLERANCE, TOLERANCE, write_graph
from mtlnet.inference.model_card import (
    UNCERTAINTY_WEIGHTS,
    GRAPH,
    GRAPH_WEIGHTS,
    MODEL_FILES,
    WEIGHTS,
    ModelCard,
    ModelError,
    file_hash,
    golden_image,
)
from mtlnet.inference.prediction import OUTPUTS
from mtlnet.inference.uncertainty import FittedUncertainty, UncertaintyHead, texture, write_uncertainty_head
from mtlnet.model.network import HEIGHT, WIDTH, Network, predict_images, run_network, fold
from runtime.files import atomic_write
from trackfeatures.camera import CameraParameters

PACKAGES = ("driverview", "torch", "openvino", "numpy")


def publish(
    network: Network,
    run: Path,
    images: NDArray[np.uint8],
    *,
    camera: CameraParameters | None = None,
    alpha: tuple[float, float, float] = (0.3, 0.2, 0.5),
    recipe: str = "fast",
    iterations: int = 0,
    batch: int = 32,
    seed: int = 0,
    data: dict[str, Any] | None = None,
    doubt: FittedUncertainty | None = None,
) -> ModelCard:
    """Fold `network`, write all of `mtlnet.inference.model_card.MODEL_FILES` and the card into
    folder `run`.

    `images` (N, 210, 280, 3): frames on which the graph is held against torch. `doubt`: its second
    head (`mtlnet.uncertainty_fit.head`); without one the model gives no standard deviations. Raises
    ModelError when the graph differs by more than `mtlnet.export.openvino_graph.TOLERANCE`; the run
    then has no card.
    """
    run.mkdir(parents=True, exist_ok=True)
    folded = fold(network)
    weights = {name: t.contiguous() for name, t in folded.state_dict().items()}
    atomic_write(run / WEIGHTS, save(weights), fsync=True)
    head = None if doubt is None else doubt.head
    if head is not None:
        write_uncertainty_head(run, head)
    write_graph(folded, run / GRAPH, run / GRAPH_WEIGHTS, head)
    check = compare(folded, run, images, head)
    _require_equal(run, check)
    golden = golden_image(WIDTH, HEIGHT)
    names = MODEL_FILES if doubt is None else (*MODEL_FILES, UNCERTAINTY_WEIGHTS)
    card = ModelCard(
        name=run.resolve().name,
        network=folded.architecture.name,
        definitions_version=tf.VERSION,
        program_version=package_versions()["driverview"],
        camera=camera or CameraParameters(),
        alpha=alpha,
        recipe=recipe,
        iterations=iterations,
        batch=batch,
        seed=seed,
        data=data or {},
        versions=package_versions(),
        files={name: file_hash(run / name) for name in names},
        export_check=check,
        golden=tuple(float(v) for v in predict_images(folded, golden[None])[0]),
        doubt=None if doubt is None else doubt.about,
    )
    card.write(run)
    return card


def _require_equal(run: Path, check: dict[str, float]) -> None:
    limits = {"openvino_f32_max": TOLERANCE, "openvino_f32_doubt": UNCERTAINTY_TOLERANCE}
    for name, limit in limits.items():
        if not check.get(name, 0.0) <= limit:  # written so that NaN is a failure too
            raise ModelError(
                f"the exported graph {run / GRAPH} differs from torch by {check[name]:.2g} "
                f"({name}), at most {limit:g} is expected: the model is not published; report this "
                "as a fault"
            )


def compare(
    network: Network, run: Path, images: NDArray[np.uint8], doubt: UncertaintyHead | None = None
) -> dict[str, float]:
    """Largest difference between torch in float32 and the graph, per precision.

    Of any of the nine outputs; and, as a share of its value, of any of the second head's.
    """
    import openvino

    from mtlnet.inference.engine import best_precision

    x, expected = run_network(network, images)
    textures = np.stack([texture(image) for image in images])
    second = None if doubt is None else doubt.assess(x, textures)
    core = openvino.Core()
    differences = {"frames": float(len(images))}
    for precision in dict.fromkeys(("f32", best_precision(core))):
        options = {"INFERENCE_PRECISION_HINT": precision, "NUM_STREAMS": 1}
        try:
            request = core.compile_model(str(run / GRAPH), "CPU", options).create_infer_request()
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ModelError(
                f"OpenVINO cannot load {run / GRAPH}, just written ({reason}): the model is not "
                "published; is the disk full?"
            ) from error
        answers = np.concatenate([request.infer([image[None]])[0].copy() for image in images])
        nine = answers[:, :OUTPUTS]
        differences[f"openvino_{precision}_max"] = float(np.abs(nine - expected).max())
        if second is not None:
            share = np.abs(answers[:, OUTPUTS:] / second - 1)
            differences[f"openvino_{precision}_doubt"] = float(share.max())
    return differences


def package_versions() -> dict[str, str]:
    """Versions of what made the model."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "unknown"
    return versions
