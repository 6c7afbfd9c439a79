"""Bins that are made of what was learned of the light: right where they are, and left alone where they are not."""

from dataclasses import replace

import numpy as np
import pytest

from bakers.adaptive.component_fit import LOOKS, LightFunctions
from bakers.adaptive.lattice_pools import Pool
from bakers.adaptive.records import Refined, Refinement
from prt_bake import bake
from prt_bake.baking.adaptive.pilot import Site, first_refinement
from prt_bake.baking.adaptive.tolerances import coarse, refined_block
from prt_bake.baking.job.lattices import pools_for
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics import sh, sphere
from tests.bakers.transports import (
    Array,
    Chequered,
    Clamped,
    Counting,
    Edged,
    Incoherent,
    Lobed,
    Sunlit,
    exact,
    icosphere,
)

MESH, RINGS, SECTORS = icosphere(0), 8, 64
POOL: Pool = pools_for(2, 0).of(181)


def site_of(transport: object) -> Site:
    vertices = np.arange(len(MESH.positions))
    views = views_of(MESH, RINGS, SECTORS)[1]
    return Site(transport, MESH, vertices, views, sphere.view_bins(RINGS, SECTORS), 2, 0)


def learning(site: Site, error: float = 0.01) -> Refinement:
    return replace(coarse(first_refinement(site)[0], error).refinement, lattices="learned")


def baked(transport: object, vertices: Array | None = None) -> Refined:
    site = site_of(transport)
    return refined_block(site, learning(site), site.vertices if vertices is None else vertices)[0]


def functions() -> LightFunctions:
    return LightFunctions(POOL, np.eye(9)[None])


@pytest.mark.parametrize("transport", [Clamped(), Chequered(), Edged()])
def test_products_of_light_and_view_take_few_directions(transport: object) -> None:
    counted = Counting(transport)
    site = site_of(counted)
    how = learning(site)
    counted.evaluations = 0
    found = refined_block(site, how, site.vertices)[0]
    truth = exact(transport, MESH, RINGS, SECTORS)
    off = found.coefficients - truth
    assert np.sqrt((off**2).sum() / (truth**2).sum()) < 0.01
    assert counted.evaluations == found.evaluations
    rest = found.evaluations - found.checks.evaluations
    assert rest < 14 * len(site.vertices) * RINGS * SECTORS
    assert set(np.unique(found.directions[found.way > 0])) >= {LOOKS[0][0]}
    # Checks take as many directions as bins are rough, though few have shown it.
    assert np.sqrt((found.checks.noise**2).mean()) < 0.02**2 * (truth**2).mean()


def test_a_small_light_that_few_directions_would_miss_is_learned() -> None:
    # Along the rim, where the coarsest bins are, hardly anything of it is seen.
    asset = bake(Sunlit(), MESH, rings=RINGS, sectors=SECTORS, error=0.01)
    truth = exact(Sunlit(), MESH, RINGS, SECTORS)
    true = np.sqrt(((asset.coefficients - truth) ** 2).sum() / (truth**2).sum())
    assert true < 0.01
    assert asset.provenance["estimated_relative_rmse"]["total"] > 0.6 * true
    assert asset.provenance["evaluations"] < 100 * asset.coefficients.shape[0] * RINGS * SECTORS


@pytest.mark.parametrize("transport", [Lobed(), Incoherent()])
def test_what_is_not_made_of_few_functions_is_integrated_on_its_own(transport: object) -> None:
    found = baked(transport)
    truth = exact(transport, MESH, RINGS, SECTORS)
    off = found.coefficients - truth
    # No pilot has held these tolerances against anything.
    assert np.sqrt((off**2).sum() / (truth**2).sum()) < 0.03
    alone = found.way == 2
    assert alone.sum() > 0.6 * (found.way > 0).sum()


@pytest.mark.parametrize(
    ("transport", "learnable"), [(Clamped(), True), (Chequered(), True), (Edged(), True), (Lobed(), False)]
)
def test_a_survey_knows_what_may_be_learned(transport: object, learnable: bool) -> None:
    survey = first_refinement(site_of(transport))[0].survey
    assert survey is not None
    assert survey.learnable(0.01) == learnable


def test_a_vertex_does_not_depend_on_those_baked_with_it() -> None:
    together, alone = baked(Incoherent()), baked(Incoherent(), np.array([7]))
    np.testing.assert_array_equal(together.coefficients[7], alone.coefficients[0])
    np.testing.assert_array_equal(together.deviation[7], alone.deviation[0])


def test_a_vertex_where_nothing_is_finite_spoils_no_other() -> None:
    class Cracked(Clamped):
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            answer = super().evaluate(incident, positions, outgoing)
            answer[np.isclose(positions, MESH.positions[3]).all(axis=1)] = np.nan
            return answer

    whole, found = baked(Clamped()), baked(Cracked())
    assert np.flatnonzero(~found.valid).tolist() == [3]
    good = found.valid
    np.testing.assert_array_equal(found.coefficients[good], whole.coefficients[good])


def test_nothing_is_learned_of_nothing() -> None:
    class Dark:
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            return np.zeros((*incident.shape[:2], 3))

    found = baked(Dark())
    assert not found.coefficients.any()
    assert not found.deviation.any()


def test_amounts_of_functions_give_back_what_they_were_learned_from() -> None:
    known, cosine = functions(), POOL.directions[:, 2]
    values = np.stack([np.maximum(cosine, 0.0), np.abs(cosine), np.ones_like(cosine)], axis=1)
    known.learn(np.array([0]), values[None])
    known.look_for(np.array([0]))
    mixed = values @ np.random.default_rng(0).random((3, 3))
    for look, (directions, _most) in enumerate(LOOKS):
        seen = np.zeros((1, LOOKS[-1][0], 3))
        seen[0, :directions] = mixed[known.picked[0, :directions]]
        amounts, variance = known.fitted(np.array([0]), seen, look)
        plain = POOL.weights @ mixed
        np.testing.assert_allclose(known.coefficients(np.array([0]), amounts)[0], plain.ravel(), atol=1e-9)
        left = mixed - POOL.harmonics @ plain
        rough = (left**2).sum(axis=0).mean() / (len(left) - 9)
        assert known.roughness(np.array([0]), amounts)[0] == pytest.approx(rough, abs=1e-12)
        assert variance[0] < 1e-9


def test_the_amount_of_what_is_not_seen_is_unknown() -> None:
    known, cosine = functions(), POOL.directions[:, 2]
    known.learn(np.array([0]), np.repeat(np.maximum(cosine, 0.0)[None, :, None], 3, axis=2))
    known.look_for(np.array([0]))
    hidden = np.ones(len(cosine))
    hidden[known.picked[0]] = 0.0
    seen = np.maximum(cosine, 0.0)[known.picked[0]][None, :, None] * np.ones(3)
    assert np.isfinite(known.fitted(np.array([0]), seen, 1)[1]).all()
    known.learn(np.array([0]), np.repeat((10.0 * hidden)[None, :, None], 3, axis=2))
    assert known.known[0] == 2
    # Whatever a bin shows where it is looked at, how much of the hidden function it holds is not told.
    assert np.isinf(known.fitted(np.array([0]), seen, 1)[1]).all()


def test_what_a_fit_leaves_over_is_told_as_error() -> None:
    generator, known = np.random.default_rng(1), functions()
    cosine = POOL.directions[:, 2]
    known.learn(np.array([0]), np.repeat(np.maximum(cosine, 0.0)[None, :, None], 3, axis=2))
    known.look_for(np.array([0]))
    rows, true, told = np.zeros(400, np.int64), 0.0, 0.0
    for _try in range(20):
        # Something else in every bin, of harmonics to degree 6 about axes that are drawn.
        axes = sphere.random_rotations(400, int(generator.integers(1 << 30)))[:, 2]
        other = 0.05 * (axes @ POOL.directions.T) ** 6
        values = np.maximum(cosine, 0.0) + other
        seen = values[:, known.picked[0], None] * np.ones(3)
        amounts, variance = known.fitted(rows, seen, 1)
        truth = np.linalg.lstsq(sh.evaluate(POOL.directions, 2), values.T)[0].T
        found = known.coefficients(rows, amounts).reshape(400, 9, 3)[..., 0]
        true, told = true + ((found - truth) ** 2).mean(), told + variance.mean()
    assert 0.2 < told / true < 5.0
