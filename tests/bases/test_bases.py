"""Each basis represents exactly what it is made for, and errors are those of what it leaves over."""

import math
from itertools import pairwise

import numpy as np
import pytest

from prt_bake.bases.cells import cell_directions, cell_numbers, turned_skies
from prt_bake.bases.gaussians import GaussianFit
from prt_bake.bases.linear import Harmonics, LearnedBasis, sky_norm
from prt_bake.bases.rows import Basis, Values, every_basis, measured, radiance, relative_error
from prt_bake.bases.wavelets import haar, inverse_haar, keep_largest
from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import fibonacci

Array = np.ndarray
DIRECTIONS = cell_directions(16, "y")


def relative(found: Array, values: Array) -> float:
    return float(np.linalg.norm(found - values) / np.linalg.norm(values))


def low_rank(count: int, rank: int, seed: int) -> Array:
    functions = np.random.default_rng(7).normal(size=(rank, len(DIRECTIONS), 3))
    return np.asarray(np.einsum("nr,rmc->nmc", np.random.default_rng(seed).normal(size=(count, rank)), functions))


def test_cells_are_unit_directions_of_equal_weight() -> None:
    np.testing.assert_allclose(np.linalg.norm(DIRECTIONS, axis=1), 1.0, atol=1e-12)
    harmonics = sh.evaluate(DIRECTIONS, 3) * math.sqrt(4.0 * math.pi / len(DIRECTIONS))
    np.testing.assert_allclose(harmonics.T @ harmonics, np.eye(16), atol=0.02)


@pytest.mark.parametrize("up", ["y", "z"])
def test_directions_are_in_the_cells_of_their_centres_and_fill_all_alike(up: str) -> None:
    np.testing.assert_array_equal(cell_numbers(cell_directions(16, up), 16, up), np.arange(256))
    counts = np.bincount(cell_numbers(fibonacci(256 * 400), 16, up), minlength=256)
    assert np.abs(counts - 400).max() < 40


@pytest.mark.parametrize("up", ["y", "z"])
def test_skies_are_turned_by_quarters_about_the_up_axis(up: str) -> None:
    picture = np.zeros((32, 64, 3), np.float32)
    picture[4:12, 30:34] = 1.0
    towards = [sky[:, 0] @ cell_directions(16, up) for sky in turned_skies(picture, 16)]
    axis = "xyz".index(up)
    np.testing.assert_allclose([direction[axis] for direction in towards], towards[0][axis], atol=1e-3)
    np.testing.assert_allclose(np.delete(towards[0] + towards[2], axis), 0.0, atol=1e-3)
    assert abs(np.delete(towards[0], axis) @ np.delete(towards[1], axis)) < 1e-3
    power = 4.0 * math.pi * np.mean(turned_skies(np.ones((2, 4, 3), np.float32), 16).sum(axis=1) / (4.0 * math.pi))
    assert power == pytest.approx(4.0 * math.pi, rel=1e-6)


def test_harmonics_represent_themselves_and_nothing_above() -> None:
    random = np.random.default_rng(1)
    values = np.einsum("mk,nkc->nmc", sh.evaluate(DIRECTIONS, 2), random.normal(size=(5, 9, 3)))
    assert relative(Harmonics(DIRECTIONS, 2).approximate(values), values) < 1e-12
    assert relative(Harmonics(DIRECTIONS, 1).approximate(values), values) > 0.3


@pytest.mark.parametrize("together", [False, True])
def test_learned_functions_represent_transport_of_their_rank(together: bool) -> None:
    training, values = low_rank(60, 4, 1), low_rank(9, 4, 2)
    rank = 4 if together else 12
    basis = LearnedBasis(training, rank, together)
    assert relative(basis.approximate(values, rank), values) < 1e-9
    assert relative(basis.approximate(values, rank - 1), values) > 0.05


def test_functions_weighted_by_skies_err_less_under_them() -> None:
    random = np.random.default_rng(3)
    training, values = (random.normal(size=(count, len(DIRECTIONS), 3)) for count in (400, 30))
    sky = np.exp(4.0 * (DIRECTIONS @ [0.0, 1.0, 0.0] - 1.0))[None, :, None] * np.ones(3)

    def error(basis: LearnedBasis) -> float:
        wrong = np.einsum("nmc,tmc->ntc", basis.approximate(values, 30) - values, sky)
        return float(np.linalg.norm(wrong))

    assert error(LearnedBasis(training, 30, True, sky_norm(sky))) < 0.2 * error(LearnedBasis(training, 30, True))


def test_the_norm_of_skies_is_that_of_their_covariance_and_is_inverted() -> None:
    random = np.random.default_rng(4)
    skies, rows = random.exponential(size=(3, 64, 3)), random.normal(size=(5, 64))
    norm = sky_norm(skies)
    units = [sky / np.linalg.norm(sky) for sky in np.moveaxis(skies, 2, 1).reshape(-1, 64)]
    covariance = 0.9 * np.mean([np.outer(unit, unit) for unit in units], axis=0) + 0.1 / 64 * np.eye(64)
    np.testing.assert_allclose((norm.weigh(rows) ** 2).sum(axis=1), ((rows @ covariance) * rows).sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(norm.restore(norm.weigh(rows)), rows, atol=1e-9)


def test_a_black_channel_of_a_sky_says_nothing() -> None:
    random = np.random.default_rng(4)
    skies, rows = random.exponential(size=(2, 64, 3)), random.normal(size=(5, 64))
    skies[1, :, 2] = 0.0
    others = np.delete(np.moveaxis(skies, 2, 1).reshape(-1, 64), 5, axis=0)
    units = others / np.linalg.norm(others, axis=1, keepdims=True)
    covariance = 0.9 * units.T @ units / len(units) + 0.1 / 64 * np.eye(64)
    weighed = sky_norm(skies).weigh(rows)
    np.testing.assert_allclose((weighed**2).sum(axis=1), ((rows @ covariance) * rows).sum(axis=1), rtol=1e-9)


def test_wavelets_are_orthonormal_and_their_largest_represent_a_block() -> None:
    values = np.random.default_rng(5).normal(size=(3, 256, 3))
    np.testing.assert_allclose(inverse_haar(haar(values)), values, atol=1e-12)
    np.testing.assert_allclose((haar(values) ** 2).sum(), (values**2).sum(), rtol=1e-12)
    block = np.zeros((1, 16, 16, 3))
    block[0, 4:8, 8:12] = [1.0, 2.0, 3.0]
    assert relative(keep_largest(block.reshape(1, 256, 3), 7), block.reshape(1, 256, 3)) < 1e-12
    assert relative(keep_largest(block.reshape(1, 256, 3), 3), block.reshape(1, 256, 3)) > 0.1


def test_wavelets_of_dark_places_are_dropped_first() -> None:
    values = np.random.default_rng(6).normal(size=(4, 256, 3))
    light = np.zeros((256, 1))
    light[:20] = 1.0
    kept = haar(keep_largest(values, 20, light))
    np.testing.assert_allclose(kept[:, :20], haar(values)[:, :20], atol=1e-12)
    np.testing.assert_allclose(kept[:, 20:], 0.0, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 2])
def test_gaussians_beside_harmonics_are_found(degree: int) -> None:
    axes = np.array([[0.0, 0.6, 0.8], [-0.8, 0.6, 0.0]])
    lobes = np.exp(np.array([20.0, 6.0]) * (DIRECTIONS @ axes.T - 1.0))
    values = (lobes @ [[1.0, 0.5, 0.2], [0.3, 0.6, 0.9]])[None]
    values = values + (sh.evaluate(DIRECTIONS, degree) @ np.full(((degree + 1) ** 2, 3), 0.2))[None]
    assert relative(GaussianFit(DIRECTIONS, degree, 2).approximate(values, 2), values) < 0.01
    assert relative(Harmonics(DIRECTIONS, 2).approximate(values), values) > 0.1


def test_every_gaussian_leaves_less_over() -> None:
    random = np.random.default_rng(11)
    axes = random.normal(size=(20, 5, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    shapes = np.exp(np.exp(random.uniform(0.0, 4.0, (20, 5, 1))) * (axes @ DIRECTIONS.T - 1.0))
    values = np.einsum("nkm,nkc->nmc", shapes, random.exponential(size=(20, 5, 3)))
    fit = GaussianFit(DIRECTIONS, 2, 4)
    errors = [np.linalg.norm(fit.approximate(values, count) - values, axis=(1, 2)) for count in (1, 2, 3, 4)]
    assert all((after <= before * (1.0 + 1e-5)).all() for before, after in pairwise(errors))
    assert errors[3].sum() < 0.4 * errors[0].sum()


def test_intervals_cover_the_error_of_all_queries() -> None:
    random, covered = np.random.default_rng(8), 0
    for seed in range(200):
        true = random.exponential(size=60)
        wrong = true * random.exponential(size=60) * 0.01
        estimate = relative_error(wrong, true, seed)
        covered += estimate.low <= 0.1 <= estimate.high
    assert 175 <= covered <= 200


def test_radiance_is_the_sum_over_the_sky_channel_by_channel() -> None:
    draw = np.random.default_rng(0)
    values, skies = draw.normal(size=(5, 40, 3)), draw.normal(size=(2, 40, 3))
    expected = np.einsum("nmc,tmc->ntc", values, skies)
    np.testing.assert_allclose(radiance(values, skies), expected, rtol=1e-12)


def of(values: Array, checks: tuple[Array, Array] | None = None, weights: Array | None = None) -> Values:
    return Values(values, checks or (values, values), None, np.ones(len(values)) if weights is None else weights)


def test_errors_are_those_of_radiance_under_each_light() -> None:
    values, sky = np.ones((12, 4, 3)), np.full((1, 4, 3), 0.25)
    basis = Basis("nine", 1, lambda part: 0.9 * part.fitted, (lambda part: 0.9 * part.fitted,) * 2)
    row = measured(basis, of(values), [sky, sky], 0)
    assert row.transport is not None
    assert row.transport.value == pytest.approx(0.1)
    assert [estimate.value for estimate in row.radiance] == pytest.approx([0.1, 0.1])
    depends = Basis("of light", 1, None, (lambda part: 0.9 * part.fitted, lambda part: 0.8 * part.fitted))
    row = measured(depends, of(values), [sky, sky], 0)
    assert row.transport is None
    assert [estimate.value for estimate in row.radiance] == pytest.approx([0.1, 0.2])


def test_queries_count_by_their_weights() -> None:
    values = np.ones((2, 4, 3))
    values[1] *= 2.0
    wrong_in_second = Basis("half", 1, lambda part: part.fitted * [[[1.0]], [[0.5]]], ())
    row = measured(wrong_in_second, of(values, weights=np.array([6.0, 0.5])), [], 0)
    assert row.transport is not None
    assert row.transport.value == pytest.approx(np.sqrt(0.5 / (6.0 + 2.0)))


def test_noise_of_the_checks_is_no_error() -> None:
    random = np.random.default_rng(9)
    exact = random.normal(size=(4000, 4, 3))
    checks = exact + random.normal(size=exact.shape), exact + random.normal(size=exact.shape)
    row = measured(Basis("nine", 1, lambda part: 0.9 * part.fitted, ()), of(exact, checks), [], 0)
    assert row.transport is not None
    assert row.transport.low <= 0.1 <= row.transport.high
    assert row.transport.value == pytest.approx(0.1, abs=0.04)


def test_every_basis_represents_more_with_more_numbers() -> None:
    random = np.random.default_rng(10)
    axes = random.normal(size=(90, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    values = np.exp(8.0 * (axes @ DIRECTIONS.T - 1.0))[..., None] * random.exponential(size=(90, 1, 3)) + 0.1
    skies = [random.exponential(size=(4, 256, 3)) for _ in range(2)]
    rows = [measured(basis, of(values[:30]), skies, 0) for basis in every_basis(values[30:], DIRECTIONS, skies)]
    names = [(row.name, row.numbers) for row in rows]
    assert len(set(names)) == len(names)
    for kind in ("SH degree", "learned", "learned, channels apart", "Haar, the largest"):
        own = [row for row in rows if (row.name == kind or row.name.startswith(kind)) and row.transport is not None]
        of_kind = [row for row in own if kind != "SH degree" or "Gaussian" not in row.name]
        errors = [row.transport.value for row in of_kind if row.name == kind or kind == "SH degree"]
        assert errors == sorted(errors, reverse=True), kind
    best = {row.name: row.transport.value for row in rows if row.transport}
    assert best["SH degree 2 and 1 Gaussian"] < 0.05 < 0.3 < best["SH degree 2"]
