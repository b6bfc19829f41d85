"""Blocks of coefficients to samples, and samples to RGB, many at a time, as libjpeg-turbo does it.

Sources: ITU-T T.81 (JPEG), T.871 (colour); the exact roundings are those of libjpeg's `jidctint`
(Loeffler, Ligtenberg and Moschytz's transform), `jdsample` (h2v2, "fancy") and `jdcolor`.
"""

from typing import Any

from numba import types

from datagen.recording.jpeg.vectors import (
    I8,
    I16,
    I32,
    Intrinsic,
    Vector,
    beyond,
    load,
    make_intrinsic,
    place_in,
    shuffled,
    store,
    zeros,
)

LANES = 8  # blocks side by side, transformed at once
HALF = 16  # chroma samples that are coloured at once, for twice as many pixels
STEP = 2 * HALF
FIRST_BITS, SECOND_BITS = 11, 18  # what the two passes are scaled by


def _eight(a: list[Vector], bits: int) -> list[Vector]:
    """The inverse transform of eight 16-bit vectors, 32-bit ones, scaled down by `bits`."""
    a0, a1, a2, a3, a4, a5, a6, a7 = a
    z1 = (a2 + a6).to(I32) * 4433
    t2, t3 = z1 - a6.to(I32) * 15137, z1 + a2.to(I32) * 6270
    t0 = ((a0 + a4).to(I32) << 13) + (1 << (bits - 1))
    t1 = ((a0 - a4).to(I32) << 13) + (1 << (bits - 1))
    even = [t0 + t3, t1 + t2, t1 - t2, t0 - t3]
    z3, z4 = a7 + a3, a5 + a1
    z5 = (z3 + z4).to(I32) * 9633
    z1, z2 = (a7 + a1).to(I32) * -7373, (a5 + a3).to(I32) * -20995
    z3, z4 = z3.to(I32) * -16069 + z5, z4.to(I32) * -3196 + z5
    odd = [
        a1.to(I32) * 12299 + z1 + z4,
        a3.to(I32) * 25172 + z2 + z3,
        a5.to(I32) * 16819 + z2 + z4,
        a7.to(I32) * 2446 + z1 + z3,
    ]
    sums = [(e + o) >> bits for e, o in zip(even, odd, strict=True)]
    return sums + [(e - o) >> bits for e, o in zip(even[::-1], odd[::-1], strict=True)]


def _inverse(size: int) -> Intrinsic:
    """For blocks with nothing but zeros beyond their first `size` rows and columns: what those
    would be multiplied with is then never written."""

    def typed(  # type: ignore[no-untyped-def]
        tc, coefficients, first, factors, by, samples, to, stride
    ) -> Any:
        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            place = place_in(context, builder, signature.args[0], *arguments[:2])
            factor = place_in(context, builder, signature.args[2], *arguments[2:4])
            zero = zeros(builder, I16, LANES)
            between = [zero] * 64
            for x in range(size):
                column = []
                for number in range(x, 8 * size, 8):
                    at, times = (beyond(builder, p, number * LANES) for p in (place, factor))
                    column.append(load(builder, at, I16, LANES) * load(builder, times, I16, LANES))
                    store(at, zero)  # for the next blocks
                for y, vector in enumerate(_eight(column + [zero] * (8 - size), FIRST_BITS)):
                    between[8 * y + x] = vector.to(I16)
            row = place_in(context, builder, signature.args[4], *arguments[4:6])
            for y in range(8):
                found = _eight(between[8 * y : 8 * y + 8], SECOND_BITS)
                left, right = (_four_bytes(found[i : i + 4]) for i in (0, 4))
                pairs = [lane for i in range(LANES) for lane in (i, LANES + i)]
                store(row, shuffled(left, right, pairs))
                row = builder.gep(row, [arguments[6]])
            return context.get_dummy_value()

        arrays = coefficients, types.intp, factors, types.intp, samples
        return types.void(*arrays, types.intp, types.intp), build

    return make_intrinsic(typed)


def _four_bytes(a: list[Vector]) -> Vector:
    """Four samples of 16 bits around 0, each in 32, as bytes; two of them are limited at once."""
    even, odd = ((v & 0xFFFF | w << 16).seen_as(I16) for v, w in ((a[0], a[2]), (a[1], a[3])))
    return ((even + 128).byte() | (odd + 128).byte() << 8).seen_as(I32)


# (coefficients, first, factors, by, samples, to, stride): `LANES` blocks, lane after lane of each
# of 64 coefficients from `first`, times those of `factors` from `by`, become 8 rows of
# 8 * `LANES` bytes from `to`, `stride` bytes apart. The coefficients are zero afterwards.
inverse_full, inverse_four, inverse_two = _inverse(8), _inverse(4), _inverse(2)


@make_intrinsic
def colour(
    tc: Any, samples: Any, luma: Any, blue: Any, red: Any, far: Any, out: Any, to: Any
) -> Any:
    """`STEP` pixels: luma from `luma`, chroma from `blue` and `red`, both one sample beyond each
    side too, and `far` bytes from them, in the row on this pixel's other side; RGB to `out[to:]`.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values, luma, blue, red, far, target, to = arguments
        kinds = signature.args

        def upsampled(start: Any) -> tuple[Vector, Vector]:
            """Of the even and of the odd pixels."""
            near = place_in(context, builder, kinds[0], values, start)
            sums = []
            for column in (-1, 0, 1):
                place = beyond(builder, near, column)
                one = load(builder, place, I8, HALF).to(I16, unsigned=True)
                other = load(builder, builder.gep(place, [far]), I8, HALF).to(I16, unsigned=True)
                sums.append(one * 3 + other)
            middle = sums[1] * 3
            return ((middle + sums[0] + 8) >> 4) - 128, ((middle + sums[2] + 7) >> 4) - 128

        two = load(builder, place_in(context, builder, kinds[0], values, luma), I16, HALF)
        parts: list[list[Vector]] = [[], [], []]
        for y, b, r in zip(
            (two & 255, two.unsigned_shift(8)), upsampled(blue), upsampled(red), strict=True
        ):
            parts[0].append((y + r + _times(r, 26345)).byte())  # 1.402 - 1, of 65536
            parts[1].append((y - r + _green(b, r)).byte())
            parts[2].append((y + b + b + _times(b, -14942)).byte())  # 1.772 - 2
        r, g, b = ((even | (odd << 8)).seen_as(I8) for even, odd in parts)
        rg, bb = (shuffled(v, w, range(2 * STEP)) for v, w in ((r, g), (b, b)))
        rgb = [lane for i in range(STEP) for lane in (i, STEP + i, 2 * STEP + i)]
        store(place_in(context, builder, kinds[5], target, to), shuffled(rg, bb, rgb))
        return context.get_dummy_value()

    ints = (types.intp,) * 4
    return types.void(samples, *ints, out, types.intp), build


def _times(v: Vector, factor: int) -> Vector:
    """(v * factor + 32768) >> 16, as the high half of a product."""
    return ((((v + v).to(I32) * factor) >> 16).to(I16) + 1) >> 1


def _green(blue: Vector, red: Vector) -> Vector:
    """(-0.34414 blue + (1 - 0.71414) red) rounded; 32 bits for each lane, so one in two at once."""
    b, r = blue.seen_as(I32), red.seen_as(I32)
    low = ((b << 16) >> 16) * -22554 + ((r << 16) >> 16) * 18734 + 32768
    high = (b >> 16) * -22554 + (r >> 16) * 18734 + 32768
    return (low.unsigned_shift(16) | (high & -65536)).seen_as(I16)
