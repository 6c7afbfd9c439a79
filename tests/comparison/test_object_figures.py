"""Metrics of the paper's tables: pixels, exposure, and the effect of noise."""

import numpy as np
import pytest

from formats.errors import QueryError
from prt_bake.comparison import object_figures
from prt_bake.comparison.metrics import compare
from prt_bake.paper.artefacts import Artefact
from prt_bake.paper.reference import Reference

GENERATOR = np.random.default_rng(3)
IMAGE = np.exp(GENERATOR.normal(size=(64, 64, 3)) * 0.3 - 4.0)
COVERAGE = np.zeros((64, 64))
COVERAGE[8:56, 12:60] = 1.0
COVERAGE[7, 12:60] = 0.97


def test_the_object_has_a_median_luminance_of_018_after_exposure() -> None:
    mask = object_figures.object_mask(COVERAGE)
    assert mask.sum() == 48 * 48
    lifted = IMAGE * 2.0 ** object_figures.exposure(IMAGE, mask)
    assert np.median(lifted[mask] @ [0.2126, 0.7152, 0.0722]) == pytest.approx(0.18, rel=1e-12)


def test_pixels_off_the_object_do_not_count() -> None:
    mask = object_figures.object_mask(COVERAGE)
    stops = object_figures.exposure(IMAGE, mask)
    other = IMAGE.copy()
    other[0, 0] = 1e3
    assert object_figures.exposure(other, mask) == stops
    assert object_figures.measure(other, IMAGE, mask, stops).mse == 0.0
    assert object_figures.measure(IMAGE, IMAGE, mask, stops).as_json() == {
        **{"mse": 0.0, "flip": 0.0},
        **{"ssim": 1.0, "ssim_quarter": 1.0},
    }


def test_metrics_equal_those_of_compare() -> None:
    mask = object_figures.object_mask(COVERAGE)
    stops = object_figures.exposure(IMAGE, mask)
    found, expected = object_figures.measure(1.1 * IMAGE, IMAGE, mask, stops), compare(1.1 * IMAGE, IMAGE, mask, stops)
    assert found.as_json() == {name: getattr(expected, name) for name in ("mse", "ssim", "ssim_quarter", "flip")}
    lifted = 0.1 * IMAGE[mask] * 2.0**stops
    assert found.mse == pytest.approx(np.mean(lifted**2), rel=1e-9)


def test_the_noise_floor_equals_the_metrics_of_an_exact_picture_with_such_noise() -> None:
    smooth = np.full((64, 64, 3), 0.2, np.float32)
    sigma = 0.02
    drawn = GENERATOR.normal(size=(2, 64, 64, 3)).astype(np.float32) * np.float32(sigma)
    truth = Reference(smooth + drawn[0], np.full_like(smooth, sigma), drawn[1], COVERAGE, Artefact("", "", {}))
    mask = object_figures.object_mask(COVERAGE)
    found = object_figures.noise_figures(truth, smooth, mask, 0.0)
    exact = object_figures.measure(smooth, truth.image, mask, 0.0)
    assert found["mse"] == pytest.approx(sigma**2, rel=1e-6)
    # Another draw of the same distribution: means over 2304 pixels differ by a few per cent.
    assert found["flip"] == pytest.approx(exact.flip, rel=0.1)
    assert found["ssim"] == pytest.approx(exact.ssim, abs=0.05)


def test_unmeasurable_pictures_are_refused() -> None:
    with pytest.raises(QueryError, match="covers no pixel"):
        object_figures.object_mask(np.full((4, 4), 0.9))
    with pytest.raises(QueryError, match="no light"):
        object_figures.exposure(np.zeros((4, 4, 3)), np.ones((4, 4), np.bool_))
    assert object_figures.framing(COVERAGE) == {"object_share": COVERAGE.mean(), "object_pixels": 2304}


def test_flip_without_noise_is_closer_to_the_truth_and_not_below_it() -> None:
    smooth = np.full((64, 64, 3), 0.2)
    ramp = np.linspace(0.0, 0.06, 64)[:, None, None]
    mask = object_figures.object_mask(COVERAGE)
    truth = object_figures.measure(smooth + ramp, smooth, mask, 0.0).flip
    drawn = 0.03 * GENERATOR.normal(size=(2, 64, 64, 3)).astype(np.float32)
    noisy = Reference((smooth + drawn[0]).astype(np.float32), drawn[0], drawn[1], COVERAGE, Artefact("", "", {}))
    seen = object_figures.measure(smooth + ramp, noisy.image, mask, 0.0).flip
    estimate = object_figures.flip_without_noise(smooth + ramp, noisy, mask, 0.0, seen)
    assert 0.9 * truth < estimate < truth + 0.5 * (seen - truth)
    still = Reference(smooth.astype(np.float32), 0 * drawn[0], 0 * drawn[0], COVERAGE, Artefact("", "", {}))
    exact = object_figures.measure(smooth + ramp, still.image, mask, 0.0).flip
    assert object_figures.flip_without_noise(smooth + ramp, still, mask, 0.0, exact) == pytest.approx(exact)


def test_the_error_without_noise_equals_that_of_the_expected_pictures() -> None:
    """8 % too bright, with noise of 10 and 20 %; the standard error over 2304 pixels of 3 channels is 0.004."""
    smooth = np.full((64, 64, 3), 0.2)
    mask = object_figures.object_mask(COVERAGE)
    drawn = GENERATOR.normal(size=(2, 64, 64, 3))
    sigma = np.full((64, 64, 3), 0.02, np.float32)
    noisy = Reference((smooth + 0.02 * drawn[0]).astype(np.float32), sigma, sigma, COVERAGE, Artefact("", "", {}))
    found = object_figures.error_without_noise(1.08 * smooth + 0.04 * drawn[1], np.full_like(smooth, 0.04), noisy, mask)
    assert found == pytest.approx(0.08, abs=0.016)
    assert np.isnan(object_figures.error_without_noise(smooth, 1.0, noisy, mask))
    still = Reference(smooth.astype(np.float32), 0 * sigma, sigma, COVERAGE, Artefact("", "", {}))
    assert object_figures.error_without_noise(1.08 * smooth, 0.0, still, mask) == pytest.approx(0.08, rel=1e-5)
    assert object_figures.error_without_noise(still.image, 0.0, still, mask) == 0.0
    black = Reference(0 * sigma, sigma, sigma, COVERAGE, Artefact("", "", {}))
    assert np.isnan(object_figures.error_without_noise(smooth, 0.0, black, mask))


def test_the_error_without_noise_is_relative_to_the_reference_without_noise() -> None:
    """Noise of half the radiance with alternating signs, whose sums are exact."""
    smooth = np.full((64, 64, 3), 0.2)
    sigma = np.full((64, 64, 3), 0.1, np.float32)
    sign = (-1.0) ** np.add.outer(np.arange(64), np.arange(64))[..., None]
    truth = Reference((smooth + 0.1 * sign).astype(np.float32), sigma, sigma, COVERAGE, Artefact("", "", {}))
    found = object_figures.error_without_noise(1.08 * smooth, 0.0, truth, object_figures.object_mask(COVERAGE))
    assert found == pytest.approx(0.08, rel=1e-4)
