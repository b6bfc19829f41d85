"""The CPU kernels match the plain network: outputs, gradients, running statistics."""

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch

from mtlnet.architecture import GRID, GRID_RESIDUAL, MTL, SHARED, Architecture, Pool
from mtlnet.model.cpu_kernels.convolutions import (
    im2col_convolution,
    space_to_depth,
    space_to_depth_convolution,
)
from mtlnet.model.cpu_kernels.elementwise import affine_relu, as_rows, in_threads
from mtlnet.model.cpu_kernels.forward import forward_features, training_outputs
from mtlnet.model.cpu_kernels.norm_pool_relu import norm_pool_relu, statistics
from mtlnet.model.cpu_kernels.winograd import IMAGES, winograd_convolution
from mtlnet.model.network import Network, initialise
from mtlnet.training.trainer import dropout_masks, freeze_batch_norm


def pictures(count: int) -> torch.Tensor:
    rng = np.random.default_rng(0)
    return torch.from_numpy(rng.integers(0, 256, (count, 210, 280, 3), dtype=np.uint8))


def some_network(*, batch_norm: bool, architecture: Architecture = MTL) -> Network:
    """A network whose normalisation gains have both signs, as after training."""
    network = Network(batch_norm=batch_norm, architecture=architecture)
    initialise(network, 1)
    generator = torch.Generator().manual_seed(2)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            with torch.no_grad():
                module.weight.uniform_(-1.0, 1.5, generator=generator)
                module.bias.uniform_(-0.5, 0.5, generator=generator)
    return network.to(memory_format=torch.channels_last).train()


@pytest.mark.parametrize(
    "architecture", [MTL, GRID, GRID_RESIDUAL], ids=lambda architecture: architecture.name
)
@pytest.mark.parametrize("norm", ["training", "frozen", "none"])
def test_features_and_gradients_match_the_plain_network(
    norm: str, architecture: Architecture
) -> None:
    # In float64: with float32 rounding, a maximum may pass its gradient to a neighbour.
    images = pictures(4)
    plain = some_network(batch_norm=norm != "none", architecture=architecture).double()
    if norm == "frozen":
        plain.forward_features(pictures(2).double() * (1 / 127.5) - 1.0)
        freeze_batch_norm(plain)
    fast = copy.deepcopy(plain)
    expected = plain.forward_features(images.double() * (1 / 127.5) - 1.0)
    found = forward_features(fast, images, torch.float64)
    torch.testing.assert_close(found, expected)
    gradient = torch.randn(expected.shape, generator=torch.Generator().manual_seed(3)).double()
    torch.autograd.backward(expected, gradient)
    torch.autograd.backward(found, gradient)
    pairs = zip(plain.named_parameters(), fast.named_parameters(), strict=True)
    for (name, one), (_, other) in pairs:
        if name.startswith(("heads", "auxiliary")):
            continue
        assert one.grad is not None
        assert other.grad is not None
        torch.testing.assert_close(other.grad, one.grad, rtol=1e-6, atol=1e-8, msg=name)
        # The fused optimizers need gradients with the memory layout of the parameters.
        assert other.grad.stride() == other.stride(), name
    buffers = zip(plain.named_buffers(), fast.named_buffers(), strict=True)
    for (name, before), (_, after) in buffers:
        torch.testing.assert_close(after, before, msg=name)


def test_outputs_match_the_plain_network() -> None:
    images, network = pictures(2), some_network(batch_norm=False)
    expected, found = network(images), training_outputs(network, images, torch.float32)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=5e-6)


def test_bf16_is_within_5_percent_of_float32() -> None:
    images, network = pictures(4), some_network(batch_norm=True)
    exact = training_outputs(copy.deepcopy(network), images, torch.float32)
    rounded = training_outputs(network, images, torch.bfloat16)
    assert rounded.dtype == torch.float32
    assert float((rounded - exact).detach().abs().max() / exact.detach().abs().max()) < 0.05


def test_space_to_depth_convolution_matches_conv2d() -> None:
    rng = torch.Generator().manual_seed(0)
    weight = torch.randn((5, 3, 11, 11), generator=rng, dtype=torch.float64, requires_grad=True)
    for height, width in [(210, 280), (8, 12), (9, 8), (7, 16)]:
        images = torch.randint(0, 256, (2, height, width, 3), generator=rng, dtype=torch.uint8)
        x = images.double().permute(0, 3, 1, 2) / 127.5 - 1
        rows = (-(-height // 4) - 1) * 4 + 11 - height
        # 4 rows of padding before: TensorFlow's SAME padding for 210 rows.
        padded = torch.nn.functional.pad(x, (3, 4, 4, max(rows - 4, 0)))
        expected = torch.nn.functional.conv2d(padded, weight, stride=4)
        found = space_to_depth_convolution(
            space_to_depth(images, torch.float64), weight, None, torch.float64
        )
        torch.testing.assert_close(found, expected)
        (one,), (two,) = (torch.autograd.grad(y.square().sum(), weight) for y in (expected, found))
        torch.testing.assert_close(one, two)


def test_im2col_convolution_matches_conv2d_and_passes_gradcheck() -> None:
    rng = torch.Generator().manual_seed(0)
    x = torch.randn((2, 3, 4, 5), generator=rng, dtype=torch.float64, requires_grad=True)
    weight = torch.randn((2, 3, 3, 3), generator=rng, dtype=torch.float64, requires_grad=True)
    plain = torch.nn.functional.conv2d(torch.nn.functional.pad(x, (1, 1, 0, 1)), weight, stride=2)
    torch.testing.assert_close(im2col_convolution(x, weight, 2), plain)
    assert torch.autograd.gradcheck(lambda a, b: im2col_convolution(a, b, 2), (x, weight))


@pytest.mark.parametrize(
    "size", [(1, 1), (2, 4), (3, 3), (4, 6), (5, 8)], ids=lambda size: f"{size[0]}x{size[1]}"
)
def test_winograd_gradients_match_those_of_torch(size: tuple[int, int]) -> None:
    rng = torch.Generator().manual_seed(0)
    count = IMAGES + 3  # the last part has fewer images
    values = [
        torch.randn(shape, generator=rng) for shape in ((count, 5, *size), (4, 5, 3, 3), (4,))
    ]
    x, weight, bias = (value.double().requires_grad_() for value in values)
    expected = torch.nn.functional.conv2d(x, weight, bias, padding=1)
    found = winograd_convolution(x, weight, bias)
    torch.testing.assert_close(found, expected)
    gradient = torch.randn(found.shape, generator=rng).double()
    plain, fast = (torch.autograd.grad(y, (x, weight, bias), gradient) for y in (expected, found))
    for one, other in zip(plain, fast, strict=True):
        torch.testing.assert_close(other, one)


def test_winograd_computes_only_the_gradients_that_are_needed() -> None:
    rng = torch.Generator().manual_seed(0)
    image, filters = (torch.randn((2, 3, n, n), generator=rng).double() for n in (5, 3))
    for frozen in ("image", "filters"):
        x, weight = image.clone(), filters.clone()
        trained = weight if frozen == "image" else x
        trained.requires_grad_()
        (expected,) = torch.autograd.grad(
            torch.nn.functional.conv2d(x, weight, padding=1).square().sum(), trained
        )
        (found,) = torch.autograd.grad(
            winograd_convolution(x, weight, None).square().sum(), trained
        )
        torch.testing.assert_close(found, expected)


def test_winograd_gradients_in_float32_lose_at_most_one_digit() -> None:
    rng = torch.Generator().manual_seed(0)
    x = torch.randn((4, 32, 9, 18), generator=rng)
    weight = torch.randn((16, 32, 3, 3), generator=rng)
    gradient = torch.randn((4, 16, 9, 18), generator=rng)

    def gradients(convolve: Callable[..., torch.Tensor], dtype: torch.dtype) -> list[torch.Tensor]:
        inputs = [value.to(dtype).requires_grad_() for value in (x, weight)]
        found = torch.autograd.grad(convolve(*inputs), inputs, gradient.to(dtype))
        return [value.double() for value in found]

    def plain(x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(x, weight, padding=1)

    def fast(x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        return winograd_convolution(x, weight, None)

    exact = gradients(plain, torch.float64)
    for one, other, true in zip(
        gradients(plain, torch.float32), gradients(fast, torch.float32), exact, strict=True
    ):
        assert (other - true).norm() < 10 * (one - true).norm()


def test_batch_statistics_of_bf16_are_float32() -> None:
    x = torch.randn((4, 8, 20, 30), generator=torch.Generator().manual_seed(0)) * 3 + 5
    x = x.bfloat16().contiguous(memory_format=torch.channels_last)
    mean, variance, count = statistics(x)
    assert (mean.dtype, count) == (torch.float32, 2400)
    torch.testing.assert_close(mean.double(), x.double().mean((0, 2, 3)), rtol=1e-5, atol=1e-5)
    expected = x.double().var((0, 2, 3), correction=0)
    torch.testing.assert_close(variance.double(), expected, rtol=1e-4, atol=1e-4)


def test_the_variance_of_values_far_from_zero_loses_no_digits() -> None:
    x = torch.randn((4, 8, 20, 30), generator=torch.Generator().manual_seed(0)) * 0.01 + 1000
    x = x.contiguous(memory_format=torch.channels_last)
    _, variance, _ = statistics(x)
    expected = x.double().var((0, 2, 3), correction=0)
    torch.testing.assert_close(variance.double(), expected, rtol=1e-3, atol=0.0)


def test_elementwise_passes_round_to_bf16_like_torch() -> None:
    values = torch.arange(1 << 16, dtype=torch.int32).to(torch.uint16).view(torch.bfloat16)
    x = values[values.isfinite()].view(1, -1, 1, 32).permute(0, 3, 1, 2)
    a = torch.linspace(0.1, 3.0, 32)
    out = torch.empty_like(x, memory_format=torch.channels_last)
    affine_relu(as_rows(x), a.numpy(), torch.zeros(32).numpy(), as_rows(out))
    expected = torch.relu(x.float() * a[:, None, None]).bfloat16()
    assert torch.equal(out, expected)


@pytest.mark.parametrize("pool", [None, Pool()], ids=["no pool", "pool"])
def test_gradients_of_batch_norm_in_bf16_are_those_of_float64_rounded(pool: Pool | None) -> None:
    generator = torch.Generator().manual_seed(0)
    x = (torch.randn((6, 16, 9, 13), generator=generator) * 2 + 1).bfloat16()
    x = x.contiguous(memory_format=torch.channels_last)
    gradient = torch.randn((6, 16, 5, 7) if pool else x.shape, generator=generator).bfloat16()
    found = []
    for dtype in (torch.float64, torch.bfloat16):
        norm = torch.nn.BatchNorm2d(16, dtype=torch.promote_types(dtype, torch.float32))
        with torch.no_grad():
            norm.weight.copy_(torch.linspace(0.5, 1.5, 16))
        values = x.to(dtype).requires_grad_()
        y = norm_pool_relu(values, torch.ones(16, dtype=norm.weight.dtype), norm, pool)
        assert y.dtype == dtype
        torch.autograd.backward(y, gradient.to(dtype))
        found.append((y.detach(), values.grad, norm.weight.grad, norm.bias.grad))
    for exact, rounded in zip(*found, strict=True):
        assert exact is not None
        assert rounded is not None
        difference = (rounded.double() - exact).norm() / exact.norm()
        assert float(difference) < 0.005


def test_parts_of_a_pass_cover_all_rows_and_raise_what_a_thread_raises() -> None:
    rows = np.zeros(1001)

    def count(part: slice, _: int) -> None:
        rows[part] += 1

    in_threads(count, len(rows))
    assert bool((rows == 1).all())

    def fail(part: slice, _: int) -> None:
        if part.stop == len(rows):
            raise ValueError("last part")

    with pytest.raises(ValueError, match="last part"):
        in_threads(fail, len(rows))


def test_dropout_masks_depend_on_the_seed_and_not_on_the_number_of_processes() -> None:
    whole = dropout_masks(0.5, SHARED, 6, [1, 3, 40])
    assert [tuple(mask.shape) for mask in whole] == [(6, 4096), (6, 1024), (6, 256)]
    assert set(np.unique(whole[0].numpy()).tolist()) == {0.0, 2.0}
    assert float(whole[0].mean()) == pytest.approx(1.0, abs=0.05)
    halves = [dropout_masks(0.5, SHARED, 3, [1, 3, 40], (which, 2)) for which in (0, 1)]
    for number in range(3):
        assert torch.equal(whole[number], torch.cat([half[number] for half in halves]))
    assert not torch.equal(whole[0], dropout_masks(0.5, SHARED, 6, [1, 3, 41])[0])
    assert dropout_masks(0.0, SHARED, 6, [1]) == []
