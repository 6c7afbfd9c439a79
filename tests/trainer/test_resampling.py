"""Few rays that stand for many walks: they keep sums, their expectation whatever is summed, and little noise."""

import numpy as np
import pytest

from prt_bake.mathematics import sh
from prt_bake.mathematics.directions import uniform
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.samples.resampling import hilbert_index, resampled
from prt_bake.trainer.samples.rows import ExitTracer, StreamSettings
from prt_bake.trainer.training_data import box_of
from tests.trainer.small_training import make_scene

WALKS, KEPT = 32, 8


@pytest.fixture(scope="module")
def rough_scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("rough"), eta=1.3, roughness=0.5)


def walks_of(queries, seed=1):
    """Where walks leave and what they carry [N,P,3]: anywhere, anything; a quarter of them nothing."""
    generator = np.random.default_rng(seed)
    carried = generator.random((queries, WALKS, 3)) ** 3 * (generator.random((queries, WALKS, 1)) > 0.25)
    return uniform(queries * WALKS, seed).reshape(queries, WALKS, 3), carried


def harmonic_means(directions, carried):
    """Means of T Y_lm over rays [N,16,3]."""
    basis = sh.evaluate(directions.reshape(-1, 3), 3).reshape(*directions.shape[:2], 16)
    return np.einsum("npk,npc->nkc", basis, carried) / directions.shape[1]


def test_the_light_of_each_query_is_kept_to_rounding():
    """Averaged over channels, as draws are weighed."""
    walks = walks_of(200)
    _directions, carried = resampled(*walks, KEPT, 3, np.arange(200))
    np.testing.assert_allclose(carried.mean(axis=(1, 2)), walks[1].mean(axis=(1, 2)), rtol=1e-12)


def test_means_keep_their_expectation():
    """One query's walks drawn 20 000 times: 48 means, z-tests with the variance of the draws, 10⁻⁶ of false alarm."""
    draws = 20_000
    one = walks_of(1)
    found = harmonic_means(*resampled(*(np.repeat(part, draws, axis=0) for part in one), KEPT, 5, np.arange(draws)))
    z = (found.mean(axis=0) - harmonic_means(*one)[0]) / (found.std(axis=0) / np.sqrt(draws))
    assert np.abs(z).max() < 5.7


def test_thinning_adds_less_noise_than_walking_less():
    """Of bands 0 to 2, against the first 8 of the 32 walks, whose noise is three times that of all of them."""
    walks = walks_of(4000)
    all_of_them = harmonic_means(*walks)
    fewer = harmonic_means(*(part[:, :KEPT] for part in walks))
    rays = harmonic_means(*resampled(*walks, KEPT, 7, np.arange(4000)))
    added, by_fewer = (((found - all_of_them) ** 2)[:, :9].mean() for found in (rays, fewer))
    assert added < 0.35 * by_fewer


def test_draws_depend_on_the_key_alone():
    walks, keys = walks_of(64), np.arange(100, 164)
    rays = resampled(*walks, KEPT, 3, keys)
    later = resampled(*(part[40:] for part in walks), KEPT, 3, keys[40:])
    for all_of_them, some in zip(rays, later, strict=True):
        np.testing.assert_array_equal(all_of_them[40:], some)
    assert (resampled(*walks, KEPT, 4, keys)[0] != rays[0]).any()


def test_walks_that_carry_nothing_give_rays_that_carry_nothing():
    towards, carried = walks_of(3)
    directions, nothing = resampled(towards, np.zeros_like(carried), KEPT, 0, np.arange(3))
    assert not nothing.any()
    np.testing.assert_array_equal(np.linalg.norm(directions, axis=-1), 1.0)


@pytest.mark.parametrize("fault", [np.nan, np.inf])
def test_a_walk_that_is_not_finite_is_not_lost(fault):
    """The learner stops at it and names its query; the queries beside it are as they were."""
    (towards, carried), keys = walks_of(3), np.arange(3)
    broken = carried.copy()
    broken[1, 5, 2] = fault
    directions, found = resampled(towards, broken, KEPT, 0, keys)
    _directions, sound = resampled(towards, carried, KEPT, 0, keys)
    assert not np.isfinite(found[1, :, 2]).any()
    np.testing.assert_array_equal(directions[1], np.repeat(towards[1, 5:6], KEPT, axis=0))
    np.testing.assert_array_equal(found[[0, 2]], sound[[0, 2]])


def test_a_walk_that_carries_nearly_all_is_drawn_nearly_always():
    """Contrast of 10¹²: no other ray is scaled up for it."""
    towards, carried = walks_of(1)
    carried = np.full_like(carried, 1e-12)
    carried[0, 11] = 1.0
    directions, found = resampled(towards, carried, KEPT, 0, np.arange(1))
    assert np.all(directions[0] == towards[0, 11], axis=-1).sum() >= KEPT - 1
    assert found.max() <= KEPT * carried.max()


def test_the_curve_goes_everywhere_and_from_neighbour_to_neighbour():
    """Points close along the curve lie close on the sphere, poles and the equator included."""
    directions = uniform(40_000, 2)
    ends = np.concatenate((np.eye(3), -np.eye(3)))
    place = np.array([hilbert_index(*direction) for direction in np.concatenate((directions, ends))])
    assert place.min() >= 0
    assert place.max() < 4**8
    in_order = np.concatenate((directions, ends))[np.argsort(place)]
    apart = np.linalg.norm(np.diff(in_order, axis=0), axis=-1)
    assert apart.mean() < 2.5 * np.sqrt(4 * np.pi / len(in_order))
    assert np.quantile(apart, 0.999) < 12 * np.sqrt(4 * np.pi / len(in_order))
    np.testing.assert_allclose(np.histogram(place, 16, (0, 4**8))[0].min() / len(place), 1 / 16, rtol=0.5)


@pytest.mark.parametrize(("exits", "kept"), [(8, 3), (3, 8), (4, 4)])
def test_rows_have_as_many_rays_as_are_kept(rough_scene, exits, kept):
    """Of fewer walks some are told twice, so that all rows are alike whatever the haste."""
    walks = ExitTracer(prepare(rough_scene), box_of(rough_scene), StreamSettings(exits=exits, kept=kept), 0)
    assert walks.render(0, 10).rays.shape == (10, kept, 6)
    assert walks.walks_per_query == exits


def test_rows_of_thinned_walks_mean_what_walks_mean(rough_scene):
    """The same queries and walks, resampled or not: a query's light is the same."""
    prepared, box = prepare(rough_scene), box_of(rough_scene)
    thin = ExitTracer(prepared, box, StreamSettings(exits=WALKS, kept=KEPT), 0).render(0, 50)
    full = ExitTracer(prepared, box, StreamSettings(exits=WALKS, kept=WALKS), 0).render(0, 50)
    np.testing.assert_array_equal(thin.rows[:, :6], full.rows[:, :6])
    np.testing.assert_allclose(thin.rays[..., 3:].mean(axis=(1, 2)), full.rays[..., 3:].mean(axis=(1, 2)), rtol=1e-5)
