"""Plans of bakes: predicted costs compared with actual ones, and sizes that are refused."""

from typing import Any

import numpy as np
import pytest

from bakers.adaptive.records import RefinedBlock
from bakers.workers import Threads
from formats.errors import QueryError
from prt_bake import bake
from prt_bake.baking.adaptive import pilot_pass
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.noise_pilot import first_refinement
from prt_bake.baking.adaptive.pass_settings import PassSettings
from prt_bake.baking.adaptive.tolerances import settings_for_error
from prt_bake.baking.adaptive.trials import Pilot, pilot_vertices
from prt_bake.baking.bake import plan
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics import sphere
from tests.bakers.transports import Counting, Edged, Incoherent, Lobed, icosphere
from tests.baking.clock import Clock, Timed

MESH = icosphere(3)
GRID: dict[str, Any] = {"rings": 4, "sectors": 32}


def job_of(transport: object, vertices: int = len(MESH.positions)) -> AdaptiveJob:
    views, local = views_of(MESH, **GRID), sphere.view_bins(**GRID)
    return AdaptiveJob(transport, MESH, np.arange(vertices), views, local, 2, 0, (GRID["rings"], GRID["sectors"]))


@pytest.mark.statistics
@pytest.mark.parametrize("error", [0.03, 0.05])
@pytest.mark.parametrize("transport", [Edged, Lobed, Incoherent])
def test_predicted_evaluations_are_those_of_the_bake(transport: type, error: float) -> None:
    arguments: dict[str, Any] = GRID | {"error": error, "seed": 2}
    baked = bake(transport(), MESH, **arguments).provenance
    assert baked["refinement"]["passes"] == 1
    assert plan(transport(), MESH, **arguments).evaluations == pytest.approx(baked["evaluations"], rel=0.15)


@pytest.mark.statistics
def test_the_prediction_includes_a_second_pass() -> None:
    arguments: dict[str, Any] = {"rings": 8, "sectors": 32, "error": 0.03, "seed": 1}
    asset = bake(Incoherent(), MESH, **arguments)
    assert asset.provenance["refinement"]["passes"] == 2
    assert plan(Incoherent(), MESH, **arguments).evaluations == pytest.approx(asset.provenance["evaluations"], rel=0.2)


def test_predicted_seconds_are_those_of_the_bake_with_slow_first_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    predicted = plan(Timed(Lobed(), clock, each=1e-6, first=0.4), MESH, **GRID, error=0.05)
    began = clock.now
    bake(Timed(Lobed(), clock, each=1e-6, first=0.4), MESH, **GRID, error=0.05)
    assert predicted.seconds == pytest.approx(clock.now - began, rel=0.2)
    assert predicted.seconds_between is not None
    low, high = predicted.seconds_between
    assert low < predicted.seconds < high


def test_a_pilot_pass_bakes_vertices_until_their_mean_cost_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stated standard error of the mean holds if a tenth of the vertices cost ten times as much."""
    job = job_of(Edged(), 600)
    expensive = np.arange(600) % 10 == 0
    baked: list[np.ndarray] = []

    def block(job: AdaptiveJob, how: object, vertices: Any) -> tuple[RefinedBlock, int]:
        baked.append(vertices)
        found, clamped = original(job, how, vertices)
        found.directions[:] = np.where(expensive[vertices], 500, 50)[:, None]
        return found, clamped

    original = pilot_pass.refined_block
    monkeypatch.setattr(pilot_pass, "refined_block", block)
    monkeypatch.setattr("prt_bake.baking.adaptive.adaptive_job.BINS_AT_ONCE", 16 * job.bins)
    monkeypatch.setattr(pilot_pass, "MOST", 0.5)
    how = first_refinement(job)[0].with_full_levels(0.1, 0.1)
    found = pilot_pass.run_pilot_pass(job, how, Threads(1))
    vertices = np.concatenate(baked)
    assert found.vertices == len(vertices) == len(np.unique(vertices)) == 304
    mean = np.where(expensive[vertices], 500, 50).mean()
    assert abs(mean - 95.0) < 3.0 * found.deviation * mean
    monkeypatch.setattr(pilot_pass, "ENOUGH", 2.0 * found.deviation)
    assert pilot_pass.run_pilot_pass(job, how, Threads(1)).vertices < 200


def test_a_pilot_pass_does_not_use_the_cache_of_the_pilot() -> None:
    counted = Counting(Edged())
    job = job_of(counted)
    settings: PassSettings = settings_for_error(Pilot(job), first_refinement(job)[0], 0.05)
    before = counted.evaluations
    found = pilot_pass.run_pilot_pass(job, settings.refinement, Threads(1))
    assert found.tally.done[pilot_vertices(job)].any()
    assert found.tally.recalled == 0
    assert counted.evaluations - before == found.tally.evaluations


def test_a_plan_with_fixed_samples_bakes_only_some_blocks() -> None:
    counted = Counting(Incoherent())
    predicted = plan(counted, MESH, **GRID, samples=64)
    assert predicted.seconds is not None
    assert counted.evaluations < 0.5 * predicted.evaluations


@pytest.mark.parametrize(
    ("change", "sentence"), [({"rings": 1024, "sectors": 1024}, "view bins"), ({"samples": 10**9}, "a bin")]
)
def test_excessive_sizes_raise_before_any_work(change: dict[str, int], sentence: str) -> None:
    with pytest.raises(QueryError, match=sentence):
        plan(Edged(), MESH, **change)
