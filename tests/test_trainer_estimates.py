"""Laws of the two estimators, and what they refuse. z-bounds of 4.5 on at most some 200 values; fixed seeds."""

import numba
import numpy as np
import pytest
from scenes import lumpy, make_scene, queries, sphere, unit_directions

from formats.errors import QueryError
from formats.mesh import build_mesh
from prt_bake import sh
from prt_bake.sphere import fibonacci
from prt_bake.trainer.estimate import estimate_coefficients, estimate_transport
from prt_bake.trainer.interface import fresnel, rough_density

GENERATOR = np.random.default_rng(7)
SIGMA_T, ALBEDO = GENERATOR.uniform(0.5, 6.0, (3, 4, 5)), GENERATOR.uniform(0.4, 1.0, (4, 3, 3, 3))
KINDS = {
    "index-matched": (sphere, {"sigma_t": 3.0, "albedo": [0.9, 0.5, 1.0], "phase_g": 0.5}),
    "index-matched grid": (lumpy, {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": 0.3}),
    "rough": (sphere, {"sigma_t": 3.0, "albedo": [0.9, 0.5, 1.0], "eta": 1.4, "roughness": 0.3}),
    "rough grid": (lumpy, {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": 0.3, "eta": 1.3, "roughness": 0.4}),
}


def z_scores(first, second):
    return (first.mean - second.mean) / np.hypot(first.standard_error, second.standard_error)


@pytest.mark.parametrize("kind", KINDS)
def test_values_integrate_to_the_coefficients(kind, tmp_path):
    """Two independent estimators of one thing: ∫ Ŝ Y over random directions, and the exits' Y."""
    shape, medium = KINDS[kind]
    scene = make_scene(tmp_path, shape(), **medium)
    positions, outgoing, _ = queries(scene.mesh, 6, seed=1)
    copies, directions = 96, 8
    incident = unit_directions(6 * copies * directions, seed=2).reshape(-1, directions, 3)
    values = estimate_transport(
        scene, np.repeat(positions, copies, 0), np.repeat(outgoing, copies, 0), incident, paths=200, seed=3
    )
    basis = sh.evaluate(incident, 1)
    each = 4 * np.pi * np.einsum("ndc,ndk->nkc", values.mean, basis).reshape(6, copies, 4, 3) / directions
    mean, error = each.mean(axis=1), each.std(axis=1, ddof=1) / np.sqrt(copies)
    walked = estimate_coefficients(scene, positions, outgoing, 1, paths=40_000, seed=4)
    z = (mean - walked.mean) / np.hypot(error, walked.standard_error)
    assert np.abs(z).max() < 4.5
    assert np.sqrt(np.mean(z**2)) < 1.4


@pytest.mark.parametrize("interface", [{}, {"eta": 1.3, "roughness": 0.4}])
def test_a_grid_of_one_value_is_a_homogeneous_medium(interface, tmp_path):
    positions, outgoing, _ = queries(lumpy(), 20, seed=1)
    incident = unit_directions(20, seed=2)
    estimates = []
    for name, sigma_t, albedo in (
        ("numbers", 3.0, [0.9, 0.7, 0.5]),
        ("grids", np.full((2, 3, 4), 3.0), np.broadcast_to([0.9, 0.7, 0.5], (3, 2, 2, 3))),
    ):
        (tmp_path / name).mkdir()
        scene = make_scene(tmp_path / name, lumpy(), sigma_t=sigma_t, albedo=albedo, phase_g=0.4, **interface)
        estimates.append(estimate_transport(scene, positions, outgoing, incident, paths=8000, seed=len(estimates)))
    z = z_scores(*estimates)
    assert np.abs(z).max() < 4.5
    assert np.sqrt(np.mean(z**2)) < 1.4


@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e5), (3.7, -20.0)])
def test_only_the_optical_thickness_counts(scale, shift, tmp_path):
    """A mesh of another size or far from the origin, its extinction scaled along: the same numbers."""
    (tmp_path / "near").mkdir()
    mesh = lumpy()
    near = make_scene(tmp_path / "near", mesh, sigma_t=4.0, albedo=0.9, eta=1.3, roughness=0.3)
    far = make_scene(
        tmp_path,
        build_mesh(mesh.positions * scale + shift, mesh.faces),
        sigma_t=4.0 / scale,
        albedo=0.9,
        eta=1.3,
        roughness=0.3,
    )
    positions, outgoing, _ = queries(mesh, 20, seed=1)
    incident = unit_directions(20, seed=2)
    first = estimate_transport(near, positions, outgoing, incident, paths=500, seed=3)
    second = estimate_transport(far, positions * scale + shift, outgoing, incident, paths=500, seed=3)
    # The same random numbers; a walk differs only where rounding turns a corner another way.
    agree = np.abs(first.mean - second.mean) <= 1e-3 * first.mean.max() + 4.5 * 0.3 * first.standard_error
    assert agree.mean() > 0.9
    assert np.abs(z_scores(first, second)).max() < 4.5


def test_single_scattering_in_a_sphere(tmp_path):
    """Albedo ε: Ŝ / ε → ∫ σ p(ω) exp(−σ (t + s)) dt along the view, s the way out to the light; integrated here by
    itself.
    """
    sigma_t, g, epsilon = 2.0, 0.4, 1e-4
    scene = make_scene(tmp_path, sphere(5), sigma_t=sigma_t, albedo=epsilon, phase_g=g)
    positions, outgoing, _ = queries(scene.mesh, 16, seed=1)
    incident = unit_directions(16, seed=2)
    ours = estimate_transport(scene, positions, outgoing, incident, paths=20_000, seed=3)

    def way_out(p, d):
        along = np.sum(p * d, axis=-1)
        return -along + np.sqrt(np.maximum(0.0, along**2 + 1.0 - np.sum(p * p, axis=-1)))

    nodes, weights = np.polynomial.legendre.leggauss(200)
    chord = way_out(positions, -outgoing)[:, None]
    t = 0.5 * chord * (1 + nodes)
    points = positions[:, None] - t[..., None] * outgoing[:, None]
    out = way_out(points, incident[:, None])
    cosine = -np.sum(outgoing * incident, axis=1)
    phase = (1 - g * g) / (4 * np.pi * (1 + g * g - 2 * g * cosine) ** 1.5)
    exact = phase * np.sum(0.5 * chord * weights * sigma_t * np.exp(-sigma_t * (t + out)), axis=1)
    z = (ours.mean[:, 0] / epsilon - exact) / (ours.standard_error[:, 0] / epsilon + 2e-3 * exact)
    assert np.abs(z).max() < 4.5


def test_a_black_medium_behind_a_rough_interface(tmp_path):
    """Albedo 0: light reaches the eye only straight through two rough crossings; integrated here over the entry's
    lobe.
    """
    sigma_t, eta, alpha = 0.5, 1.3, 0.5
    scene = make_scene(tmp_path, sphere(5), sigma_t=sigma_t, albedo=0.0, eta=eta, roughness=alpha)
    positions, outgoing, _ = queries(scene.mesh, 6, seed=1)
    incident = unit_directions(6, seed=2) * 0.3 - outgoing
    incident /= np.linalg.norm(incident, axis=1, keepdims=True)
    ours = estimate_transport(scene, positions, outgoing, incident, paths=400_000, seed=3)
    exact = np.array(
        [_crossing_twice(*q, sigma_t, eta, alpha) for q in zip(positions, outgoing, incident, strict=True)]
    )
    assert exact.max() > 0.01
    # Internal reflections add light that the two crossings leave out; facets of the mesh turn normals by up to 1.5
    # degrees.
    ratio = (ours.mean[:, 0] - exact) / exact.max()
    assert (ratio > -0.03 - 4.5 * ours.standard_error[:, 0] / exact.max()).all()
    assert np.abs(ratio).max() < 0.1


def _crossing_twice(x, outgoing, incident, sigma_t, eta, alpha):
    x = x / np.linalg.norm(x)
    directions = fibonacci(16_000)
    inward = directions[np.sum(directions * x, axis=1) < -1e-3]
    leave = x - 2 * np.sum(inward * x, axis=1, keepdims=True) * inward
    length = np.linalg.norm(leave - x, axis=1)
    total = 0.0
    for d, q, s in zip(inward, leave, length, strict=True):
        first = rough_density(alpha, eta, *_local(outgoing, x), *_local(d, x))
        if first > 0.0 and incident @ q > 0.0:
            second = rough_density(alpha, 1.0 / eta, *_local(-d, -q), *_local(incident, -q))
            total += first * second * np.exp(-sigma_t * s)
    return total * 4.0 * np.pi / len(directions)


def _local(d, n):
    t = np.cross(n, [1.0, 0.0, 0.0] if abs(n[0]) < 0.7 else [0.0, 1.0, 0.0])
    t /= np.linalg.norm(t)
    return d @ t, d @ np.cross(n, t), d @ n


def test_results_depend_on_neither_threads_nor_batches(tmp_path):
    scene = make_scene(tmp_path, lumpy(), sigma_t=SIGMA_T, albedo=0.9, eta=1.3, roughness=0.4)
    positions, outgoing, _ = queries(scene.mesh, 10, seed=1)
    incident = unit_directions(40, seed=2).reshape(10, 4, 3)
    threads = numba.get_num_threads()
    results = []
    try:
        for count in {1, threads}:
            numba.set_num_threads(count)
            results.append(estimate_transport(scene, positions, outgoing, incident, paths=300, seed=3).mean)
    finally:
        numba.set_num_threads(threads)
    results.append(estimate_transport(scene, positions[:4], outgoing[:4], incident[:4], paths=300, seed=3).mean)
    np.testing.assert_array_equal(results[0], results[-2])
    np.testing.assert_array_equal(results[0][:4], results[-1])
    other = estimate_transport(scene, positions, outgoing, incident, paths=300, seed=4).mean
    assert not np.array_equal(other, results[0])


def test_one_direction_a_query_or_many_is_the_same_thing(tmp_path):
    scene = make_scene(tmp_path, sphere(2))
    positions, outgoing, _ = queries(scene.mesh, 5, seed=1)
    incident = unit_directions(5, seed=2)
    single = estimate_transport(scene, positions, outgoing, incident, paths=200, seed=3)
    many = estimate_transport(scene, positions, outgoing, incident[:, None], paths=200, seed=3)
    assert single.mean.shape == (5, 3)
    assert many.mean.shape == (5, 1, 3)
    np.testing.assert_array_equal(single.mean, many.mean[:, 0])
    assert single.unscattered.shape == single.reliable.shape == (5,)


@pytest.mark.parametrize("interface", [{}, {"eta": 1.5}, {"eta": 1.3, "roughness": 0.25}])
def test_vertices_edges_and_grazing_views_are_sound(interface, tmp_path):
    scene = make_scene(tmp_path, lumpy(2), sigma_t=5.0, albedo=0.99, **interface)
    mesh = scene.mesh
    corners = mesh.positions[mesh.faces[:40]]
    places = np.concatenate([corners[:, 0], 0.5 * (corners[:, 0] + corners[:, 1]), corners.mean(axis=1)])
    normals = np.tile(mesh.face_normals[:40], (3, 1))
    across = np.cross(normals, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    outgoing = 1e-3 * normals + np.sqrt(1 - 1e-6) * across
    estimate = estimate_coefficients(scene, places, outgoing, 2, paths=200, seed=1)
    assert np.isfinite(estimate.mean).all()
    assert (estimate.lost == 0).all()
    assert (estimate.mean[:, 0] >= 0).all()
    assert (np.sqrt(4 * np.pi) * estimate.mean[:, 0] <= 1 + 1e-9).all()


class TestRefusals:
    @pytest.fixture
    def asked(self, tmp_path):
        scene = make_scene(tmp_path, sphere(2))
        return scene, *queries(scene.mesh, 4, seed=1)[:2]

    def test_a_smooth_interface_has_no_values(self, tmp_path):
        scene = make_scene(tmp_path, sphere(2), eta=1.4)
        positions, outgoing, _ = queries(scene.mesh, 4, seed=1)
        with pytest.raises(QueryError, match="smooth interface"):
            estimate_transport(scene, positions, outgoing, outgoing, paths=10)
        assert np.isfinite(estimate_coefficients(scene, positions, outgoing, paths=10).mean).all()

    def test_below_the_horizon(self, asked):
        scene, positions, outgoing = asked
        outgoing[2:] *= -1
        with pytest.raises(QueryError, match=r"2 of 4 queries lie below .* number 2 "):
            estimate_coefficients(scene, positions, outgoing, paths=10)

    def test_off_the_surface(self, asked):
        scene, positions, outgoing = asked
        positions[1] *= 1.5
        with pytest.raises(QueryError, match=r"1 of 4 do not lie on the surface; the first is number 1, 0\.[45]"):
            estimate_coefficients(scene, positions, outgoing, paths=10)

    def test_within_reach_is_taken_to_the_surface(self, asked):
        scene, positions, outgoing = asked
        moved = estimate_coefficients(scene, positions * (1 + 1e-5), outgoing, paths=50)
        np.testing.assert_allclose(
            moved.mean, estimate_coefficients(scene, positions, outgoing, paths=50).mean, rtol=0.02
        )

    @pytest.mark.parametrize(
        ("change", "match"),
        [
            ({"outgoing": 2.0}, "outgoing: 4 directions are not of unit length"),
            ({"positions": np.nan}, "positions: 4 of 4 are not finite"),
            ({"incident": 0.5}, "incident: 4 directions are not of unit length"),
        ],
    )
    def test_numbers_out_of_their_domain(self, asked, change, match):
        scene, positions, outgoing = asked
        arguments = {"positions": positions, "outgoing": outgoing, "incident": outgoing}
        arguments = {name: value * change.get(name, 1.0) for name, value in arguments.items()}
        with pytest.raises(QueryError, match=match):
            estimate_transport(scene, paths=10, **arguments)

    def test_shapes(self, asked):
        scene, positions, outgoing = asked
        with pytest.raises(QueryError, match="incident"):
            estimate_transport(scene, positions, outgoing, outgoing[:3], paths=10)
        with pytest.raises(QueryError, match="positions"):
            estimate_transport(scene, positions[:2], outgoing, outgoing, paths=10)
        with pytest.raises(QueryError, match="paths"):
            estimate_coefficients(scene, positions, outgoing, paths=1)


def test_fresnel_is_what_the_furnace_takes_it_for():
    assert fresnel(1.0, 1.5) == pytest.approx(0.04)
    assert fresnel(0.2, 1 / 1.5) == 1.0
