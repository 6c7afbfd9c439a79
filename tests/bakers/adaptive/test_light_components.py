"""Light components: accurate where they explain the bins, unused where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from bakers.adaptive.lattice_pools import Pool
from bakers.adaptive.principal_components import PROBE_STAGES, LightComponents
from bakers.adaptive.records import RefinedBlock, RefinementSettings
from prt_bake import bake
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.noise_pilot import first_refinement
from prt_bake.baking.adaptive.pass_settings import refined_block, uncalibrated
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


def job_of(transport: object) -> AdaptiveJob:
    vertices = np.arange(len(MESH.positions))
    views = views_of(MESH, RINGS, SECTORS)
    return AdaptiveJob(transport, MESH, vertices, views, sphere.view_bins(RINGS, SECTORS), 2, 0)


def learning(job: AdaptiveJob, error: float = 0.01) -> RefinementSettings:
    return replace(uncalibrated(first_refinement(job)[0], error).refinement, lattices="learned")


def baked(transport: object, vertices: Array | None = None) -> RefinedBlock:
    job = job_of(transport)
    return refined_block(job, learning(job), job.vertices if vertices is None else vertices)[0]


def new_components() -> LightComponents:
    return LightComponents(POOL, np.eye(9)[None])


@pytest.mark.statistics
@pytest.mark.parametrize("transport", [Clamped(), Chequered(), Edged()])
def test_products_of_light_and_view_need_few_directions(transport: object) -> None:
    counted = Counting(transport)
    job = job_of(counted)
    how = learning(job)
    counted.evaluations = 0
    found = refined_block(job, how, job.vertices)[0]
    truth = exact(transport, MESH, RINGS, SECTORS)
    off = found.coefficients - truth
    assert np.sqrt((off**2).sum() / (truth**2).sum()) < 0.01
    assert counted.evaluations == found.evaluations
    rest = found.evaluations - found.validation.evaluations
    assert rest < 14 * len(job.vertices) * RINGS * SECTORS
    assert set(np.unique(found.directions[found.method > 0])) >= {PROBE_STAGES[0][0]}
    # Validation samples use as many directions as the residual bins need, though few bins have shown that.
    assert np.sqrt((found.validation.noise**2).mean()) < 0.02**2 * (truth**2).mean()


def test_a_small_light_that_few_directions_would_miss_is_learned() -> None:
    # Hardly any of it is visible along the rim, where the coarsest bins are.
    asset = bake(Sunlit(), MESH, rings=RINGS, sectors=SECTORS, error=0.01)
    truth = exact(Sunlit(), MESH, RINGS, SECTORS)
    true = np.sqrt(((asset.coefficients - truth) ** 2).sum() / (truth**2).sum())
    assert true < 0.01
    assert asset.provenance["estimated_relative_rmse"]["total"] > 0.6 * true
    assert asset.provenance["evaluations"] < 100 * asset.coefficients.shape[0] * RINGS * SECTORS


@pytest.mark.statistics
@pytest.mark.parametrize("transport", [Lobed(), Incoherent()])
def test_unexplained_bins_are_integrated_over_own_lattices(transport: object) -> None:
    found = baked(transport)
    truth = exact(transport, MESH, RINGS, SECTORS)
    off = found.coefficients - truth
    # No pilot has calibrated these tolerances.
    assert np.sqrt((off**2).sum() / (truth**2).sum()) < 0.03
    own = found.method == 2
    assert own.sum() > 0.6 * (found.method > 0).sum()


@pytest.mark.parametrize(
    ("transport", "low_rank"), [(Clamped(), True), (Chequered(), True), (Edged(), True), (Lobed(), False)]
)
def test_a_survey_detects_low_rank_light(transport: object, low_rank: bool) -> None:
    survey = first_refinement(job_of(transport))[0].survey
    assert survey is not None
    assert survey.is_low_rank(0.01) == low_rank


def test_a_vertex_does_not_depend_on_those_baked_with_it() -> None:
    together, alone = baked(Incoherent()), baked(Incoherent(), np.array([7]))
    np.testing.assert_array_equal(together.coefficients[7], alone.coefficients[0])
    np.testing.assert_array_equal(together.standard_error[7], alone.standard_error[0])


def test_a_vertex_that_is_not_finite_affects_no_other() -> None:
    class Cracked(Clamped):
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            answer = super().evaluate(incident, positions, outgoing)
            answer[np.isclose(positions, MESH.positions[3]).all(axis=1)] = np.nan
            return answer

    complete, found = baked(Clamped()), baked(Cracked())
    assert np.flatnonzero(~found.valid).tolist() == [3]
    good = found.valid
    np.testing.assert_array_equal(found.coefficients[good], complete.coefficients[good])


def test_a_black_transport_has_no_components() -> None:
    class Dark:
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            return np.zeros((*incident.shape[:2], 3))

    found = baked(Dark())
    assert not found.coefficients.any()
    assert not found.standard_error.any()


def test_amplitudes_reproduce_the_values_that_were_learned_from() -> None:
    components, cosine = new_components(), POOL.directions[:, 2]
    values = np.stack([np.maximum(cosine, 0.0), np.abs(cosine), np.ones_like(cosine)], axis=1)
    components.learn(np.array([0]), values[None])
    components.choose_probes(np.array([0]))
    mixed = values @ np.random.default_rng(0).random((3, 3))
    for stage, (directions, _most) in enumerate(PROBE_STAGES):
        probed = np.zeros((1, PROBE_STAGES[-1][0], 3))
        probed[0, :directions] = mixed[components.probes[0, :directions]]
        amplitudes, variance = components.fit(np.array([0]), probed, stage)
        plain = POOL.weights @ mixed
        np.testing.assert_allclose(components.coefficients(np.array([0]), amplitudes)[0], plain.ravel(), atol=1e-9)
        left = mixed - POOL.harmonics @ plain
        residual = (left**2).sum(axis=0).mean() / (len(left) - 9)
        assert components.residual_variance(np.array([0]), amplitudes)[0] == pytest.approx(residual, abs=1e-12)
        assert variance[0] < 1e-9


def test_amplitudes_of_invisible_components_are_unknown() -> None:
    components, cosine = new_components(), POOL.directions[:, 2]
    components.learn(np.array([0]), np.repeat(np.maximum(cosine, 0.0)[None, :, None], 3, axis=2))
    components.choose_probes(np.array([0]))
    hidden = np.ones(len(cosine))
    hidden[components.probes[0]] = 0.0
    probed = np.maximum(cosine, 0.0)[components.probes[0]][None, :, None] * np.ones(3)
    assert np.isfinite(components.fit(np.array([0]), probed, 1)[1]).all()
    components.learn(np.array([0]), np.repeat((10.0 * hidden)[None, :, None], 3, axis=2))
    assert components.counts[0] == 2
    # The probes do not determine the amplitude of the hidden component.
    assert np.isinf(components.fit(np.array([0]), probed, 1)[1]).all()


def test_the_variance_is_estimated_from_the_residual() -> None:
    generator, components = np.random.default_rng(1), new_components()
    cosine = POOL.directions[:, 2]
    components.learn(np.array([0]), np.repeat(np.maximum(cosine, 0.0)[None, :, None], 3, axis=2))
    components.choose_probes(np.array([0]))
    rows, true, stated = np.zeros(400, np.int64), 0.0, 0.0
    for _try in range(20):
        # A different part in every bin, of harmonics to degree 6 about random axes.
        axes = sphere.random_rotations(400, int(generator.integers(1 << 30)))[:, 2]
        other = 0.05 * (axes @ POOL.directions.T) ** 6
        values = np.maximum(cosine, 0.0) + other
        probed = values[:, components.probes[0], None] * np.ones(3)
        amplitudes, variance = components.fit(rows, probed, 1)
        truth = np.linalg.lstsq(sh.evaluate(POOL.directions, 2), values.T)[0].T
        found = components.coefficients(rows, amplitudes).reshape(400, 9, 3)[..., 0]
        true, stated = true + ((found - truth) ** 2).mean(), stated + variance.mean()
    assert 0.2 < stated / true < 5.0
