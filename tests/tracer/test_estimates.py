"""Properties of the two estimators, and refused arguments. z-bounds at `significance.FALSE_ALARM`, fixed seeds."""

import numba
import numpy as np
import pytest

from formats.errors import QueryError
from prt_bake.mathematics import sh
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from tests.mathematics.significance import assert_agree
from tests.tracer.scenes import lumpy, make_scene, moved, queries, rotated_lattices, sphere, unit_directions

GENERATOR = np.random.default_rng(7)
SIGMA_T, ALBEDO = GENERATOR.uniform(0.5, 6.0, (3, 4, 5)), GENERATOR.uniform(0.4, 1.0, (4, 3, 3, 3))
KINDS = {
    "index-matched": (sphere, {"sigma_t": 3.0, "albedo": [0.9, 0.5, 1.0], "phase_g": 0.5}),
    "index-matched grid": (lumpy, {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": 0.3}),
    "rough": (sphere, {"sigma_t": 3.0, "albedo": [0.9, 0.5, 1.0], "eta": 1.4, "roughness": 0.3}),
    "rough grid": (lumpy, {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": 0.3, "eta": 1.3, "roughness": 0.4}),
    "rough, interpolated normals": (
        lumpy,
        {"sigma_t": 3.0, "albedo": [0.9, 0.5, 1.0], "eta": 1.3, "roughness": 0.3, "normals": "vertex"},
    ),
}


@pytest.mark.statistics
@pytest.mark.parametrize("kind", KINDS)
def test_values_integrate_to_the_coefficients(kind, tmp_path):
    """Two independent estimators of the same value: ∫ Ŝ Y over randomly rotated lattices, and Y at exits."""
    shape, medium = KINDS[kind]
    scene = make_scene(tmp_path, shape(), **medium)
    positions, outgoing, _ = queries(scene.mesh, 6, seed=1)
    copies, directions = 64, 32
    incident = rotated_lattices(6 * copies, directions, seed=2)
    values = estimate_transport(
        scene, np.repeat(positions, copies, 0), np.repeat(outgoing, copies, 0), incident, paths=25, seed=3
    )
    basis = sh.evaluate(incident, 2)
    each = 4 * np.pi * np.einsum("ndc,ndk->nkc", values.mean, basis).reshape(6, copies, 9, 3) / directions
    mean, error = each.mean(axis=1), each.std(axis=1, ddof=1) / np.sqrt(copies)
    walked = estimate_coefficients(scene, positions, outgoing, 2, paths=20_000, seed=4)
    assert_agree(mean, error, walked.mean, walked.standard_error)


@pytest.mark.parametrize("interface", [{}, {"eta": 1.3, "roughness": 0.4}])
def test_constant_grid_is_a_homogeneous_medium(interface, tmp_path):
    positions, outgoing, _ = queries(lumpy(), 20, seed=1)
    incident = unit_directions(20, seed=2)
    values, coefficients = [], []
    for name, sigma_t, albedo in (
        ("numbers", 3.0, [0.9, 0.7, 0.5]),
        ("grids", np.full((2, 3, 4), 3.0), np.broadcast_to([0.9, 0.7, 0.5], (3, 2, 2, 3))),
    ):
        (tmp_path / name).mkdir()
        scene = make_scene(tmp_path / name, lumpy(), sigma_t=sigma_t, albedo=albedo, phase_g=0.4, **interface)
        values.append(estimate_transport(scene, positions, outgoing, incident, paths=4000, seed=len(values)))
        coefficients.append(estimate_coefficients(scene, positions, outgoing, 2, paths=2000, seed=len(values)))
    for one, other in (values, coefficients):
        assert_agree(one.mean, one.standard_error, other.mean, other.standard_error)
        binomial = np.sqrt(np.maximum(one.unscattered, 1 / one.paths) / one.paths)
        assert_agree(one.unscattered, binomial, other.unscattered, binomial)


SCALED = {"albedo": 0.9, "eta": 1.3, "roughness": 0.3}


@pytest.fixture(scope="module")
def near(tmp_path_factory):
    """A scene with positions, outgoing and incident directions."""
    scene = make_scene(tmp_path_factory.mktemp("near"), lumpy(), sigma_t=4.0 * SIGMA_T, **SCALED)
    positions, outgoing, _ = queries(scene.mesh, 20, seed=1)
    return scene, positions, outgoing, unit_directions(20, seed=2)


@pytest.fixture(scope="module")
def near_estimates(near):
    scene, positions, outgoing, incident = near
    return (
        estimate_transport(scene, positions, outgoing, incident, paths=1500, seed=0),
        estimate_coefficients(scene, positions, outgoing, 2, 1500, seed=0),
    )


def far(folder, near, scale, shift):
    """The same object and queries at another size and place, with the extinction scaled along."""
    scene, positions, outgoing, incident = near
    moved_scene = make_scene(folder, moved(scene.mesh, scale, shift), sigma_t=4.0 * SIGMA_T / scale, **SCALED)
    return moved_scene, positions * scale + shift, outgoing, incident


@pytest.mark.statistics
@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e6, 0.0), (1.0, 1e5), (3.7, -20.0), (1e-6, 3.0)])
def test_estimates_depend_on_the_optical_thickness_alone(scale, shift, near, near_estimates, tmp_path):
    """Another size or position, with the extinction scaled along, gives the same values from other seeds."""
    scene, positions, outgoing, incident = far(tmp_path, near, scale, shift)
    values = estimate_transport(scene, positions, outgoing, incident, paths=1500, seed=1)
    coefficients = estimate_coefficients(scene, positions, outgoing, 2, 1500, seed=1)
    for first, second in zip(near_estimates, (values, coefficients), strict=True):
        assert_agree(first.mean, first.standard_error, second.mean, second.standard_error)


def test_scaling_by_a_power_of_two_changes_no_bit(near, tmp_path):
    """Powers of two are exact: the same seed gives the same walks."""
    first, second = (estimate_transport(*scene, 200, 3) for scene in (near, far(tmp_path, near, 2.0**20, 0.0)))
    np.testing.assert_array_equal(first.mean, second.mean)


@pytest.mark.parametrize("estimate", ["transport", "coefficients"])
def test_results_depend_on_neither_threads_nor_batches(estimate, tmp_path, monkeypatch):
    """Bit by bit: one thread or all, blocks of two queries or ten, the first four queries or ten; three chunks of paths
    per query.
    """
    monkeypatch.setattr("prt_bake.tracer.estimate._PATHS_PER_CHUNK", 128)
    scene = make_scene(tmp_path, lumpy(), sigma_t=SIGMA_T, albedo=0.9, eta=1.3, roughness=0.4)
    positions, outgoing, _ = queries(scene.mesh, 10, seed=1)
    incident = unit_directions(40, seed=2).reshape(10, 4, 3)

    def run(count=10, seed=3):
        if estimate == "transport":
            return estimate_transport(scene, positions[:count], outgoing[:count], incident[:count], 300, seed)
        return estimate_coefficients(scene, positions[:count], outgoing[:count], 2, 300, seed)

    reference, threads = run(), numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        single = run()
    finally:
        numba.set_num_threads(threads)
    monkeypatch.setattr("prt_bake.tracer.estimate._NUMBERS_AT_ONCE", 2 * 4 * 3 * 14)
    blocks = run()
    for other in (single, blocks):
        for name in ("mean", "standard_error", "unscattered", "reliable"):
            np.testing.assert_array_equal(getattr(other, name), getattr(reference, name))
    np.testing.assert_array_equal(run(4).mean, reference.mean[:4])
    assert not np.array_equal(run(seed=4).mean, reference.mean)


@pytest.mark.statistics
@pytest.mark.parametrize("kind", ["index-matched grid", "rough"])
def test_number_of_connections_does_not_change_the_expectation(kind, tmp_path):
    """Sums over sixteen directions do not depend on how many of them an event connects to; errors from copies."""
    shape, medium = KINDS[kind]
    scene = make_scene(tmp_path, shape(2), **medium)
    count, copies = 4, 48
    positions, outgoing, _ = (np.repeat(rows, copies, axis=0) for rows in queries(scene.mesh, count, seed=1))
    incident = np.repeat(unit_directions(count * 16, seed=2).reshape(count, 16, 3), copies, axis=0)
    means, errors = [], []
    for connections in (1, 3, 16):
        result = estimate_transport(scene, positions, outgoing, incident, 200, connections, connections=connections)
        sums = np.einsum("ndc,d->nc", result.mean, np.tile([1.0, 0.5], 8)).reshape(count, copies, 3)
        means.append(sums.mean(axis=1))
        errors.append(sums.std(axis=1, ddof=1) / np.sqrt(copies))
    assert_agree(means[0], errors[0], means[2], errors[2])
    assert_agree(means[1], errors[1], means[2], errors[2])


def test_single_and_multiple_directions_per_query_agree(tmp_path):
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
    if interface != {"eta": 1.5}:
        values = estimate_transport(scene, places, outgoing, np.roll(normals, 7, axis=0), paths=200, seed=1)
        assert np.isfinite(values.mean).all()
        assert np.isfinite(values.standard_error).all()
        assert (values.mean >= 0).all()
    estimate = estimate_coefficients(scene, places, outgoing, 2, paths=200, seed=1)
    assert np.isfinite(estimate.standard_error).all()
    assert np.isfinite(estimate.mean).all()
    assert (estimate.lost == 0).all()
    assert (estimate.mean[:, 0] >= 0).all()
    assert (np.sqrt(4 * np.pi) * estimate.mean[:, 0] <= 1 + 1e-9).all()


class TestRefusedArguments:
    @pytest.fixture
    def scene_queries(self, tmp_path):
        scene = make_scene(tmp_path, sphere(2))
        return scene, *queries(scene.mesh, 4, seed=1)[:2]

    def test_smooth_interface_has_no_point_values(self, tmp_path):
        scene = make_scene(tmp_path, sphere(2), eta=1.4)
        positions, outgoing, _ = queries(scene.mesh, 4, seed=1)
        with pytest.raises(QueryError, match="is smooth; no event can connect"):
            estimate_transport(scene, positions, outgoing, outgoing, paths=10)
        assert np.isfinite(estimate_coefficients(scene, positions, outgoing, paths=10).mean).all()

    def test_directions_below_the_horizon(self, scene_queries):
        scene, positions, outgoing = scene_queries
        outgoing[2:] *= -1
        with pytest.raises(QueryError, match=r"found 2 of 4 queries below .* number 2 "):
            estimate_coefficients(scene, positions, outgoing, paths=10)

    def test_positions_off_the_surface(self, scene_queries):
        scene, positions, outgoing = scene_queries
        positions[1] *= 1.5
        with pytest.raises(QueryError, match=r"found 1 of 4 farther away; the first, number 1, is 0\.[45]"):
            estimate_coefficients(scene, positions, outgoing, paths=10)

    def test_positions_in_reach_are_moved_to_the_surface(self, scene_queries):
        scene, positions, outgoing = scene_queries
        moved = estimate_coefficients(scene, positions * (1 + 1e-5), outgoing, paths=50)
        np.testing.assert_allclose(
            moved.mean, estimate_coefficients(scene, positions, outgoing, paths=50).mean, rtol=0.02
        )

    @pytest.mark.parametrize(
        ("change", "match"),
        [
            ({"outgoing": 2.0}, "outgoing: expected unit vectors, found 4 that are not"),
            ({"positions": np.nan}, "found 4 of 4 that are not finite"),
            ({"incident": 0.5}, "incident: expected unit vectors, found 4 that are not"),
        ],
    )
    def test_values_out_of_range(self, scene_queries, change, match):
        scene, positions, outgoing = scene_queries
        arguments = {"positions": positions, "outgoing": outgoing, "incident": outgoing}
        arguments = {name: value * change.get(name, 1.0) for name, value in arguments.items()}
        with pytest.raises(QueryError, match=match):
            estimate_transport(scene, paths=10, **arguments)

    def test_wrong_shapes(self, scene_queries):
        scene, positions, outgoing = scene_queries
        with pytest.raises(QueryError, match="incident"):
            estimate_transport(scene, positions, outgoing, outgoing[:3], paths=10)
        with pytest.raises(QueryError, match="positions"):
            estimate_transport(scene, positions[:2], outgoing, outgoing, paths=10)
        with pytest.raises(QueryError, match="paths"):
            estimate_coefficients(scene, positions, outgoing, paths=1)


def test_walks_that_all_carry_the_same_leave_no_error(tmp_path):
    """Every walk leaves a white polished ball; it carries the share that was refracted at the first interface."""
    scene = make_scene(tmp_path, sphere(2), eta=2.5, albedo=1.0, sigma_t=50.0)
    positions, outgoing, _ = queries(scene.mesh, 24, seed=1)
    found = estimate_coefficients(scene, positions, outgoing, 0, paths=300, seed=3)
    assert np.ptp(found.mean, axis=2).max() == 0.0
    assert found.standard_error.max() < 1e-6 * found.mean.min()
    assert found.reliable.all()
