"""`mtlnet export --model RUN --format onnx|openvino --precision f32|bf16|int8`: checked on frames.

float32: as trained. bf16: weights stored in half the bytes, widened as they are read. int8
(OpenVINO): see `mtlnet.export.int8`; it is used by default once it has passed its gate on test
rounds.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from datagen.recording import Dataset
from mtlnet.evaluation.evaluate import require_fit
from mtlnet.export.int8 import calibration_images, judge, quantise
from mtlnet.export.openvino_graph import TOLERANCE
from mtlnet.inference.exported import ABOUT, write_about
from mtlnet.inference.model_card import (
    GRAPH,
    GRAPH_WEIGHTS,
    WEIGHTS,
    ModelError,
    check_files,
    read_card,
)
from mtlnet.inference.prediction import OUTPUTS
from mtlnet.model.network import HEIGHT, WIDTH, Network, predict_images, load_network
from trackfeatures.errors import UserError

FORMATS, PRECISIONS = ("onnx", "openvino"), ("f32", "bf16", "int8")
ONNX_FILE = "model.onnx"
OPSET = 18
LARGE = 256  # numbers; smaller constants are not worth half their bytes


def export_model(
    run: Path,
    kind: str,
    precision: str,
    data: Path | None = None,
    out: Path | None = None,
    frames: int = 64,
) -> dict[str, Any]:
    """Write the model of `run` in another form and check it; what `--json` prints.

    `data`: the dataset of the frames it is checked on, by default the one it was trained on.
    Raises UserError for what cannot be exported, ModelError when the result is wrong.
    """
    if kind not in FORMATS or precision not in PRECISIONS:
        raise UserError(
            f"there is no {kind} in {precision}; give --format {' or '.join(FORMATS)} and "
            f"--precision {', '.join(PRECISIONS)}"
        )
    if kind == "onnx" and precision == "int8":
        raise UserError("int8 is made for OpenVINO; give --format openvino, or --precision bf16")
    if frames < 1:
        raise UserError(f"--frames is {frames}; give at least 1")
    card = read_card(run)
    check_files(run, card, (WEIGHTS, GRAPH, GRAPH_WEIGHTS))
    dataset = Dataset.open(data or Path(card.data.get("path", "datasets/default")))
    shown = dataset.select("all" if precision != "int8" else "test")
    require_fit(card, shown, "all")
    chosen = np.linspace(0, len(shown) - 1, min(frames, len(shown))).astype(np.int64)
    if precision == "int8" and out is not None:
        raise UserError("an int8 graph is judged where the engine finds it; leave out --out")
    folder = out or run / "export" / f"{kind}-{precision}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / ABOUT).unlink(missing_ok=True)  # killed from here on, there is no export at all
    network = load_network(run / WEIGHTS, card.network)
    images = shown.read_batch(chosen)
    names = _write(run, network, folder, (kind, precision), dataset)
    check = check_on(network, folder / names[0], precision, images)
    about: dict[str, Any] = {"format": kind, "precision": precision, "check": check}
    write_about(folder, card, names, **about)
    if precision == "int8":
        about["gate"] = judge(run, dataset.path)
        write_about(folder, card, names, **about)
    if precision == "f32" and not check["largest"] <= TOLERANCE:
        raise ModelError(
            f"{folder / names[0]} differs from torch by {check['largest']:.2g}, at most "
            f"{TOLERANCE:g} is expected; report this as a fault"
        )
    return {"model": card.name, "out": str(folder), "files": list(names), **about}


def _write(
    run: Path, network: Network, folder: Path, form: tuple[str, str], dataset: Dataset
) -> tuple[str, ...]:
    """Write the files of an export of this format and precision; their names."""
    kind, precision = form
    try:
        if kind == "onnx":
            return write_onnx(network, folder, half=precision == "bf16")
        return write_openvino(run, folder, precision, dataset)
    except RuntimeError as error:  # how OpenVINO says that a write failed, without the reason
        reason = str(error).strip().splitlines()[-1]
        raise UserError(f"{folder} could not be written ({reason}); is the disk full?") from error


class Answering(torch.nn.Module):
    """What an exported graph computes: images (1, H, W, 3) uint8 -> (1, 9), probabilities last."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """The nine outputs."""
        outputs = self.network(images)
        return torch.cat([outputs[:, :6], torch.softmax(outputs[:, 6:], 1)], 1)


def write_onnx(network: Network, folder: Path, *, half: bool) -> tuple[str, ...]:
    """Write `model.onnx`, one file; `half`: large weights in bf16."""
    import onnx

    images = torch.zeros((1, HEIGHT, WIDTH, 3), dtype=torch.uint8)
    path = folder / ONNX_FILE
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    program = torch.onnx.export(
        Answering(network).eval(),
        (images,),
        dynamo=True,
        opset_version=OPSET,
        input_names=["images"],
        output_names=["outputs"],
        verbose=False,
    )
    assert program is not None
    model = program.model_proto
    if half:
        halve_onnx(model)
    onnx.checker.check_model(model)
    staged = path.with_suffix(".partial")
    try:
        onnx.save_model(model, str(staged))
        staged.replace(path)
    finally:
        staged.unlink(missing_ok=True)
    return (ONNX_FILE,)


def halve_onnx(model: Any) -> None:
    """Store large float32 weights of an ONNX model as bf16, cast to float32 where they are read."""
    import ml_dtypes
    import onnx
    from onnx import helper, numpy_helper

    casts = []
    for tensor in model.graph.initializer:
        if tensor.data_type != onnx.TensorProto.FLOAT or np.prod(tensor.dims) < LARGE:
            continue
        rounded = numpy_helper.to_array(tensor).astype(ml_dtypes.bfloat16)
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(rounded, f"{name}_bf16"))
        casts.append(helper.make_node("Cast", [f"{name}_bf16"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)


def write_openvino(run: Path, folder: Path, precision: str, dataset: Dataset) -> tuple[str, ...]:
    """Write `model.xml` and `model.bin`, made from the graph the run was published with."""
    import openvino

    model = openvino.Core().read_model(str(run / GRAPH))
    if precision == "bf16":
        halve_openvino(model)
    if precision == "int8":
        model = quantise(model, calibration_images(dataset.select("train")))
    openvino.save_model(model, str(folder / GRAPH), compress_to_fp16=False)
    return (GRAPH, GRAPH_WEIGHTS)


def halve_openvino(model: Any) -> None:
    """Store large float32 weights of an OpenVINO model as bf16, widened where they are read."""
    import openvino
    from openvino import opset13 as ops

    for node in model.get_ordered_ops():
        if node.get_type_name() != "Constant" or node.get_element_type() != openvino.Type.f32:
            continue
        if int(np.prod(node.get_output_shape(0))) < LARGE:
            continue
        readers = node.output(0).get_target_inputs()
        rounded = ops.constant(node.get_data(), dtype=openvino.Type.bf16)
        widened = ops.convert(rounded, "f32")
        widened.get_rt_info()["decompression_0"] = ""
        for reader in readers:
            reader.replace_source_output(widened.output(0))


def check_on(
    network: Network, path: Path, precision: str, images: NDArray[np.uint8]
) -> dict[str, Any]:
    """Largest difference of any of the nine outputs from torch in float32, as OpenVINO reads it."""
    import openvino

    from mtlnet.inference.engine import best_precision

    core = openvino.Core()
    computed = "f32" if precision == "f32" else best_precision(core)
    options = {"INFERENCE_PRECISION_HINT": computed}
    request = core.compile_model(str(path), "CPU", options).create_infer_request()
    found = np.concatenate([request.infer([image[None]])[0].copy() for image in images])
    difference = np.abs(found[:, :OUTPUTS] - predict_images(network, images))
    return {
        "frames": len(images),
        "computed_in": computed,
        "largest": float(difference.max()),
        "coded": float(difference[:, :6].max()),
        "probability": float(difference[:, 6:].max()),
    }
