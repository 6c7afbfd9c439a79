"""View bins, interpolation between them, and tangent frames."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from formats.errors import QueryError
from prt_bake.mathematics import sphere

SIZES = [(16, 64), (1, 1), (1, 5), (3, 1), (2, 2), (4, 7)]


def hemisphere(count: int, seed: int) -> NDArray[np.float64]:
    directions = sphere.uniform(count, seed)
    directions[:, 2] = np.abs(directions[:, 2])
    return directions


def direction(cos_theta: float, phi: float) -> NDArray[np.float64]:
    sin_theta = math.sqrt(max(0.0, 1 - cos_theta**2))
    return np.array([sin_theta * math.cos(phi), sin_theta * math.sin(phi), cos_theta])


def interpolated(values: NDArray[np.float64], local: NDArray[np.float64]) -> float:
    """The interpolation by definition, one direction at a time: values [rings, sectors]."""
    rings, sectors = values.shape
    phi = math.atan2(local[1], local[0]) % (2 * math.pi)

    def around(ring: int) -> float:
        place = phi * sectors / (2 * math.pi) - 0.5
        low = math.floor(place)
        share = place - low
        return float((1 - share) * values[ring, low % sectors] + share * values[ring, (low + 1) % sectors])

    centres: list[float] = [1 - (i + 0.5) / rings for i in range(rings)]
    cos_theta = float(local[2])
    if cos_theta >= centres[0]:
        share = (1 - cos_theta) / (1 - centres[0])
        return (1 - share) * float(values[0].mean()) + share * around(0)
    if cos_theta <= centres[-1]:
        return around(rings - 1)
    ring = next(i for i in range(rings - 1) if centres[i] >= cos_theta >= centres[i + 1])
    share = (centres[ring] - cos_theta) / (centres[ring] - centres[ring + 1])
    return (1 - share) * around(ring) + share * around(ring + 1)


@pytest.mark.parametrize(("rings", "sectors"), SIZES)
def test_bins_have_the_directions_of_their_centres_in_ring_major_order(rings: int, sectors: int) -> None:
    bins = sphere.view_bins(rings, sectors)
    assert bins.shape == (rings * sectors, 3)
    for i in range(rings):
        for j in range(sectors):
            expected = direction(1 - (i + 0.5) / rings, 2 * math.pi * (j + 0.5) / sectors)
            np.testing.assert_allclose(bins[sectors * i + j], expected, atol=1e-15)


@pytest.mark.parametrize(("rings", "sectors"), [(16, 64), (4, 7), (1, 5)])
def test_bins_have_equal_solid_angle(rings: int, sectors: int) -> None:
    """Each bin has the largest weight for 6 × 6 fine cells of equal solid angle."""
    cos_theta = 1 - (np.arange(6 * rings) + 0.5) / (6 * rings)
    phi = 2 * math.pi * (np.arange(6 * sectors) + 0.5) / (6 * sectors)
    cells = np.stack([direction(c, p) for c in cos_theta for p in phi])
    nearest = sphere.bin_matrix(cells, rings, sectors).argmax(axis=1)
    np.testing.assert_array_equal(np.bincount(nearest, minlength=rings * sectors), 36)


@pytest.mark.parametrize(("rings", "sectors"), SIZES)
def test_interpolation_agrees_with_its_definition(rings: int, sectors: int) -> None:
    directions = hemisphere(400, seed=1)
    values = np.random.default_rng(2).normal(size=(rings, sectors))
    expected = [interpolated(values, local) for local in directions]
    matrix = sphere.bin_matrix(directions, rings, sectors)
    np.testing.assert_allclose(matrix @ values.ravel(), expected, atol=1e-12)
    at = sphere.bin_coordinates(directions, rings, sectors)
    low, high = (
        (1 - at.sector_weight) * values[ring, at.sector_low] + at.sector_weight * values[ring, at.sector_high]
        for ring in (at.ring_low, at.ring_high)
    )
    between = (1 - at.ring_weight) * low + at.ring_weight * high
    by_coordinates = (1 - at.pole_weight) * between + at.pole_weight * values[0].mean()
    np.testing.assert_allclose(by_coordinates, expected, atol=1e-12)


@pytest.mark.parametrize(("rings", "sectors"), SIZES)
def test_weights_are_a_partition_of_unity(rings: int, sectors: int) -> None:
    directions = np.concatenate([sphere.uniform(2_000, 3), sphere.view_bins(rings, sectors), np.eye(3), -np.eye(3)])
    bins, weights = sphere.bin_weights(directions, rings, sectors)
    assert bins.shape == weights.shape
    assert bins.min() >= 0
    assert bins.max() < rings * sectors
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-14)


@pytest.mark.parametrize(("rings", "sectors"), SIZES)
def test_interpolation_at_a_bin_s_centre_is_its_value(rings: int, sectors: int) -> None:
    matrix = sphere.bin_matrix(sphere.view_bins(rings, sectors), rings, sectors)
    np.testing.assert_allclose(matrix, np.eye(rings * sectors), atol=1e-12)


def test_four_weights_suffice_away_from_the_pole() -> None:
    away = np.stack([direction(0.95, phi) for phi in np.linspace(0, 6, 20)])
    assert sphere.bin_weights(away, 16, 64)[0].shape == (20, 4)
    assert sphere.bin_weights([[0, 0, 1]], 16, 64)[0].shape == (1, 68)


@pytest.mark.parametrize(("rings", "sectors"), SIZES)
def test_pole_has_one_value_from_every_azimuth(rings: int, sectors: int) -> None:
    values = np.random.default_rng(4).normal(size=rings * sectors)
    azimuths = 2 * math.pi * np.arange(64) / 64
    approach = np.stack([np.cos(azimuths) * 1e-8, np.sin(azimuths) * 1e-8, np.full(64, math.sqrt(1 - 1e-16))], axis=-1)
    at_pole = values[:sectors].mean()
    np.testing.assert_allclose(sphere.bin_matrix(approach, rings, sectors) @ values, at_pole, atol=1e-12)
    signed_zeros = [[0.0, 0.0, 1.0], [-0.0, 0.0, 1.0], [0.0, -0.0, 1.0], [-0.0, -0.0, 1.0]]
    np.testing.assert_allclose(sphere.bin_matrix(signed_zeros, rings, sectors) @ values, at_pole, atol=1e-14)


def test_interpolation_is_linear_from_the_pole_to_the_first_ring() -> None:
    values = np.random.default_rng(5).normal(size=16 * 64)
    heights = 1 - np.linspace(0, 0.5 / 16, 9)
    profile = sphere.bin_matrix([direction(h, 2.0) for h in heights], 16, 64) @ values
    np.testing.assert_allclose(np.diff(profile, 2), 0, atol=1e-12)
    assert abs(profile[-1] - profile[0]) > 0.1


@pytest.mark.parametrize("cos_theta", [0.99, 0.7, 0.01])
def test_azimuth_wraps(cos_theta: float) -> None:
    values = np.random.default_rng(6).normal(size=16 * 64)
    for seam in (0.0, math.pi, -math.pi):
        sides = [direction(cos_theta, seam + step) for step in (-1e-14, 1e-14)]
        left, right = sphere.bin_matrix(sides, 16, 64) @ values
        assert abs(left - right) < 1e-11
    half_way = sphere.bin_matrix([direction(1 - 0.5 / 16, 0.0)], 16, 64)[0]
    np.testing.assert_allclose(half_way[[0, 63]], 0.5, atol=1e-12)


def test_grazing_directions_are_clamped() -> None:
    values = np.random.default_rng(7).normal(size=16 * 64)
    last = sphere.bin_matrix([direction(0.5 / 16, 1.0)], 16, 64) @ values
    for cos_theta in (0.4 / 16, 1e-9, 0.0, -0.3, -1 + 1e-9):
        np.testing.assert_allclose(sphere.bin_matrix([direction(cos_theta, 1.0)], 16, 64) @ values, last, atol=1e-12)


def test_interpolation_is_continuous_everywhere() -> None:
    """Small steps change the value by at most the steepest slope between bins."""
    values = np.random.default_rng(8).uniform(-1, 1, size=16 * 64)
    start = hemisphere(20_000, seed=9)
    step = 1e-7 * sphere.uniform(20_000, 10)
    end = (start + step) / np.linalg.norm(start + step, axis=-1, keepdims=True)
    change = np.abs((sphere.bin_matrix(end, 16, 64) - sphere.bin_matrix(start, 16, 64)) @ values)
    # Values differ by at most 2: slope 2·16 per unit of cosθ, twice that above ring 0, and 2·64/2π per radian of φ. A
    # step changes φ by step/sinθ, most at ring 0; above it the effect of φ falls with 1 − cosθ, faster than sinθ.
    slope = 2 * 2 * 16 + 2 * 64 / (2 * math.pi) / math.sin(math.acos(1 - 0.5 / 16))
    assert change.max() < slope * 1.1e-7


@pytest.mark.parametrize(("rings", "sectors"), [(0, 4), (4, 0), (-1, -1)])
def test_empty_grids_are_refused(rings: int, sectors: int) -> None:
    with pytest.raises(QueryError, match="at least 1 ring and 1 sector"):
        sphere.view_bins(rings, sectors)
    with pytest.raises(QueryError, match="at least 1 ring and 1 sector"):
        sphere.bin_coordinates([[0, 0, 1]], rings, sectors)


def near_south_pole() -> NDArray[np.float64]:
    azimuths = np.linspace(0, 2 * math.pi, 33)
    radii = 10.0 ** np.arange(-1, -20, -1)
    radius, azimuth = (grid.ravel() for grid in np.meshgrid(radii, azimuths))
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), -np.sqrt(1 - radius**2)], axis=-1)


def test_frames_are_orthonormal_to_rounding_everywhere() -> None:
    normals = np.concatenate([sphere.uniform(20_000, 11), near_south_pole(), np.eye(3), -np.eye(3)])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    tangents = sphere.tangent_frame(normals)
    np.testing.assert_allclose((tangents * normals).sum(axis=-1), 0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(tangents, axis=-1), 1, atol=1e-15)


def test_frame_is_the_shortest_rotation_of_the_axes() -> None:
    np.testing.assert_array_equal(sphere.tangent_frame([[0, 0, 1.0], [0, 0, -1.0]]), [[1, 0, 0], [1, 0, 0]])
    normal = direction(math.cos(0.8), 0.3)
    axis = np.cross([0, 0, 1], normal) / math.sin(0.8)
    x = np.array([1.0, 0, 0])
    turned = math.cos(0.8) * x + math.sin(0.8) * np.cross(axis, x) + (1 - math.cos(0.8)) * (axis @ x) * axis
    np.testing.assert_allclose(sphere.tangent_frame(normal), turned, atol=1e-15)


def test_frames_are_continuous_except_at_the_south_pole() -> None:
    equator = np.stack([direction(0.0, phi) for phi in np.linspace(0, 6, 50)])
    start = np.concatenate([sphere.uniform(20_000, 12), equator, near_south_pole()])
    start = start[start[:, 2] > -1 + 1e-10]
    step = 1e-9 * sphere.uniform(len(start), 13)
    change = np.linalg.norm(sphere.tangent_frame(start + step) - sphere.tangent_frame(start), axis=-1)
    # Near −z the frame rotates twice per revolution of the normal: 2/sinθ per radian, 1 elsewhere.
    sin_theta = np.hypot(start[:, 0], start[:, 1])
    slope = np.where(start[:, 2] < 0, 2 / np.maximum(sin_theta, 1e-5), 0) + 2
    assert (change < 1.5e-9 * slope).all()


def test_length_of_a_normal_does_not_matter() -> None:
    normals = sphere.uniform(100, 14)
    lengths = np.geomspace(1e-9, 1e9, 100)[:, None]
    np.testing.assert_allclose(sphere.tangent_frame(normals * lengths), sphere.tangent_frame(normals), atol=1e-14)


@pytest.mark.parametrize("wrong", [[0, 0, 0], [0, np.nan, 1], [np.inf, 0, 0]])
def test_normals_without_direction_are_refused(wrong: list[float]) -> None:
    normals = sphere.uniform(10, 15)
    normals[[3, 8]] = wrong
    with pytest.raises(QueryError, match=r"2 of 10 .* index \[3\]"):
        sphere.tangent_frame(normals)


def test_local_frame_is_right_handed_and_invertible() -> None:
    normals = sphere.uniform(50, 16)
    tangents = sphere.tangent_frame(normals)
    np.testing.assert_allclose(sphere.to_local(normals, normals, tangents), np.eye(3)[[2]].repeat(50, 0), atol=1e-15)
    np.testing.assert_allclose(sphere.to_local(tangents, normals, tangents), np.eye(3)[[0]].repeat(50, 0), atol=1e-15)
    bitangents = np.cross(normals, tangents)
    np.testing.assert_allclose(sphere.to_world([0, 1, 0], normals, tangents), bitangents, atol=1e-15)
    bins = sphere.view_bins(4, 8)
    world = sphere.to_world(bins, normals[:, None], tangents[:, None])
    assert world.shape == (50, 32, 3)
    back = sphere.to_local(world, normals[:, None], tangents[:, None])
    np.testing.assert_allclose(back, np.broadcast_to(bins, back.shape), atol=1e-15)


def test_vectors_need_three_components() -> None:
    with pytest.raises(QueryError, match=r"\[\.\.\., 3\]"):
        sphere.to_local([1.0, 2.0], [0, 0, 1.0], [1.0, 0, 0])


def test_one_direction_has_coordinates_in_several_frames() -> None:
    frames = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    found = sphere.to_local([[0.0, 0.0, 1.0]], frames, [[1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(found, [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
