"""Reads and writes tensors of the Open Inference Protocol v2, in JSON or raw binary.

Source: Open Inference Protocol, REST, and its binary tensor data extension. A JSON part of
`Inference-Header-Content-Length` bytes is followed by the tensors with a `binary_data_size`, in
order, little-endian, row-major. A 4-byte length precedes each element of a BYTES tensor.
"""

import asyncio
import binascii
from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from serve.api.request_options import OPTIONS, check_names, parse_json_object
from serve.problems import INVALID_REQUEST, Problem

MAX_DEPTH = 4
MAX_VALUES = 1_300_000  # JSON values and lists, enough for 640 x 480 px; decoding one takes 10 ns
MAX_SMALL_BYTES = 4096  # largest JSON size of a shape, of the outputs or of an object of parameters
WINDOW_BYTES = 1 << 16  # JSON or base64 decoded in one piece; other tasks can run in between
SIZE, BINARY, ALL_BINARY = "binary_data_size", "binary_data", "binary_data_output"
# Known parameters of an input, of an output and of a request; OPTIONS are the options of an image.
INPUT_PARAMETERS, OUTPUT_PARAMETERS = {SIZE: "int"}, {BINARY: "bool"}
REQUEST_PARAMETERS = {ALL_BINARY: "bool", **OPTIONS}
PAUSE_S = 0.001  # pause between windows; without it the engine's thread waits for the GIL
COUNT_BYTES = 1 << 18  # JSON whose values are counted in one step, which bounds the memory
JSON_MS_PER_BYTE = 1e-4  # time to decode a byte of pixels in JSON
PIXEL_MS = 1e-6  # time to crop and scale a pixel
MAX_SIDE = 1 << 31  # limit for the numbers of a shape; much larger numbers do not fit into a float
COMMA, BRACKET = b",["
MAX_LENGTH_DIGITS = 20
NULL = memoryview(b"null")
BLANKS = b" \t\r\n"
T = TypeVar("T")


class _Misplaced(msgspec.Struct, kw_only=True):
    """Options placed next to `parameters` instead of in it; absent options are empty."""

    frame_id: msgspec.Raw = msgspec.Raw()
    stream_id: msgspec.Raw = msgspec.Raw()
    deadline_ms: msgspec.Raw = msgspec.Raw()
    fov_y: msgspec.Raw = msgspec.Raw()
    camera: msgspec.Raw = msgspec.Raw()
    binary_data_output: msgspec.Raw = msgspec.Raw()

    def check(self) -> None:
        """Raise Problem for a misplaced option, which would otherwise be ignored."""
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if name in REQUEST_PARAMETERS and len(memoryview(value)):
                raise invalid_request(
                    f"{name} is at the wrong place; put it into the parameters of the request"
                )


class RequestedOutput(msgspec.Struct):
    """An output that the client requests, with its parameters."""

    name: str
    parameters: dict[str, Any] = {}


class Tensor(msgspec.Struct):
    """An input tensor; `data` is JSON text, or empty for a binary tensor."""

    name: str
    shape: list[int]
    datatype: str
    parameters: dict[str, Any] = {}
    data: bytes = b""


class InferRequest(msgspec.Struct):
    """The JSON part of a request."""

    input: Tensor
    id: str | None = None
    outputs: list[RequestedOutput] = []
    parameters: dict[str, Any] = {}


# The raw structs split a request without decoding it: the objects of a 4 MB list can need 40 MB.


class _RawTensor(_Misplaced):
    name: str
    shape: msgspec.Raw
    datatype: str
    parameters: msgspec.Raw = msgspec.Raw(b"{}")
    data: msgspec.Raw = msgspec.Raw(b"")


class _RawRequest(_Misplaced):
    inputs: tuple[_RawTensor]
    id: str | None = None
    outputs: msgspec.Raw = msgspec.Raw(b"[]")
    parameters: msgspec.Raw = msgspec.Raw(b"{}")


def read_json_length(body: bytes, header: bytes | None) -> int:
    """Size in bytes of the JSON part: `header` (Inference-Header-Content-Length), else the whole
    body. Raises Problem."""
    if header is None:
        return len(body)
    usable = header.isdigit() and len(header) <= MAX_LENGTH_DIGITS
    if not usable or int(header) > len(body):
        raise invalid_request("Inference-Header-Content-Length is not a length within this body")
    return int(header)


def parse_request(body: bytes, length: int) -> tuple[InferRequest, memoryview]:
    """Decode the JSON part, the first `length` bytes of `body`; return it and the binary rest."""
    text, values = np.frombuffer(body, np.uint8, length), 0
    for start in range(0, length, COUNT_BYTES):
        part = text[start : start + COUNT_BYTES]
        values += int(np.count_nonzero(part == COMMA) + np.count_nonzero(part == BRACKET))
    if values > MAX_VALUES:
        raise invalid_request(
            f"the JSON part has {values} values and lists; at most {MAX_VALUES} are accepted: send "
            "the tensor as binary data"
        )
    try:
        request = _parse_json(memoryview(body)[:length])
    except (msgspec.DecodeError, RecursionError) as error:
        raise invalid_request(f"the body is not an inference request: {error}") from error
    return request, memoryview(body)[length:]


def _parse_json(text: memoryview) -> InferRequest:
    """Decode the JSON part of a request. Raises Problem, msgspec.DecodeError, RecursionError."""
    raw = msgspec.json.decode(text, type=_RawRequest)
    (tensor,) = raw.inputs
    raw.check()
    tensor.check()
    return InferRequest(
        Tensor(
            tensor.name,
            _small(tensor.shape, list[int]),
            tensor.datatype,
            _parameters(tensor.parameters, INPUT_PARAMETERS, f"parameters of {tensor.name[:40]}"),
            b"" if memoryview(tensor.data) == NULL else bytes(tensor.data),
        ),
        raw.id,
        _outputs(raw.outputs),
        _parameters(raw.parameters, REQUEST_PARAMETERS, "parameters"),
    )


def _outputs(raw: msgspec.Raw) -> list[RequestedOutput]:
    """Decode and check the requested outputs. Raises Problem, msgspec.DecodeError."""
    outputs = _small(raw, list[RequestedOutput])
    for output in outputs:
        where = f"parameters of {output.name[:40]}"
        check_names(output.parameters, OUTPUT_PARAMETERS, where)
        _check_flag(output.parameters, BINARY, where)
    return outputs


def _parameters(raw: msgspec.Raw, known: dict[str, str], where: str) -> dict[str, Any]:
    """Decode parameters; `where` names them in messages. Raises Problem, also for unknown names."""
    _check_small(raw)
    found = parse_json_object(bytes(raw), where)
    if found is None:
        raise invalid_request(f"{where} must be a JSON object; send one, or leave it out")
    check_names(found, known, where)
    _check_flag(found, ALL_BINARY, where)
    return found


def _check_flag(parameters: dict[str, Any], name: str, where: str) -> None:
    if not isinstance(parameters.get(name, False), bool):
        raise invalid_request(f"{name} in {where} must be true or false")


def take_options(request: InferRequest) -> dict[str, Any]:
    """Return the parameters of a request that are options of its image, by name."""
    return {name: value for name, value in request.parameters.items() if name in OPTIONS}


def _check_small(raw: msgspec.Raw) -> None:
    if len(memoryview(raw)) > MAX_SMALL_BYTES:
        raise invalid_request(
            f"a shape, the outputs or the parameters exceed {MAX_SMALL_BYTES} bytes; send fewer"
        )


def _small(raw: msgspec.Raw, kind: type[T]) -> T:
    """Decode a part of a request of at most MAX_SMALL_BYTES. Raises Problem, DecodeError."""
    _check_small(raw)
    return msgspec.json.decode(raw, type=kind)


async def read_image_bytes(tensor: Tensor, binary: memoryview) -> bytes:
    """Read the image file in a BYTES tensor with one element (base64 in JSON). Raises Problem."""
    if tensor.datatype != "BYTES" or tensor.shape not in ([1], [1, 1]):
        raise invalid_request(
            f"{tensor.name} is {tensor.datatype[:20]} {tensor.shape[:8]}; it must be BYTES [1, 1]"
        )
    raw = _binary(tensor, binary)
    if raw is not None:
        if len(raw) < 4 or int.from_bytes(raw[:4], "little") != len(raw) - 4:
            raise invalid_request(f"{tensor.name} must hold one element, preceded by its length")
        return bytes(raw[4:])
    return await _read_base64(tensor)


async def _read_base64(tensor: Tensor) -> bytes:
    """Decode a base64 string, which can be nested in lists. Raises Problem.

    It is decoded in parts of `WINDOW_BYTES`, so that other tasks can run in between.
    """
    data, start = tensor.data, tensor.data.find(b'"')
    end = data.rfind(b'"') + 1
    before, after = data[:start].translate(None, BLANKS), data[end:].translate(None, BLANKS)
    depth = min(len(before), MAX_DEPTH)
    if not end or before != b"[" * depth or after != b"]" * depth:
        raise invalid_request(f"{tensor.name} must hold one file in base64")
    text = memoryview(data)[start + 1 : end - 1]
    parts = []
    try:
        if data.find(b"\\", start) >= 0:
            if len(text) > WINDOW_BYTES:
                await asyncio.sleep(PAUSE_S)  # decoding the escapes of 4 MiB takes 10 ms
            text = memoryview(msgspec.json.decode(data[start:end], type=str).encode())
        for window in range(0, len(text), WINDOW_BYTES):
            if window:
                await asyncio.sleep(PAUSE_S)
            part = text[window : window + WINDOW_BYTES]
            parts.append(binascii.a2b_base64(part, strict_mode=True))
    except (msgspec.DecodeError, ValueError) as error:  # binascii.Error is a ValueError
        raise invalid_request(f"{tensor.name} is not base64: {error}") from error
    if any(len(part) < WINDOW_BYTES // 4 * 3 for part in parts[:-1]):
        raise invalid_request(f"{tensor.name} is not base64: characters follow its padding")
    return b"".join(parts)


@dataclass(frozen=True, slots=True)
class Pixels:
    """A UINT8 tensor of a request before decoding; `read_ms` is the estimated decoding time."""

    height: int
    width: int
    read_ms: float
    read: Callable[[], NDArray[np.uint8]]
    """Returns the tensor as (height, width, 3) uint8 RGB. Raises Problem."""


def find_pixels(tensor: Tensor, binary: memoryview) -> Pixels:
    """Check a UINT8 tensor ([1,] height, width, 3); return it undecoded. Raises Problem."""
    shape = tensor.shape[1:] if len(tensor.shape) == 4 and tensor.shape[0] == 1 else tensor.shape
    usable = len(shape) == 3 and shape[2] == 3 and min(shape) > 0 and max(shape) < MAX_SIDE
    if tensor.datatype != "UINT8" or not usable:
        raise invalid_request(
            f"{tensor.name} is {tensor.datatype[:20]} {tensor.shape[:8]}; it must be UINT8 "
            "[1, height, width, 3]"
        )
    raw = _binary(tensor, binary)
    height, width, _ = shape
    pixel_ms = PIXEL_MS * height * width
    if raw is None:
        text = tensor.data
        read_ms = pixel_ms + JSON_MS_PER_BYTE * len(text)
        return Pixels(
            height, width, read_ms, lambda: _shaped(_read_json(tensor.name, text), tensor, shape)
        )
    values = _shaped(raw, tensor, shape)
    return Pixels(height, width, pixel_ms, lambda: values)


def _shaped(
    values: bytes | bytearray | memoryview, tensor: Tensor, shape: list[int]
) -> NDArray[np.uint8]:
    if len(values) != prod(shape):
        raise invalid_request(
            f"{tensor.name} has {len(values)} values, but its shape requires {prod(shape)}"
        )
    return np.frombuffer(values, np.uint8).reshape(shape)


def _read_json(name: str, text: bytes) -> bytearray:
    """Decode nested lists of integers in JSON to their flat values. Raises Problem.

    They are decoded in parts of `WINDOW_BYTES`: msgspec holds the GIL, which delays the event loop.
    """
    flat = text.translate(None, b"[]" + BLANKS)
    values, start = bytearray(), 0
    while start < len(flat):
        end = flat.find(b",", start + WINDOW_BYTES)
        end = len(flat) if end < 0 else end
        try:
            values += bytes(msgspec.json.decode(b"[%b]" % flat[start:end], type=list[int]))
        except (msgspec.DecodeError, ValueError) as error:
            raise invalid_request(f"{name} must hold integers from 0 to 255") from error
        start = end + 1
    return values


def _binary(tensor: Tensor, binary: memoryview) -> memoryview | None:
    size = tensor.parameters.get(SIZE)
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


def encode_response(
    head: dict[str, Any], tensors: dict[str, NDArray[np.float32]], request: InferRequest
) -> tuple[bytes, int | None]:
    """Encode an answer: `head` and the requested `tensors`. Returns the body and the size of its
    JSON part in bytes, which is None if the whole body is JSON. Raises Problem."""
    requested = request.outputs or [RequestedOutput(name) for name in tensors]
    default = request.parameters.get(ALL_BINARY, False)
    outputs, parts = [], []
    for output_request in requested:
        if output_request.name not in tensors:
            raise invalid_request(
                f"unknown output {output_request.name[:80]!r}; known are {', '.join(tensors)}"
            )
        values = tensors[output_request.name]
        output: dict[str, Any] = {
            "name": output_request.name,
            "datatype": "FP32",
            "shape": list(values.shape),
        }
        if output_request.parameters.get(BINARY, default):
            parts.append(values.astype("<f4").tobytes())
            output["parameters"] = {SIZE: len(parts[-1])}
        else:
            output["data"] = values.ravel().tolist()  # NaN (absent) becomes null
        outputs.append(output)
    content = msgspec.json.encode({**head, "outputs": outputs})
    return content + b"".join(parts), len(content) if parts else None


def invalid_request(detail: str) -> Problem:
    """Make the problem of a request that violates the protocol."""
    return Problem(INVALID_REQUEST, detail)
