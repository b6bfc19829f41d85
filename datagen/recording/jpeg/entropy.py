"""The entropy-coded part of a JPEG file to coefficients (ITU-T T.81, annex F), two at a time.

Whatever the bytes are, nothing is written out of place: a place in a block is at most 62 when a
coefficient is looked up and grows by less than 255, for which `tables.places` has entries. What
cannot be is noticed at the end of each block.
"""

import numpy as np

from datagen.recording.jpeg.compiled import compiled
from datagen.recording.jpeg.tables import AC_BITS, DC_BITS, ENDS, LONG
from datagen.recording.jpeg.transform import LANES
from datagen.recording.jpeg.vectors import at, big_endian, copy_eight, put

u64 = np.uint64
BLOCKS = 6  # of a unit of 16 x 16 pixels: four of luma, two of chroma
SPARE = 1024  # zero bytes behind the coded ones: more than a block can ask for
BAD = -1
ONES, TOPS = u64(0x0101010101010101), u64(0x8080808080808080)
DC_SHIFT, AC_SHIFT = u64(64 - DC_BITS), u64(64 - AC_BITS)


@compiled
def unstuffed(source, start, out):  # type: ignore[no-untyped-def]
    """The bytes up to the next marker, without the zeros after each 255, to `out`: how many, and
    where the marker is. `out` has room for all of `source` and `SPARE` more."""
    size, i, j = len(source), start, 0
    while i < size:
        if i + 8 <= size:
            eight = big_endian(source, i)
            if (~eight - ONES) & eight & TOPS == u64(0):  # none of them is 255
                copy_eight(source, i, out, j)
                i, j = i + 8, j + 8
                continue
        for _ in range(min(8, size - i)):
            byte = source[i]
            if byte == 0xFF:
                if i + 1 >= size or source[i + 1] != 0:
                    out[j : j + SPARE] = 0
                    return j, i
                i += 1
            out[j] = byte
            i, j = i + 1, j + 1
            if i >= size:
                break
    out[j : j + SPARE] = 0
    return j, i


@compiled
def more(coded, place, bits, have):  # type: ignore[no-untyped-def]
    """At least 56 bits: `bits` are at the top of a number, of which `have` count."""
    bits |= big_endian(coded, place) >> u64(have)
    return place + ((63 - have) >> 3), bits, have | 56


@compiled
def valued(bits, size):  # type: ignore[no-untyped-def]
    """The number that the first `size` bits, at least one, stand for (T.81, table F.1)."""
    negative = np.int64((bits >> u64(63)) ^ u64(1))
    return np.int64(bits >> u64(64 - size)) - negative * ((1 << size) - 1)


@compiled
def row_of_units(  # type: ignore[no-untyped-def]
    coded, end, place, bits, have, last_dc, units, dc, ac, codes, places, coefficients, deepest
):
    """Read a row of `units`: where it ends in `coded`, or `BAD`, and the bits left over.

    `units` are places of blocks in `coefficients`. `deepest` gets, of each group of `LANES` blocks,
    the place of its last coefficient.
    """
    for number in range(len(units)):
        block = number % BLOCKS
        chroma = 0 if block < 4 else 1
        component = 0 if block < 4 else block - 3
        home = at(units, number)
        ac_at = chroma << AC_BITS

        place, bits, have = more(coded, place, bits, have)
        entry = at(dc, (chroma << DC_BITS) + np.int64(bits >> DC_SHIFT))
        if entry:
            bits <<= u64(entry & 63)
            have -= entry & 63
            last_dc[component] += entry >> 16
        else:
            code = np.int64(at(codes, (chroma << 16) + np.int64(bits >> u64(48))))
            size = code & 255
            if code == 0 or size > 15:
                return BAD, bits, have
            bits <<= u64(code >> 8)
            if size:
                last_dc[component] += valued(bits, size)
                bits <<= u64(size)
            have -= (code >> 8) + size
        put(coefficients, home, last_dc[component])

        k = 0
        while True:
            place, bits, have = more(coded, place, bits, have)
            before, entry = bits, 0
            for _ in range(5):  # so many at `AC_BITS` are there, of 56
                before = bits
                entry = at(ac, ac_at + np.int64(bits >> AC_SHIFT))
                bits <<= u64(entry & 63)
                have -= entry & 255  # the same, off the chain that the next one waits for
                put(coefficients, home + at(places, k + ((entry >> 8) & 255)), entry >> 32)
                put(coefficients, home + at(places, k + ((entry >> 16) & 255)), entry >> 48)
                k += (entry >> 24) & 255
                if k >= 63:
                    break
            if k < 63:
                continue
            step = (entry >> 24) & 255
            if step != LONG:
                if k & 127 > 63 or k == 63 + ENDS:
                    # The first was the block's last, what follows is not of it: take that back.
                    if k - step + ((entry >> 8) & 255) != 63:
                        return BAD, bits, have
                    code = np.int64(at(codes, ((2 + chroma) << 16) + np.int64(before >> u64(48))))
                    used = (code >> 8) + (code & 15)
                    bits = before << u64(used)
                    have += (entry & 63) - used
                    k = 63
                    put(coefficients, home + at(places, k), entry >> 32)
                break
            k -= LONG
            place, bits, have = more(coded, place, bits, have)
            code = np.int64(at(codes, ((2 + chroma) << 16) + np.int64(bits >> u64(48))))
            if code == 0:
                return BAD, bits, have
            bits <<= u64(code >> 8)
            have -= code >> 8
            symbol = code & 255
            if symbol == 0:
                break
            k += int(symbol >> 4) + 1
            size = symbol & 15
            if size:
                put(coefficients, home + at(places, k), valued(bits, size))
                bits <<= u64(size)
                have -= size
            if k >= 63:
                break
        k &= 127
        if k > 63 or place > end + 16:
            return BAD, bits, have
        group = home // (64 * LANES)
        put(deepest, group, max(at(deepest, group), k))
    return place, bits, have
