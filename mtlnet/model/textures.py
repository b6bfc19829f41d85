"""Texture features of an image: what the out-of-distribution score and the light are computed from.

An image is divided into 14 x 8 cells of three bands each. A cell or a band has mean colours in
[-1, 1], and the square roots of the mean absolute differences of brightness between horizontal and
vertical neighbours. Torch operations without branches, so that they can be part of an exported
network; B is the number of images, C = CELL_VALUES, M = CENTRE_VALUES.
"""

import torch
from torch import Tensor

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
"""Added to a mean difference before the square root; the difference is 0 in a flat cell."""
LEVEL = 1 / 127.5  # of a colour's step, where colours lie in [-1, 1]


def texture_features(images: Tensor) -> Tensor:
    """Texture features (B, C + M) of images uint8 (B, H, W, 3): of all cells, then of the bands of
    the centre.

    H and W must be multiples of the numbers of bands and columns.
    """
    sums, pixels = band_sums(images)
    colours = sums[:, :COLOURS] * (LEVEL / pixels) - 1
    differences = sums[:, COLOURS:] * (LEVEL / COLOURS / pixels)
    narrow = torch.cat([colours, differences], 1)
    cells = narrow.reshape(-1, PLANES, CELL_ROWS, BANDS, CELL_COLUMNS).mean(3)
    centre = narrow[:, :, CENTRE_BANDS, CENTRE_COLUMNS]
    return torch.cat([_with_roots(cells), _with_roots(centre)], 1)


def band_sums(images: Tensor) -> tuple[Tensor, int]:
    """Sums over each band (B, PLANES, bands, columns) of images uint8 (B, H, W, 3), and the number
    of pixels of a band.

    The planes are red, green, blue, and the absolute differences of red + green + blue from the
    next column and from the next row; the last column and row differ by 0 from theirs. All sums are
    of integers below 2**24, and therefore exact in float32. The rows of a band are added before its
    columns: all rows with the same place in their band together, because long sums of few terms are
    the fastest in OpenVINO.
    """
    bands = CELL_ROWS * BANDS
    height, width = int(images.shape[1]), int(images.shape[2])
    count = height // bands
    planes = images.permute(0, 3, 1, 2).reshape(-1, COLOURS, bands, count, width)
    rows = [planes[:, :, :, k : k + 1] for k in range(count)]  # each (B, 3, bands, 1, W)
    grey = [_total([row[:, k : k + 1].float() for k in range(COLOURS)]) for row in rows]
    following = torch.cat([grey[0][:, :, 1:], grey[-1][:, :, -1:]], 2)
    down = _total([(b - a).abs() for a, b in zip(grey, [*grey[1:], following], strict=True)])
    across = _total([(torch.cat([a[..., 1:], a[..., -1:]], 4) - a).abs() for a in grey])
    narrow = torch.cat([_total([row.float() for row in rows]), across, down], 1)
    columns = narrow.reshape(-1, PLANES, bands, CELL_COLUMNS, width // CELL_COLUMNS)
    return columns.sum(4), count * (width // CELL_COLUMNS)


def light_features(textures: Tensor) -> Tensor:
    """Light features (B, LIGHT_VALUES) from textures (B, C + M): the mean of each texture plane
    over the upper half, then over the lower half of the image."""
    cells = textures[:, :CELL_VALUES].reshape(-1, LIGHT_VALUES, CELL_VALUES // LIGHT_VALUES)
    return cells.mean(2)


def _total(terms: list[Tensor]) -> Tensor:
    return sum(terms[1:], terms[0])


def _with_roots(planes: Tensor) -> Tensor:
    """Values (B, N) of planes (B, PLANES, h, w), with the square roots of the differences."""
    roots = torch.sqrt(planes[:, COLOURS:] + SQRT_EPSILON)
    return torch.cat([planes[:, :COLOURS], roots], 1).flatten(1)
