"""HDR-FLIP: the largest FLIP over exposures, in a range given by the reference."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.errors import QueryError
from formats.image.png import to_srgb
from prt_bake.comparison.flip import Exposures, exposures_between, flip_map, hdr_flip_map, paper_exposures
from prt_bake.comparison.metrics import compare


def bright(seed: int, height: int = 20, width: int = 24) -> np.ndarray:
    """A picture over a few decades."""
    generator = np.random.default_rng(seed)
    return np.exp(1.2 * generator.normal(size=(height, width, 3)) + 0.5)


def aces(radiance: np.ndarray) -> np.ndarray:
    """Narkowicz's fit after the scale by 0.6, in another form than in the product."""
    x = 0.6 * radiance
    return np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)


def test_hdr_flip_is_the_largest_flip_over_exposures() -> None:
    image, reference = bright(1), bright(2)
    exposures = Exposures(-3.0, 1.0, 5)
    of_each = [
        flip_map(*(to_srgb(aces(2.0**stops * part)) for part in (image, reference)))
        for stops in np.linspace(*exposures)
    ]
    found = hdr_flip_map(image, reference, exposures)
    np.testing.assert_allclose(found, np.max(of_each, axis=0), atol=2e-5)
    at_none = flip_map(*(to_srgb(aces(part)) for part in (image, reference)))
    assert (found >= at_none - 2e-5).all()
    assert (found > at_none + 1e-3).any()


@pytest.mark.parametrize("seed", [1, 2])
def test_the_range_equals_that_of_the_library(seed: int) -> None:
    import flip_evaluator

    reference = bright(seed, 21, 25).astype(np.float32)
    options = {"applyMagma": False, "computeMeanError": True, "parameters": {"ppd": 67.0}}
    _map, mean, theirs = flip_evaluator.evaluate(reference, 1.3 * reference, "HDR", **options)
    ours = paper_exposures(reference)
    assert ours.start == pytest.approx(theirs["startExposure"], abs=1e-4)
    assert ours.stop == pytest.approx(theirs["stopExposure"], abs=1e-4)
    assert ours.steps == theirs["numExposures"]
    assert compare(1.3 * reference, reference, hdr=True).hdr_flip == pytest.approx(mean, rel=1e-4)


@settings(max_examples=25, deadline=None)
@given(st.floats(-30.0, 30.0), st.integers(0, 2**32 - 1))
def test_exposure_shifts_the_range_and_keeps_the_value(stops: float, seed: int) -> None:
    reference = bright(seed, 8, 9)
    image = reference * np.random.default_rng(seed).uniform(0.7, 1.4, reference.shape)
    plain, lifted = (compare(image, reference, exposure=e, hdr=True) for e in (0.0, stops))
    assert plain.hdr_exposures is not None
    assert lifted.hdr_exposures is not None
    assert lifted.hdr_exposures.start == pytest.approx(plain.hdr_exposures.start - stops, abs=1e-6)
    assert lifted.hdr_flip == pytest.approx(plain.hdr_flip, abs=1e-4)


@pytest.mark.parametrize("scale", [1e-30, 1e14, 1e16, 1e30])
def test_the_value_does_not_depend_on_the_scale_of_radiance(scale: float) -> None:
    reference = np.random.default_rng(0).uniform(0.2, 0.9, (16, 16, 3))
    expected = compare(1.1 * reference, reference, hdr=True).hdr_flip
    assert expected > 0.05
    assert compare(1.1 * scale * reference, scale * reference, hdr=True).hdr_flip == pytest.approx(expected, rel=1e-3)


def test_a_wider_range_gives_no_smaller_value() -> None:
    image, reference = bright(3), bright(4)
    narrow, wide = (hdr_flip_map(image, reference, Exposures(-2.0 - more, 1.0 + more, 4 + 2 * more)) for more in (0, 2))
    assert (wide >= narrow - 1e-6).all()


def test_equal_pictures_have_zero_difference_and_metrics_are_symmetric() -> None:
    image, reference = bright(5), bright(6)
    assert compare(image, image, hdr=True).hdr_flip == 0.0
    there, back = (compare(a, b, hdr=(-3.0, 2.0)) for a, b in ((image, reference), (reference, image)))
    assert there.hdr_flip == pytest.approx(back.hdr_flip, abs=1e-6)
    assert there.flip == pytest.approx(back.flip, abs=1e-6)
    assert there.ssim == pytest.approx(back.ssim, abs=1e-12)
    assert there.mse == back.mse


def test_metrics_grow_with_a_disturbance() -> None:
    reference = bright(7)
    disturbance = np.random.default_rng(8).normal(size=reference.shape) * reference
    found = [compare(reference + size * disturbance, reference, hdr=(-3.0, 1.0)) for size in (0.01, 0.03, 0.1, 0.3)]
    for name in ("mse", "relative_mse", "relative_rmse", "flip", "hdr_flip"):
        values = [getattr(each, name) for each in found]
        assert values == sorted(values)
        assert values[0] < values[-1]
    assert [each.ssim for each in found] == sorted((each.ssim for each in found), reverse=True)


def test_only_masked_pixels_count() -> None:
    reference = bright(9)
    image = reference.copy()
    image[:, 20:] *= 3.0
    mask = np.zeros(reference.shape[:2])
    mask[:, :2] = 1.0
    assert compare(image, reference, mask, hdr=True).hdr_flip == pytest.approx(0.0, abs=1e-6)
    assert compare(image, reference, 1.0 - mask, hdr=True).hdr_flip > compare(image, reference, hdr=True).hdr_flip > 0


@pytest.mark.parametrize(
    ("reference", "expected"),
    [
        (np.zeros((4, 4, 3)), Exposures(0.0, 0.0, 2)),
        (np.full((4, 4, 3), -1.0), Exposures(0.0, 0.0, 2)),
        (np.full((1, 1, 3), 2.0), None),
    ],
)
def test_constant_pictures_have_a_range(reference: np.ndarray, expected: Exposures | None) -> None:
    exposures = paper_exposures(reference)
    assert expected in (None, exposures)
    assert exposures.start == exposures.stop
    assert hdr_flip_map(np.abs(reference) + 0.5, reference, exposures).max() > 0.05


def test_a_black_background_does_not_change_the_range() -> None:
    framed = np.zeros((40, 24, 3))
    framed[:16] = bright(10, 16)
    assert paper_exposures(framed) == paper_exposures(framed[:16])


@pytest.mark.parametrize("peak", [1e5, 1e12, 1e30])
def test_very_bright_pixels_have_finite_values(peak: float) -> None:
    reference = bright(11)
    reference[3, 4] = peak
    image = reference.copy()
    image[3, 4] *= 0.2
    found = compare(image, reference, hdr=True)
    assert found.hdr_flip_map is not None
    assert np.isfinite(found.hdr_flip_map).all()
    assert found.hdr_flip_map[3, 4] > 0.05 or peak > 1e15
    assert found.flip == 0.0


@pytest.mark.parametrize(("start", "stop"), [(1.0, 0.0), (-200.0, 0.0), (0.0, np.nan), (np.inf, np.inf)])
def test_an_invalid_range_is_refused(start: float, stop: float) -> None:
    with pytest.raises(QueryError, match="a range of exposures within ±128 stops"):
        exposures_between(start, stop)


@pytest.mark.parametrize(("setting", "policy"), [(None, "PASSIVE"), ("active", "ACTIVE")])
def test_openmp_threads_sleep_by_default(setting: str | None, policy: str) -> None:
    program = (
        "import os, numpy\n"
        "from prt_bake.comparison.flip import flip_map\n"
        "flip_map(numpy.zeros((8, 8, 3)), numpy.ones((8, 8, 3)))\n"
        "print(os.environ.get('OMP_WAIT_POLICY'))\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment |= {"OMP_DISPLAY_ENV": "true"} | ({} if setting is None else {"OMP_WAIT_POLICY": setting})
    ran = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert f"OMP_WAIT_POLICY = '{policy}'" in ran.stderr
    assert ran.stdout.strip() == str(setting)


@pytest.mark.skipif(not hasattr(os, "RTLD_DEEPBIND"), reason="torch offers its OpenMP to other libraries on Linux only")
def test_openmp_is_not_that_of_torch() -> None:
    """Threads of torch's OpenMP spin while they wait; here it has one, and FLIP starts two more of its own."""
    program = (
        "import os, numpy, torch\n"
        "torch.set_num_threads(1)\n"
        "from prt_bake.comparison.flip import flip_map\n"
        "before = len(os.listdir('/proc/self/task'))\n"
        "flip_map(numpy.zeros((24, 32, 3)), numpy.ones((24, 32, 3)))\n"
        "print(len(os.listdir('/proc/self/task')) - before)\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment["OMP_NUM_THREADS"] = "3"
    ran = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "2"
