"""The paper's network: layers, padding, parameter count; folding keeps the outputs."""

import numpy as np
import pytest
import torch

from mtlnet.architecture import FEATURES, GRID, SHARED, Conv, same_padding
from mtlnet.model.network import (
    Network,
    fold,
    initialise,
    normalise,
    predict_images,
)

# Paper, section IV-C, and the sizes SAME padding gives for 280 x 210: layer, (rows, columns).
LAYERS = [
    ((96, 11, 4), (53, 70)),
    ((3, 2), (27, 35)),
    ((256, 5, 2), (14, 18)),
    ((3, 2), (7, 9)),
    ((384, 3, 2), (4, 5)),
    ((384, 3, 2), (2, 3)),
    ((256, 3, 2), (1, 2)),
    ((3, 2), (1, 1)),
]


def images(count: int, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.integers(0, 256, (count, 210, 280, 3), dtype=np.uint8))


def test_layers_are_those_of_the_paper() -> None:
    assert SHARED == (4096, 1024, 256)
    found = [
        (spec.filters, spec.kernel, spec.stride)
        if isinstance(spec, Conv)
        else (spec.kernel, spec.stride)
        for spec in FEATURES
    ]
    assert found == [layer for layer, _ in LAYERS]


def test_output_sizes_of_the_layers() -> None:
    network, sizes = Network(), []
    for module in network.features.children():
        if type(module).__name__ != "SamePad":
            module.register_forward_hook(lambda _m, _i, out: sizes.append(tuple(out.shape[2:])))
    network(images(1))
    assert sizes == [size for _, size in LAYERS]


def test_parameter_count() -> None:
    convolutions = [(3, 96, 11), (96, 256, 5), (256, 384, 3), (384, 384, 3), (384, 256, 3)]
    linears = [(256, 4096), (4096, 1024), (1024, 256), (256, 5), (256, 1), (256, 3)]
    expected = sum(i * o * k * k + o for i, o, k in convolutions)
    expected += sum(i * o + o for i, o in linears)
    found = sum(p.numel() for p in Network().parameters())
    assert found == expected == 9_259_913


@pytest.mark.parametrize(
    ("size", "kernel", "stride", "expected"),
    [
        (280, 11, 4, (70, 3, 4)),
        (210, 11, 4, (53, 4, 5)),
        (35, 5, 2, (18, 2, 2)),
        (70, 3, 2, (35, 0, 1)),
        (53, 3, 2, (27, 1, 1)),
        (4, 3, 2, (2, 0, 1)),
        (2, 3, 2, (1, 0, 1)),
        (1, 3, 2, (1, 1, 1)),
    ],
)
def test_same_padding_matches_tensorflow(
    size: int, kernel: int, stride: int, expected: tuple[int, int, int]
) -> None:
    # tf.nn: out = ceil(size / stride); pad = (out - 1) stride + kernel - size; the odd one after.
    assert same_padding(size, kernel, stride) == expected


def test_first_layer_against_a_sum_by_hand() -> None:
    network = Network()
    initialise(network, 1)
    pixels = images(1)
    features = network.features
    first = (features.get_submodule("pad0"), features.get_submodule("conv0"))
    out = torch.nn.Sequential(*first)(normalise(pixels).permute(0, 3, 1, 2))
    weight = features.get_parameter("conv0.layer.weight").detach().numpy().astype(np.float64)
    padded = np.zeros((219, 287, 3))
    padded[4:214, 3:283] = pixels[0].numpy() / 127.5 - 1
    for row, column in [(0, 0), (20, 31), (52, 69)]:
        patch = padded[row * 4 : row * 4 + 11, column * 4 : column * 4 + 11]
        expected = np.maximum(np.einsum("hwc,fchw->f", patch, weight), 0)
        np.testing.assert_allclose(out[0, :, row, column].detach().numpy(), expected, atol=1e-4)


def test_folding_keeps_the_outputs() -> None:
    network = Network(batch_norm=True, dropout=0.1)
    initialise(network, 2)
    network.train()
    with torch.no_grad():
        network(images(4))  # updates the running statistics
        for module in network.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.weight.uniform_(0.5, 1.5)
                module.bias.uniform_(-0.5, 0.5)
    network.target_mean.copy_(torch.linspace(0.2, 0.7, 6))
    network.target_std.copy_(torch.linspace(0.02, 0.3, 6))
    folded = fold(network)
    assert not [m for m in folded.modules() if isinstance(m, torch.nn.BatchNorm2d)]
    network.eval()
    with torch.no_grad():
        difference = (network(images(4, seed=1)) - folded(images(4, seed=1))).abs().max()
    assert float(difference) < 2e-5


def test_probabilities_sum_to_one_and_the_seed_determines_the_weights() -> None:
    first, second, other = Network(), Network(), Network()
    initialise(first, 3)
    initialise(second, 3)
    initialise(other, 4)
    outputs = predict_images(first, images(2).numpy())
    np.testing.assert_allclose(outputs[:, 6:].sum(1), 1, atol=1e-6)
    assert outputs.tolist() == predict_images(second, images(2).numpy()).tolist()
    assert outputs.tolist() != predict_images(other, images(2).numpy()).tolist()


def test_many_images_are_computed_a_few_at_a_time() -> None:
    # All at once, 12,000 frames of `mtlnet export --frames` took more than 22 GB.
    network = Network(architecture=GRID)
    initialise(network, 1)
    sizes: list[int] = []
    network.features.register_forward_pre_hook(lambda _, args: sizes.append(len(args[0])))
    frames = images(70).numpy()
    together = predict_images(network, frames)
    assert sum(sizes) == 70
    assert max(sizes) <= 32
    np.testing.assert_allclose(together[-1:], predict_images(network, frames[-1:]), atol=1e-4)
