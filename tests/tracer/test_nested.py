"""Objects inside the object: regions, relative indices, diffuse parts, clipping, and connections.

z-tests of false-alarm rate `significance.FALSE_ALARM` each, about 20 of them.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.errors import QueryError
from formats.mesh import Mesh, write_mesh
from formats.scene import Scene, read_scene
from prt_bake.geometry.surface import Surface
from prt_bake.mathematics import sh
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from prt_bake.tracer.light_samples import sample_exits
from prt_bake.tracer.prepared import smooth_part
from prt_bake.tracer.surface.interface import fresnel
from tests.mathematics.significance import assert_agree
from tests.tracer.scenes import lumpy, moved, queries, rotated_lattices, slab, sphere, unit_directions

pytestmark = pytest.mark.statistics

HAZE = {"sigma_t": 3.0, "albedo": [0.9, 0.6, 0.99], "phase_g": 0.3}
MILK = {"sigma_t": 9.0, "albedo": [0.99, 0.8, 0.5]}
CLEAR = {"sigma_t": 0.0, "albedo": 1.0}
WHITE = {"sigma_t": 4.0, "albedo": 1.0}
ROUGH = {"eta": 1.3, "roughness": 0.4}


def nested(
    folder: Path, mesh: Mesh, medium: dict[str, Any], interface: dict[str, Any], *inside: dict[str, Any]
) -> Scene:
    """A scene of an outer mesh and tables of inner parts, whose "mesh" is a Mesh."""
    write_mesh(mesh, folder / "outer.ply")
    lines = ["[object]", 'mesh = "outer.ply"', "[interface]", *_keys(interface), "[medium]", *_keys(medium)]
    for i, table in enumerate(inside):
        write_mesh(table["mesh"], folder / f"inner{i}.ply")
        tables = {key: table[key] for key in ("interface", "medium") if key in table}
        rest = {key: value for key, value in table.items() if key not in ("mesh", *tables)}
        lines += ["[[inside]]", f'name = "{table.get("name", f"inner{i}")}"', f'mesh = "inner{i}.ply"']
        lines += _keys({key: value for key, value in rest.items() if key != "name"})
        for name, keys in tables.items():
            lines += [f"[inside.{name}]", *_keys(keys)]
    (folder / "scene.toml").write_text("\n".join(lines))
    return read_scene(folder / "scene.toml")


def _keys(table: dict[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value)}" for key, value in table.items()]


def small(radius: float, x: float = 0.0) -> Mesh:
    return moved(sphere(3), radius, [x, 0.0, 0.0])


CASES = {
    "milk in haze": ({}, {"mesh": small(0.5), "medium": MILK}),
    "milk in haze, behind a rough boundary": (ROUGH, {"mesh": small(0.5), "medium": MILK}),
    "diffuse ball": ({}, {"mesh": small(0.5), "surface": "diffuse", "reflectance": [0.9, 0.2, 0.5]}),
    "diffuse ball behind a rough boundary": (
        ROUGH,
        {"mesh": small(0.5), "surface": "diffuse", "reflectance": [0.9, 0.2, 0.5]},
    ),
    "rough glass in an index-matched haze": (
        {},
        {"mesh": small(0.5), "interface": {"eta": 1.5, "roughness": 0.5}, "medium": CLEAR},
    ),
    "rough milk behind a rough boundary": (
        ROUGH,
        {"mesh": small(0.5), "interface": {"eta": 1.6, "roughness": 0.3}, "medium": MILK},
    ),
    "smooth glass behind a rough boundary": (
        ROUGH,
        {"mesh": small(0.5), "interface": {"eta": 1.6}, "medium": CLEAR},
    ),
    "compensated milk behind a compensated boundary": (
        {"eta": 1.4, "roughness": 0.5, "energy_compensation": True},
        {"mesh": small(0.5), "interface": {"eta": 1.2, "roughness": 0.6, "energy_compensation": True}, "medium": MILK},
    ),
    "milk by channel": (
        {"eta": 1.2, "roughness": 0.5},
        {"mesh": small(0.5), "medium": {"sigma_t": [1.0, 4.0, 12.0], "albedo": 0.9}},
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_connections_agree_with_exits(name, tmp_path):
    """∫ Ŝ Y_lm dωi by connections to random directions equals a_lm by exits."""
    interface, inner = CASES[name]
    scene = nested(tmp_path, lumpy(2), HAZE, interface, inner)
    positions, outgoing, _ = queries(scene.mesh, 12, 5)
    exits = estimate_coefficients(scene, positions, outgoing, 1, 10_000, seed=1)
    batches = [_integrated(scene, positions, outgoing, seed) for seed in range(2, 26)]
    mean, error = np.mean(batches, axis=0), np.std(batches, axis=0, ddof=1) / np.sqrt(len(batches))
    # An error from two dozen batches is itself known to a seventh, hence the factor.
    assert_agree(exits.mean, exits.standard_error, mean, 1.3 * error)


def _integrated(scene: Scene, positions: np.ndarray, outgoing: np.ndarray, seed: int) -> np.ndarray:
    """a_lm to degree 1 [N,4,3] from 32 directions per query, a randomly rotated lattice: unbiased, with a third of the
    error of independent directions.
    """
    incident = rotated_lattices(len(positions), 32, seed)
    values = estimate_transport(scene, positions, outgoing, incident, 50, seed).mean
    return 4.0 * np.pi * np.einsum("ndc,ndk->nkc", values, sh.evaluate(incident, 1)) / 32


@pytest.mark.parametrize("interface", [{}, ROUGH])
def test_part_of_the_same_medium_changes_nothing(interface, tmp_path):
    (tmp_path / "plain").mkdir()
    plain = nested(tmp_path / "plain", lumpy(2), HAZE, interface)
    parted = nested(tmp_path, lumpy(2), HAZE, interface, {"mesh": small(0.5), "medium": HAZE})
    positions, outgoing, _ = queries(plain.mesh, 15, 8)
    incident = unit_directions(15, 3)
    for estimate, arguments in ((estimate_transport, (incident, 10_000)), (estimate_coefficients, (1, 10_000))):
        one = estimate(plain, positions, outgoing, *arguments, seed=1)
        two = estimate(parted, positions, outgoing, *arguments, seed=2)
        assert_agree(one.mean, one.standard_error, two.mean, two.standard_error)
        if estimate is estimate_transport:
            np.testing.assert_allclose(one.unscattered, two.unscattered, rtol=1e-6, atol=1e-12)


def test_diffuse_ball_in_a_vacuum_is_lambertian(tmp_path):
    scene = nested(
        tmp_path,
        moved(sphere(3), 2.0),
        CLEAR,
        {},
        {"mesh": sphere(4), "surface": "diffuse", "reflectance": [0.9, 0.2, 0.5]},
    )
    generator = np.random.default_rng(4)
    eye = unit_directions(20, 6)
    aside = np.cross(eye, unit_directions(20, 7))
    start = 0.8 * generator.random((20, 1)) * aside
    positions, hit = _first_hits(scene.mesh, start, eye), _first_hits(scene.parts[1].mesh, start, eye)
    incident = unit_directions(20, 8)
    result = estimate_transport(scene, positions, eye, incident, 16, seed=1)
    faces = Surface(scene.parts[1].mesh).choose(hit, eye)[0].faces
    cosine = np.maximum(np.sum(scene.parts[1].mesh.face_normals[faces] * incident, axis=1), 0.0)
    expected = np.array([0.9, 0.2, 0.5]) * cosine[:, None] / np.pi
    illuminated = cosine > 0.05
    assert illuminated.sum() >= 5
    np.testing.assert_allclose(result.mean[illuminated], expected[illuminated], rtol=1e-5)
    np.testing.assert_allclose(result.mean[cosine == 0.0], 0.0, atol=1e-12)
    assert (result.unscattered == 0.0).all()


def _first_hits(mesh: Mesh, start: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """First hits of rays through `start` from afar in direction `eye`."""
    from tests.shading.reference import nearest_hits

    corners = mesh.positions[mesh.faces]
    rows = []
    for point, direction in zip(start, eye, strict=True):
        origin = point + 5.0 * direction
        _face, t = nearest_hits(corners, origin, -direction[None])
        rows.append(origin - t[0] * direction)
    return np.array(rows)


def test_stack_of_plates_transmits_by_the_relative_indices(tmp_path):
    """Clear plane glass around liquid around ice: T of the stack from the Fresnel reflectance of each boundary."""
    etas = [1.5, 1.33, 1.25]
    plates = [moved(slab(4.0), 1.0), moved(slab(3.9), 0.6), moved(slab(3.8), 0.3)]
    inside = [
        {"mesh": plates[1], "name": "liquid", "interface": {"eta": etas[1]}, "medium": CLEAR},
        {"mesh": plates[2], "name": "ice", "in": "liquid", "interface": {"eta": etas[2]}, "medium": CLEAR},
    ]
    scene = nested(tmp_path, plates[0], CLEAR, {"eta": etas[0]}, *inside)
    cosine = 0.8
    outgoing = np.array([[0.6, 0.0, cosine]])
    location = scene_location(scene, np.array([[0.01, 0.02, 0.5]]), outgoing)
    exits = sample_exits(scene, location.faces, location.barycentric, outgoing, np.zeros(1, np.uint64), 200_000, 3)
    through = np.where(exits.directions[0] @ -outgoing[0] > 1.0 - 1e-6, exits.throughput[0, :, 0], 0.0)
    reflectances = []
    for before, after in zip([1.0, *etas[:-1]], etas, strict=True):
        inner = np.sqrt(1.0 - (1.0 - cosine**2) / before**2)
        reflectances.append(fresnel(inner, after / before))
    total = 1.0 / (1.0 + 2.0 * sum(r / (1.0 - r) for r in reflectances))
    assert_agree(through.mean(), through.std() / np.sqrt(through.size), total)


def scene_location(scene: Scene, positions: np.ndarray, outgoing: np.ndarray) -> Any:
    return Surface(scene.mesh).locate(positions, outgoing)


@pytest.mark.parametrize("interface", [{}, {"eta": 1.4}])
def test_nested_white_furnace(interface, tmp_path):
    """Without absorption all light but the reflection at x returns, whatever is inside."""
    scene = nested(
        tmp_path,
        lumpy(2),
        WHITE,
        interface,
        {"mesh": small(0.3, 0.35), "interface": {"eta": 1.6}, "medium": CLEAR},
        {"mesh": small(0.3, -0.35), "surface": "diffuse", "reflectance": 1.0},
        {
            "mesh": small(0.1, 0.35),
            "in": "inner0",
            "interface": {"eta": 1.2},
            "medium": {"sigma_t": 30.0, "albedo": 1.0},
        },
    )
    positions, outgoing, normals = queries(scene.mesh, 12, 5)
    result = estimate_coefficients(scene, positions, outgoing, 0, 3000, seed=1)
    total = result.mean[:, 0] * np.sqrt(4.0 * np.pi) + result.unscattered[:, None]
    cosines = np.sum(outgoing * normals, axis=1)
    expected = np.array([1.0 - fresnel(c, scene.eta) if scene.eta != 1.0 else 1.0 for c in cosines])
    np.testing.assert_allclose(total, np.broadcast_to(expected[:, None], total.shape), rtol=2e-5)


def test_part_that_fills_the_object_replaces_it(tmp_path):
    """Of coincident surfaces the innermost part counts; the interface is that between it and the outside."""
    (tmp_path / "plain").mkdir()
    plain = nested(tmp_path / "plain", sphere(3), MILK, ROUGH)
    lining = {"mesh": sphere(3), "interface": {"eta": 1.3, "roughness": 0.4}, "medium": MILK}
    filled = nested(tmp_path, sphere(3), HAZE, ROUGH, lining)
    positions, outgoing, _ = queries(plain.mesh, 12, 9)
    one = estimate_coefficients(plain, positions, outgoing, 1, 8_000, seed=1)
    two = estimate_coefficients(filled, positions, outgoing, 1, 8_000, seed=2)
    assert_agree(one.mean, one.standard_error, two.mean, two.standard_error)


def test_protruding_part_is_clipped(tmp_path):
    (tmp_path / "cut").mkdir()
    lying = {"mesh": moved(slab(3.0), 1.0), "medium": MILK}
    cut = {"mesh": moved(slab(1.3), 1.0), "medium": MILK}
    outer = moved(slab(1.0), 1.3)
    one = nested(tmp_path, outer, HAZE, ROUGH, lying)
    two = nested(tmp_path / "cut", outer, HAZE, ROUGH, cut)
    positions, outgoing, _ = queries(outer, 12, 9)
    a = estimate_coefficients(one, positions, outgoing, 1, 8_000, seed=1)
    b = estimate_coefficients(two, positions, outgoing, 1, 8_000, seed=2)
    assert_agree(a.mean, a.standard_error, b.mean, b.standard_error)


def test_smooth_glass_in_an_index_matched_medium_is_refused_by_name(tmp_path):
    inner = {"mesh": small(0.5), "name": "marble", "interface": {"eta": 1.5}, "medium": CLEAR}
    scene = nested(tmp_path, sphere(2), HAZE, {}, inner)
    positions, outgoing, _ = queries(scene.mesh, 2, 1)
    with pytest.raises(QueryError, match="the interface of 'marble' is smooth"):
        estimate_transport(scene, positions, outgoing, outgoing, 16)
    assert np.isfinite(estimate_coefficients(scene, positions, outgoing, 1, 64).mean).all()


@pytest.mark.parametrize(("height", "opens"), [(0.0, False), (0.2 - 1e-9, True), (0.2, True), (0.4, True)])
def test_an_air_bubble_that_reaches_a_rough_surface_allows_no_connections(height, opens, tmp_path):
    """Light enters through its opening without refraction, so that no event could connect to it."""
    bubble = {"mesh": moved(slab(1.0), 0.6, [0.0, 0.0, height]), "name": "bubble", "interface": {"eta": 1.0}}
    scene = nested(tmp_path, slab(1.0), WHITE, ROUGH, bubble | {"medium": CLEAR})
    positions, outgoing = np.array([[0.1, 0.05, -0.5]]), np.array([[0.0, 0.0, -1.0]])
    assert (smooth_part(scene) is scene.parts[1]) == opens
    if opens:
        with pytest.raises(QueryError, match=r"'bubble' has index 1 and reaches the surface, so .* straight"):
            estimate_transport(scene, positions, outgoing, outgoing, 16)
