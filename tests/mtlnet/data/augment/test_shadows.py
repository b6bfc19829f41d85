"""Shadows of trees lie on the road and depend on their number only."""

import numpy as np

from mtlnet.data.augment.shadows import SHADOWS, add_shadow, road_points, shadow_mask
from tests.mtlnet.data.augment.samples import SMALL, pixel_of
from trackfeatures.camera import CameraParameters


def test_a_shadow_is_the_same_whichever_was_drawn_before_it() -> None:
    shadow_mask.cache_clear()
    third = shadow_mask(SMALL, 3)
    shadow_mask.cache_clear()
    in_order = [shadow_mask(SMALL, number) for number in range(4)]
    assert [bool((mask == third).all()) for mask in in_order] == [False, False, False, True]
    assert (in_order[0] == 255).all()


def test_shadows_darken_only_the_road() -> None:
    camera = CameraParameters()
    white = np.full((210, 280, 3), 255, np.uint8)
    covered = []
    for which in (1, 20, SHADOWS - 1):
        image = white.copy()
        add_shadow(image, camera, which)
        assert len(np.unique(image[:100])) <= 3  # uniform above the horizon
        assert image.min() >= 255 * 0.25 - 1
        road = image[120:, :, 0]
        covered.append(float((road < 0.5 * road.min() + 127).mean()))
    assert all(0.01 < share < 0.99 for share in covered)
    ahead, left = road_points(camera)
    x, y = float(ahead[150, 30]), float(left[150, 30])
    seen = pixel_of(camera, 0.0, 0.0, np.array([x + camera.x, y]))
    np.testing.assert_allclose(seen, [30.0, 150.0], atol=1e-9)
