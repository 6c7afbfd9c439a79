"""Metrics of pictures."""

import subprocess
import sys

import numpy as np
import pytest

from formats.errors import PrtbakeError, QueryError
from formats.image.png import to_srgb
from prt_bake.comparison.metrics import compare


def picture(height: int = 48, width: int = 64, seed: int = 0) -> np.ndarray:
    """A smooth picture with structure in (0.2, 0.8)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width] / 10.0
    waves = [np.sin(a * x + b * y + c) for a, b, c in rng.uniform(0.3, 1.5, (3, 3))]
    return 0.5 + 0.3 * np.stack(waves, axis=-1)


def test_a_picture_equals_itself():
    image = picture()
    figures = compare(image, image)
    assert (figures.mse, figures.relative_mse, figures.flip) == (0, 0, 0)
    assert figures.ssim == pytest.approx(1, abs=1e-12)
    assert figures.ssim_quarter == pytest.approx(1, abs=1e-12)
    assert figures.flip_map.shape == image.shape[:2]


def test_mse_is_of_linear_radiance_and_grows_with_the_square_of_exposure():
    image = picture()
    bright = image + np.array([0.1, -0.2, 5.0])
    expected = (0.01 + 0.04 + 25) / 3
    assert compare(bright, image).mse == pytest.approx(expected, rel=1e-12)
    assert compare(bright, image, exposure=1.5).mse == pytest.approx(8 * expected, rel=1e-12)


def test_relative_mse_of_a_scaled_picture():
    reference = np.full((16, 16, 3), 0.5)
    assert compare(1.1 * reference, reference).relative_mse == pytest.approx(0.0025 / (0.25 + 1e-4), rel=1e-12)


def test_ssim_and_flip_ignore_clipped_radiance():
    image = np.where(picture() > 0.5, 1.0, picture())
    figures = compare(np.where(image >= 1, 7.0, image), image)
    assert figures.mse > 1
    assert figures.flip == 0
    assert figures.ssim == pytest.approx(1, abs=1e-12)


def ssim_at(image: np.ndarray, reference: np.ndarray, row: int, column: int) -> float:
    """SSIM at one pixel by its formula (Wang et al. 2004): 11×11 window, Gaussian of sigma 1.5."""
    steps = np.arange(-5, 6)
    bell = np.exp(-(steps**2) / (2 * 1.5**2))
    weights = np.outer(bell, bell)
    weights /= weights.sum()
    window = np.s_[row - 5 : row + 6, column - 5 : column + 6]
    x, y = image[window], reference[window]
    mean_x, mean_y = (weights * x).sum(), (weights * y).sum()
    var_x, var_y = (weights * (x - mean_x) ** 2).sum(), (weights * (y - mean_y) ** 2).sum()
    covariance = (weights * (x - mean_x) * (y - mean_y)).sum()
    c1, c2 = 0.01**2, 0.03**2
    return float(
        (2 * mean_x * mean_y + c1) * (2 * covariance + c2) / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
    )


def test_ssim_equals_its_formula():
    reference = picture(seed=1)
    image = reference + 0.1 * np.random.default_rng(2).normal(size=reference.shape)
    mask = np.zeros(reference.shape[:2])
    mask[20, 30] = 1
    shown, wanted = to_srgb(image), to_srgb(reference)
    expected = np.mean([ssim_at(shown[..., c], wanted[..., c], 20, 30) for c in range(3)])
    assert compare(image, reference, mask).ssim == pytest.approx(expected, abs=1e-10)


def test_ssim_at_quarter_size_is_less_sensitive_to_noise():
    reference = picture(seed=1)
    noisy = reference + 0.1 * np.random.default_rng(2).normal(size=reference.shape)
    figures = compare(noisy, reference)
    assert figures.ssim < figures.ssim_quarter < 1


def test_flip_is_largest_for_black_and_white_and_grows_with_noise():
    black, white = np.zeros((32, 32, 3)), np.ones((32, 32, 3))
    assert compare(white, black).flip == pytest.approx(1, abs=0.1)
    reference, noise = picture(), np.random.default_rng(3).normal(size=(48, 64, 3))
    little, much = (compare(reference + scale * noise, reference).flip for scale in (0.02, 0.2))
    assert 0 < little < much < 1


def test_flip_equals_that_of_the_library_at_67_pixels_per_degree():
    import flip_evaluator

    image, reference = picture(), picture(seed=1)
    shown, wanted = (to_srgb(part).astype(np.float32) for part in (image, reference))
    parameters = {"ppd": 67.0}
    _map, mean, _ = flip_evaluator.evaluate(wanted, shown, "LDR", applyMagma=False, parameters=parameters)
    assert compare(image, reference).flip == pytest.approx(mean, rel=1e-5)


def test_only_masked_pixels_count():
    reference = picture()
    image = reference.copy()
    image[:, 40:] += 0.3
    mask = np.zeros((48, 64))
    mask[:, :8] = 1
    left = compare(image, reference, mask)
    right = compare(image, reference, 1 - mask)
    assert left.mse == 0
    assert left.ssim == pytest.approx(1, abs=1e-12)
    assert right.mse == pytest.approx(0.09 * 24 / 56, rel=1e-12)
    assert right.flip > compare(image, reference).flip > left.flip
    in_colour = compare(image, reference, np.repeat(mask[..., None], 3, axis=2))
    assert in_colour.as_json() == left.as_json()


def test_pictures_smaller_than_the_window_have_no_ssim():
    for height, width in ((10, 60), (3, 60), (1, 1)):
        small = compare(picture(height, width), picture(height, width, seed=1))
        assert np.isnan(small.ssim)
        assert np.isnan(small.ssim_quarter)
        assert small.mse > 0


@pytest.mark.parametrize("exposure", [np.nan, np.inf, -5000.0])
def test_an_extreme_exposure_is_refused(exposure):
    with pytest.raises(QueryError, match="expected an exposure"):
        compare(picture(), picture(), exposure=exposure)


def test_metrics_are_plain_numbers_for_json():
    figures = compare(picture(), picture(seed=1)).as_json()
    assert list(figures) == ["mse", "relative_mse", "relative_rmse", "ssim", "ssim_quarter", "flip"]
    assert {type(value) for value in figures.values()} == {float}


def broken(value: float) -> np.ndarray:
    image = picture()
    image[5, 7, 1] = value
    return image


@pytest.mark.parametrize(
    ("image", "reference", "mask", "expected"),
    [
        (picture(48, 60), picture(), None, "the image is 60x48, the reference 64x48"),
        (picture()[..., 0], picture(), None, r"the image of shape \[H, W, 3\], found \[48, 64\]"),
        (picture(), np.zeros((0, 5, 3)), None, r"the reference of shape \[H, W, 3\], found \[0, 5, 3\]"),
        (broken(np.nan), picture(), None, "1 of 3072 pixels of the image are not finite, the first at row 5, column 7"),
        (picture(), broken(-np.inf), None, "1 of 3072 pixels of the reference"),
        (picture(), picture(), np.ones((4, 4)), r"the mask of the pictures' shape \[48, 64\], found \[4, 4\]"),
        (picture(), picture(), np.full((48, 64), 0.5), "chooses no pixel"),
        (picture(), picture(), np.full((48, 64), np.nan), "is NaN at 3072 of 3072 pixels"),
    ],
)
def test_invalid_pictures_and_masks_are_refused(image, reference, mask, expected):
    with pytest.raises(QueryError, match=expected):
        compare(image, reference, mask)


@pytest.mark.parametrize(("module", "package"), [("skimage", "scikit-image"), ("flip_evaluator", "flip-evaluator")])
def test_a_missing_extra_is_named(module, package, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(PrtbakeError, match=f"compare: {package} is not installed; pip install {package}"):
        compare(picture(), picture())


def test_the_extra_is_loaded_on_first_use_and_torch_never():
    program = (
        "import sys, prt_bake.comparison.metrics as c, numpy as np\n"
        "heavy = {'skimage', 'flip_evaluator', 'torch'}\n"
        "before = sorted(heavy & set(sys.modules))\n"
        "c.compare(np.ones((16, 16, 3)), np.ones((16, 16, 3)))\n"
        "print(before, 'torch' in sys.modules)"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[] False"
