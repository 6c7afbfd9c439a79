"""Metrics corrected for noise: squared metrics are unbiased, and confidence intervals contain the truth.

Noise of known variance is simulated on known pictures. Apart from the fixed seeds, a test of a mean would reject a
correct estimator with the probability FALSE_ALARM.
"""

import numpy as np
import pytest
from scipy.stats import binom, norm

from formats.errors import QueryError
from formats.image.exr import Layers
from prt_bake.comparison.metrics import compare
from prt_bake.comparison.noise import NoiseLike, PixelErrors, errors_of, same_random_numbers
from prt_bake.comparison.noise_free import compare_without_noise

FALSE_ALARM = 1e-5
SHAPE = (64, 64, 3)


def scene(seed: int = 0) -> np.ndarray:
    """A smooth picture in (0.1, 0.6)."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 10.0
    turn = np.random.default_rng(seed).uniform(0.0, 6.0, 3)
    return 0.35 + 0.25 * np.stack([np.sin(0.7 * x + 0.4 * y + t) for t in turn], axis=-1)


def walks(
    truth: np.ndarray, noise: float, passes: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A mean over passes with skewed grey noise, and its standard error from the variance between passes."""
    drawn = generator.exponential(size=(passes, *truth.shape[:2], 1)) - 1.0
    each = truth * (1.0 + noise * np.sqrt(passes) * drawn)
    return each.mean(axis=0), np.sqrt(each.var(axis=0, ddof=1) / passes)


def shift(kind: str) -> np.ndarray:
    """The true difference of a picture: none, a factor of brightness, or a stain."""
    truth = scene()
    if kind == "nothing":
        return np.zeros_like(truth)
    if kind == "brighter":
        return 0.06 * truth
    stain = np.zeros_like(truth)
    stain[10:30, 20:50] = [0.2, -0.1, 0.05]
    return stain


@pytest.mark.parametrize("kind", ["nothing", "brighter", "stain"])
def test_squared_metrics_are_unbiased_and_their_intervals_contain_the_truth(kind: str) -> None:
    truth, off, generator, trials = scene(), shift(kind), np.random.default_rng(1), 60
    true = {
        "mse": float((off**2).mean()),
        "relative_mse": float((off**2 / (truth**2 + 1e-4)).mean()),
        "relative_rmse": float(np.sqrt((off**2).mean() / (truth**2).mean())),
    }
    found: dict[str, list[float]] = {name: [] for name in true}
    contained = dict.fromkeys(true, 0)
    for trial in range(trials):
        image, sigma = walks(truth + off, 0.3, 8, generator)
        reference, small = walks(truth, 0.03, 8, generator)
        errors = PixelErrors(sigma, small, np.zeros(SHAPE))
        figures = squares_of(image, reference, errors, trial)
        for name in true:
            found[name].append(figures[name].value)
            contained[name] += figures[name].low <= true[name] <= figures[name].high
    error = np.std(found["mse"], ddof=1) / np.sqrt(trials)
    assert abs(np.mean(found["mse"]) - true["mse"]) < norm.isf(FALSE_ALARM / 2) * error
    # The test is sensitive: the noise is a hundred times the standard error of its mean.
    assert error < 0.09 * float((truth**2).mean()) / 100.0
    assert abs(np.mean(found["relative_mse"]) - true["relative_mse"]) < 0.09 / 30.0
    for name in true:
        assert contained[name] >= binom.ppf(FALSE_ALARM, trials, 0.92), name


def squares_of(image: np.ndarray, reference: np.ndarray, errors: PixelErrors, seed: int) -> dict:
    """The squared metrics alone, without the cost of FLIP."""
    from prt_bake.comparison import noise_free

    return noise_free._squared_metrics(image, reference, errors, np.ones(SHAPE[:2], np.bool_), seed)


def test_gaussian_noise_is_corrected_without_bias() -> None:
    """A z-test with known variance: Σ n² of Gaussians has the variance 2 Σ sigma⁴."""
    generator, sigma = np.random.default_rng(2), 0.1 * scene(3)
    values = []
    for trial in range(40):
        image = scene() + sigma * generator.normal(size=SHAPE)
        values.append(squares_of(image, scene(), PixelErrors(sigma, 0 * sigma, 0 * sigma), trial)["mse"].value)
    error = np.sqrt(2.0 * (sigma**4).sum()) / sigma.size / np.sqrt(len(values))
    assert abs(np.mean(values)) < norm.isf(FALSE_ALARM / 2) * error
    assert np.std(values, ddof=1) * np.sqrt(1 / len(values)) == pytest.approx(error, rel=0.5)


@pytest.mark.statistics
@pytest.mark.parametrize("kind", ["nothing", "stain"])
@pytest.mark.parametrize("noise", [0.1, 0.3])
def test_intervals_of_flip_and_ssim_contain_the_noise_free_values(kind: str, noise: float) -> None:
    truth, off, generator = scene(), shift(kind), np.random.default_rng(4)
    exact = compare(truth + off, truth, hdr=(-1.0, 3.0))
    assert exact.hdr_exposures is not None
    for trial in range(4):
        image, sigma = walks(truth + off, noise, 16, generator)
        reference, small = walks(truth, noise / 10, 16, generator)
        errors = PixelErrors(sigma, small, np.zeros(SHAPE))
        seen = compare(image, reference, hdr=(-1.0, 3.0))
        free = compare_without_noise(image, reference, errors, hdr=exact.hdr_exposures, seed=trial)
        for name, slack in (("flip", 0.01), ("hdr_flip", 0.01), ("ssim", 0.01), ("ssim_quarter", 0.01)):
            true, interval = getattr(exact, name), free.figures[name]
            assert interval.low - slack <= true <= interval.high + slack, name
            # Closer to the truth than without correction.
            assert abs(interval.value - true) < abs(getattr(seen, name) - true) + 1e-3, name
        floor = free.of_noise["flip"]
        if kind == "nothing":
            assert floor == pytest.approx(seen.flip, rel=0.12)
            assert free.figures["flip"].low == 0.0


def test_intervals_shrink_with_the_noise() -> None:
    truth, off, lengths = scene(), shift("stain"), []
    for noise in (0.3, 0.1, 0.03):
        image, sigma = walks(truth + off, noise, 16, np.random.default_rng(5))
        free = compare_without_noise(image, truth, PixelErrors(sigma, 0 * sigma, 0 * sigma))
        lengths.append([free.figures[name].high - free.figures[name].low for name in ("mse", "flip", "ssim")])
    assert (np.diff(lengths, axis=0) < 0.0).all()


def test_without_noise_the_metrics_are_unchanged() -> None:
    truth = scene()
    image = truth + shift("stain")
    nothing = np.zeros(SHAPE)
    free, plain = compare_without_noise(image, truth, PixelErrors(nothing, nothing, nothing)), compare(image, truth)
    for name in ("mse", "relative_mse", "relative_rmse"):
        assert free.figures[name].value == pytest.approx(getattr(plain, name), rel=1e-9)
    assert set(free.figures) == {"mse", "relative_mse", "relative_rmse"}


@pytest.mark.parametrize("stops", [-2.0, 3.0])
def test_exposure_scales_squared_metrics_and_keeps_ratios(stops: float) -> None:
    image, sigma = walks(scene(), 0.2, 8, np.random.default_rng(6))
    errors = PixelErrors(sigma, 0 * sigma, 0 * sigma)
    plain, lifted = (compare_without_noise(1.2 * image, scene(), errors, exposure=e).figures for e in (0.0, stops))
    assert lifted["mse"].value == pytest.approx(4.0**stops * plain["mse"].value, rel=1e-9)
    assert lifted["relative_rmse"].high == pytest.approx(plain["relative_rmse"].high, rel=1e-9)


def test_only_the_noise_of_masked_pixels_counts() -> None:
    sigma = np.zeros(SHAPE)
    sigma[:, 32:] = 0.2
    image = scene() + sigma * np.random.default_rng(7).normal(size=SHAPE)
    mask = np.zeros(SHAPE[:2])
    mask[:, :16] = 1.0
    free = compare_without_noise(image, scene(), PixelErrors(sigma, 0 * sigma, 0 * sigma), mask)
    assert (free.figures["mse"].value, free.of_noise["mse"]) == (0.0, 0.0)


def test_shared_errors_are_corrected_in_squared_metrics_and_widen_their_intervals() -> None:
    """All pixels have one common random error: 95 % of the intervals contain zero difference."""
    truth, sigma, contained, trials = scene(), 0.05 * scene(), 0, 200
    generator = np.random.default_rng(8)
    errors = PixelErrors(0 * sigma, 0 * sigma, sigma)
    for trial in range(trials):
        interval = squares_of(truth + sigma * generator.normal(), truth, errors, trial)["mse"]
        contained += interval.low <= 0.0 <= interval.high
    assert binom.ppf(FALSE_ALARM, trials, 0.95) <= contained
    off = squares_of(truth + 0.5 * truth, truth, errors, 0)
    assert off["relative_rmse"].low < 0.5 < off["relative_rmse"].high
    assert off["relative_rmse"].low == pytest.approx(0.5 - 1.96 * 0.05, rel=1e-3)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (9, 40)])
def test_small_pictures_have_values_and_intervals_if_possible(size: tuple[int, int]) -> None:
    generator = np.random.default_rng(9)
    image, reference = generator.uniform(0.2, 0.8, (2, *size, 3))
    sigma = np.full((*size, 3), 0.05)
    free = compare_without_noise(image, reference, PixelErrors(sigma, sigma, 0 * sigma))
    assert np.isfinite(free.figures["mse"].value)
    assert np.isfinite(free.figures["mse"].low) == (size[0] * size[1] >= 8)
    assert np.isfinite(free.figures["flip"].value)
    assert np.isnan(free.figures["ssim"].value) == (min(size) < 11)


def test_a_noisy_reference_leaves_relative_mse_without_an_interval() -> None:
    image, sigma = walks(scene(), 0.4, 8, np.random.default_rng(10))
    free = squares_of(scene(), image, PixelErrors(0 * sigma, sigma, 0 * sigma), 0)
    assert np.isnan(free["relative_mse"].low)
    assert free["mse"].low <= 0.0 <= free["mse"].high


def test_resampled_noise_is_like_that_of_the_pictures() -> None:
    """It has the same standard error, correlation of channels and kurtosis."""
    truth, generator = np.full(SHAPE, 0.4), np.random.default_rng(11)
    image, sigma = walks(truth, 0.5, 4, generator)
    drawn = [NoiseLike(image, truth, PixelErrors(sigma, 0 * sigma, 0 * sigma), seed).draw()[0] for seed in range(20)]
    size = np.sqrt(np.mean(np.square(drawn)))
    assert size == pytest.approx(0.4 * 0.5, rel=0.05)
    assert np.corrcoef(np.reshape(drawn, (-1, 3)).T)[0, 1] > 0.99
    kurtosis = np.mean(np.power(drawn, 4)) / size**4
    assert kurtosis > 3.3


def layered(image: np.ndarray, error: np.ndarray | None = None, **texts: str) -> Layers:
    attributes = {f"prtbake.{name}": text for name, text in texts.items()}
    return Layers(image.astype(np.float32), {} if error is None else {"error": error.astype(np.float32)}, attributes)


def test_independent_and_shared_errors_are_read_from_files() -> None:
    image, sigma = scene(), 0.1 * scene()
    rendered, shaded, plain = layered(image, sigma, passes="8"), layered(image, 2 * sigma), layered(image)
    assert errors_of(plain, plain) is None
    both = errors_of(rendered, shaded)
    assert both is not None
    assert both.independent
    np.testing.assert_allclose([both.image, both.shared], [sigma, 2 * sigma], rtol=1e-6)
    assert not both.reference.any()
    baked = errors_of(shaded, shaded)
    assert baked is not None
    assert not baked.independent
    np.testing.assert_allclose(baked.shared, np.sqrt(8.0) * sigma, rtol=1e-6)


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"),
    [
        ({"seed": "1", "scene": "a"}, {"seed": "1", "scene": "b"}, True),
        ({"seed": "1", "scene": "a"}, {"seed": "2", "scene": "a"}, False),
        ({"seed": "1", "scene": "a"}, {"seed": "1", "model": "b"}, False),
        ({}, {}, False),
    ],
)
def test_pictures_of_one_seed_have_correlated_noise(ours: dict, theirs: dict, expected: bool) -> None:
    first, second = layered(scene(), **ours), layered(scene(1), **theirs)
    assert same_random_numbers(first, second) is expected
    assert same_random_numbers(first, first)


def test_errors_of_another_size_are_refused() -> None:
    other = np.zeros((4, 4, 3))
    with pytest.raises(QueryError, match=r"found \[4, 4, 3\]"):
        compare_without_noise(scene(), scene(), PixelErrors(other, other, other))
