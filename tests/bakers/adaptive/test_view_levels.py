"""Levels of view bins, nested lattices and lattice pools."""

from itertools import pairwise

import numpy as np
import pytest

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.lattice_noise import LatticeNoise, fit_lattice_noise
from bakers.adaptive.records import validation_noise
from bakers.adaptive.view_levels import view_levels
from prt_bake.baking.job import lattices
from prt_bake.baking.job.lattices import (
    lattice_for,
    pools_for,
    sample_without_replacement,
    validation_bins,
    vertex_rotations,
)
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.directions import extensible_lattice
from tests.bakers.transports import Lobed


@pytest.mark.parametrize(("rings", "sectors"), [(1, 1), (1, 5), (2, 3), (4, 8), (16, 64), (40, 64)])
def test_every_bin_is_in_one_level_and_predicted_from_those_below(rings: int, sectors: int) -> None:
    directions = sphere.view_bins(rings, sectors)
    levels = view_levels(directions)
    below: set[int] = set()
    for level in levels:
        assert not below & set(level.bins.tolist())
        assert set(level.parents.ravel().tolist()) <= below
        if level is not levels[0]:
            np.testing.assert_allclose(level.weights.sum(axis=1), 1.0, atol=1e-9)
        below |= set(level.bins.tolist())
    assert below == set(range(rings * sectors))


def test_predictions_of_smooth_functions_improve_with_the_level() -> None:
    directions = sphere.view_bins(16, 64)
    values = sh.evaluate(directions, 3)
    off = [
        float(np.abs(level.interpolation @ values - values[level.bins]).max()) for level in view_levels(directions)[2:]
    ]
    assert all(after < 0.7 * before for before, after in pairwise(off))
    assert off[-1] < 0.01


def test_the_lattice_is_nested_and_each_size_is_equidistributed() -> None:
    whole = extensible_lattice(1 << 12)
    for size in (16, 64, 512, 4096):
        some = whole[:size]
        np.testing.assert_array_equal(extensible_lattice(size), some)
        heights = np.sort(some[:, 2])
        # One point in each of `size` zones of equal area: the heights are equally spaced.
        np.testing.assert_allclose(np.diff(heights), 2.0 / size, atol=1e-9)
        harmonics = sh.evaluate(some, 2)
        np.testing.assert_allclose(4.0 * np.pi / size * harmonics.T @ harmonics, np.eye(9), atol=12.0 / size)
    with pytest.raises(Exception, match="16384"):
        extensible_lattice((1 << 14) + 1)


@pytest.mark.parametrize("degree", [0, 2, 5])
def test_fits_reproduce_band_limited_functions_and_estimate_residuals(degree: int) -> None:
    lattice = lattice_for(degree)
    exact = np.random.default_rng(degree).normal(size=(4, sh.count(degree), 3))
    for step, size in enumerate(lattice.sizes[:4]):
        values = lattice.harmonics[:size] @ exact
        found, residual = lattice.fitted(values, step)
        np.testing.assert_allclose(found.reshape(exact.shape), exact, atol=1e-12)
        assert (residual < 1e-24).all()
        noise = np.random.default_rng(step).normal(size=(400, size, 3))
        found, residual = lattice.fitted(noise, step)
        assert residual.mean() == pytest.approx(1.0, abs=0.05)
        assert (found**2).mean() == pytest.approx(lattice.variance_shares[step], rel=0.1)


def test_rotations_depend_on_the_vertex_alone() -> None:
    turns = vertex_rotations(3)(np.arange(2000))
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    # Uniform on SO(3): the image of any axis has mean 0 and a third of its length in each direction.
    assert np.abs(turns.mean(axis=0)).max() < 5.0 / np.sqrt(3.0 * 2000)
    np.testing.assert_array_equal(vertex_rotations(3)(np.array([7])), turns[7:8])
    np.testing.assert_allclose(sh.rotations(turns[:5], 3), [sh.rotation(turn, 3) for turn in turns[:5]], atol=1e-12)


def test_bins_are_drawn_by_the_seed_with_their_share() -> None:
    some = validation_bins(1, 1024, 0.02)(np.arange(50))
    assert some.mean() == pytest.approx(0.02, abs=0.003)
    np.testing.assert_array_equal(validation_bins(1, 1024, 0.02)(np.array([7])), some[7:8])
    assert validation_bins(1, 8, 1.0)(np.arange(9)).all()
    assert not validation_bins(1, 8, 0.0)(np.arange(9)).any()
    assert len(set(sample_without_replacement(1, 100, 30).tolist())) == 30


@pytest.mark.parametrize("count", [0, 30, 99, 100])
def test_numbers_are_drawn_alike_from_parts_and_at_once(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    at_once = sample_without_replacement(1, 100, count)
    assert len(set(at_once.tolist())) == count
    monkeypatch.setattr(lattices, "_AT_ONCE", 7)
    np.testing.assert_array_equal(sample_without_replacement(1, 100, count), at_once)


@pytest.mark.parametrize("share", [0.3 / 1024, 0.003, 0.02])
def test_checked_bins_are_spread_over_vertices_and_views(share: float) -> None:
    drawn_there = np.array([validation_bins(seed, 1024, share)(np.arange(400)) for seed in range(40)])
    each, ring = drawn_there.sum(axis=2), drawn_there.reshape(40, 400, 16, 64).sum(axis=(1, 3))
    expected = 400 * 64 * share
    assert each.max() - each.min() <= 1
    # A tenth of the variance of independently drawn bins; unbiased, to five of their sigmas.
    assert ring.var(axis=0).mean() < 0.1 * expected
    assert np.abs(drawn_there.mean(axis=(0, 1)) - share).max() < 5.0 * np.sqrt(share / (40 * 400))


@pytest.mark.parametrize("kind", ["many numbers", "one number", "lattices of different accuracy"])
def test_the_noise_of_validation_samples_is_estimated(kind: str) -> None:
    numbers = np.random.default_rng(3)
    rows = np.repeat(np.arange(2000), 5)
    shape = (len(rows), 9, 1 if kind != "many numbers" else 3)
    off = 0.5 * numbers.normal(size=shape)
    errors = numbers.normal(size=(2, *shape))
    if kind == "one number":
        errors = numbers.normal(size=(2, len(rows), 1, 1)) * np.ones((9, 1))
    if kind == "lattices of different accuracy":
        errors *= np.exp(numbers.normal(size=(2, len(rows), 1, 1)))
    one, other = errors[0] - off, errors[1] - off
    truly = (one * other).mean(axis=(1, 2)) - (off**2).mean(axis=(1, 2))
    estimated = validation_noise(rows, one, other)
    assert abs(estimated.mean()) < 5.0 * estimated.std() / np.sqrt(len(estimated))
    assert estimated.std() == pytest.approx(truly.std(), rel=0.1)
    first = slice(0, 5)
    np.testing.assert_array_equal(validation_noise(rows[first], one[first], other[first]), estimated[first])


def test_lattice_noise_is_fitted_to_pairs() -> None:
    sizes, shares, many = (20, 40, 80), (0.6, 0.3, 0.15), 4000
    true = LatticeNoise(gain=5.0, slope=0.5)
    draws = np.random.default_rng(1)
    residual = draws.lognormal(size=(3, many))
    usual = (
        np.array([true.variance(share, size) for share, size in zip(shares, sizes, strict=True)])[:, None] * residual
    )
    squared = usual * draws.lognormal(-0.5 * 0.7**2, 0.7, size=usual.shape)
    found = fit_lattice_noise(shares, sizes, residual, squared)
    assert found.gain == pytest.approx(5.0, rel=0.03)
    assert found.slope == pytest.approx(0.5, abs=0.05)
    nothing = fit_lattice_noise(shares, sizes, np.zeros((3, 5)), np.zeros((3, 5)))
    assert nothing.gain == pytest.approx(LatticeNoise().gain)


@pytest.mark.parametrize("degree", [0, 2, 5])
def test_pools_reproduce_band_limited_functions_in_every_copy(degree: int) -> None:
    pools = pools_for(degree, 4)
    exact = np.random.default_rng(degree).normal(size=(5, sh.count(degree), 3))
    for size in pools.sizes[:5]:
        pool = pools.of(size)
        copies = np.arange(5) % len(pool.incident)
        values = sh.evaluate(pool.incident[copies].reshape(-1, 3), degree).reshape(5, size, -1) @ exact
        found, _residuals, residual = pool.fitted(values, copies)
        np.testing.assert_allclose(found, exact, atol=1e-11)
        assert (residual < 1e-22).all()
        noise = np.random.default_rng(size).normal(size=(400, size, 3))
        found, _residuals, residual = pool.fitted(noise, np.zeros(400, np.int64))
        assert residual.mean() == pytest.approx(1.0, abs=0.05)
        assert (found**2).mean() == pytest.approx((pool.weights**2).sum(axis=1).mean(), rel=0.1)


def test_bins_and_their_validation_use_different_copies_evenly() -> None:
    pools = pools_for(2, 4)
    for size in (pools.sizes[0], pools.sizes[-1]):
        half = len(pools.of(size).incident) // 2
        vertices, bins = np.divmod(np.arange(20_000), 64)
        taken = np.array([pools.copies(size, vertices, bins, which) for which in range(3)])
        assert taken[0].max() < half <= taken[1:].min()
        assert (taken[1] != taken[2]).all()
        for row in (taken[0], taken[1] - half, taken[2] - half):
            counts = np.bincount(row, minlength=half)
            expected = taken.shape[1] / half
            # Chi-square with half − 1 degrees of freedom: above ten sigma once in 1e5 runs.
            off = ((counts - expected) ** 2 / expected).sum()
            assert abs(off - (half - 1)) < 10.0 * np.sqrt(2.0 * (half - 1))
        np.testing.assert_array_equal(pools.copies(size, vertices[7:9], bins[7:9], 2), taken[2, 7:9])


def test_a_correction_without_samples_is_the_prior() -> None:
    assert Tally(3).correction(Correction(2.0, 0.5)) == Correction(2.0, 0.5)
    assert Tally(3).relative(Correction()) == (0.0, 0.0)


def test_the_lattices_error_falls_faster_than_a_root() -> None:
    lattice, transport = lattice_for(2), Lobed()
    turns = vertex_rotations(5)(np.arange(200))
    x = np.array([[0.0, 0.0, 1.0]])
    off = []
    for step, size in enumerate(lattice.sizes[:4]):
        incident = lattice.directions[:size] @ turns.transpose(0, 2, 1)
        values = transport.evaluate(incident, np.repeat(x, 200, 0), np.repeat([[0.6, 0.0, 0.8]], 200, 0))
        found = sh.rotations(turns, 2) @ lattice.fitted(values, step)[0].reshape(200, 9, 3)
        off.append(float(np.sqrt(found.var(axis=0).mean())))
    assert np.polyfit(np.log(lattice.sizes[:4]), np.log(off), 1)[0] < -1.0
