"""Few rays that stand for many walks: they keep sums, their expectation whatever is summed, and little noise."""

import numpy as np
import pytest
from small_training import make_scene

from prt_bake import sh
from prt_bake.directions import uniform
from prt_bake.trainer.lit import Exits
from prt_bake.trainer.material import box_of
from prt_bake.trainer.prepared import prepare
from prt_bake.trainer.rows import ExitWalks, StreamSettings
from prt_bake.trainer.thinning import along_curve, thinned

WALKS, KEPT = 32, 8


@pytest.fixture(scope="module")
def rough_scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("rough"), eta=1.3, roughness=0.5)


def exits_of(queries, seed=1):
    """Walks that leave anywhere and carry anything; a quarter of them nothing, a tenth unscattered light."""
    generator = np.random.default_rng(seed)
    directions = uniform(queries * WALKS, seed).reshape(queries, WALKS, 3)
    carried = generator.random((queries, WALKS, 3)) ** 3 * (generator.random((queries, WALKS, 1)) > 0.25)
    return Exits(directions, carried, generator.random((queries, WALKS)) < 0.1)


def harmonic_sums(exits):
    """Σ T Y_lm over rays [N,16,3], over their number."""
    basis = sh.evaluate(exits.directions.reshape(-1, 3), 3).reshape(*exits.directions.shape[:2], 16)
    carried = np.where(exits.unscattered[..., None], 0.0, exits.throughput)
    return np.einsum("npk,npc->nkc", basis, carried) / exits.directions.shape[1]


def test_the_light_of_each_query_is_kept_to_rounding():
    """Averaged over channels, as draws are weighed; whatever is unscattered is not in it."""
    exits = exits_of(200)
    whole = np.where(exits.unscattered[..., None], 0.0, exits.throughput).mean(axis=(1, 2))
    rays = thinned(exits, KEPT, 3, np.arange(200))
    np.testing.assert_allclose(rays.throughput.mean(axis=(1, 2)), whole, rtol=1e-12)
    assert not rays.unscattered.any()


def test_sums_keep_their_expectation():
    """One query's exits drawn 20 000 times: 48 sums, z-tests with the variance of the draws, 10⁻⁶ of false alarm."""
    draws = 20_000
    one = exits_of(1)
    many = Exits(*(np.repeat(part, draws, axis=0) for part in one))
    found = harmonic_sums(thinned(many, KEPT, 5, np.arange(draws)))
    error = found.std(axis=0) / np.sqrt(draws)
    z = (found.mean(axis=0) - harmonic_sums(one)[0])[error > 1e-12] / error[error > 1e-12]
    assert np.abs(z).max() < 5.7


def test_thinning_adds_less_noise_than_walking_less():
    """Of bands 0 to 2, against the first 8 of the 32 walks, whose noise is three times that of all of them."""
    exits = exits_of(4000)
    all_of_them = harmonic_sums(exits)
    fewer = Exits(*(part[:, :KEPT] for part in exits))
    added = ((harmonic_sums(thinned(exits, KEPT, 7, np.arange(4000))) - all_of_them) ** 2)[:, :9].mean()
    by_fewer = ((harmonic_sums(fewer) - all_of_them) ** 2)[:, :9].mean()
    assert added < 0.35 * by_fewer


def test_draws_depend_on_the_key_alone():
    exits = exits_of(64)
    keys = np.arange(100, 164)
    rays = thinned(exits, KEPT, 3, keys)
    later = thinned(Exits(*(part[40:] for part in exits)), KEPT, 3, keys[40:])
    np.testing.assert_array_equal(rays.directions[40:], later.directions)
    np.testing.assert_array_equal(rays.throughput[40:], later.throughput)
    assert (thinned(exits, KEPT, 4, keys).directions != rays.directions).any()


def test_walks_that_carry_nothing_give_rays_that_carry_nothing():
    exits = exits_of(3)
    rays = thinned(Exits(exits.directions, np.zeros_like(exits.throughput), exits.unscattered), KEPT, 0, np.arange(3))
    assert not rays.throughput.any()
    np.testing.assert_array_equal(np.linalg.norm(rays.directions, axis=-1), 1.0)


@pytest.mark.parametrize("fault", [np.nan, np.inf])
def test_a_walk_that_is_not_finite_is_not_lost(fault):
    """The learner stops at it and names its query; the queries beside it are as they were."""
    exits, keys = exits_of(3), np.arange(3)
    broken = exits.throughput.copy()
    broken[1, 5, 2] = fault
    unscattered = np.zeros_like(exits.unscattered)
    rays = thinned(Exits(exits.directions, broken, unscattered), KEPT, 0, keys)
    sound = thinned(Exits(exits.directions, exits.throughput, unscattered), KEPT, 0, keys)
    assert not np.isfinite(rays.throughput[1, :, 2]).any()
    np.testing.assert_array_equal(rays.directions[1], np.repeat(exits.directions[1, 5:6], KEPT, axis=0))
    np.testing.assert_array_equal(rays.throughput[[0, 2]], sound.throughput[[0, 2]])


def test_a_walk_that_carries_nearly_all_is_drawn_nearly_always():
    """Contrast of 10¹²: no other ray is scaled up for it."""
    exits = exits_of(1)
    carried = np.full_like(exits.throughput, 1e-12)
    carried[0, 11] = 1.0
    rays = thinned(Exits(exits.directions, carried, np.zeros((1, WALKS), bool)), KEPT, 0, np.arange(1))
    near = np.all(rays.directions[0] == exits.directions[0, 11], axis=-1)
    assert near.sum() >= KEPT - 1
    assert rays.throughput.max() <= KEPT * carried.max()


def test_the_curve_goes_everywhere_and_from_neighbour_to_neighbour():
    """Points close along the curve lie close on the sphere, poles and the equator included."""
    directions = uniform(40_000, 2)
    ends = np.concatenate((np.eye(3), -np.eye(3)))
    place = np.array([along_curve(*direction) for direction in np.concatenate((directions, ends))])
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
    walks = ExitWalks(prepare(rough_scene), box_of(rough_scene), StreamSettings(exits=exits, kept=kept), 0)
    assert walks.render(0, 10).rays.shape == (10, kept, 6)
    assert walks.walks_a_query == exits


def test_rows_of_thinned_walks_mean_what_walks_mean(rough_scene):
    """The same queries and walks, thinned or not: a query's light is the same."""
    prepared, box = prepare(rough_scene), box_of(rough_scene)
    thin = ExitWalks(prepared, box, StreamSettings(exits=WALKS, kept=KEPT), 0).render(0, 50)
    full = ExitWalks(prepared, box, StreamSettings(exits=WALKS, kept=WALKS), 0).render(0, 50)
    np.testing.assert_array_equal(thin.rows[:, :6], full.rows[:, :6])
    np.testing.assert_allclose(thin.rays[..., 3:].mean(axis=(1, 2)), full.rays[..., 3:].mean(axis=(1, 2)), rtol=1e-5)
