"""Architectures of the networks, layer by layer. This module does not import torch.

`mtl`: the paper's network (section IV-C), with TensorFlow's SAME padding.

`deepdriving`: the network of Chen et al. (DeepDriving, ICCV 2015), with which the paper compares
its network. It is AlexNet with a fourth fully connected layer, trained on one task, the regression
of coded values. Layers, padding and local response normalisation are taken from the authors' Caffe
model. Deviations from this model: the outputs are the six coded values of this project (five
distances and the angle) instead of the authors' fourteen; the outputs are linear, without a
sigmoid; no mean image is subtracted; the network is trained with the recipes of `mtlnet train`. It
has no classifier: each class of the road has probability one third.

`grid`: five convolutions that keep a grid of 9 x 18 positions; the paper's convolutions end in a
single position. Its outputs are distributions over bins (`mtlnet.model.bins`). It does not read the
image rows of the sky. In training, auxiliary heads read the positions of the lane's markings from
the grid and the curvature ahead from the shared features (`mtlnet.model.auxiliary`).

`grid_residual`: `grid` with six additional residual convolutions, for long trainings; it can start
from a trained `grid` (`mtlnet.model.pretrained`).

`mobilenet_v3_small`, `regnet_y_400mf`: for comparison, small modern backbones of torchvision with
random initial weights. One layer of 256 units follows their pooled features. They have the same
nine outputs as `mtl`: five coded distances, the coded angle and three class scores.
"""

from dataclasses import dataclass, replace

from trackfeatures.errors import UserError

HEIGHT, WIDTH = 210, 280


@dataclass(frozen=True)
class Conv:
    """A convolution and ReLU, the paper's Conv(n, k, s): n filters of k x k, stride s.

    `pad`: number of zeros added at each side; None: SAME padding. `groups`: number of groups of
    channels that are convolved separately. `skip`: the input is added to the output (a residual
    connection, He et al. 2015).
    """

    filters: int
    kernel: int
    stride: int
    pad: int | None = None
    groups: int = 1
    skip: bool = False


@dataclass(frozen=True)
class Pool:
    """A layer of max pooling, the paper's MaxPool(k, s). `same`: it has SAME padding, as in the
    paper. Otherwise it has no padding, and the output's size is rounded up, as in Caffe."""

    kernel: int = 3
    stride: int = 2
    same: bool = True


@dataclass(frozen=True)
class LocalNorm:
    """AlexNet's local response normalisation over neighbouring channels (Krizhevsky 2012)."""

    size: int = 5
    alpha: float = 1e-4
    beta: float = 0.75


Layer = Conv | Pool | LocalNorm


@dataclass(frozen=True)
class Architecture:
    """One network: layers or a torchvision backbone, then shared fully connected layers."""

    name: str
    features: tuple[Layer, ...]
    shared: tuple[int, ...]
    tasks: tuple[str, ...] = ("distance", "angle", "heading")
    backbone: str = ""
    """Name of the torchvision model that computes the features; empty: `features` are the layers.
    """
    bins: bool = False
    """Whether the outputs are distributions over bins instead of the paper's coded values."""
    first_row: int = 0
    """Index of the first image row that is read."""

    @property
    def default_alpha(self) -> tuple[float, float, float]:
        """Default task weights (distance, angle, class): the weights of the row MTL 3 of the
        paper's ablation table, or (1, 1, 0) for a network without a classifier."""
        return (0.3, 0.2, 0.5) if "heading" in self.tasks else (1.0, 1.0, 0.0)

    @property
    def heads(self) -> tuple[tuple[str, int], ...]:
        """Name and number of outputs of each head."""
        return BIN_HEADS if self.bins else HEADS

    @property
    def keeps_places(self) -> bool:
        """Whether the output of the last convolution or pooling layer has more than one position in
        the image."""
        return bool(self.features) and grid_size(self)[1] > 1

    @property
    def uncertainty_inputs(self) -> int:
        """Number of inputs of the uncertainty head: the units of the last shared layer and, for a
        network with bins, the spread of each of its six distributions (five distances and the
        angle)."""
        return self.shared[-1] + (6 if self.bins else 0)

    @property
    def convolutions(self) -> tuple[str, ...]:
        """Submodule names of the convolutions, in order; none for a torchvision backbone."""
        each = enumerate(self.features)
        return tuple(f"conv{number}" for number, spec in each if isinstance(spec, Conv))


FEATURES: tuple[Conv | Pool, ...] = (
    Conv(96, 11, 4),
    Pool(),
    Conv(256, 5, 2),
    Pool(),
    Conv(384, 3, 2),
    Conv(384, 3, 2),
    Conv(256, 3, 2),
    Pool(),
)
SHARED = (4096, 1024, 256)
HEADS = (("distance", 5), ("angle", 1), ("heading", 3))
DISTANCE_BINS, ANGLE_BINS = 70, 100
"""Number of bins of a distance (besides one for "absent") and of the angle."""
NEAR = 4
"""Number of bins to each side of the likeliest bin; the answer is the expectation over these bins.
"""
BIN_VARIANCE = 1 / 12
"""Variance of a uniform distribution over one bin, in squared bins."""
PAIR = slice(0, 2)
"""Indices of `ml` and `mr`, the two sides of the car's lane, which are present or absent together.
"""
ABSENT_ABOVE = (0.54, 0.54, 0.75, 0.54, 0.75)
"""Probabilities above which `ml`, `mr`, `l`, `m` and `r` are answered as absent, chosen on held-out
frames (docs/experiments/uncertainty.md). A wrongly absent marking counts as an error of 4 to 5 m,
and `l` and `r` are absent in 70 % of the frames. With a limit of 0.5 the mean error of `l` and `r`
is larger by half; with a limit of 0.9 a briefly trained model has a larger error of the offset from
the lane's centre."""
BIN_HEADS = (("distance", 5 * (DISTANCE_BINS + 1)), ("angle", ANGLE_BINS), ("heading", 3))
ALEXNET: tuple[Layer, ...] = (
    Conv(96, 11, 4, pad=0),
    Pool(same=False),
    LocalNorm(),
    Conv(256, 5, 1, pad=2, groups=2),
    Pool(same=False),
    LocalNorm(),
    Conv(384, 3, 1, pad=1),
    Conv(384, 3, 1, pad=1, groups=2),
    Conv(256, 3, 1, pad=1, groups=2),
    Pool(same=False),
)
GRID_FEATURES = (
    Conv(64, 12, 4, pad=4),
    Conv(128, 3, 2, pad=1),
    Conv(192, 3, 2, pad=1),
    Conv(192, 3, 1, pad=1),
    Conv(32, 1, 1, pad=0),
)
RESIDUAL_FEATURES = (
    Conv(64, 12, 4, pad=4),
    Conv(128, 3, 2, pad=1),
    *(Conv(128, 3, 1, pad=1, skip=True),) * 2,
    Conv(192, 3, 2, pad=1),
    Conv(192, 3, 1, pad=1),
    *(Conv(192, 3, 1, pad=1, skip=True),) * 4,
    Conv(32, 1, 1, pad=0),
)
MTL = Architecture("mtl", FEATURES, SHARED)
GRID = Architecture("grid", GRID_FEATURES, (512, 256, 256), bins=True, first_row=66)
GRID_RESIDUAL = replace(GRID, name="grid_residual", features=RESIDUAL_FEATURES)
ARCHITECTURES = {
    architecture.name: architecture
    for architecture in (
        MTL,
        Architecture("deepdriving", ALEXNET, (4096, 4096, 256), tasks=("distance", "angle")),
        Architecture("mobilenet_v3_small", (), (256,), backbone="mobilenet_v3_small"),
        Architecture("regnet_y_400mf", (), (256,), backbone="regnet_y_400mf"),
        GRID,
        GRID_RESIDUAL,
    )
}
HEAD_KINDS = ("coded", "bins")
"""Kinds of heads: the paper's coded values, or distributions over bins."""
ARCHITECTURES |= {
    f"{base.name}-{kind}": replace(base, name=f"{base.name}-{kind}", bins=kind == "bins")
    for base in list(ARCHITECTURES.values())
    for kind in HEAD_KINDS
    if base.bins != (kind == "bins")
}  # each network also with the other kind of heads: `mtl-bins`, ..., `grid-coded`


def find_architecture(name: str) -> Architecture:
    """Return the architecture called `name`. Raises UserError for an unknown name."""
    if name not in ARCHITECTURES:
        names = [name for name in ARCHITECTURES if not name.endswith(HEAD_KINDS)]
        raise UserError(f"there is no network {name!r}; choose one of {', '.join(names)}")
    return ARCHITECTURES[name]


def with_heads(name: str, kind: str) -> str:
    """Return the name of network `name` with heads of `kind`, "coded" or "bins": for example
    `mtl-bins`, or `mtl` if these are its usual heads. Raises UserError for an unknown kind or name.
    """
    if kind not in HEAD_KINDS:
        raise UserError(f"--heads {kind!r} is unknown; give {' or '.join(HEAD_KINDS)}")
    base = name.removesuffix("-bins").removesuffix("-coded")
    return base if find_architecture(base).bins == (kind == "bins") else f"{base}-{kind}"


def require_task_heads(architecture: Architecture, alpha: tuple[float, float, float]) -> None:
    """Raise UserError when the task weights `alpha` (distance, angle, class) give weight to the
    class and the network has no classifier."""
    if alpha[2] > 0 and "heading" not in architecture.tasks:
        raise UserError(
            f"network {architecture.name} has no class, so alpha's third weight must be 0, not "
            f"{alpha[2]:g}; give for example --alpha 1,1,0"
        )


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int, int]:
    """Return the output size of TensorFlow's SAME padding for `size` input values, and the numbers
    of zeros that it adds before and after them."""
    out = -(-size // stride)
    total = max((out - 1) * stride + kernel - size, 0)
    return out, total // 2, total - total // 2


def grid_size(architecture: Architecture) -> tuple[int, int, int]:
    """Return channels, rows and columns of the output of the last convolution or pooling layer."""
    channels, height, width = 3, HEIGHT - architecture.first_row, WIDTH
    for spec in architecture.features:
        height, width = output_size(height, spec), output_size(width, spec)
        channels = spec.filters if isinstance(spec, Conv) else channels
    return channels, height, width


def output_size(size: int, layer: Layer) -> int:
    """Return a layer's number of output rows (or columns) for `size` input rows (or columns)."""
    if isinstance(layer, LocalNorm):
        return size
    if isinstance(layer, Conv) and layer.pad is not None:
        return (size + 2 * layer.pad - layer.kernel) // layer.stride + 1
    if isinstance(layer, Pool) and not layer.same:
        return -(-(size - layer.kernel) // layer.stride) + 1
    return same_padding(size, layer.kernel, layer.stride)[0]
