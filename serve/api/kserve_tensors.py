"""Encoding of tensors in the Open Inference Protocol v2: JSON or raw binary.

Source: Open Inference Protocol, REST, and its binary tensor data extension: a JSON header of
`Inference-Header-Content-Length` bytes is followed by the tensors that have `binary_data_size`, in
order, little-endian, row-major; each element of BYTES is preceded by its length as a 4-byte number.
"""

import base64
import binascii
from collections.abc import Iterator
from math import prod
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from serve.api.problems import INVALID_REQUEST, Problem

MAX_DEPTH = 4
MAX_DIGITS = 20  # of a length in a header; int() refuses thousands


class RequestedOutput(msgspec.Struct):
    """A requested output."""

    name: str
    parameters: dict[str, Any] = {}


class Tensor(msgspec.Struct):
    """An input tensor."""

    name: str
    shape: list[int]
    datatype: str
    parameters: dict[str, Any] = {}
    data: Any = None


class InferRequest(msgspec.Struct):
    """The JSON part of a request."""

    inputs: list[Tensor]
    id: str | None = None
    outputs: list[RequestedOutput] = []
    parameters: dict[str, Any] = {}


def parse_request(body: bytes, header_length: bytes | None) -> tuple[InferRequest, memoryview]:
    """(the JSON part, the binary part) of a request. Raises Problem."""
    length = len(body)
    if header_length is not None:
        usable = header_length.isdigit() and len(header_length) <= MAX_DIGITS
        if not usable or int(header_length) > len(body):
            raise invalid_request(
                "Inference-Header-Content-Length is not a length within this body"
            )
        length = int(header_length)
    try:
        request = msgspec.json.decode(body[:length], type=InferRequest)
    except (msgspec.DecodeError, RecursionError) as error:
        raise invalid_request(f"the body is not an inference request: {error}") from error
    return request, memoryview(body)[length:]


def read_image_bytes(tensor: Tensor, binary: memoryview) -> bytes:
    """The file in a BYTES tensor of one element; in JSON it is base64. Raises Problem."""
    if tensor.datatype != "BYTES" or tensor.shape not in ([1], [1, 1]):
        raise invalid_request(
            f"{tensor.name} is {tensor.datatype[:20]} {tensor.shape[:8]}; it takes BYTES [1, 1]"
        )
    raw = _binary(tensor, binary)
    if raw is not None:
        if len(raw) < 4 or int.from_bytes(raw[:4], "little") != len(raw) - 4:
            raise invalid_request(f"{tensor.name} must hold one element, preceded by its length")
        return bytes(raw[4:])
    elements = list(_flat(tensor.data))
    if len(elements) != 1 or not isinstance(elements[0], str):
        raise invalid_request(f"{tensor.name} must hold one file in base64")
    try:
        return base64.b64decode(elements[0], validate=True)
    except (binascii.Error, ValueError) as error:
        raise invalid_request(f"{tensor.name} is not base64: {error}") from error


def read_pixels(tensor: Tensor, binary: memoryview) -> NDArray[np.uint8]:
    """A UINT8 tensor as (height, width, 3); a leading 1 is removed. Raises Problem."""
    shape = tensor.shape[1:] if len(tensor.shape) == 4 and tensor.shape[0] == 1 else tensor.shape
    usable = len(shape) == 3 and shape[2] == 3 and min(shape) > 0
    if tensor.datatype != "UINT8" or not usable:
        raise invalid_request(
            f"{tensor.name} is {tensor.datatype[:20]} {tensor.shape[:8]}; it takes UINT8 "
            "[1, height, width, 3]"
        )
    raw = _binary(tensor, binary)
    if raw is not None:
        values = np.frombuffer(raw, np.uint8)
    else:
        elements = list(_flat(tensor.data))
        if not all(type(value) is int and 0 <= value <= 255 for value in elements):
            raise invalid_request(f"{tensor.name} must hold integers from 0 to 255")
        values = np.array(elements, np.uint8)
    if values.size != prod(shape):
        raise invalid_request(
            f"{tensor.name} has {values.size} values, its shape needs {prod(shape)}"
        )
    return values.reshape(shape)


def _binary(tensor: Tensor, binary: memoryview) -> memoryview | None:
    size = tensor.parameters.get("binary_data_size")
    if size is None:
        if len(binary):
            raise invalid_request(
                f"{tensor.name} has no binary_data_size, but bytes follow the JSON part"
            )
        return None
    if type(size) is not int or size != len(binary):
        raise invalid_request(
            f"{tensor.name} declares binary_data_size {size!r}, but {len(binary)} bytes follow"
        )
    return binary


def _flat(data: Any, depth: int = MAX_DEPTH) -> Iterator[Any]:
    """The elements of nested lists in order. Raises Problem where they are nested too deep."""
    if isinstance(data, list):
        if depth == 0:
            raise invalid_request(f"the data is nested deeper than {MAX_DEPTH} lists")
        for part in data:
            yield from _flat(part, depth - 1)
    elif data is not None:
        yield data


def encode_response(
    head: dict[str, Any], tensors: dict[str, NDArray[np.float32]], request: InferRequest
) -> tuple[bytes, int | None]:
    """(body of the answer, length of its JSON part or None where all is JSON). Raises Problem."""
    requested = request.outputs or [RequestedOutput(name) for name in tensors]
    default = bool(request.parameters.get("binary_data_output", False))
    outputs, parts = [], []
    for output_request in requested:
        if output_request.name not in tensors:
            raise invalid_request(
                f"unknown output {output_request.name[:80]!r}; there are {', '.join(tensors)}"
            )
        values = tensors[output_request.name]
        output: dict[str, Any] = {
            "name": output_request.name,
            "datatype": "FP32",
            "shape": list(values.shape),
        }
        if output_request.parameters.get("binary_data", default):
            parts.append(values.astype("<f4").tobytes())
            output["parameters"] = {"binary_data_size": len(parts[-1])}
        else:
            output["data"] = values.ravel().tolist()  # NaN, for absent, becomes null
        outputs.append(output)
    content = msgspec.json.encode({**head, "outputs": outputs})
    return content + b"".join(parts), len(content) if parts else None


def invalid_request(detail: str) -> Problem:
    """The problem of a request that violates the protocol."""
    return Problem(INVALID_REQUEST, detail)
