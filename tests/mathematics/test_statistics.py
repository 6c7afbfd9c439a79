"""Moments that merge, and the relative error of coefficients."""

import functools
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import kurtosis, skew

from formats.errors import QueryError
from prt_bake.mathematics import statistics

FIELDS = ("count", "mean", "m2", "m3", "m4")


def skewed(count: int, seed: int) -> NDArray[np.float64]:
    return np.random.default_rng(seed).exponential(size=(count, 3)) * [1.0, 5.0, 0.01]


def test_moments_agree_with_scipy() -> None:
    samples = skewed(1_000, 1)
    found = statistics.moments(samples)
    np.testing.assert_allclose(found.mean, samples.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(found.variance, samples.var(axis=0, ddof=1), rtol=1e-13)
    np.testing.assert_allclose(found.standard_error, samples.std(axis=0, ddof=1) / np.sqrt(1_000), rtol=1e-13)
    np.testing.assert_allclose(found.skewness, skew(samples, axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.kurtosis, kurtosis(samples, axis=0, fisher=False), rtol=1e-12)


def test_parts_of_any_size_merge_to_the_whole() -> None:
    samples = skewed(500, 2)
    whole = statistics.moments(samples)
    parts = [statistics.moments(part) for part in np.split(samples, [1, 3, 10, 400])]
    for ordered in (parts, parts[::-1]):
        merged = functools.reduce(statistics.merge, ordered, statistics.empty((3,)))
        for field in FIELDS:
            np.testing.assert_allclose(getattr(merged, field), getattr(whole, field), rtol=1e-11)


def test_a_large_offset_costs_no_digits() -> None:
    samples = skewed(4_096, 3)
    # Sums with 2³⁰ are rounded to 2⁻²²; taking it away again gives exactly what was stored.
    shifted = samples + 2.0**30
    parts = [statistics.moments(part) for part in np.split(shifted, 64)]
    merged = functools.reduce(statistics.merge, parts)
    expected = statistics.moments(shifted - 2.0**30)
    np.testing.assert_allclose(merged.mean - 2.0**30, expected.mean, atol=1e-6)
    np.testing.assert_allclose(merged.variance, expected.variance, rtol=1e-6)
    np.testing.assert_allclose(merged.kurtosis[:2], expected.kurtosis[:2], rtol=1e-6)


def test_empty_moments_are_neutral() -> None:
    some = statistics.moments(skewed(7, 4))
    nothing = statistics.empty((3,))
    for merged in (statistics.merge(some, nothing), statistics.merge(nothing, some)):
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(merged, field), getattr(some, field))
    assert (statistics.merge(nothing, nothing).count == 0).all()


def test_what_is_not_defined_is_nan() -> None:
    single = statistics.moments(np.ones((1, 2)))
    assert np.isnan(single.variance).all()
    assert np.isnan(single.standard_error).all()
    constant = statistics.moments(np.ones((5, 2)))
    assert (constant.variance == 0).all()
    assert np.isnan(constant.kurtosis).all()
    with pytest.raises(QueryError, match="at least one sample"):
        statistics.moments(np.ones((0, 2)))


def coefficients(seed: int, shape: tuple[int, ...] = (40, 6, 9, 3)) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(size=shape)


def test_relative_error_is_a_ratio_of_sums() -> None:
    reference = coefficients(1)
    estimate = reference + 0.01 * coefficients(2)
    found = statistics.relative_rmse(estimate, reference)
    assert found.total == pytest.approx(np.sqrt(((estimate - reference) ** 2).sum() / (reference**2).sum()), rel=1e-13)
    by_vertex = [np.linalg.norm(e - r) / np.linalg.norm(r) for e, r in zip(estimate, reference, strict=True)]
    np.testing.assert_allclose(found.per_vertex, by_vertex, rtol=1e-13)
    assert found.percentile_95 == pytest.approx(sorted(by_vertex)[37], rel=1e-13)


def test_relative_error_of_a_scaled_reference_is_the_scale_s() -> None:
    reference = coefficients(3)
    found = statistics.relative_rmse(1.25 * reference, reference)
    assert found.total == pytest.approx(0.25, rel=1e-13)
    assert found.percentile_95 == pytest.approx(0.25, rel=1e-13)


def test_percentile_sees_a_few_bad_vertices_and_no_fewer() -> None:
    reference = np.ones((100, 1, 1, 1))
    estimate = reference.copy()
    estimate[:5] = 2
    assert statistics.relative_rmse(estimate, reference).percentile_95 == 0
    estimate[5] = 2
    assert statistics.relative_rmse(estimate, reference).percentile_95 == 1


def test_shortened_axes_broadcast() -> None:
    reference = coefficients(4)
    for shape in [(40, 1, 9, 3), (40, 6, 9, 1), (40, 1, 9, 1)]:
        short = coefficients(5, shape)
        wide = np.broadcast_to(short, reference.shape)
        assert statistics.relative_rmse(short, reference).total == statistics.relative_rmse(wide, reference).total
        assert statistics.relative_rmse(reference, short).total == statistics.relative_rmse(reference, wide).total


def test_vertices_left_out_do_not_count() -> None:
    reference = coefficients(6)
    estimate = reference + 0.1
    spoiled = estimate.copy()
    valid = np.arange(40) % 4 != 0
    spoiled[~valid] = np.nan
    found = statistics.relative_rmse(spoiled, reference, valid.astype(np.uint8))
    assert found.total == statistics.relative_rmse(estimate[valid], reference[valid]).total
    assert np.isnan(statistics.relative_rmse(spoiled, reference).total)


def test_vertices_without_reference() -> None:
    reference, estimate = np.ones((3, 2, 1, 1)), np.ones((3, 2, 1, 1))
    reference[:2], estimate[0] = 0, 0
    np.testing.assert_array_equal(statistics.relative_rmse(estimate, reference).per_vertex, [0, np.inf, 0])


def test_open_datasets_are_read_block_by_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reference = coefficients(7)
    estimate = (reference + 0.01 * coefficients(8)).astype(np.float16)
    expected = statistics.relative_rmse(estimate, reference)
    monkeypatch.setattr(statistics, "BLOCK_ELEMENTS", 3 * 6 * 9 * 3)
    with h5py.File(tmp_path / "estimate.h5", "w") as file:
        found = statistics.relative_rmse(file.create_dataset("coefficients", data=estimate), reference)
    assert found.total == pytest.approx(expected.total, rel=1e-14)
    np.testing.assert_array_equal(found.per_vertex, expected.per_vertex)


@pytest.mark.parametrize("shape", [(39, 6, 9, 3), (40, 5, 9, 3), (40, 6, 9)])
def test_shapes_that_do_not_fit_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(QueryError, match="relative error: expected"):
        statistics.relative_rmse(np.ones(shape), np.ones((40, 6, 9, 3)))


def test_no_vertex_is_no_error_figure() -> None:
    with pytest.raises(QueryError, match="at least one valid vertex"):
        statistics.relative_rmse(np.ones((2, 1)), np.ones((2, 1)), [False, False])
    with pytest.raises(QueryError, match="`valid` of shape"):
        statistics.relative_rmse(np.ones((2, 1)), np.ones((2, 1)), [True])
