"""All of a picture: units row by row, coefficients to samples to RGB while they are at hand."""

import numpy as np

from datagen.recording.jpeg.compiled import compiled
from datagen.recording.jpeg.entropy import BAD, row_of_units, unstuffed
from datagen.recording.jpeg.tables import DC_BITS
from datagen.recording.jpeg.transform import (
    LANES,
    STEP,
    colour,
    inverse_four,
    inverse_full,
    inverse_two,
)

u64 = np.uint64
END_OF_IMAGE = 0xD9
# The place of the last coefficient, in zigzag order, of a block within 2 x 2 and 4 x 4.
IN_TWO, IN_FOUR = 2, 9


@compiled
def transformed(row, groups, coefficients, factors, deepest, samples):  # type: ignore[no-untyped-def]
    """The coefficients of a row of units into samples; all of them are zero afterwards.

    `groups` (n, 4): where a group of blocks starts in the first row of samples, how much further
    for each row of units, how far apart its rows are, and where its `factors` start.
    """
    for number in range(len(groups)):
        first = number * 64 * LANES
        to, stride = groups[number, 0] + row * groups[number, 1], groups[number, 2]
        depth, by = deepest[number], groups[number, 3]
        deepest[number] = 0
        if depth > IN_FOUR:
            inverse_full(coefficients, first, factors, by, samples, to, stride)
        elif depth > IN_TWO:
            inverse_four(coefficients, first, factors, by, samples, to, stride)
        else:
            inverse_two(coefficients, first, factors, by, samples, to, stride)


@compiled
def widened(samples, first, last, start, stride, width):  # type: ignore[no-untyped-def]
    """Repeat the outermost samples of rows of chroma beyond both sides."""
    for row in range(first, last):
        place = start + row * stride
        samples[place - 1] = samples[place]
        samples[place + width] = samples[place + width - 1]


@compiled
def coloured(samples, planes, first, last, width, height, out):  # type: ignore[no-untyped-def]
    """Rows `first` to `last` of pixels; `planes` (3, 2): where a plane starts, and its stride."""
    rows, stride = (height + 1) // 2, planes[1, 1]
    for row in range(first, last):
        near = row >> 1
        other = min(near + 1, rows - 1) if row & 1 else max(near - 1, 0)
        luma = planes[0, 0] + row * planes[0, 1]
        blue, red = planes[1, 0] + near * stride, planes[2, 0] + near * stride
        far = (other - near) * stride
        target = row * width
        for x in range(0, width - STEP + 1, STEP):
            half = x >> 1
            colour(samples, luma + x, blue + half, red + half, far, out, (target + x) * 3)
        if width % STEP:  # the last ones overlap
            x = width - STEP
            half = x >> 1
            colour(samples, luma + x, blue + half, red + half, far, out, (target + x) * 3)


@compiled
def decoded(  # type: ignore[no-untyped-def]
    source, start, width, height, tables, codes, places, factors, units, groups, planes,
    coefficients, samples, coded, out,
):  # fmt: skip
    """The picture of `source`, whose coded part begins at `start`, to `out` (H * W * 3 bytes).

    False where it is damaged: then `out` and what was to be zero in `coefficients` are anything.
    """
    ac_at = 2 << DC_BITS
    dc, ac = tables[:ac_at], tables[ac_at:]
    end, marker = unstuffed(source, start, coded)
    if marker + 1 >= len(source) or source[marker + 1] != END_OF_IMAGE:
        return False
    place, bits, have = 0, u64(0), 0
    last_dc, deepest = np.zeros(3, np.int64), np.zeros(len(groups), np.int64)
    rows = (height + 15) // 16
    for row in range(rows):
        place, bits, have = row_of_units(
            coded, end, place, bits, have, last_dc, units, dc, ac, codes, places, coefficients,
            deepest,
        )  # fmt: skip
        if place == BAD:
            return False
        transformed(row, groups, coefficients, factors, deepest, samples)
        for plane in (1, 2):
            begin, stride = planes[plane]
            widened(samples, 8 * row, 8 * row + 8, begin, stride, (width + 1) // 2)
        # The last row of pixels needs the chroma of the next row of units.
        last = height if row == rows - 1 else 16 * row + 15
        coloured(samples, planes, max(16 * row - 1, 0), last, width, height, out)
    return 0 <= 8 * end - (8 * place - have) < 8
