"""`mtlnet export --model RUN --format onnx|openvino --precision f32|bf16|int8`.

With f32 the weights stay as trained. With bf16 large weights (arrays of at least 256 values) are
stored in bf16, and the graph converts them to float32. int8 is possible for OpenVINO only
(`mtlnet.export.int8`). The engine uses an int8 graph by default if the graph has passed the
accuracy gate: its errors on the test rounds are at most a little larger than the errors in float32.
Each export is compared with torch on frames of a dataset.

ONNX and OpenVINO models take any number of images at once (first axis, "batch") and give the same
answers as for single images. ONNX models lack the uncertainty head. The int8 graph takes one image,
as the engine does, because a graph for a single image is faster.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from datagen.recording import Dataset, Frames
from mtlnet.architecture import HEIGHT, WIDTH
from mtlnet.data.custom_images import has_labels_file
from mtlnet.data.labels_file import LABELS
from mtlnet.data.rounds import hold_out_rounds, require_decodable
from mtlnet.evaluation.evaluate import require_fit
from mtlnet.export.int8 import (
    FLOAT_ACTIVATIONS,
    calibration_images,
    choose_float_activations,
    judge,
    quantise,
)
from mtlnet.inference.engine import (
    EXPORT_FILE,
    GATES,
    INT8,
    best_precision,
    int8_graph,
    read_export,
    run_graph,
)
from mtlnet.inference.model_card import (
    GRAPH,
    GRAPH_WEIGHTS,
    ModelCard,
    ModelError,
    read_card,
)
from mtlnet.inference.prediction import OUTPUTS
from mtlnet.inference.torch_engine import load_served
from mtlnet.inference.trained_rounds import names_entry
from mtlnet.model.network import Network, predict_images
from mtlnet.model.openvino_graph import (
    MIN_NARROW_VALUES,
    TOLERANCE,
    build_graph,
    narrow_constants,
)
from mtlnet.model.served import ServedNetwork
from runtime.files import atomic_move, file_hash, replaced_files, utf8_path, write_json
from trackfeatures.errors import UserError

FORMATS, PRECISIONS = ("onnx", "openvino"), ("f32", "bf16", "int8")
ONNX_FILE = "model.onnx"
OPSET = 18
CHECK_BATCH = 3  # images at once
MAX_CHECK_FRAMES = 10_000
"""Maximum number of frames of a comparison, whose images are held in memory (1.8 GB)."""


def export_model(
    run: Path,
    kind: str,
    precision: str,
    data: Path | None = None,
    out: Path | None = None,
    frames: int = 64,
    *,
    gate_only: bool = False,
) -> dict[str, Any]:
    """Write the model of `run` in another format and compare it with torch; returns the result of
    `--json`.

    `kind`: "onnx" or "openvino"; `precision`: "f32", "bf16" or "int8". The comparison uses `frames`
    frames of the dataset `data`, by default of the training data, which a shipped model lacks. For
    int8 it uses frames of the dataset's test rounds only. `out`: the folder to write.
    `gate_only`: write no graph, only evaluate the gate of the existing int8 graph
    (`evaluate_gate`). Raises UserError for an unsupported export and for missing data, ModelError
    when an f32 export differs by more than the tolerance.
    """
    _require_supported(kind, precision, out, frames)
    if gate_only:
        return evaluate_gate(run, precision, data)
    card = read_card(run)
    dataset, shown = _open_data(card, precision, data)
    chosen = np.linspace(0, len(shown) - 1, min(frames, len(shown))).astype(np.int64)
    folder = out or run / "export" / f"{kind}-{precision}"
    served = load_served(run, card)
    network = served.network
    images = shown.read_batch(chosen)
    about: dict[str, Any] = {"format": kind, "precision": precision}
    with replaced_files(folder, last=EXPORT_FILE) as staged:
        if kind == "onnx":
            names = write_onnx(network, staged, bf16=precision == "bf16")
        else:
            int8 = precision == "int8"
            graph = build_graph(network, served.head, batch=1 if int8 else -1)
            if int8:
                graph, about["float_activations"] = _quantised(graph, card, dataset)
            try:
                names = write_openvino(graph, staged, precision)
            except RuntimeError as error:  # OpenVINO's error for a failed write
                reason = str(error).strip().splitlines()[-1]
                raise UserError(
                    f"{folder} could not be written ({reason}); is the disk full?"
                ) from error
        about["check"] = check = check_export(network, staged / names[0], precision, images)
        if precision == "f32" and not check["largest"] <= TOLERANCE:
            raise ModelError(
                f"{folder / names[0]} would differ from torch by {check['largest']:.2g}, at most "
                f"{TOLERANCE:g} is expected; report this as a fault"
            )
        write_export(staged, card, names, **about)
    if precision == "int8":
        about["gate"] = judge(run, dataset.path)
        write_export(folder, card, names, **about)
    return {"model": card.name, "out": str(folder), "files": list(names), **about}


def evaluate_gate(run: Path, precision: str, data: Path | None) -> dict[str, Any]:
    """Evaluate the accuracy gate of the int8 graph of `run` again, on this processor and the test
    rounds of the dataset `data` (None: of the training data), and store the result with the graph.

    A result of the same kind of processor, with or without native int8, is replaced. Returns the
    result of `--json`. Raises UserError for another `precision` than int8 and for missing data,
    ModelError without an int8 graph.
    """
    if precision != "int8":
        raise UserError(
            f"{precision} has no accuracy gate; give --precision int8 or leave out --gate-only"
        )
    card = read_card(run)
    int8_graph(run, card)
    dataset, _ = _open_data(card, "int8", data)
    found = judge(run, dataset.path)
    folder = run / INT8
    about = read_export(folder)
    assert about is not None
    first = about.get("gate") or found
    name = GATES[first.get("native_int8", False) != found["native_int8"]]
    write_json(folder / EXPORT_FILE, {**about, name: found})
    return {"model": card.name, "out": str(folder), **about, "gate": found}


def _open_data(card: ModelCard, precision: str, data: Path | None) -> tuple[Dataset, Frames]:
    """Open the dataset `data`, by default of the training data; returns it and the frames that the
    comparison can use. Raises UserError or ModelError for data that cannot be used."""
    source = data or Path(card.data.get("path", "datasets/default"))
    if has_labels_file(source):
        raise UserError(
            f"{source} holds images with a {LABELS}; an export is checked on recorded rounds: give "
            "a dataset of `datagen collect` with --data"
        )
    if data is None and not (source / "rounds").is_dir():
        raise UserError(
            f"the dataset on which model {card.name} was trained ({source}) is not here; give a "
            "dataset of the same camera, on which the export is compared with torch, with "
            "--data DIR (in Python data=DIR)"
        )
    dataset = Dataset.open(source)
    split = "test" if precision == "int8" else "all"
    shown = dataset.select(split)
    require_fit(card, shown, split)
    if precision == "int8":
        # The gate reads all of them, but only after the new graph has replaced the old one.
        require_decodable(shown, source)
    return dataset, shown


def _quantised(graph: Any, card: ModelCard, dataset: Dataset) -> tuple[Any, tuple[int, ...]]:
    """Return a graph in int8, and the numbers of its convolutions with float activations.

    These convolutions are chosen on the rounds on which the uncertainty head was fitted, if these
    rounds are a part of `dataset`; otherwise on a part of the dataset's train rounds, which is then
    not used for the calibration.
    """
    fitted = card.uncertainty or {}
    train, held_out = parts = hold_out_rounds(dataset)
    if fitted.get("content_hash", card.data.get("content_hash")) == dataset.content_hash:
        for part in filter(None, parts):
            if names_entry(info.id for info in part.rounds) == fitted.get("held_out"):
                train, held_out = dataset.select("train"), part
    images, chosen = calibration_images(train), FLOAT_ACTIVATIONS
    if held_out is not None:
        chosen = choose_float_activations(graph, images, held_out, card.data["mean"])
    return quantise(graph, images, chosen), chosen


def _require_supported(kind: str, precision: str, out: Path | None, frames: int) -> None:
    """Raise UserError for an unsupported combination of options of `export_model`."""
    if kind not in FORMATS or precision not in PRECISIONS:
        raise UserError(
            f"there is no export to {kind} in {precision}; give --format "
            f"{' or '.join(FORMATS)} and --precision {', '.join(PRECISIONS)}"
        )
    if kind == "onnx" and precision == "int8":
        raise UserError("int8 needs --format openvino; give that, or --precision bf16")
    if not 1 <= frames <= MAX_CHECK_FRAMES:
        raise UserError(f"--frames is {frames}; give 1 to {MAX_CHECK_FRAMES}")
    if precision == "int8" and out is not None:
        raise UserError("the engine looks for an int8 graph in the run's folder; leave out --out")


def write_export(folder: Path, card: ModelCard, names: tuple[str, ...], **about: Any) -> None:
    """Write the `export.json` of the export in `folder`. It has the hash of the model, the hashes
    of the files `names`, and the entries `about`."""
    files = {name: file_hash(folder / name) for name in names}
    content = {"model_hash": card.model_hash, "files": files, **about}
    write_json(folder / EXPORT_FILE, content)


class OnnxNetwork(ServedNetwork):
    """A network without uncertainty head, from uint8 images (B, H, W, 3) to its outputs (B, 9).

    With heads over bins there is a second result (B, 5): the probabilities that the markings are
    absent.
    """

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, ...]:  # type: ignore[override]
        x = self.network.forward_features(images)
        if not self.network.architecture.bins:
            return (self.network.nine_outputs(x),)
        return self.network.nine_outputs(x), self.network.absent_probabilities(x)


def write_onnx(network: Network, folder: Path, *, bf16: bool) -> tuple[str, ...]:
    """Write `model.onnx` to `folder`; returns its name as a tuple. `bf16`: large weights are stored
    in bf16."""
    import onnx

    images = torch.zeros((2, HEIGHT, WIDTH, 3), dtype=torch.uint8)  # torch would fix a size of 1
    path = folder / ONNX_FILE
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    program = torch.onnx.export(
        OnnxNetwork(network).eval(),
        (images,),
        dynamo=True,
        opset_version=OPSET,
        input_names=["images"],
        output_names=["outputs", "absent"][: 1 + network.architecture.bins],
        dynamic_shapes=({0: torch.export.Dim("batch", min=0)},),
        verbose=False,
    )
    assert program is not None
    model = program.model_proto
    if bf16:
        store_onnx_bf16(model)
    onnx.checker.check_model(model)
    staged = path.with_suffix(".partial")
    try:
        with utf8_path(staged) as plain:
            onnx.save_model(model, str(plain))
        atomic_move(staged, path)
    finally:
        staged.unlink(missing_ok=True)
    return (ONNX_FILE,)


def store_onnx_bf16(model: Any) -> None:
    """Change an `onnx.ModelProto` in place: its large float32 weights are stored in bf16, with
    casts back to float32."""
    import ml_dtypes
    import onnx
    from onnx import helper, numpy_helper

    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type != onnx.TensorProto.FLOAT or np.prod(tensor.dims) < MIN_NARROW_VALUES:
            continue
        rounded = numpy_helper.to_array(tensor).astype(ml_dtypes.bfloat16)
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(rounded, f"{name}_bf16"))
        casts.append(helper.make_node("Cast", [f"{name}_bf16"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)


def write_openvino(model: Any, folder: Path, precision: str) -> tuple[str, ...]:
    """Write the files of `model`, an `openvino.Model`, to `folder`; returns their names. With the
    `precision` bf16, large weights are stored in bf16."""
    import openvino

    model.inputs[0].get_node().set_layout(openvino.Layout("[batch,height,width,colour]"))
    if precision == "bf16":
        narrow_constants(model, "bf16")
    with utf8_path(folder / GRAPH) as plain:
        openvino.save_model(model, str(plain), compress_to_fp16=False)
    return (GRAPH, GRAPH_WEIGHTS)


def check_export(
    network: Network, path: Path, precision: str, images: NDArray[np.uint8]
) -> dict[str, Any]:
    """Return the largest differences between the nine outputs of the file `path`, computed by
    OpenVINO, and the outputs of torch in float32, for `images` (N, H, W, 3).

    The images are computed in batches, except for int8, whose graph takes one image.
    """
    computed = "f32" if precision == "f32" else best_precision()
    found = run_graph(path, computed, images, 1 if precision == "int8" else CHECK_BATCH)
    difference = np.abs(found[:, :OUTPUTS] - predict_images(network, images))
    return {
        "frames": len(images),
        "computed_in": computed,
        "largest": float(difference.max()),
        "coded": float(difference[:, :6].max()),
        "probability": float(difference[:, 6:].max()),
    }
