"""The pass over a rendered picture: gain, addition, exposure, noise, tone, motion blur, glare."""

import numpy as np
from numpy.typing import NDArray

from simulator.camera.lens.develop import develop, noise_table

HEIGHT, WIDTH = 60, 80
STILL = (40.0, 20.0, 100.0, 0.0)
NO_GLARE = (0.0, 0.0, 0.0)


def developed(
    picture: NDArray[np.uint8],
    *,
    gain: float = 1.0,
    add: float = 0.0,
    exposure: float = 1.0,
    motion: tuple[float, float, float, float] = STILL,
    glare: tuple[float, float, float] = NO_GLARE,
    noise: tuple[float, int] = (0.0, 1),
    contrast: float = 0.0,
) -> NDArray[np.float64]:
    """The picture developed with the same gain and addition for every pixel."""
    plane = np.ones(picture.shape, np.float32)
    table = noise_table()
    parts = gain * plane, add * plane, exposure, motion, glare, noise, table, contrast
    return develop(picture, *parts).astype(np.float64)


def every_value() -> NDArray[np.uint8]:
    levels = np.arange(HEIGHT * WIDTH * 3) % 256
    return levels.reshape(HEIGHT, WIDTH, 3).astype(np.uint8)


def grey(level: int) -> NDArray[np.uint8]:
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


def linear(display: NDArray[np.float64]) -> NDArray[np.float64]:
    return (display / 255.0) ** 2


def test_nothing_to_do_changes_nothing() -> None:
    assert np.array_equal(developed(every_value()), every_value())


def test_gain_addition_and_exposure_apply_to_linear_light() -> None:
    picture = every_value()
    found = developed(picture, gain=0.5, add=0.1, exposure=1.5)
    light = np.clip((linear(picture.astype(np.float64)) * 0.5 + 0.1) * 1.5, 0.0, 1.0)
    assert np.abs(found - 255.0 * np.sqrt(light)).max() <= 0.501


def test_noise_has_the_declared_deviation_and_follows_its_seed() -> None:
    picture = grey(120)
    first, again, other = (developed(picture, noise=(4.0, seed)) for seed in (7, 7, 8))
    assert np.array_equal(first, again)
    assert np.mean(first != other) > 0.8
    # Rounding adds a variance of 1/12.
    assert abs(first.std() - np.sqrt(16.0 + 1.0 / 12.0)) < 0.15
    assert abs(first.mean() - 120.0) < 0.2
    rows = first[..., 0] - 120.0
    assert abs(np.mean(rows[1:] * rows[:-1])) / 16.0 < 0.06


def test_the_tone_curve_has_the_declared_slope_and_keeps_its_ends() -> None:
    levels = every_value().astype(np.float64)
    found = developed(every_value(), contrast=0.4)
    assert (found[levels == 0] == 0).all()
    assert (found[levels == 255] == 255).all()
    x = levels / 255.0
    curve = x + 0.4 * (x - 0.5) * 4.0 * x * (1.0 - x)
    assert np.abs(found - 255.0 * curve).max() <= 0.501
    slope = found[levels == 133].mean() - found[levels == 122].mean()
    assert abs(slope / 11.0 - 1.4) < 0.1


def test_motion_blur_mixes_light_along_the_way_and_spares_the_horizon() -> None:
    picture = grey(0)
    picture[45:47] = 255  # a bright bar across the road
    blurred = developed(picture, motion=(40.0, 20.0, 100.0, 0.9))
    still = developed(picture)
    assert np.array_equal(blurred[:21], still[:21])
    middle = linear(blurred[:, 40, 0])
    # At row 46 the road is 100 / 26 = 3.8 m away: 0.9 m sweep over 26 * 0.9 / 3.8 = 6.1 rows.
    assert 5 <= np.count_nonzero(middle > 0.02) <= 10
    assert middle.max() < 0.6
    assert abs(middle.sum() - 2.0) < 1.0


def test_glare_falls_from_the_sun_outwards() -> None:
    found = linear(developed(grey(0), glare=(60.0, 10.0, 0.5)))[..., 0]
    # 0.5 * (1 + 0.12) at the sun; half of the narrow part at 0.04 of the width.
    assert abs(found[10, 60] - 0.56) < 0.01
    assert abs(found[10, 57] - 0.5 * (1.0 / (1.0 + 9.0 / 3.2**2) + 0.12)) < 0.02
    assert found[50, 5] < 0.05
