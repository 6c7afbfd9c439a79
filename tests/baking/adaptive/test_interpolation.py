"""Fine meshes: most vertices are interpolated from others, which saves evaluations and is validated."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from bakers.adaptive.vertex_validation import validation_errors
from formats.asset import Asset
from prt_bake import bake
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.noise_pilot import first_refinement
from prt_bake.baking.adaptive.parent_vertices import Interpolation, cell_interpolation
from prt_bake.baking.adaptive.tolerances import settings_for_error
from prt_bake.baking.adaptive.trials import Pilot
from prt_bake.baking.bake import plan
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics import sh, sphere
from tests.bakers.transports import Array, Counting, Lobed, Ringed, exact, icosphere, patched
from tests.baking.test_resume import same

pytestmark = pytest.mark.statistics

ERROR, RINGS, SECTORS = 0.02, 4, 32
SMALL = {"error": ERROR, "rings": RINGS, "sectors": SECTORS}
MESH = icosphere(4)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("nearby") / "whole.h5"


class Whole(NamedTuple):
    """A complete bake: its asset, its evaluations, and its progress (done, seconds left)."""

    asset: Asset
    evaluations: int
    progress: list[tuple[int, float | None]]


@pytest.fixture(scope="module")
def followed(path: Path) -> Iterator[Whole]:
    progress: list[tuple[int, float | None]] = []
    counted = Counting(Ringed())
    follow = {"progress": lambda done, _of, row: progress.append((done, row.left))}
    with bake(counted, MESH, **SMALL, **follow, out=path) as asset:
        yield Whole(asset, counted.evaluations, progress)


@pytest.fixture
def whole(followed: Whole) -> Asset:
    return followed.asset


def true_errors(asset: Asset, transport: Ringed, vertices: Array) -> tuple[Array, Array]:
    """Squared errors [n,B] and squares [n,B], mean over coefficients; the reference has many directions."""
    lattice, views = sphere.fibonacci(1024), views_of(MESH, RINGS, SECTORS)
    fit = np.linalg.pinv(sh.evaluate(lattice, 2))
    off, signal = [], []
    for vertex in vertices:
        outgoing = views(np.array([vertex]))[0][0]
        count = len(outgoing)
        answers = transport.evaluate(
            np.broadcast_to(lattice, (count, *lattice.shape)), np.tile(MESH.positions[vertex], (count, 1)), outgoing
        )
        truth = np.einsum("kd,bdc->bkc", fit, answers)
        off.append(((asset.coefficients[vertex] - truth) ** 2).mean(axis=(1, 2)))
        signal.append((truth**2).mean(axis=(1, 2)))
    return np.array(off), np.array(signal)


def some_vertices(count: int = 150) -> Array:
    return np.random.default_rng(0).choice(len(MESH.positions), count, replace=False)


def interpolated(asset: Asset) -> int:
    return int(asset.provenance["refinement"]["vertices_interpolated"])


def test_most_vertices_of_a_fine_mesh_are_interpolated_and_the_reported_error_is_correct(whole: Asset) -> None:
    off, signal = true_errors(whole, Ringed(), some_vertices())
    true = np.sqrt(off.sum() / signal.sum())
    reported = whole.provenance["estimated_relative_rmse"]["total"]
    assert interpolated(whole) > 0.6 * len(MESH.positions)
    assert true < 1.1 * ERROR
    assert 0.8 < reported / true < 1.25
    standard_error = np.asarray(whole.standard_error)[some_vertices()]
    assert 0.92 < (np.sqrt(off) <= 1.96 * standard_error).mean() < 0.99


def test_interpolation_saves_evaluations_as_the_plan_predicts(whole: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    predicted = plan(Ringed(), MESH, **SMALL).evaluations
    monkeypatch.setattr("prt_bake.baking.adaptive.tolerances.choose_interpolation", lambda *_all: (None, 0))
    without = plan(Ringed(), MESH, **SMALL).evaluations
    assert predicted < 0.7 * without
    assert whole.provenance["evaluations"] < without / 1.5


def test_a_patch_that_the_trials_missed_is_detected() -> None:
    transport = Ringed(patch=0.15)
    with bake(transport, MESH, **SMALL) as asset:
        edge = np.flatnonzero(patched(MESH.positions, 0.25) & ~patched(MESH.positions, 0.08))
        off, signal = true_errors(asset, transport, edge)
        assert interpolated(asset) > 0.5 * len(MESH.positions)
        assert np.sqrt(off.sum() / signal.sum()) < 1.5 * ERROR
        assert np.sqrt((off.sum(axis=1) / signal.sum(axis=1)).max()) < 6.0 * ERROR


def test_vertices_that_do_not_predict_others_are_not_used() -> None:
    transport = Ringed(sharp=True)
    with bake(transport, MESH, **SMALL) as asset:
        off, signal = true_errors(asset, transport, some_vertices())
        assert interpolated(asset) == 0
        assert np.sqrt(off.sum() / signal.sum()) < 1.1 * ERROR


def test_a_vertex_that_is_not_finite_does_not_affect_others() -> None:
    with bake(Ringed(blind=MESH.positions[7]), MESH, **SMALL) as asset:
        assert asset.provenance["vertices_not_finite"] == {"count": 1, "first": [7]}
        assert np.flatnonzero(~np.asarray(asset.valid)).tolist() == [7]
        assert interpolated(asset) > 0.5 * len(MESH.positions)


def test_results_do_not_depend_on_workers_or_block_size(
    whole: Asset, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prt_bake.baking.adaptive.run.vertices_at_once", lambda *_all: 77)
    bake(Ringed(), MESH, **SMALL, workers=2, out=tmp_path / "cut.h5").close()
    same(tmp_path / "cut.h5", path)


@pytest.mark.parametrize(("calls_until_stop", "interrupt"), [(14, False), (20, False), (14, True)])
def test_a_bake_stopped_among_the_vertices_to_interpolate_from_resumes(
    whole: Asset, path: Path, tmp_path: Path, calls_until_stop: int, interrupt: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    # On a slow machine the pilot would check for a stop too.
    monkeypatch.setattr("prt_bake.baking.adaptive.run.UNINTERRUPTED", math.inf)
    out, calls = tmp_path / "stopped.h5", iter([False] * calls_until_stop + [True] * 1000)

    def stop() -> bool:
        if not next(calls):
            return False
        if interrupt:
            raise KeyboardInterrupt
        return True

    with bake(Ringed(), MESH, **SMALL, out=out, stop=stop) as part:
        assert part.complete
        assert part.provenance["estimated_relative_rmse"]["total"] > ERROR
    kept = {path.name[:9] for path in (tmp_path / "stopped.h5.journal").iterdir()}
    assert "evaluated" in kept
    bake(Ringed(), MESH, **SMALL, out=out, resume=True).close()
    same(out, path)
    assert [path.name for path in tmp_path.iterdir()] == ["stopped.h5"]


def test_progress_never_decreases_and_all_evaluations_are_counted(followed: Whole) -> None:
    assert followed.evaluations == followed.asset.provenance["evaluations"]
    done = [count for count, _left in followed.progress]
    ends = [place for place, count in enumerate(done) if count == len(MESH.positions)]
    assert len(ends) >= 2
    last = done[ends[-2] + 1 :]
    assert last == sorted(last)
    assert 0 < last[0] < len(MESH.positions) / 3
    assert all(left is None or left >= 0.0 for _done, left in followed.progress)


def test_one_vertex_per_cell_is_evaluated_first() -> None:
    views = views_of(MESH, RINGS, SECTORS)
    job = AdaptiveJob(
        Ringed(), MESH, np.arange(len(MESH.positions)), views, sphere.view_bins(RINGS, SECTORS), 2, 0, (RINGS, SECTORS)
    )
    found: list[Interpolation] = [cell_interpolation(job, spacing, ERROR, 1, 64.0, 1e5) for spacing in (0.1, 0.2, 0.4)]
    shares = [len(each.numbers) / len(MESH.positions) for each in found]
    assert shares == sorted(shares, reverse=True)
    for each, share in zip(found, shares, strict=True):
        assert 1e5 * share < each.mean_evaluations < 1e5
        assert each.ahead == pytest.approx(1e5 * share / each.mean_evaluations)


@pytest.mark.parametrize("scale", [1.0, 1.03])
def test_the_error_of_interpolated_vertices_is_measured_without_noise(scale: float) -> None:
    mesh, transport = icosphere(1), Lobed()
    views = views_of(mesh, 4, 16)
    job = AdaptiveJob(transport, mesh, np.arange(42), views, sphere.view_bins(4, 16), 2, 0, (4, 16))
    how = replace(
        settings_for_error(Pilot(job), first_refinement(job)[0], ERROR).refinement, validation_noise=2.0 * ERROR
    )
    outgoing = views(np.arange(42))[0]
    coefficients = scale * exact(transport, mesh, 4, 16, directions=1024)
    bins = np.tile(np.arange(64), (42, 1))
    off, spent = validation_errors(transport, how, np.arange(42), mesh.positions, outgoing, coefficients, bins)
    # The variance of the directions is four times the squared error; at most a sixteenth of it may remain.
    assert off.mean() == pytest.approx((1.0 - 1.0 / scale) ** 2, abs=0.25 * ERROR**2)
    assert off.shape == (42, 64)
    assert spent >= off.size * how.lattice.sizes[0]
