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
from mtlnet.card import (
    GRAPH,
    GRAPH_WEIGHTS,
    MODEL_FILES,
    WEIGHTS,
    Camera,
    ModelCard,
    ModelError,
    file_hash,
)
from mtlnet.export import TOLERANCE, write_graph
from mtlnet.golden import golden_image
from mtlnet.network import HEIGHT, WIDTH, Network, answer_images, fold
from mtlnet.whole import write_whole

PACKAGES = ("driverview", "torch", "openvino", "numpy")


def publish(
    network: Network,
    run: Path,
    images: NDArray[np.uint8],
    *,
    camera: Camera | None = None,
    alpha: tuple[float, float, float] = (0.3, 0.2, 0.5),
    recipe: str = "fast",
    iterations: int = 0,
    batch: int = 32,
    seed: int = 0,
    data: dict[str, Any] | None = None,
) -> ModelCard:
    """Fold `network`, write all of `mtlnet.card.MODEL_FILES` and the card into folder `run`.

    `images` (N, 210, 280, 3): frames on which the graph is held against torch. Raises ModelError
    when it differs by more than `mtlnet.export.TOLERANCE`; the run then has no card.
    """
    run.mkdir(parents=True, exist_ok=True)
    folded = fold(network)
    weights = {name: t.contiguous() for name, t in folded.state_dict().items()}
    write_whole(run / WEIGHTS, save(weights))
    write_graph(folded, run / GRAPH, run / GRAPH_WEIGHTS)
    check = compare(folded, run, images)
    if check["openvino_f32_max"] > TOLERANCE:
        raise ModelError(
            f"the exported graph {run / GRAPH} differs from torch by "
            f"{check['openvino_f32_max']:.2g}, at most {TOLERANCE:g} is expected: the model is "
            "not published; report this as a fault"
        )
    golden = golden_image(WIDTH, HEIGHT)
    card = ModelCard(
        name=run.resolve().name,
        network=folded.plan.name,
        definitions_version=tf.VERSION,
        program_version=package_versions()["driverview"],
        camera=camera or Camera(),
        alpha=alpha,
        recipe=recipe,
        iterations=iterations,
        batch=batch,
        seed=seed,
        data=data or {},
        versions=package_versions(),
        files={name: file_hash(run / name) for name in MODEL_FILES},
        export_check=check,
        golden=tuple(float(v) for v in answer_images(folded, golden[None])[0]),
    )
    card.write(run)
    return card


def compare(network: Network, run: Path, images: NDArray[np.uint8]) -> dict[str, float]:
    """Largest difference of any output between torch in float32 and the graph, per precision."""
    import openvino

    from mtlnet.engine import best_precision

    expected = answer_images(network, images)
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
        differences[f"openvino_{precision}_max"] = float(np.abs(answers - expected).max())
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
