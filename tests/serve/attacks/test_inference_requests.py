"""Open Inference requests that are costly for their size: time of the event loop, memory."""

import asyncio
import base64
import json
import time
import tracemalloc
from contextlib import suppress

import numpy as np
import pytest

from serve.api.kserve_tensors import (
    WINDOW_BYTES,
    Tensor,
    find_pixels,
    parse_request,
    read_image_bytes,
)
from serve.config import MAX_BODY_BYTES
from serve.problems import Problem
from tests.serve.attacks.conftest import types_in_cycles
from tests.serve.attacks.loop_time import LOOP_S, held_s
from tests.serve.conftest import INFER, Served

HEAD = '{"inputs":[{"name":"pixels","shape":[1,2,2,3],"datatype":"UINT8","data":'


def filled(text: str, part: str, end: str) -> bytes:
    return (text + part * ((MAX_BODY_BYTES - len(text) - len(end)) // len(part)) + end).encode()


HOSTILE = {
    "values": filled(HEAD + "[", "0,", "0]}]}"),
    "allowed": filled(HEAD + "[", "10 ,", "0]}]}"),
    "brackets": filled(HEAD + "[", "[9],", "0]}]}"),
    "lists": filled(HEAD + "[", "[],", "0]}]}"),
    "open": filled(HEAD, "[", ""),
    "inputs": filled('{"inputs":[', "0,", "0]}"),
    "objects": filled('{"inputs":[', "{},", "{}]}"),
    "outputs": filled(HEAD + '[1]}],"outputs":[', '{"name":"std"},', '{"name":"std"}]}'),
    "parameters": filled(HEAD + '[1]}],"parameters":{"a":[', "0,", "0]}}"),
    "shape": filled('{"inputs":[{"name":"pixels","shape":[', "1,", "1]}]}"),
    "unknown": filled('{"other":[', "0,", "0]}"),
    "spaces": filled('{"inputs":', " ", "[]}"),
    "name": filled('{"inputs":[{"name":"', "x", '"}]}'),
}


@pytest.mark.alone
@pytest.mark.parametrize("name", HOSTILE)
def test_no_inference_request_holds_the_event_loop_or_memory(name: str) -> None:
    body = HOSTILE[name]
    assert len(body) <= MAX_BODY_BYTES
    assert held_s(lambda: parse_request(body, len(body))) < LOOP_S
    tracemalloc.start()
    try:
        with suppress(Problem):
            parse_request(body, len(body))
        assert tracemalloc.get_traced_memory()[1] < 3 * MAX_BODY_BYTES
    finally:
        tracemalloc.stop()


@pytest.mark.alone
def test_a_large_image_in_base64_does_not_hold_the_event_loop() -> None:
    sent = np.random.default_rng(0).bytes(3 * MAX_BODY_BYTES // 4 - 3000)
    tensor = {"name": "image", "shape": [1, 1], "datatype": "BYTES"}
    content = {"inputs": [{**tensor, "data": [[base64.b64encode(sent).decode()]]}]}
    body = json.dumps(content).encode()
    assert held_s(lambda: parse_request(body, len(body)), LOOP_S / 2) < LOOP_S / 2
    request, binary = parse_request(body, len(body))
    found: list[bytes] = []

    async def others_s() -> float:
        """The longest processor time in s for which reading the image blocks other tasks."""
        reader = asyncio.ensure_future(read_image_bytes(request.input, binary))
        longest = 0.0
        while not reader.done():
            start = time.thread_time()
            await asyncio.sleep(0)
            longest = max(longest, time.thread_time() - start)
        found.append(await reader)
        return longest

    assert min(asyncio.run(others_s()) for _ in range(5)) < LOOP_S / 2
    assert found[0] == sent


def test_base64_is_read_as_it_is_written() -> None:
    def read(data: bytes) -> bytes:
        tensor = Tensor("image", [1], "BYTES", {}, data)
        return asyncio.run(read_image_bytes(tensor, memoryview(b"")))

    for size in (0, 1, 2, 3, 4, WINDOW_BYTES // 4 * 3 + 1, 100_000):
        sent = np.random.default_rng(size).bytes(size)
        text = base64.b64encode(sent)
        for data in (b'"%b"', b'[ "%b"]', b' [\n[[["%b" ]\t]]] '):
            assert read(data % text) == sent
        assert read(b'["%b"]' % text.replace(b"/", b"\\/")) == sent
    long = b"A" * WINDOW_BYTES
    for wrong in (
        b"",
        b"[]",
        b'[[[[["AAAA"]]]]]',
        b'["AAAA"',
        b'[["AAAA"]',
        b'["AAAA","AAAA"]',
        b'["AAAA", 1]',
        b'[1, "AAAA"]',
        b'["\\n","AAAA"]',
        b'"AA=="AA',
        b'"AA==AAAA"',
        b'"AAA"',
        b'"AA A"',
        b'"%b%b"' % (long[:-1], b"=AAAA"),
        b'"%b==%b"' % (long[:-2], long),
    ):
        with pytest.raises(Problem, match=r"one file in base64|not base64"):
            read(wrong)


def test_refused_requests_leave_nothing_for_the_garbage_collector(service: Served) -> None:
    bodies = [HOSTILE["outputs"], HOSTILE["open"], b"{}", b"[" * 1000]
    bodies.append(b'{"inputs":[{"name":"image","shape":[1],"datatype":"BYTES","data":["AAAA"]}]}')
    bodies.append(b'{"inputs":[{"name":"pixels","shape":[9,9,3],"datatype":"UINT8","data":[1]}]}')
    service.ask("POST", INFER, b"{}")
    statuses: list[int] = []
    left = types_in_cycles(
        lambda: statuses.extend(service.ask("POST", INFER, body).status for body in bodies)
    )
    assert set(statuses) == {422}
    assert "Request" not in [found.__name__ for found in left]


def test_pixels_in_json_are_those_that_were_sent() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (1, 200, 300, 3), np.uint8)
    for text in (json.dumps(pixels.tolist()), json.dumps(pixels.ravel().tolist(), indent=0)):
        tensor = Tensor("pixels", [1, 200, 300, 3], "UINT8", {}, text.encode())
        found = find_pixels(tensor, memoryview(b""))
        assert (found.height, found.width) == (200, 300)
        assert np.array_equal(found.read(), pixels[0])
    for wrong in (
        b"[1, 256]",
        b"[-1]",
        b"[true]",
        b'["1"]',
        b"[1.5]",
        b"[null]",
        b'"1,2"',
        b"[{}]",
    ):
        with pytest.raises(Problem, match=r"integers from 0 to 255"):
            find_pixels(Tensor("pixels", [1, 1, 3], "UINT8", {}, wrong), memoryview(b"")).read()


def test_a_shape_too_large_for_a_float_is_refused(service: Served) -> None:
    for height in ("9" * 400, "9" * 19, "-1"):
        body = HEAD.replace("[1,2,2,3]", f"[1,{height},2,3]") + "[1]}]}"
        assert service.ask("POST", INFER, body.encode()).status == 422
