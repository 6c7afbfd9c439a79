"""Bakes with a fixed number of samples: exact projection, correct errors, horizons, and three interfaces."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from bakers.baker import Block, Sampling, Task, bake_block, block_size, cuts
from bakers.error_estimate import (
    choose_estimator,
    half_buffer_variance,
    neighbour_errors,
    unreliable_vertices,
    validated_variance,
)
from bakers.horizon import LOWEST_COSINE, clamp_to_horizon, vertex_faces
from bakers.in_order import in_order
from bakers.path_traced import WALKS_AT_ONCE, Walks
from bakers.plan import vertices_at_once
from bakers.projection import DirectionPool, direction_pool, project, residual_variance
from bakers.transport import as_radiance, transport_kind
from formats.errors import QueryError
from prt_bake.mathematics import sh, sphere

Array = NDArray[np.float64]


def lattice_pool(directions: int, degree: int, copies: int = 8, fitted: bool = True) -> DirectionPool:
    turned = np.einsum("rij,dj->rdi", sphere.random_rotations(copies, 1), sphere.fibonacci(directions))
    return direction_pool(turned, sh.evaluate(turned, degree), fitted)


@pytest.mark.parametrize(("degree", "directions"), [(0, 1), (2, 9), (2, 64), (5, 72), (8, 162)])
def test_fitted_weights_reproduce_band_limited_functions(degree: int, directions: int) -> None:
    pool = lattice_pool(directions, degree)
    rng = np.random.default_rng(1)
    a = rng.normal(size=(3, 4, sh.count(degree), 3))
    rotation = rng.integers(0, 8, (3, 4))
    values = sh.evaluate(pool.incident, degree)[rotation] @ a
    np.testing.assert_allclose(project(values, pool, rotation), a, atol=1e-12 * pool.condition)


def test_fitted_weights_are_unbiased_for_higher_degrees() -> None:
    """Over rotations uniform on SO(3) harmonics of degree 3 and 4 do not leak into degrees 0 to 2."""
    pool = lattice_pool(16, 2, copies=4096)
    leaked = pool.weights @ sh.evaluate(pool.incident, 4)[..., 9:]
    deviation = leaked.mean(axis=0) / (leaked.std(axis=0) / np.sqrt(len(leaked)))
    assert np.abs(deviation).max() < 4.5
    assert 0.8 < deviation.std() < 1.2


def test_equal_weights_are_plain_monte_carlo() -> None:
    pool = lattice_pool(5, 1, fitted=False)
    values = np.random.default_rng(2).normal(size=(1, 1, 5, 3))
    rotation = np.array([[3]])
    expected = 4 * np.pi / 5 * np.einsum("dk,dc->kc", sh.evaluate(pool.incident[3], 1), values[0, 0])
    np.testing.assert_allclose(project(values, pool, rotation)[0, 0], expected, atol=1e-14)
    assert pool.condition == 1.0


def test_too_few_directions_are_refused_and_exactly_enough_have_an_unknown_error() -> None:
    with pytest.raises(QueryError, match="8 directions cannot determine 9"):
        lattice_pool(8, 2)
    pool = lattice_pool(9, 2)
    rotation = np.zeros((1, 1), dtype=np.int64)
    values = np.random.default_rng(3).normal(size=(1, 1, 9, 3))
    a = project(values, pool, rotation)
    np.testing.assert_allclose(residual_variance(values, a, pool, rotation), (a**2).mean(axis=(2, 3)))


def test_directions_on_one_circle_are_refused() -> None:
    phi = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    circle = np.stack([np.cos(phi), np.sin(phi), 0 * phi], axis=-1)[None]
    with pytest.raises(QueryError, match="condition number"):
        direction_pool(circle, sh.evaluate(circle, 2), True)


def test_residual_variance_is_unbiased_for_independent_errors() -> None:
    """White noise of known size: the estimate's mean is the variance that the coefficients then have."""
    pool = lattice_pool(24, 2)
    rng = np.random.default_rng(4)
    rotation = rng.integers(0, 8, (20, 200))
    values = 0.3 * rng.normal(size=(20, 200, 24, 3))
    a = project(values, pool, rotation)
    assert residual_variance(values, a, pool, rotation).mean() == pytest.approx((a**2).mean(), rel=0.03)


@pytest.mark.parametrize("sectors", [32, 64])
def test_neighbour_errors_contain_the_noise_and_not_the_signal(sectors: int) -> None:
    rng = np.random.default_rng(5)
    phi = 2 * np.pi * (np.arange(sectors) + 0.5) / sectors
    signal = (1.0 + 0.5 * np.cos(phi) + 0.2 * np.sin(2 * phi))[None, None, :, None, None]
    signal = np.broadcast_to(signal, (50, 2, sectors, 9, 3)).reshape(50, 2 * sectors, 9, 3)
    noise = 0.01 * rng.normal(size=signal.shape)
    estimate = neighbour_errors(signal + noise, sectors)
    assert estimate.shape == signal.shape
    assert (estimate**2).mean() == pytest.approx(1e-4, rel=0.03)
    assert (neighbour_errors(signal, sectors) ** 2).mean(axis=(2, 3)).max() < 1e-6


def test_validation_bins_replace_the_neighbour_estimate_where_it_contains_signal() -> None:
    rng = np.random.default_rng(7)
    rough = np.full((3, 64), 4.0) * rng.uniform(0.5, 2.0, (3, 64))
    neighbours = np.outer([0.1, 3.0, 3.0], np.ones(64)) * rough.mean(axis=1, keepdims=True)
    assert unreliable_vertices(neighbours, rough, 64).tolist() == [1, 2]
    assert unreliable_vertices(neighbours, rough, 256).tolist() == [0, 1, 2]
    assert unreliable_vertices(neighbours / 2.5, rough, 0).tolist() == []
    at = np.tile(np.arange(0, 64, 16), (3, 1))
    # The first two pairs agree with the neighbours; the third has a hundredth of the residual.
    pairs = np.array([neighbours[0].mean(), neighbours[1].mean(), 0.04])
    found = validated_variance(pairs, neighbours, rough, at)
    np.testing.assert_array_equal(found[:2], neighbours[:2])
    assert found[2, at[2]].mean() == pytest.approx(0.04)
    np.testing.assert_allclose(found[2] / rough[2], found[2, 0] / rough[2, 0])
    assert (validated_variance(np.zeros(3), neighbours, 0.0 * rough, at) == 0.0).all()


@pytest.mark.parametrize("sectors", [1, 2, 8])
def test_half_buffer_variance_is_that_of_the_mean(sectors: int) -> None:
    rng = np.random.default_rng(6)
    first, second = 0.1 * rng.normal(size=(2, 100, 2 * sectors, 9, 3))
    estimate = half_buffer_variance((first - second) / 2, np.ones((100, 2 * sectors)), sectors)
    assert estimate.shape == (100, 2 * sectors)
    assert estimate.mean() == pytest.approx((((first + second) / 2) ** 2).mean(), rel=0.05)


def test_the_best_possible_estimator_is_chosen() -> None:
    assert choose_estimator(64, 9, 9, fitted=True) == "neighbours"
    assert choose_estimator(8, 64, 9, fitted=True) == "halves"
    assert choose_estimator(1, 162, 81, fitted=True) == "residual"
    assert choose_estimator(1, 2, 81, fitted=False) == "halves"


def test_directions_below_every_face_are_clamped() -> None:
    """An octahedron's vertices, all directions: only those below all four faces move, in the plane of the normal."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    edges = corners[faces]
    normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    around = vertex_faces(6, faces, normals)
    outgoing = np.broadcast_to(sphere.uniform(300, 1), (6, 300, 3)).copy()
    outgoing[0, 0] = -normals[0]
    clamped, count = clamp_to_horizon(outgoing[2:4], around, np.array([2, 3]))
    for vertex in (2, 3):
        own = normals[(faces == vertex).any(axis=1)]
        cosines = outgoing[vertex] @ own.T
        below = cosines.max(axis=1) <= 0
        highest = own[cosines.argmax(axis=1)]
        moved = clamped[vertex - 2]
        np.testing.assert_array_equal(moved[~below], outgoing[vertex][~below])
        np.testing.assert_allclose((moved * highest).sum(axis=1)[below], LOWEST_COSINE, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1, atol=1e-12)
        plane = np.cross(outgoing[vertex], highest)[below]
        assert np.abs((plane * moved[below]).sum(axis=1)).max() < 1e-12
        count -= below.sum()
    assert count == 0


def test_the_inverted_normal_is_clamped_and_a_lone_vertex_has_no_horizon() -> None:
    around = vertex_faces(4, np.array([[0, 1, 2]]), np.array([[0.0, 0.0, 1.0]]))
    down = np.array([[[0.0, 0.0, -1.0]], [[0.0, 0.6, -0.8]]])
    clamped, count = clamp_to_horizon(down, around, np.array([2, 3]))
    assert count == 1
    assert clamped[0, 0, 2] == pytest.approx(LOWEST_COSINE)
    np.testing.assert_array_equal(clamped[1], down[1])


class Lobed:
    """Ŝ = exp(ωi·ωo) (1 + x), in three channels."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        cosine = np.einsum(
            "...di,...i->...d", np.broadcast_to(incident, (len(positions), *incident.shape[-2:])), outgoing
        )
        return np.exp(cosine)[..., None] * (1 + positions)[:, None, :]


class LobedInBlocks(Lobed):
    """The same with the block interface."""

    def evaluate_block(self, incident: Array, rotation: NDArray[np.int64], positions: Array, outgoing: Array) -> Array:
        cosine = np.einsum("nbdi,nbi->nbd", incident[rotation], outgoing)
        return np.exp(cosine)[..., None] * (1 + positions)[:, None, None, :]


@dataclass
class Estimate:
    mean: Array
    standard_error: Array


class Walker:
    """Returns its arguments as coefficients."""

    def estimate_coefficients(self, positions: Array, outgoing: Array, degree: int, paths: int, seed: int) -> Estimate:
        mean = np.zeros((len(positions), (degree + 1) ** 2, 3))
        mean[:, 0] = positions
        mean[:, 1] = outgoing
        mean[:, 2] = seed
        return Estimate(mean, np.full_like(mean, 1 / paths))


def task(transport: Any, vertices: int = 7, rings: int = 2, sectors: int = 32, sampling: Any = None) -> Task:
    rng = np.random.default_rng(8)
    local = sphere.view_bins(rings, sectors)

    def outgoing(vertices: NDArray[np.int64]) -> tuple[Array, int]:
        return np.broadcast_to(local, (len(vertices), *local.shape)), len(vertices)

    def rotation(first: int, last: int) -> NDArray[np.int64]:
        return (np.arange(first, last)[:, None] + np.arange(len(local))) % 8

    sampling = sampling or Sampling(lattice_pool(16, 1), rotation, None, "neighbours")
    return Task(transport, rng.uniform(size=(vertices, 3)), outgoing, len(local), sectors, sampling)


def test_interfaces_are_detected_by_their_methods() -> None:
    assert transport_kind(Lobed()) == "evaluate"
    assert transport_kind(LobedInBlocks()) == "block"
    assert transport_kind(Walker()) == "coefficients"
    with pytest.raises(QueryError, match="object cannot be baked"):
        transport_kind(object())


def test_evaluate_and_evaluate_block_agree() -> None:
    plain, fused = bake_block(task(Lobed()), 0, 7), bake_block(task(LobedInBlocks()), 0, 7)
    np.testing.assert_allclose(plain.coefficients, fused.coefficients, rtol=1e-6)
    np.testing.assert_allclose(plain.standard_error, fused.standard_error, rtol=1e-3)


def test_walks_are_seeded_by_vertex_and_their_errors_are_kept() -> None:
    block = bake_block(task(Walker(), sampling=Walks(1, 50, lambda vertex: 10 * vertex)), 2, 4)
    np.testing.assert_allclose(block.coefficients[:, 0, 2, 0], [20, 30])
    np.testing.assert_allclose(block.standard_error, 0.02, rtol=1e-6)


def in_blocks(work: Task, vertices: int, workers: int) -> Generator[Block, None, None]:
    return in_order(lambda cut: bake_block(work, *cut), cuts(work, np.arange(vertices)), workers)


def test_cuts_contain_only_the_requested_vertices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bakers.baker.vertices_at_once", lambda bins, directions: 2)
    assert cuts(task(LobedInBlocks()), np.array([0, 1, 2, 5, 6])) == [(0, 2), (2, 3), (5, 7)]
    assert cuts(task(LobedInBlocks()), np.zeros(0, np.int64)) == []


@pytest.mark.parametrize("workers", [1, 3])
def test_blocks_are_in_order_and_do_not_depend_on_workers_or_cuts(
    workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    single = bake_block(task(LobedInBlocks()), 0, 7)
    monkeypatch.setattr("bakers.baker.vertices_at_once", lambda bins, directions: 2)
    blocks = list(in_blocks(task(LobedInBlocks()), 7, workers))
    assert [block.first_vertex for block in blocks] == [0, 2, 4, 6]
    np.testing.assert_array_equal(np.concatenate([block.coefficients for block in blocks]), single.coefficients)
    np.testing.assert_array_equal(np.concatenate([block.standard_error for block in blocks]), single.standard_error)
    assert sum(block.clamped for block in blocks) == 7


@pytest.mark.parametrize("workers", [1, 2])
def test_exceptions_of_a_transport_propagate(workers: int) -> None:
    class Broken(Lobed):
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            raise RuntimeError("transport failed")

    with pytest.raises(RuntimeError, match="transport failed"):
        list(in_blocks(task(Broken()), 7, workers))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_vertices_that_are_not_finite_are_marked_and_the_others_are_baked(value: float) -> None:
    class Cracked(Lobed):
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            result = super().evaluate(incident, positions, outgoing)
            result[positions[:, 0] == bad, 3, 1] = value
            return result

    sound = bake_block(task(Lobed()), 0, 7)
    cracked = task(Cracked())
    bad = cracked.positions[4, 0]
    block = bake_block(cracked, 0, 7)
    np.testing.assert_array_equal(np.flatnonzero(~block.valid), [4])
    np.testing.assert_array_equal(block.coefficients[:4], sound.coefficients[:4])
    assert not block.coefficients[4].any()
    assert not block.standard_error[4].any()


def test_torch_results_are_converted() -> None:
    result = as_radiance(torch.ones((2, 1, 3), dtype=torch.bfloat16, requires_grad=True), (2, 1, 3), "evaluate")
    np.testing.assert_array_equal(result, 1)


@pytest.mark.parametrize("result", [np.ones((2, 3)), np.ones((2, 1, 3), dtype=complex), None, "light"])
def test_results_of_another_shape_are_refused(result: object) -> None:
    with pytest.raises(QueryError, match=r"the transport's evaluate.* expected (real numbers|an array of numbers)"):
        as_radiance(result, (2, 1, 3), "evaluate")


def test_a_block_has_at_least_one_vertex() -> None:
    assert vertices_at_once(1024, 64) >= 1
    assert vertices_at_once(1 << 20, 1 << 14) == 1
    assert block_size(task(Walker(), sampling=Walks(1, WALKS_AT_ONCE // 64 // 3, int))) == 3
    assert block_size(task(Walker(), sampling=Walks(1, 1 << 20, int))) == 1


def test_the_iterator_can_be_closed_early() -> None:
    calls: list[int] = []

    class Counting(Lobed):
        def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
            calls.append(len(positions))
            return super().evaluate(incident, positions, outgoing)

    blocks = in_blocks(task(Counting(), vertices=4, sampling=None), 4, 1)
    next(blocks)
    blocks.close()
    assert len(calls) == 1
