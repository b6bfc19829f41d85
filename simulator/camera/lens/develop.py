"""Applies motion blur, glass, glare, sensor noise and a tone curve to a rendered picture.

The rendered picture contains square roots of linear light, 0 to 255. Each pixel becomes
tone(sqrt((mean of light over the exposure * gain + add + glare) * exposure) + noise).
"""

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled

NOISE_SIZE = 2**17
NOISE_STEPS = 32.0
"""Size of the noise table's integer unit: this many units are one standard deviation."""
MOST_TAPS = 6
LEAST_BLUR_PX = 0.75

Picture = NDArray[np.uint8]
Plane = NDArray[np.float32]


def noise_table() -> NDArray[np.int8]:
    """Return standard normal noise (131072,) int8, in units of 1/32 standard deviation."""
    rng = np.random.default_rng(20261126)
    drawn = np.rint(rng.standard_normal(NOISE_SIZE) * NOISE_STEPS)
    return np.clip(drawn, -127, 127).astype(np.int8)


@compiled
def develop(
    picture: Picture,
    gain: Plane,
    add: Plane,
    exposure: float,
    motion: tuple[float, float, float, float],
    glare: tuple[float, float, float],
    noise: tuple[float, int],
    normal: NDArray[np.int8],
    contrast: float,
) -> Picture:
    """Return `picture` (H, W, 3) with all effects applied, (H, W, 3).

    `gain` and `add` (H, W, 3) and the factor `exposure` apply to linear light, where 1 is the
    brightest displayed value. `motion` contains u, v (px) of the point that the car drives to, the
    height of the camera times the focal length (m px), and the distance driven during the exposure
    (m). `glare` contains u, v (px) of the sun and the strength of the glare. `noise` contains the
    standard deviation, in display values of 0 to 255, and the seed of this picture; `normal` is the
    table from `noise_table`. The tone curve is an S through 0, 0.5 and 1 of the display's range,
    with the slope 1 + `contrast` in the middle.
    """
    height, width = picture.shape[0], picture.shape[1]
    out = np.empty_like(picture)
    one, half, bend = np.float32(1.0), np.float32(0.5), np.float32(4.0 * contrast)
    sigma = np.float32(noise[0] / 255.0 / NOISE_STEPS)
    factor = np.float32(exposure)
    state = np.uint64(noise[1])
    light = np.empty(3 * width, np.float32)
    for v in range(height):
        _exposed_row(picture, v, motion, light)
        if glare[2] > 0.0:
            _add_glare(light, v, glare)
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        first = np.int64(state >> np.uint64(40)) % (NOISE_SIZE - 3 * width)
        row_gain, row_add = gain[v].reshape(3 * width), add[v].reshape(3 * width)
        grain, row = normal[first : first + 3 * width], out[v].reshape(3 * width)
        for k in range(3 * width):
            value = np.sqrt((light[k] * row_gain[k] + row_add[k]) * factor)
            value = min(max(value + sigma * np.float32(grain[k]), np.float32(0.0)), one)
            value += bend * (value - half) * value * (one - value)
            row[k] = np.uint8(min(max(value, np.float32(0.0)), one) * np.float32(255.0) + half)
    return out


@compiled
def _exposed_row(
    picture: Picture, v: int, motion: tuple[float, float, float, float], light: Plane
) -> None:
    """Write the linear light (3 W,) of row `v`, averaged over the exposure, into `light`.

    Pixels below the horizon are treated as points of a flat road, which move away from the point
    that the car drives to. Pixels above the horizon do not move.
    """
    height, width = picture.shape[0], picture.shape[1]
    u0, v0, reach, travel = motion
    full = np.float32(1.0 / 255.0**2)
    row = picture[v].reshape(3 * width)
    for k in range(3 * width):
        light[k] = np.float32(row[k]) * np.float32(row[k]) * full
    share = travel * max(v - v0, 0.0) / reach  # distance driven / distance of the road point
    apart = share * max(0.5 * width, v - v0)
    if apart < LEAST_BLUR_PX:
        return
    taps = min(MOST_TAPS, int(apart / 2.0) + 2)
    light[:] = np.float32(0.0)
    full /= np.float32(taps)
    for tap in range(taps):
        scale = 1.0 / (1.0 - share * ((tap + 0.5) / taps - 0.5))
        seen = picture[min(max(int(v0 + (v - v0) * scale + 0.5), 0), height - 1)]
        at = u0 - u0 * scale + 0.5
        for u in range(width):
            column = min(max(int(at), 0), width - 1)
            at += scale
            for c in range(3):
                value = np.float32(seen[column, c])
                light[3 * u + c] += value * value * full


@compiled
def _add_glare(light: Plane, v: int, glare: tuple[float, float, float]) -> None:
    """Add the sunlight that the lens scatters round the sun to row `v` of linear light (3 W,).
    `glare` contains u, v (px) of the sun and the strength of the glare."""
    width = len(light) // 3
    sun_u, sun_v, strength = glare
    narrow, wide = np.float32(0.04 * width) ** 2, np.float32(0.3 * width) ** 2
    for u in range(width):
        off = np.float32((u - sun_u) ** 2 + (v - sun_v) ** 2)
        veil = np.float32(1.0) / (np.float32(1.0) + off / narrow)
        veil += np.float32(0.12) / (np.float32(1.0) + off / wide)
        for c in range(3):
            light[3 * u + c] += np.float32(strength) * veil
