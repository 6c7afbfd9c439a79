"""Bakes with fixed samples: exactness in the band, calibrated errors, independence of blocks, partial results."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.mesh import Mesh, build_mesh
from prt_bake.baking.bake import bake, plan
from prt_bake.baking.job.sample_pilot import error_ladder
from prt_bake.mathematics import sh, sphere
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF

Array = NDArray[np.float64]


def ball(vertices: int = 14) -> Mesh:
    """A convex mesh about the origin: the hull of a few lattice points, with outward faces."""
    from scipy.spatial import ConvexHull

    points = sphere.fibonacci(vertices)
    faces = ConvexHull(points).simplices
    corners = points[faces]
    inward = np.linalg.det(corners) < 0
    faces[inward] = faces[inward][:, ::-1]
    return build_mesh(points, faces)


class Banded:
    """Ŝ = Σ a_lm(x, ωo) Y_lm(ωi), the coefficients being smooth functions of position and view."""

    def __init__(self, degree: int) -> None:
        self.degree = degree

    def coefficients(self, positions: Array, outgoing: Array) -> Array:
        k = np.arange(sh.count(self.degree))
        wave = 1.0 + 0.3 * np.cos(k[:, None] + np.arange(3) + positions[:, None, :1] + outgoing[:, None, :])
        return wave * (-1.0) ** k[:, None]

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        return sh.evaluate(incident, self.degree) @ self.coefficients(positions, outgoing)


class Kinked:
    """A clamped cosine, a lobe that follows the view, a shadow's edge."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        light = np.broadcast_to(incident, (len(positions), *incident.shape[-2:]))
        facing = np.einsum("ndi,ni->nd", light, positions)
        lobe = np.exp(6.0 * (np.einsum("ndi,ni->nd", light, outgoing) - 1.0))
        shadow = np.where(light[..., 0] + 0.3 * light[..., 1] > -0.4, 1.0, 0.4)
        return np.stack([np.maximum(facing, 0.0) * shadow, 0.3 * np.exp(facing) + lobe, lobe * shadow + 0.1], axis=-1)


class Counted(Kinked):
    """Counts evaluations."""

    def __init__(self) -> None:
        self.evaluations = 0

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        values = super().evaluate(incident, positions, outgoing)
        self.evaluations += values.shape[0] * values.shape[1]
        return values


def views(mesh: Mesh, rings: int, sectors: int) -> Array:
    """Directions to the eye [V,B,3] of the view bins."""
    tangents = sphere.tangent_frame(mesh.normals)
    return sphere.to_world(sphere.view_bins(rings, sectors), mesh.normals[:, None], tangents[:, None])


@pytest.mark.parametrize(
    ("degree", "rings", "sectors"),
    [(0, 1, 1), (1, 2, 3), (2, 1, 1), (2, 4, 32), (3, 1, 40), (5, 2, 2), (8, 1, 1), (8, 1, 32)],
)
def test_band_limited_transports_are_recovered_exactly(degree: int, rings: int, sectors: int) -> None:
    mesh, transport = ball(14 if degree < 8 else 6), Banded(degree)
    asset = bake(transport, mesh, degree, rings, sectors, samples=max(64, 2 * (degree + 1) ** 2), seed=3)
    outgoing = views(mesh, rings, sectors)
    bins = rings * sectors
    expected = transport.coefficients(np.repeat(mesh.positions, bins, axis=0), outgoing.reshape(-1, 3))
    found = asset.coefficients.reshape(-1, sh.count(degree), 3)
    assert asset.provenance["bins_moved_to_the_horizon"] == 0
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    assert asset.coefficients.dtype == np.float32
    assert asset.complete
    assert asset.valid.all()
    assert asset.standard_error.max() < 2e-3


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("directions", "rings", "sectors", "samples", "method"),
    [
        ("fibonacci", 4, 64, 64, "neighbours"),
        ("sobol", 4, 64, 32, "neighbours"),
        ("uniform", 4, 64, 32, "neighbours"),
        ("fibonacci", 16, 8, 64, "halves"),
        ("uniform", 16, 8, 32, "halves"),
    ],
)
def test_standard_errors_are_calibrated(directions: str, rings: int, sectors: int, samples: int, method: str) -> None:
    """Errors compared with 2¹³ directions: their rms, and the share of bins within 1.96 standard errors."""
    mesh = ball(8)
    asset = bake(Kinked(), mesh, 2, rings, sectors, directions, samples, seed=5)
    expected = reference(mesh, rings, sectors)
    squared = ((asset.coefficients - expected) ** 2).mean(axis=(2, 3))
    stated = asset.standard_error.astype(np.float64)
    assert asset.provenance["error_estimate"] == method
    assert np.sqrt((stated**2).mean() / squared.mean()) == pytest.approx(1.0, abs=0.12)
    assert 0.92 <= (np.sqrt(squared) <= 1.96 * stated).mean() <= 1.0
    relative = np.sqrt(squared.sum() * 27 / (expected**2).sum())
    assert asset.error_vs_time[-1, 2] == pytest.approx(relative, rel=0.12)


def reference(mesh: Mesh, rings: int, sectors: int) -> Array:
    """Coefficients [V,B,9,3] of `Kinked` from 2¹³ lattice points summed with equal weights."""
    directions = sphere.fibonacci(1 << 13) @ sphere.random_rotations(1, 99)[0].T
    weights = 4 * np.pi / len(directions) * sh.evaluate(directions, 2).T
    outgoing = views(mesh, rings, sectors)
    expected = np.empty((*outgoing.shape[:2], 9, 3))
    for vertex, x in enumerate(mesh.positions):
        for first in range(0, outgoing.shape[1], 16):
            eye = outgoing[vertex, first : first + 16]
            values = Kinked().evaluate(directions, np.repeat(x[None], len(eye), axis=0), eye)
            expected[vertex, first : first + 16] = weights @ values
    return expected


def test_the_residual_estimate_is_conservative() -> None:
    mesh = ball(40)
    asset = bake(Kinked(), mesh, 2, 2, 2, samples=20, seed=1)
    expected = reference(mesh, 2, 2)
    squared = ((asset.coefficients - expected) ** 2).mean(axis=(2, 3))
    assert asset.provenance["error_estimate"] == "residual"
    assert 1.0 < np.sqrt((asset.standard_error**2).mean() / squared.mean()) < 3.0


@pytest.mark.statistics
def test_the_lattice_is_unbiased_and_far_better_than_uniform_directions() -> None:
    """The mean over many seeds agrees with the reference within its standard error."""
    mesh = ball(8)
    expected = reference(mesh, 1, 1)
    errors = {
        kind: np.stack([bake(Kinked(), mesh, 2, 1, 1, kind, 32, seed=seed).coefficients for seed in range(200)])
        - expected
        for kind in ("fibonacci", "uniform")
    }
    scatter = {kind: np.sqrt((error**2).mean()) for kind, error in errors.items()}
    assert scatter["uniform"] > 5 * scatter["fibonacci"]
    for error in errors.values():
        z = error.mean(axis=0) / (error.std(axis=0) / np.sqrt(len(error)))
        assert np.abs(z).max() < 4.5
        assert z.std() < 1.3


def test_equal_seeds_give_equal_assets_for_any_number_of_workers() -> None:
    mesh = ball()
    network = NeuralBSSRDF(NetworkSettings(features=16, width=16), mesh.bounds[0], 2.0)
    first, second = (bake(network, mesh, 1, 4, 32, samples=64, seed=4, workers=workers) for workers in (1, 2))
    np.testing.assert_array_equal(first.coefficients, second.coefficients)
    np.testing.assert_array_equal(first.standard_error, second.standard_error)
    other = bake(network, mesh, 1, 4, 32, samples=64, seed=5)
    assert (other.coefficients != first.coefficients).any()


def test_a_vertex_does_not_depend_on_the_block_size(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = ball()
    network = NeuralBSSRDF(NetworkSettings(features=16, width=16), mesh.bounds[0], 2.0)
    whole = bake(network, mesh, 2, 4, 32, samples=64)
    monkeypatch.setattr("bakers.baker.vertices_at_once", lambda bins, directions: 3)
    np.testing.assert_array_equal(bake(network, mesh, 2, 4, 32, samples=64).coefficients, whole.coefficients)


def test_the_fast_evaluation_of_networks_agrees_with_evaluate() -> None:
    mesh = ball(6)
    network = NeuralBSSRDF(NetworkSettings(features=16, width=16), mesh.bounds[0], 2.0)

    class EvaluateOnly:
        evaluate = staticmethod(network.evaluate)

    fast, plain = bake(network, mesh, 2, 2, 32, samples=64), bake(EvaluateOnly(), mesh, 2, 2, 32, samples=64)
    np.testing.assert_allclose(fast.coefficients, plain.coefficients, atol=1e-5 * np.abs(plain.coefficients).max())


@pytest.mark.parametrize(("sectors", "samples"), [(32, 40), (4, 40), (4, 41)])
def test_evaluations_are_counted(sectors: int, samples: int) -> None:
    transport = Counted()
    asset = bake(transport, ball(6), 2, 2, sectors, samples=samples)
    assert asset.provenance["evaluations"] == transport.evaluations
    assert asset.error_vs_time[-1, 1] == transport.evaluations
    assert asset.provenance["settings"]["samples"] == samples + (sectors == 4) * samples % 2


def test_progress_and_error_rows_increase_to_the_end() -> None:
    seen: list[tuple[int, int, tuple[float, float, float]]] = []
    asset = bake(Kinked(), ball(300), 1, 16, 64, samples=16, progress=lambda *step: seen.append(step))
    assert [done for done, _, _ in seen][-1] == 300
    assert all(total == 300 for _, total, _ in seen)
    assert (np.diff(asset.error_vs_time[:, :2], axis=0) >= 0).all()
    assert tuple(asset.error_vs_time[-1]) == seen[-1][2]
    assert len(asset.error_vs_time) > 2


def test_a_requested_error_is_reached() -> None:
    mesh = ball(12)
    asset = bake(Kinked(), mesh, 2, 2, 32, "sobol", error=0.008, samples=16, seed=2)
    expected = reference(mesh, 2, 32)
    assert asset.provenance["settings"]["samples"] > 64
    assert np.sqrt(((asset.coefficients - expected) ** 2).sum() / (expected**2).sum()) < 0.01
    with pytest.raises(QueryError, match="out of reach"):
        bake(Kinked(), mesh, 2, 1, 32, "uniform", error=1e-4, samples=2048)
    with pytest.raises(QueryError, match="between 0 and 1"):
        bake(Kinked(), mesh, 2, 1, 32, error=0.0)


class Cracked(Kinked):
    """Returns NaN above a height."""

    def __init__(self, height: float) -> None:
        self.height = height

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        values = super().evaluate(incident, positions, outgoing)
        values[positions[:, 2] > self.height] = np.nan
        return values


def test_vertices_that_are_not_finite_are_reported_and_the_others_baked() -> None:
    mesh = ball(20)
    asset = bake(Cracked(0.8), mesh, 1, 2, 4, samples=64)
    finite = bake(Kinked(), mesh, 1, 2, 4, samples=64)
    bad = np.flatnonzero(mesh.positions[:, 2] > 0.8)
    assert asset.provenance["vertices_not_finite"] == {"count": len(bad), "first": bad.tolist()}
    np.testing.assert_array_equal(np.flatnonzero(~asset.valid), bad)
    np.testing.assert_array_equal(asset.coefficients[asset.valid], finite.coefficients[asset.valid])
    with pytest.raises(QueryError, match=r"Cracked: expected finite values, found .* at all 20 vertices"):
        bake(Cracked(-2.0), mesh, 1, 2, 4, samples=64)


@pytest.mark.parametrize("method", ["stop", "interrupt"])
def test_a_stopped_bake_leaves_a_valid_partial_asset(
    method: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("bakers.baker.vertices_at_once", lambda bins, directions: 2)
    done: list[int] = []

    def progress(count: int, total: int, row: tuple[float, float, float]) -> None:
        done.append(count)
        if method == "interrupt" and count == 6:
            raise KeyboardInterrupt

    stop = (lambda: len(done) == 3) if method == "stop" else None
    asset = bake(Kinked(), ball(), 1, 2, 4, samples=64, out=tmp_path / "a.h5", progress=progress, stop=stop)
    whole = bake(Kinked(), ball(), 1, 2, 4, samples=64)
    assert not asset.complete
    assert asset.provenance["vertices_baked"] == 6
    np.testing.assert_array_equal(np.flatnonzero(asset.valid), np.arange(6))
    np.testing.assert_allclose(asset.coefficients[:6], whole.coefficients[:6], rtol=1e-3, atol=1e-4)
    asset.close()


def test_file_and_array_are_equal(tmp_path: Path) -> None:
    mesh = ball()
    out = tmp_path / "asset.h5"
    asset = bake(Kinked(), mesh, 2, 2, 32, out=out, storage="float32", provenance={"command": "prtbake bake"})
    array = bake(Kinked(), mesh, 2, 2, 32)
    np.testing.assert_array_equal(asset.coefficients[:], array.coefficients)
    np.testing.assert_array_equal(asset.standard_error, array.standard_error)
    assert asset.provenance["command"] == "prtbake bake"
    np.testing.assert_allclose(asset.selftest["radiance"], array.selftest["radiance"], rtol=1e-6)
    asset.close()


def test_the_selftest_is_bilinear_interpolation() -> None:
    asset = bake(Kinked(), ball(), 2, 4, 8)
    vertex = asset.selftest["vertex"]
    local = sphere.to_local(asset.selftest["outgoing"], asset.mesh.normals[vertex], asset.tangents[vertex])
    by_bin = np.einsum("nbkc,kc->nbc", asset.coefficients[vertex], asset.selftest["light"])
    expected = np.einsum("nb,nbc->nc", sphere.bin_matrix(local, 4, 8), by_bin)
    np.testing.assert_allclose(asset.selftest["radiance"], expected, atol=1e-6 * np.abs(expected).max())


def test_a_failing_transport_leaves_an_existing_file_unchanged(tmp_path: Path) -> None:
    class Failing(Kinked):
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            raise RuntimeError("lamp is out")

    out = tmp_path / "asset.h5"
    out.write_bytes(b"older")
    with pytest.raises(RuntimeError, match="lamp is out"):
        bake(Failing(), ball(), 1, 2, 4, out=out)
    assert out.read_bytes() == b"older"
    assert [path.name for path in tmp_path.iterdir()] == ["asset.h5"]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"directions": "random"}, "fibonacci, sobol, uniform"),
        ({"samples": 8}, "degree 2 has 9 coefficients"),
        ({"samples": 0}, "at least 1"),
        ({"storage": "float64"}, "float16, float32"),
        ({"precision": "bfloat16"}, "only be baked with precision float32"),
        ({"device": "cuda"}, "on the cpu"),
        ({"rings": 0}, "ring"),
        ({"degree": -1}, "degree"),
    ],
)
def test_arguments_out_of_their_domain_raise(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(QueryError, match=sentence):
        bake(Kinked(), ball(6), **({"rings": 2, "sectors": 4} | change))


def test_the_plan_agrees_with_the_bake() -> None:
    mesh = ball()
    expected = plan(Kinked(), mesh, 2, 2, 4, samples=64)
    asset = bake(Kinked(), mesh, 2, 2, 4, samples=64)
    assert expected.evaluations == asset.provenance["evaluations"]
    assert expected.raw_bytes == asset.coefficients.size * 2
    assert expected.seconds is not None
    assert expected.seconds > 0


def test_the_thread_count_of_torch_is_restored() -> None:
    import torch

    before = torch.get_num_threads()
    inside: list[int] = []

    class Recording(Kinked):
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            inside.append(torch.get_num_threads())
            return super().evaluate(incident, positions, outgoing)

    bake(Recording(), ball(6), 1, 1, 4)
    assert set(inside) == {1}
    assert torch.get_num_threads() == before


def test_the_error_ladder_has_cost_and_error_of_each_number_of_directions() -> None:
    mesh = ball()
    rows = error_ladder(Kinked(), mesh, rings=4, sectors=32, samples=(18, 64, 256))
    assert rows[:, 1].tolist() == [len(mesh.positions) * 4 * 32 * samples for samples in (18, 64, 256)]
    assert (np.diff(rows[:, 2]) < 0).all()
    assert (rows[:, 0] > 0).all()
    whole = bake(Kinked(), mesh, rings=4, sectors=32, samples=64)
    assert rows[1, 2] == pytest.approx(whole.provenance["estimated_relative_rmse"]["total"], rel=0.5)


def test_the_error_ladder_ends_where_more_directions_change_nothing() -> None:
    rows = error_ladder(Banded(2), ball(), rings=4, sectors=8, samples=(18, 64, 256))
    assert len(rows) == 1
    assert rows[0, 2] < 1e-5


def test_a_partial_asset_never_replaces_a_complete_one(tmp_path: Path) -> None:
    out = tmp_path / "ball.h5"
    mesh = ball(200)
    bake(Kinked(), mesh, rings=2, sectors=4, samples=18, out=out).close()
    before = out.read_bytes()
    with pytest.raises(QueryError, match="nothing was written"):
        bake(Kinked(), mesh, rings=2, sectors=4, samples=18, out=out, stop=lambda: True)
    assert [path.name for path in tmp_path.iterdir()] == ["ball.h5"]
    seen: list[int] = []
    part = bake(
        Banded(2),
        mesh,
        samples=64,
        out=out,
        progress=lambda done, total, row: seen.append(done),
        stop=lambda: bool(seen),
    )
    part.close()
    assert not part.complete
    assert 0 < part.valid.sum() < len(mesh.positions)
    assert out.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.h5", "ball.h5.journal", "partial-ball.h5"]
    bake(Kinked(), mesh, rings=2, sectors=4, samples=20, out=out).close()
    assert out.read_bytes() != before


def test_a_mesh_outside_the_box_of_the_model_raises() -> None:
    mesh = ball()
    network = NeuralBSSRDF(NetworkSettings(features=4, width=4, layers=2, skips=()), mesh.positions.min(axis=0), 2.0)
    far = build_mesh(mesh.positions + np.array([0.0, 3.0, 0.0]), mesh.faces)
    with pytest.raises(QueryError, match=r"14 of 14 vertices lie outside the box .* number 0, "):
        bake(network, far, rings=1, sectors=1)
    assert bake(network, mesh, rings=1, sectors=1).complete
