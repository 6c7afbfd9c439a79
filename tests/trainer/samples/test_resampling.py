"""Systematic resampling of exits: it preserves each query's light, is unbiased and adds little noise."""

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


def random_walks(queries, seed=1):
    """Uniform directions and random throughput [N,P,3] of walks; a quarter of them carry nothing."""
    generator = np.random.default_rng(seed)
    throughput = generator.random((queries, WALKS, 3)) ** 3 * (generator.random((queries, WALKS, 1)) > 0.25)
    return uniform(queries * WALKS, seed).reshape(queries, WALKS, 3), throughput


def harmonic_means(directions, throughput):
    """Means of T Y_lm over rays [N,16,3]."""
    basis = sh.evaluate(directions.reshape(-1, 3), 3).reshape(*directions.shape[:2], 16)
    return np.einsum("npk,npc->nkc", basis, throughput) / directions.shape[1]


def test_the_light_of_each_query_is_preserved():
    """To rounding, averaged over channels, as draws are weighted."""
    walks = random_walks(200)
    _directions, throughput = resampled(*walks, KEPT, 3, np.arange(200))
    np.testing.assert_allclose(throughput.mean(axis=(1, 2)), walks[1].mean(axis=(1, 2)), rtol=1e-12)


def test_means_are_unbiased():
    """One query's walks resampled 20 000 times: z-tests of 48 means with the draws' variance, false alarm 10⁻⁶."""
    draws = 20_000
    walks = random_walks(1)
    means = harmonic_means(*resampled(*(np.repeat(part, draws, axis=0) for part in walks), KEPT, 5, np.arange(draws)))
    z = (means.mean(axis=0) - harmonic_means(*walks)[0]) / (means.std(axis=0) / np.sqrt(draws))
    assert np.abs(z).max() < 5.7


def test_resampling_adds_less_noise_than_fewer_walks():
    """Bands 0 to 2, compared with the first 8 of the 32 walks, whose noise is three times that of all of them."""
    walks = random_walks(4000)
    all_walks = harmonic_means(*walks)
    fewer = harmonic_means(*(part[:, :KEPT] for part in walks))
    rays = harmonic_means(*resampled(*walks, KEPT, 7, np.arange(4000)))
    by_resampling, by_fewer = (((means - all_walks) ** 2)[:, :9].mean() for means in (rays, fewer))
    assert by_resampling < 0.35 * by_fewer


def test_draws_depend_on_the_key_alone():
    walks, keys = random_walks(64), np.arange(100, 164)
    rays = resampled(*walks, KEPT, 3, keys)
    later = resampled(*(part[40:] for part in walks), KEPT, 3, keys[40:])
    for all_rays, some in zip(rays, later, strict=True):
        np.testing.assert_array_equal(all_rays[40:], some)
    assert (resampled(*walks, KEPT, 4, keys)[0] != rays[0]).any()


def test_walks_without_light_give_rays_without_light():
    exits, throughput = random_walks(3)
    directions, nothing = resampled(exits, np.zeros_like(throughput), KEPT, 0, np.arange(3))
    assert not nothing.any()
    np.testing.assert_array_equal(np.linalg.norm(directions, axis=-1), 1.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_walk_that_is_not_finite_is_kept(bad):
    """The learner stops at it and names its query; other queries are unchanged."""
    (exits, throughput), keys = random_walks(3), np.arange(3)
    broken = throughput.copy()
    broken[1, 5, 2] = bad
    directions, found = resampled(exits, broken, KEPT, 0, keys)
    _directions, expected = resampled(exits, throughput, KEPT, 0, keys)
    assert not np.isfinite(found[1, :, 2]).any()
    np.testing.assert_array_equal(directions[1], np.repeat(exits[1, 5:6], KEPT, axis=0))
    np.testing.assert_array_equal(found[[0, 2]], expected[[0, 2]])


def test_a_dominant_walk_is_drawn_nearly_always():
    """A contrast of 10¹² does not scale up any other ray."""
    exits, throughput = random_walks(1)
    throughput = np.full_like(throughput, 1e-12)
    throughput[0, 11] = 1.0
    directions, found = resampled(exits, throughput, KEPT, 0, np.arange(1))
    assert np.all(directions[0] == exits[0, 11], axis=-1).sum() >= KEPT - 1
    assert found.max() <= KEPT * throughput.max()


def test_the_hilbert_curve_covers_the_sphere_and_is_local():
    """Points close along the curve are close on the sphere, including the poles and the equator."""
    directions = uniform(40_000, 2)
    directions = np.concatenate((directions, np.eye(3), -np.eye(3)))
    index = np.array([hilbert_index(*direction) for direction in directions])
    assert index.min() >= 0
    assert index.max() < 4**8
    distance = np.linalg.norm(np.diff(directions[np.argsort(index)], axis=0), axis=-1)
    assert distance.mean() < 2.5 * np.sqrt(4 * np.pi / len(directions))
    assert np.quantile(distance, 0.999) < 12 * np.sqrt(4 * np.pi / len(directions))
    np.testing.assert_allclose(np.histogram(index, 16, (0, 4**8))[0].min() / len(index), 1 / 16, rtol=0.5)


@pytest.mark.parametrize(("exits", "kept"), [(8, 3), (3, 8), (4, 4)])
def test_the_number_of_rays_does_not_depend_on_the_number_of_walks(rough_scene, exits, kept):
    """Rows have the same width for any number of walks; with fewer walks some are drawn twice."""
    tracer = ExitTracer(prepare(rough_scene), box_of(rough_scene), StreamSettings(exits=exits, kept=kept), 0)
    assert tracer.render(0, 10).rays.shape == (10, kept, 6)
    assert tracer.walks_per_query == exits


def test_resampled_rows_have_the_light_of_all_walks(rough_scene):
    """The same queries and walks, resampled or not."""
    prepared, box = prepare(rough_scene), box_of(rough_scene)
    few = ExitTracer(prepared, box, StreamSettings(exits=WALKS, kept=KEPT), 0).render(0, 50)
    full = ExitTracer(prepared, box, StreamSettings(exits=WALKS, kept=WALKS), 0).render(0, 50)
    np.testing.assert_array_equal(few.rows[:, :6], full.rows[:, :6])
    np.testing.assert_allclose(few.rays[..., 3:].mean(axis=(1, 2)), full.rays[..., 3:].mean(axis=(1, 2)), rtol=1e-5)
