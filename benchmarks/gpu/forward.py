"""Time of a forward pass of the shipped network on a device, by batch size; prints JSON.

    python -m benchmarks.gpu.forward --device cuda --batches 1,2,4 --passes 50

The times are medians in ms for all nine outputs of uint8 images in the device's memory: `f32`
(without TF32), `bf16` (autocast) and, on a GPU, `bf16_graph`, a CUDA graph of `bf16`, which shows
the time of the kernels alone. Each batch size has its own line of JSON, so that a stopped run keeps
the lines of the finished sizes.
"""

import argparse
import json
import time
from collections.abc import Callable
from statistics import median

import torch
from torch import Tensor

from mtlnet.architecture import HEIGHT, WIDTH
from mtlnet.inference.model_card import WEIGHTS, read_card
from mtlnet.inference.shipped_models import SHIPPED
from mtlnet.model.network import Network, load_network

Pass = Callable[[], Tensor]


def passes(network: Network, images: Tensor) -> dict[str, Pass]:
    """Return functions that compute the outputs (B, 9) for `images` (B, 210, 280, 3) uint8, by the
    name of the variant."""

    def f32() -> Tensor:
        return network.forward_heads(network.forward_features(images))

    def bf16() -> Tensor:
        with torch.autocast(images.device.type, torch.bfloat16):
            return f32()

    ways: dict[str, Pass] = {"f32": f32, "bf16": bf16}
    if images.device.type == "cuda":
        ways["bf16_graph"] = recorded(bf16)
    return ways


def recorded(forward: Pass) -> Pass:
    """Record `forward` as a CUDA graph; return a function that replays it."""
    side = torch.cuda.Stream()  # type: ignore[no-untyped-call]  # torch's
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        forward()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        outputs = forward()

    def replay() -> Tensor:
        graph.replay()
        return outputs

    return replay


def median_ms(forward: Pass, device: torch.device, count: int) -> float:
    """Return the median time in ms of `count` passes. The same number of passes is made first, to
    warm up."""
    times = []
    for _ in range(2 * count):
        begin = time.perf_counter()
        forward()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(1e3 * (time.perf_counter() - begin))
    return median(times[count:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--batches", default="1,2,4,8,16,32,64,128,256")
    parser.add_argument("--passes", type=int, default=50)
    given = parser.parse_args()
    device = torch.device(given.device)
    torch.backends.cudnn.allow_tf32 = False
    network = load_network(SHIPPED / WEIGHTS, read_card(SHIPPED).network)
    network = network.to(device).to(memory_format=torch.channels_last)
    generator = torch.Generator().manual_seed(0)
    for batch in map(int, given.batches.split(",")):
        shape = (batch, HEIGHT, WIDTH, 3)
        drawn = torch.randint(256, shape, dtype=torch.uint8, generator=generator)
        with torch.inference_mode():
            ways = passes(network, drawn.to(device))
            found = {name: median_ms(way, device, given.passes) for name, way in ways.items()}
        print(json.dumps({"batch": batch, **found}), flush=True)


if __name__ == "__main__":
    main()
