"""Conversion of primaries: laws, published matrices, and statements that cannot be used."""

from pathlib import Path

import numpy as np
import pytest

from formats.errors import InputWarning
from formats.image import gamut
from formats.image.gamut import Primaries, convert, matrix_to_rec709

SPACES = [gamut.REC2020, gamut.P3_D65, gamut.ACES_AP0, gamut.ACES_AP1, gamut.ADOBE_RGB]


def matrix(chromaticities: tuple[float, ...]) -> np.ndarray:
    with pytest.warns(InputWarning, match="converted to Rec.709"):
        found = matrix_to_rec709("a.exr", Primaries("the test", chromaticities))
    assert found is not None
    return found


@pytest.mark.parametrize("space", SPACES)
def test_white_stays_white(space: tuple[float, ...]) -> None:
    np.testing.assert_allclose(matrix(space) @ np.ones(3), 1.0, rtol=1e-12)


def test_published_matrices() -> None:
    """ITU-R BT.2087, annex 2 (Rec.2020), and the inverse of Adobe RGB's (1998), green and white as in Rec.709."""
    rec2020 = [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
    np.testing.assert_allclose(matrix(gamut.REC2020), rec2020, atol=1e-4)
    adobe = [[1.3984, -0.3984, 0.0], [0.0, 1.0, 0.0], [0.0, -0.0429, 1.0429]]
    np.testing.assert_allclose(matrix(gamut.ADOBE_RGB), adobe, atol=1e-4)


def test_xyz_is_a_space_like_others() -> None:
    """The rows of IEC 61966-2-1 from XYZ, its white adapted from equal energy."""
    found = matrix((1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3))
    np.testing.assert_allclose(found @ np.ones(3), 1.0, rtol=1e-12)
    d65 = matrix((1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.3127, 0.3290))
    to_rec709 = np.array([[3.2405, -1.5371, -0.4985], [-0.9693, 1.8760, 0.0416], [0.0556, -0.2040, 1.0572]])
    # Stored as RGB, X = Y = Z = 1 is white.
    np.testing.assert_allclose(d65, to_rec709 * [0.95046, 1.0, 1.08906], atol=1e-3)


def test_blocks_are_converted_as_the_complete_image() -> None:
    image = np.random.default_rng(0).gamma(0.5, 4, (50, 7, 3)).astype(np.float16)
    whole = convert(image, matrix(gamut.ACES_AP0))
    parts = [convert(image[first : first + 9], matrix(gamut.ACES_AP0)) for first in range(0, 50, 9)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    np.testing.assert_allclose(whole, image.astype(np.float64) @ matrix(gamut.ACES_AP0).T, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "numbers",
    [
        (),
        (0.0,) * 8,
        (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3, 0.0),
        (0.6, 0.3, 0.6, 0.3, 0.15, 0.06, 0.3127, 0.329),
        (np.nan,) * 8,
        (1e30,) * 8,
        (0.64, 0.33, 0.3),
    ],
)
def test_unusable_numbers_are_ignored_with_a_warning(numbers: tuple[float, ...]) -> None:
    with pytest.warns(InputWarning, match=r"a.hdr: PRIMARIES is not understood; the colours are taken as linear"):
        assert matrix_to_rec709(Path("a.hdr"), Primaries("PRIMARIES", numbers)) is None


def test_rec709_needs_no_conversion() -> None:
    assert matrix_to_rec709("a.exr", None) is None
    assert matrix_to_rec709("a.exr", Primaries("the test", gamut.REC709)) is None
    image = np.ones((2, 2, 3), np.float32)
    assert convert(image, None) is image
