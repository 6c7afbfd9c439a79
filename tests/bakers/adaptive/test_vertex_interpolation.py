"""Interpolation of vertices: exact for quadratic functions, whatever the orientation of the tangent frames."""

import numpy as np
import pytest

from bakers.adaptive.vertex_interpolation import (
    Parents,
    VertexInterpolator,
    cubic_taps,
    one_per_cell,
    rotated_with_normal,
)
from prt_bake.baking.adaptive.interpolation_kernel import interpolated_from
from prt_bake.mathematics import sphere
from prt_bake.mathematics.random import hashed
from tests.bakers.transports import icosphere

Array = np.ndarray


def plane(count: int, seed: int = 0) -> tuple[Array, Array, Array]:
    """Positions on a plane, the normal, and tangents in any direction."""
    rng = np.random.default_rng(seed)
    flat = rng.random((count, 2))
    angle = rng.random(count) * 2.0 * np.pi
    zero = np.zeros(count)
    tangents = np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    return np.column_stack([flat, zero]), np.tile([0.0, 0.0, 1.0], (count, 1)), tangents


def rotated_sectors(values: Array, angle: float) -> Array:
    """Values [R,S,...] over rings and sectors, at azimuths larger by `angle`: cubic interpolation of four sectors."""
    whole, taps = cubic_taps(angle, values.shape[1])
    out = np.zeros_like(values)
    for step, weight in enumerate(taps):
        if weight != 0.0:
            out += values.dtype.type(weight) * np.roll(values, -(whole + step - 1), axis=1)
    return out


def interpolated(values: Array, parents: Parents, row: int) -> tuple[Array, Array]:
    """Values [B,C] of the vertex in that row and their variance [B] (mean over C), from the parents' shifted values
    [P,B,C]. The variance is estimated from the residuals: the parents' noise, and what is not quadratic about them.
    """
    flat = values.reshape(len(values), -1).astype(np.float64)
    function = parents.fit[row] @ flat
    residuals = flat - parents.terms[row] @ function
    residuals *= residuals
    squared = (parents.fit_weights[row] @ residuals).reshape(values.shape[1:]).mean(axis=-1)
    gain = (parents.weights[row] ** 2).sum() / parents.residual_freedom[row]
    return function[0].reshape(values.shape[1:]), gain * squared


def test_quadratic_functions_on_a_plane_are_interpolated_exactly() -> None:
    known, wanted = plane(400), plane(50, seed=1)
    parents = VertexInterpolator(*known).parents(*wanted)
    inside = (np.abs(wanted[0][:, :2] - 0.5) < 0.35).all(axis=1)
    assert parents.usable[inside].all()
    np.testing.assert_allclose(parents.weights.sum(axis=1), 1.0, atol=1e-9)

    def field(places: Array) -> Array:
        x, y = places[:, 0], places[:, 1]
        return np.stack([2.0 + x - 3.0 * y, x * y - y * y, 5.0 * x * x], axis=1)

    values = field(known[0])
    for row in np.flatnonzero(parents.usable):
        found, variance = interpolated(values[parents.indices[row]][:, None], parents, row)
        np.testing.assert_allclose(found[0], field(wanted[0])[row], atol=1e-6)
        assert variance[0] < 1e-12


def test_noise_is_estimated_from_the_residuals() -> None:
    known, wanted = plane(600), plane(200, seed=1)
    parents = VertexInterpolator(*known).parents(*wanted)
    noisy = np.random.default_rng(2).normal(1.0, 0.1, (600, 8, 27))
    rows = np.flatnonzero(parents.usable)
    found = [interpolated(noisy[parents.indices[row]], parents, row) for row in rows]
    squared = np.mean([((values - 1.0) ** 2).mean() for values, _variance in found])
    stated = np.mean([variance.mean() for _values, variance in found])
    assert stated == pytest.approx(squared, rel=0.1)
    assert squared < 0.5 * 0.1**2


def test_a_step_between_the_parents_has_a_large_variance() -> None:
    known, wanted = plane(600), plane(100, seed=1)
    parents = VertexInterpolator(*known).parents(*wanted)
    step = (known[0][:, 0] > 0.5).astype(float)[:, None, None]
    rows = np.flatnonzero(parents.usable)
    variance = np.array([interpolated(step[parents.indices[row]], parents, row)[1][0] for row in rows])
    near = np.abs(wanted[0][rows, 0] - 0.5) < 0.03
    far = np.abs(wanted[0][rows, 0] - 0.5) > 0.3
    assert variance[near].min() > 1e-3
    assert variance[far].max() < 1e-12


def test_parents_are_on_the_same_side_of_a_thin_sheet() -> None:
    one = plane(300)
    other = plane(300, seed=3)
    both = [np.concatenate(pair) for pair in zip(one, other, strict=True)]
    both[0][300:, 2], both[1][300:] = -1e-3, [0.0, 0.0, -1.0]
    parents = VertexInterpolator(*both).parents(*plane(50, seed=1))
    assert parents.usable.sum() > 30
    assert (parents.indices[parents.usable] < 300).all()


@pytest.mark.parametrize("count", [1, 5, 8])
def test_too_few_parents_are_not_usable(count: int) -> None:
    assert not VertexInterpolator(*plane(count)).parents(*plane(4, seed=1)).usable.any()


def test_parents_along_a_line_are_not_usable() -> None:
    known = plane(200)
    known[0][:, 1] = 0.5
    assert not VertexInterpolator(*known).parents(*plane(20, seed=1)).usable.any()


def test_vertices_are_not_extrapolated() -> None:
    wanted = plane(20, seed=1)
    wanted[0][:, 0] += 1.0
    assert not VertexInterpolator(*plane(400)).parents(*wanted).usable.any()


def test_one_vertex_per_cell_is_chosen_whatever_their_order() -> None:
    mesh = icosphere(4)
    order = hashed(7, 0, np.arange(len(mesh.positions)))
    chosen = one_per_cell(mesh.positions, mesh.normals, 0.2, order)
    assert 4 < len(chosen) / chosen.sum() < 8
    shuffled = np.random.default_rng(0).permutation(len(chosen))
    again = one_per_cell(mesh.positions[shuffled], mesh.normals[shuffled], 0.2, order[shuffled])
    np.testing.assert_array_equal(again, chosen[shuffled])


def test_rotation_is_exact_by_whole_sectors_and_accurate_by_fractions() -> None:
    phi = (np.arange(64) + 0.5) / 64 * 2.0 * np.pi
    values = np.stack([np.cos(3.0 * phi), np.exp(np.sin(phi))])[..., None]
    for steps in (-65, -1, 0, 5):
        np.testing.assert_array_equal(
            rotated_sectors(values, steps * 2.0 * np.pi / 64), np.roll(values, -steps, axis=1)
        )
    other = np.stack([np.cos(3.0 * (phi + 0.3)), np.exp(np.sin(phi + 0.3))])[..., None]
    np.testing.assert_allclose(rotated_sectors(values, 0.3), other, atol=3e-4)


def test_functions_of_the_view_are_interpolated_across_the_pole_of_frames() -> None:
    """Around the pole of the tangent frames: functions of the world direction to the eye alone."""
    mesh, rings, sectors = icosphere(4), 8, 64
    tangents = sphere.tangent_frame(mesh.normals)
    local = sphere.view_bins(rings, sectors)
    world = sphere.to_world(local, mesh.normals[:, None], tangents[:, None])
    values = np.stack([world[..., 0], world[..., 1] * world[..., 2]], axis=-1)
    known = np.arange(len(values)) % 3 > 0
    parents = VertexInterpolator(mesh.positions[known], mesh.normals[known], tangents[known]).parents(
        mesh.positions[~known], mesh.normals[~known], tangents[~known]
    )
    assert parents.usable.all()
    by_bin = values[known].reshape(-1, rings, sectors, 2)
    for row in range(0, int((~known).sum()), 5):
        own = [
            rotated_sectors(by_bin[p], t)
            for p, t in zip(parents.indices[row], parents.azimuth_shifts[row], strict=True)
        ]
        found, _variance = interpolated(np.stack(own).reshape(len(own), -1, 2), parents, row)
        np.testing.assert_allclose(found, values[~known][row], atol=5e-3)


def test_vectors_are_rotated_with_the_normal() -> None:
    rng = np.random.default_rng(0)
    start, end = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 20, 3)))
    np.testing.assert_allclose(rotated_with_normal(start, start, end), end, atol=1e-12)
    axis = np.cross(start, end)
    np.testing.assert_allclose(rotated_with_normal(axis, start, end), axis, atol=1e-12)


@pytest.mark.parametrize("grid", [(4, 16), (2, 1), (1, 3)])
def test_the_kernel_equals_rotation_and_interpolation(grid: tuple[int, int]) -> None:
    known, wanted = plane(60), plane(6, seed=1)
    parents = VertexInterpolator(*known).parents(*wanted)
    values = np.random.default_rng(4).normal(size=(60, *grid, 6)).astype(np.float32)
    rows = np.flatnonzero(parents.usable)
    assert len(rows)
    for row in rows:
        pairs = zip(parents.indices[row], parents.azimuth_shifts[row], strict=True)
        own = np.stack([rotated_sectors(values[p].astype(float), t) for p, t in pairs])
        expected, variance = interpolated(own.reshape(len(own), -1, 6), parents, row)
        found, estimated = interpolated_from(values, parents.indices[row], parents, row)
        np.testing.assert_allclose(found, expected, atol=1e-12)
        np.testing.assert_allclose(estimated, variance, rtol=1e-10)
