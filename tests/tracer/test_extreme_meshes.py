"""Meshes at their limits: tiny, huge, distant, slivers, twelve faces or hundreds of thousands, broken ones.

z-tests of false-alarm rate `significance.FALSE_ALARM` each, about 5 of them.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from formats.errors import MeshError, SceneError
from formats.mesh import Mesh, build_mesh
from formats.scene import Scene
from prt_bake.tracer.estimate import Estimate, estimate_coefficients, estimate_transport
from tests.mathematics.significance import assert_agree
from tests.tracer.scenes import lumpy, make_scene, moved, queries, slab, sphere, unit_directions
from tests.tracer.soundness import assert_furnace, assert_sound

pytestmark = pytest.mark.statistics

ROUGH: dict[str, Any] = {"eta": 1.3, "roughness": 0.3}
SMOOTH: dict[str, Any] = {"eta": 1.4}


def _estimates(folder: Path, scale: float, offset: Any, **interface: Any) -> tuple[Estimate, Estimate]:
    """The same queries of the same object at another size and place."""
    folder.mkdir()
    scene = make_scene(folder, moved(lumpy(2), scale, offset), sigma_t=4.0 / scale, albedo=[0.9, 1.0, 0.5], **interface)
    positions, outgoing, _ = queries(lumpy(2), 12, 3)
    positions = positions * scale + np.asarray(offset)
    return (
        estimate_transport(scene, positions, outgoing, unit_directions(12, 4), 512, 1),
        estimate_coefficients(scene, positions, outgoing, 1, 512, 1),
    )


@pytest.mark.parametrize("interface", [{}, ROUGH])
def test_size_and_position_do_not_matter(tmp_path: Path, interface: dict[str, Any]) -> None:
    """Powers of two change no digit; other sizes and distant positions change roundings only."""
    here = _estimates(tmp_path / "here", 1.0, 0.0, **interface)
    for name, scale in (("tiny", 2.0**-20), ("huge", 2.0**20)):
        for a, b in zip(here, _estimates(tmp_path / name, scale, 0.0, **interface), strict=True):
            assert_sound(b)
            np.testing.assert_array_equal(a.mean, b.mean)
            np.testing.assert_array_equal(a.standard_error, b.standard_error)
    places: dict[str, tuple[float, Any]] = {
        **{"micron": (1e-6, 0.0), "thousand kilometres": (1e6, 0.0), "far": (1.0, 1e5)},
        **{"small and far": (1e-3, [1e3, 0.0, -1e3])},
    }
    for name, (scale, offset) in places.items():
        for a, b in zip(here, _estimates(tmp_path / name, scale, offset, **interface), strict=True):
            assert_sound(b)
            assert_agree(a.mean, a.standard_error, b.mean, b.standard_error)
            # Nearly all walks are identical.
            assert np.median(np.abs(a.mean - b.mean) / np.maximum(a.standard_error, 1e-30)) < 1e-2


def _prism(angles: np.ndarray, height: float) -> Mesh:
    """A prism over points of a circle, with caps triangulated from their centres."""
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    n = len(ring)
    positions = np.concatenate([np.c_[ring, np.full(n, z)] for z in (-height / 2, height / 2)])
    positions = np.concatenate([positions, [[0.0, 0.0, -height / 2], [0.0, 0.0, height / 2]]])
    i, j = np.arange(n), np.roll(np.arange(n), -1)
    bottom, top = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    sides = [(i, j, n + j), (i, n + j, n + i), (bottom, j, i), (top, n + i, n + j)]
    return build_mesh(positions, np.concatenate([np.stack(corners, axis=1) for corners in sides]))


@pytest.mark.parametrize("interface", [{}, SMOOTH])
def test_slivers_do_not_leak(tmp_path: Path, interface: dict[str, Any]) -> None:
    """Triangles ten thousand times as long as wide, with queries on the slivers too."""
    angles = np.concatenate([np.arange(24) * 2.0 * np.pi / 24, 0.1 + 1e-4 * np.arange(30)])
    mesh = _prism(np.sort(angles), 1.0)
    edges = np.linalg.norm(mesh.positions[mesh.faces] - np.roll(mesh.positions[mesh.faces], 1, axis=1), axis=2)
    assert (edges.max(axis=1) / edges.min(axis=1)).max() > 9e3
    scene = make_scene(tmp_path, mesh, sigma_t=2.0, albedo=1.0, **interface)
    positions, outgoing, _ = queries(mesh, 24, 3)
    thin = np.flatnonzero(edges.max(axis=1) / edges.min(axis=1) > 5e3)
    middles = mesh.positions[mesh.faces[thin]].mean(axis=1)
    normals = np.asarray(mesh.face_normals)[thin]
    assert_furnace(scene, np.concatenate([positions, middles]), np.concatenate([outgoing, normals]), paths=256)


@pytest.mark.parametrize("extents", [(1.0, 1.0, 1e-4), (1.0, 1e-3, 1e-3)])
@pytest.mark.parametrize("interface", [{}, SMOOTH])
def test_thin_plates_and_needles_do_not_leak(
    tmp_path: Path, extents: tuple[float, ...], interface: dict[str, Any]
) -> None:
    box = trimesh.creation.box(extents=extents)
    mesh = build_mesh(np.asarray(box.vertices), np.asarray(box.faces))
    scene = make_scene(tmp_path, mesh, sigma_t=3.0 / min(extents), albedo=1.0, **interface)
    positions, outgoing, normals = queries(mesh, 24, 3)
    steep = np.sum(outgoing * normals, axis=1) > 0.1
    # Positions are float32 relative to the longest side, which limits the angles in a thin object to 1e-4.
    assert_furnace(scene, positions[steep], outgoing[steep], paths=128, rtol=1e-5)


@pytest.mark.parametrize("interface", [{}, SMOOTH])
def test_cube_of_twelve_faces_from_all_points(tmp_path: Path, interface: dict[str, Any]) -> None:
    """From vertices, edges, diagonals of the sides, and face centres."""
    mesh = slab(1.0)
    scene = make_scene(tmp_path, mesh, sigma_t=3.0, albedo=1.0, **interface)
    corners = mesh.positions[mesh.faces]
    middles = (0.5 * (corners + np.roll(corners, 1, axis=1))).reshape(-1, 3)
    places = np.concatenate([mesh.positions, middles, corners.mean(axis=1)])
    outgoing = places / np.linalg.norm(places, axis=1, keepdims=True)
    assert_furnace(scene, places, outgoing, paths=256)
    # Oblique views towards the nearest corner of the cube.
    aside = outgoing + 2.0 * np.sign(places)
    assert_furnace(scene, places, aside / np.linalg.norm(aside, axis=1, keepdims=True), paths=64)


def test_hundreds_of_thousands_of_faces(tmp_path: Path) -> None:
    """A ball of 407,000 faces agrees with one of 40,000 (`tests/bench/extremes.py` measures its preparation)."""
    means = []
    for sectors in (100, 320):
        (tmp_path / str(sectors)).mkdir()
        ball = trimesh.creation.uv_sphere(radius=1.0, count=[sectors, sectors])
        mesh = build_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
        scene = make_scene(tmp_path / str(sectors), mesh, sigma_t=8.0, albedo=0.9, **ROUGH)
        faces = np.linspace(0, len(mesh.faces) - 1, 9).astype(int)[1:-1]
        outgoing = np.asarray(mesh.face_normals)[faces]
        where = mesh.positions[mesh.faces[faces]].mean(axis=1)
        means.append(estimate_coefficients(scene, where, outgoing, 0, 4000, sectors))
        assert_sound(means[-1])
    assert len(mesh.faces) > 200_000
    assert_agree(means[0].mean, means[0].standard_error, means[1].mean, means[1].standard_error)


def _soup(mesh: Mesh) -> Mesh:
    """The same faces with separate vertices."""
    return build_mesh(mesh.positions[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


def test_duplicate_vertices_are_merged(tmp_path: Path) -> None:
    for name in ("plain", "doubled"):
        (tmp_path / name).mkdir()
    plain = make_scene(tmp_path / "plain", lumpy(2), **ROUGH)
    doubled = make_scene(tmp_path / "doubled", _soup(lumpy(2)), **ROUGH)
    assert len(doubled.mesh.positions) == len(plain.mesh.positions)
    positions, outgoing, _ = queries(lumpy(2), 6, 3)
    one, two = (estimate_transport(s, positions, outgoing, outgoing, 256, 1) for s in (plain, doubled))
    assert_agree(one.mean, one.standard_error, two.mean, two.standard_error)


def test_broken_meshes_are_refused_with_a_reason(tmp_path: Path) -> None:
    ball = sphere(1)
    flat = _with_sliver(ball)
    doubled = build_mesh(ball.positions, np.concatenate([ball.faces, ball.faces[:2]]))
    twice = build_mesh(np.tile(ball.positions, (2, 1)), np.concatenate([ball.faces, ball.faces + len(ball.positions)]))
    torn = build_mesh(ball.positions, np.concatenate([ball.faces[1:], ball.faces[:1, ::-1]]))
    _refused(tmp_path / "flat", flat, MeshError, "1 of 82 faces have no area, the first is face 81")
    _refused(tmp_path / "doubled", doubled, SceneError, "does not bound a solid: 2 faces lie on other faces")
    _refused(tmp_path / "twice", twice, SceneError, "does not bound a solid: 80 faces lie on other faces")
    _refused(tmp_path / "torn", torn, SceneError, "3 edges lie between faces of opposite winding")


def _with_sliver(mesh: Mesh) -> Mesh:
    """A face divided at the middle of its first edge, and a face without area between it and its neighbour."""
    (a, b, c), middle = mesh.faces[0], len(mesh.positions)
    positions = np.concatenate([mesh.positions, 0.5 * (mesh.positions[[a]] + mesh.positions[[b]])])
    return build_mesh(positions, np.concatenate([mesh.faces[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]]))


def _refused(folder: Path, mesh: Mesh, error: type[Exception], message: str) -> None:
    folder.mkdir()
    with pytest.raises(error, match=message):
        make_scene(folder, mesh)


def test_inverted_object_is_flipped(tmp_path: Path) -> None:
    ball = sphere(2)
    scene: Scene = make_scene(tmp_path, build_mesh(ball.positions, ball.faces[:, ::-1]), albedo=1.0)
    assert scene.flipped
    assert_furnace(scene, *queries(ball, 6, 3)[:2], paths=32)


def test_cubes_that_touch_along_an_edge_are_traced_as_two(tmp_path: Path) -> None:
    """Unscattered light through one of them, and close to the shared edge through both and the gap between them."""
    cube = slab(1.0)
    other = moved(cube, 1.0, [1.0, 1.0, 0.0])
    both = build_mesh(
        np.concatenate([cube.positions, other.positions]),
        np.concatenate([cube.faces, other.faces + len(cube.positions)]),
    )
    scene = make_scene(tmp_path, both, sigma_t=0.7, albedo=1.0)
    assert len(scene.mesh.positions) == 14
    right, diagonal = [1.0, 0.0, 0.0], [np.sqrt(0.5), np.sqrt(0.5), 0.0]
    positions = [[0.5, 0.1, 0.2], [1.5, 0.9, 0.1], [1.5, 0.51, -0.3], [1.5, 1.4, 0.1], [1.5, 1.5 - 1e-3, 0.1]]
    outgoing = np.array([right, right, right, diagonal, diagonal])
    estimate = estimate_transport(scene, positions, outgoing, outgoing, 64, 1)
    lengths = np.array([1.0, 1.0, 1.0, 2 * np.sqrt(2.0) * 0.9, 2 * np.sqrt(2.0) * 0.999])
    np.testing.assert_allclose(estimate.unscattered, np.exp(-0.7 * lengths), rtol=1e-5)
    assert_furnace(scene, np.array(positions), outgoing, paths=64)
