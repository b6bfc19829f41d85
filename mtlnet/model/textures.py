"""Texture features of an image, from which the out-of-distribution score and the light features are
computed.

An image is divided into 14 x 8 cells, and each cell into three bands, one above the other. The five
features of a cell or band are its three mean colours in [-1, 1], and the square roots of the mean
absolute differences of brightness between horizontal and vertical neighbours. The functions are
torch operations without branches, so that they can be part of an exported network.

In shapes B is the number of images, C = 560 the number of values of all cells (`CELL_VALUES`), and
M = 480 the number of values of the 24 x 4 bands in the image centre (`CENTRE_VALUES`).
"""

import torch
from torch import Tensor
from torch.nn.functional import pad

CELL_ROWS, CELL_COLUMNS = 14, 8
BANDS = 3  # bands per cell; the pitch is predicted from the bands of the image centre
CENTRE_BANDS, CENTRE_COLUMNS = slice(9, 33), slice(2, 6)
COLOURS = 3
PLANES = COLOURS + 2
CELL_VALUES = PLANES * CELL_ROWS * CELL_COLUMNS
CENTRE_VALUES = PLANES * 24 * 4
TEXTURE_VALUES = CELL_VALUES + CENTRE_VALUES
HALVES = 2  # upper and lower half of an image
LIGHT_VALUES = PLANES * HALVES
SQRT_EPSILON = 1e-6
"""Added to a mean difference, which can be 0, before its square root."""
LEVEL = 1 / 127.5  # difference of two successive uint8 colours on the scale [-1, 1]


def texture_features(images: Tensor) -> Tensor:
    """Compute the texture features (B, C + M) of images uint8 (B, H, W, 3): the C = 560 values of
    all cells, then the M = 480 values of the bands in the image centre.

    H must be a multiple of 42 (14 rows of cells with three bands each), W a multiple of 8
    (columns of cells).
    """
    sums, pixels = band_sums(images)
    colours = sums[:, :COLOURS] * (LEVEL / pixels) - 1
    differences = sums[:, COLOURS:] * (LEVEL / COLOURS / pixels)
    narrow = torch.cat([colours, differences], 1)
    cells = narrow.reshape(-1, PLANES, CELL_ROWS, BANDS, CELL_COLUMNS).mean(3)
    centre = narrow[:, :, CENTRE_BANDS, CENTRE_COLUMNS]
    return torch.cat([_with_roots(cells), _with_roots(centre)], 1)


def band_sums(images: Tensor) -> tuple[Tensor, int]:
    """Compute the sums of five planes over each band (B, 5, 42, 8), and the number of pixels of a
    band, for images uint8 (B, H, W, 3).

    The planes are red, green, blue, and the absolute differences of red + green + blue from the
    next column and from the next row, which are 0 in the last column and row. All sums are integers
    below 2**24, and therefore exact in float32.
    """
    colours = images.permute(0, 3, 1, 2)  # before the conversion, because bytes are faster
    red, green, blue = (colours[:, k : k + 1].float() for k in range(COLOURS))
    grey = red + green + blue
    across = (pad(grey, (0, 1, 0, 0), mode="replicate")[..., 1:] - grey).abs()
    down = (pad(grey, (0, 0, 0, 1), mode="replicate")[:, :, 1:] - grey).abs()
    sums = torch.cat([_sums(plane) for plane in (colours.float(), across, down)], 1)
    height, width = int(images.shape[1]), int(images.shape[2])
    return sums, height // (CELL_ROWS * BANDS) * (width // CELL_COLUMNS)


def _sums(planes: Tensor) -> Tensor:
    """Sums over each band (B, N, bands, columns) of planes (B, N, H, W), without a pooling layer,
    because OpenVINO computes pooling in blocks of 16 planes."""
    count, height, width = (int(size) for size in planes.shape[1:])
    bands = CELL_ROWS * BANDS
    rows = planes.reshape(-1, count, bands, height // bands, width).sum(3)
    return rows.reshape(-1, count, bands, CELL_COLUMNS, width // CELL_COLUMNS).sum(4)


def light_features(textures: Tensor) -> Tensor:
    """Compute the light features (B, 10) from texture features (B, C + M): for each of the five
    planes its mean over the upper half of the image, then its mean over the lower half."""
    cells = textures[:, :CELL_VALUES].reshape(-1, LIGHT_VALUES, CELL_VALUES // LIGHT_VALUES)
    return cells.mean(2)


def _with_roots(planes: Tensor) -> Tensor:
    """Values (B, N) of planes (B, PLANES, h, w): the colours, and the square roots of the
    differences."""
    roots = torch.sqrt(planes[:, COLOURS:] + SQRT_EPSILON)
    return torch.cat([planes[:, :COLOURS], roots], 1).flatten(1)
