"""Choice of tolerances from the trials of a pilot, and the cost of validation."""

from dataclasses import replace

import numpy as np
import pytest

from bakers.adaptive.calibration import Tally
from bakers.adaptive.records import RefinedBlock, RefinementSettings
from formats.errors import QueryError
from prt_bake.baking.adaptive import trials
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.noise_pilot import MOST_VALIDATION_BINS, fewest_validation_bins, first_refinement
from prt_bake.baking.adaptive.pass_settings import VALIDATION_NOISE, PassSettings, refined_block, uncalibrated
from prt_bake.baking.adaptive.tolerances import VALIDATION_BINS_PER_VERTEX, VALIDATION_COST, settings_for_error
from prt_bake.baking.adaptive.trials import Pilot
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics import sphere
from tests.bakers.transports import Edged, Incoherent, Lobed, Shadowed, icosphere

MESH, ERROR = icosphere(1), 0.01


def job_of(transport: object, rings: int = 16, sectors: int = 64) -> AdaptiveJob:
    vertices = np.arange(len(MESH.positions))
    return AdaptiveJob(
        transport, MESH, vertices, views_of(MESH, rings, sectors), sphere.view_bins(rings, sectors), 2, 0
    )


def scripted(errors: list[float], monkeypatch: pytest.MonkeyPatch, first: float = 1000.0) -> list[RefinementSettings]:
    """Replaces trials by ones with these errors and decreasing costs, `first` evaluations at first. Returns the list to
    which their settings are appended.
    """
    tried: list[RefinementSettings] = []

    def trial(_pilot: Pilot, how: RefinementSettings, _error: float, _bins: float) -> tuple[PassSettings, Tally]:
        tried.append(how)
        tally = Tally(1)
        tally.variance[:], tally.done[:] = errors[len(tried) - 1], True
        per_vertex = first / len(tried)
        settings = replace(uncalibrated(how, ERROR), error=errors[len(tried) - 1])
        return replace(settings, evaluations_per_vertex=per_vertex, evaluations_per_validation_bin=per_vertex), tally

    monkeypatch.setattr(trials, "trial", trial)
    return tried


@pytest.fixture(scope="module")
def refinement() -> RefinementSettings:
    return first_refinement(job_of(Lobed()))[0]


@pytest.mark.parametrize(
    ("errors", "best", "count"),
    [
        ([0.0085], 0, 1),
        ([0.004, 0.0085], 1, 2),
        # Two equal trials: nothing is cheaper.
        ([0.004, 0.004], 1, 2),
        # The last trial is far off, and an earlier one was good enough.
        ([0.0115, 0.012, 0.013, 0.011, 0.012, 0.014, 0.013, 0.03], 3, 8),
        ([0.02, 0.0099], 1, 2),
    ],
)
def test_the_best_trial_is_used(
    errors: list[float], best: int, count: int, refinement: RefinementSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scripted(errors, monkeypatch)
    settings = trials.calibrated(Pilot(job_of(Lobed())), refinement, ERROR, [])
    assert len(tried) == count
    assert settings.error == errors[best]


def test_an_error_is_out_of_reach_if_all_trials_are_far_off(
    refinement: RefinementSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scripted([0.05, 0.04, 0.03, 0.025, 0.022, 0.02, 0.02, 0.02] * 6, monkeypatch)
    with pytest.raises(QueryError, match="out of reach"):
        settings_for_error(Pilot(job_of(Lobed())), refinement, ERROR)
    assert tried[-1].initial_sizes == len(refinement.lattice.sizes)


def test_trials_start_with_more_directions_if_all_are_far_off(
    refinement: RefinementSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The new trials ignore what the earlier ones measured."""
    tried = scripted([0.05] * trials.MOST_TRIALS + [0.0085] * 2, monkeypatch)
    settings = trials.calibrated(Pilot(job_of(Lobed())), refinement, ERROR, [])
    assert settings.error == 0.0085
    assert [how.initial_sizes - tried[0].initial_sizes for how in tried] == [0] * trials.MOST_TRIALS + [2]
    assert tried[-1].pool_noise == tried[0].pool_noise
    assert tried[-1].light_tolerance == tried[0].light_tolerance


def test_tolerances_increase_if_errors_are_too_small(
    refinement: RefinementSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scripted([0.002, 0.003, 0.0085], monkeypatch)
    trials.calibrated(Pilot(job_of(Lobed())), refinement, ERROR, [])
    assert tried[0].light_tolerance < tried[1].light_tolerance < tried[2].light_tolerance


@pytest.mark.parametrize(("per_bin", "count"), [(11.0, 1), (30.0, 2)])
def test_expensive_and_too_exact_learned_light_gets_larger_tolerances(
    per_bin: float, count: int, refinement: RefinementSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cheap learned light is accepted at once."""
    job, learned = job_of(Lobed()), replace(refinement, lattices="learned")
    tried = scripted([0.002, 0.0085, 0.0085], monkeypatch, first=per_bin * job.bins)
    assert trials.calibrated(Pilot(job), learned, ERROR, []).error == [0.002, 0.0085][count - 1]
    assert [how.light_tolerance > tried[0].light_tolerance for how in tried] == [False, True][:count]


@pytest.mark.parametrize("transport", [Lobed(), Incoherent()])
def test_validation_costs_a_small_share(transport: object) -> None:
    job = job_of(transport)
    settings = settings_for_error(Pilot(job), first_refinement(job)[0], ERROR)
    share = settings.refinement.validation_bins(job.vertices).mean()
    cost = settings.evaluations_per_validation_bin * share * job.bins / settings.evaluations_per_vertex
    least, most = fewest_validation_bins(job) / job.many, MOST_VALIDATION_BINS / job.many
    assert share == pytest.approx(np.clip(VALIDATION_COST * share / cost, least, most), rel=0.15)
    assert settings.refinement.validation_noise <= 1.0001 * VALIDATION_NOISE * ERROR


def test_expensive_validation_uses_a_few_bins_of_each_vertex() -> None:
    job = job_of(Shadowed())
    settings = settings_for_error(Pilot(job), first_refinement(job)[0], ERROR)
    many = settings.refinement.validation_bins(job.vertices).sum()
    assert VALIDATION_BINS_PER_VERTEX * len(job.vertices) <= many < 0.9 * fewest_validation_bins(job)
    assert settings.evaluations_per_validation_bin * many > settings.evaluations_per_vertex * len(job.vertices)


@pytest.mark.parametrize(
    ("transport", "rings", "sectors", "lattices"),
    [
        # Equal from all views: interpolation between views is exact.
        (Edged(), 4, 32, "shared"),
        # A lobe that moves with the view: a shared lattice saves little, and misses detail at all bins together.
        (Lobed(), 4, 32, "own"),
        # Few of many bins are evaluated.
        (Lobed(), 16, 64, "own"),
    ],
)
def test_bins_share_a_lattice_if_that_is_cheaper(transport: object, rings: int, sectors: int, lattices: str) -> None:
    job = job_of(transport, rings, sectors)
    assert settings_for_error(Pilot(job), first_refinement(job)[0], ERROR).refinement.lattices == lattices


def test_a_pilot_of_few_bins_validates_as_many_as_are_cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pilot of a larger object validates more bins, because they are a smaller share of the cost."""
    tried: list[tuple[RefinementSettings, int]] = []
    original = trials.trial

    def counting(pilot: Pilot, how: RefinementSettings, error: float, bins: float) -> tuple[PassSettings, Tally]:
        settings, tally = original(pilot, how, error, bins)
        tried.append((how, tally.validated_bins))
        return settings, tally

    monkeypatch.setattr(trials, "trial", counting)
    for mesh, many in ((MESH, 128), (icosphere(4), 640)):
        tried.clear()
        vertices = np.arange(len(mesh.positions))
        job = AdaptiveJob(Lobed(), mesh, vertices, views_of(mesh, 4, 8), sphere.view_bins(4, 8), 2, 0)
        first, _spent = first_refinement(job)
        trials.calibrated(Pilot(job), replace(first.with_full_levels(0.1, 0.2), lattices="own"), 0.1, [])
        assert tried[-1][1] == pytest.approx(min(many, len(trials.pilot_vertices(job)) * 32), rel=0.2)
        # The first trial had too few validation bins, and is repeated.
        assert (len(tried) > 1 and tried[0][0].light_tolerance == tried[1][0].light_tolerance) == (many > 128)


@pytest.mark.parametrize(
    ("lattices", "least", "most"), [("own", 0.0, 0.01), ("shared", 0.3, 1.0), ("learned", 0.6, 1.0)]
)
def test_bins_that_share_a_lattice_have_correlated_errors(lattices: str, least: float, most: float) -> None:
    job = job_of(Edged(), 4, 16)
    how = replace(uncalibrated(first_refinement(job)[0], 0.05).refinement, lattices=lattices)
    refined: RefinedBlock = refined_block(job, how, job.vertices[:4])[0]
    assert ((refined.correlated >= least) & (refined.correlated <= most)).all()
