"""Converts a trained torch network to an OpenVINO graph.

The graph is written beside the weights, so that `serve` loads it without torch.

The heads, the uncertainty head and the texture features of the out-of-distribution score are
computed in float32 even if all other layers are in bf16, because OpenVINO rounds the results of a
MatMul to bf16. The steps of bf16 are 0.004 near 1, which is 0.025 m or 0.005 rad for a head with
coded values. One MatMul of the uncertainty head stays in bf16: the product with
`texture_directions`. The out-of-distribution score is the sum of the squared elements of this
product; bf16 changes the score by 0.1 %, at most by 0.5 %.
"""

import errno
import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import nn

from mtlnet.architecture import HEIGHT, WIDTH
from mtlnet.model.network import Network
from mtlnet.model.served import FitInputs, ServedNetwork
from mtlnet.model.uncertainty_head import UncertaintyHead
from runtime.files import fsync_path, utf8_path

TOLERANCE = 2e-4
"""Largest allowed absolute difference of an output (coded value or probability) from torch in
float32."""
UNCERTAINTY_TOLERANCE = 5e-3
"""Largest allowed relative difference of a standard deviation or the out-of-distribution score."""
DIRECTIONS = "__module.head/aten::linear/MatMul"
"""Name of the graph's MatMul with `UncertaintyHead.texture_directions`."""
MIN_NARROW_VALUES = 256  # smaller constants stay in float32


def build_graph(network: Network, head: UncertaintyHead | None = None, batch: int = 1) -> Any:
    """Convert a folded network, with its uncertainty head if it has one, to an OpenVINO model that
    maps uint8 images (B, 210, 280, 3) to float32 (B, K).

    K is 9 to 22; `mtlnet.inference.prediction.split_outputs` explains the columns. `batch`: number
    of images, 1 or -1; -1 allows any number, and is slower for a single image.
    """
    return _converted(ServedNetwork(network, head), batch)


def build_feature_graph(network: Network) -> Any:
    """Convert a network to an OpenVINO model with three results for one uint8 image
    (1, 210, 280, 3): the nine outputs, the inputs of the uncertainty head and the texture features
    (`mtlnet.model.served.FitInputs`)."""
    return _converted(FitInputs(network), 1)


def write_graph(
    network: Network,
    graph: Path,
    weights: Path,
    head: UncertaintyHead | None = None,
    *,
    narrow: bool = False,
) -> None:
    """Write the OpenVINO graph of a folded network, and of its uncertainty `head` if given, to
    `graph` (.xml), and its weights to `weights` (.bin).

    `narrow`: constants that float16 holds exactly are stored in float16, all others in float32.
    Raises OSError when writing fails, for example on a full disk; both files are then unchanged.
    """
    import openvino

    model = build_graph(network, head)
    if narrow:
        narrow_constants(model, "f16")
    # OpenVINO names the weights after the graph, so both are first written under another name.
    staged = graph.with_name("staged.xml")
    try:
        with utf8_path(staged) as plain:
            openvino.save_model(model, str(plain), compress_to_fp16=False)
        for path in (staged, staged.with_suffix(".bin")):
            fsync_path(path)
        staged.with_suffix(".bin").replace(weights)
        staged.replace(graph)
        fsync_path(graph.parent)
    except RuntimeError as error:  # OpenVINO's error for a failed write; it gives no reason
        reason = "OpenVINO could not write the model's graph; is the disk full?"
        raise OSError(errno.EIO, reason, str(graph)) from error
    finally:
        staged.unlink(missing_ok=True)
        staged.with_suffix(".bin").unlink(missing_ok=True)


def narrow_constants(model: Any, kind: Literal["bf16", "f16"]) -> None:
    """Store the float32 constants of an OpenVINO model that have 256 values or more in 16 bits of
    type `kind`, with conversions to float32 (in place).

    bf16 rounds the values. f16 is used only for constants that it holds exactly.
    """
    import openvino
    from openvino import opset13 as ops

    narrow = getattr(openvino.Type, kind)
    for node in model.get_ordered_ops():
        if node.get_type_name() != "Constant" or node.get_element_type() != openvino.Type.f32:
            continue
        if int(np.prod(node.get_output_shape(0))) < MIN_NARROW_VALUES:
            continue
        values = node.get_data()
        with np.errstate(over="ignore"):
            if kind == "f16" and not (values.astype(np.float16) == values).all():
                continue
        readers = node.output(0).get_target_inputs()
        widened = ops.convert(ops.constant(values, dtype=narrow), "f32")
        widened.get_rt_info()["decompression_0"] = ""
        for reader in readers:
            reader.replace_source_output(widened.output(0))


def _converted(module: nn.Module, batch: int) -> Any:
    """The OpenVINO model of a module whose input is images uint8 (`batch`, 210, 280, 3)."""
    import openvino
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder

    example = torch.zeros((2, HEIGHT, WIDTH, 3), dtype=torch.uint8)
    with warnings.catch_warnings():  # torch's tracer warns about the constants in the code
        warnings.simplefilter("ignore")
        # `publish` compares the graph with torch, so the tracer's own check, a third of the time,
        # is left out.
        traced = TorchScriptPythonDecoder(
            module.eval(), example_input=example, trace_kwargs={"check_trace": False}
        )
        model = openvino.convert_model(
            traced,
            input=[openvino.PartialShape([batch, HEIGHT, WIDTH, 3])],
        )
    model.inputs[0].get_tensor().set_names({"images"})
    model.outputs[0].get_tensor().set_names({"outputs"})
    _keep_float32(model)
    return model


def _keep_float32(model: Any) -> None:
    """Replace each MatMul of the heads and of the uncertainty head, except `DIRECTIONS`, by
    elementwise products and sums, which OpenVINO leaves in float32 (in place)."""
    products = [op for op in model.get_ordered_ops() if op.get_type_name() == "MatMul"]
    for product in products:
        name = product.get_friendly_name()
        if ".shared." not in name and name != DIRECTIONS:
            summed = _sum_of_products(*product.input_values())
            summed.set_friendly_name(f"{name}/summed")
            product.output(0).replace(summed.output(0))


def _sum_of_products(x: Any, weight: Any) -> Any:
    """Matrix product (B, N) of `x` (B, F) and the transpose of `weight` (N, F), from elementwise
    operations; B is 1 unless it is dynamic."""
    from openvino import opset13 as ops

    if x.get_partial_shape()[0].is_dynamic:
        each = ops.multiply(ops.unsqueeze(x, np.array([1])), ops.unsqueeze(weight, np.array([0])))
        # The sum must keep the axis: OpenVINO 2026.4 otherwise adds a following bias (1, N) to the
        # wrong values.
        return ops.squeeze(ops.reduce_sum(each, np.array([2]), keep_dims=True), np.array([2]))
    # Two dimensions, because OpenVINO would reorder three dimensions as the channels of an image.
    return ops.unsqueeze(ops.reduce_sum(ops.multiply(x, weight), np.array([1])), np.array([0]))
