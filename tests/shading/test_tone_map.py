"""AgX: its fixed points, and what it does to bright and to coloured light."""

import numpy as np
import pytest

from prt_bake.shading.tone_map import agx


def of(*colour: float, exposure: float = 0.0) -> np.ndarray:
    return agx(np.array([[colour]], np.float32), exposure)[0, 0]


@pytest.mark.parametrize(
    ("grey", "shown"),
    # The curve of log2(grey) from -12.47 to 4.03 by hand, to the power 2.2.
    [
        (0.0, 0.0),
        (0.18 * 2.0**-10, 0.0),
        (0.018, 0.01556),
        (0.18, 0.21452),
        (1.0, 0.59016),
        (0.18 * 2.0**6.5, 0.99688),
        (1e9, 0.99688),
    ],
)
def test_greys_stay_grey_and_keep_the_fixed_points(grey: float, shown: float) -> None:
    np.testing.assert_allclose(of(grey, grey, grey), shown, atol=2e-4)


def test_more_light_is_brighter_and_an_exposure_is_a_factor() -> None:
    ramp = np.array([of(x, x, x)[1] for x in 2.0 ** np.linspace(-12.0, 4.0, 200)])
    assert (np.diff(ramp) > 0.0).all()
    np.testing.assert_allclose(of(0.1, 0.2, 0.4, exposure=2.0), of(0.4, 0.8, 1.6), rtol=1e-6)


def test_bright_colours_turn_white_gradually() -> None:
    reds = np.array([of(x, 0.0, 0.0) for x in (0.5, 4.0, 32.0, 1000.0)])
    saturation = 1.0 - reds.min(axis=1) / reds.max(axis=1)
    assert (np.diff(saturation) < 0.0).all()
    assert saturation[0] > 0.8
    assert saturation[-1] < 0.01
    assert reds.min() >= 0.0
    assert reds.max() <= 1.0


def test_colours_outside_the_gamut_and_premultiplied_ones() -> None:
    assert np.isfinite(of(-0.1, 0.2, 0.3)).all()
    image, alpha = np.array([[[0.2, 0.1, 0.05], [0.0, 0.0, 0.0]]]), np.array([[0.25, 0.0]])
    np.testing.assert_allclose(agx(image, 0.0, alpha)[0], [0.25 * of(0.8, 0.4, 0.2), [0.0] * 3], atol=1e-6)
