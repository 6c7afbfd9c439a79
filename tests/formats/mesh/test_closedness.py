"""Closed surfaces: solids that touch, doubled faces, seams that are welded or described, faces without area."""

from pathlib import Path

import numpy as np
import pytest

from formats.errors import InputWarning, MeshError
from formats.mesh import (
    Mesh,
    build_mesh,
    check_mesh,
    closedness_faults,
    flipped,
    inconsistent_edges,
    open_edges,
    read_mesh,
    signed_volume,
    write_mesh,
)
from tests.formats.mesh.test_mesh import TETRAHEDRON, TETRAHEDRON_FACES, ascii_ply, sphere_mesh

CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
CUBE_QUADS = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
CUBE_FACES = CUBE_QUADS[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
OTHER_DIAGONALS = CUBE_QUADS[:, [1, 2, 3, 1, 3, 0]].reshape(-1, 3)


def cubes(folder: Path, *offsets: tuple[float, float, float], second: np.ndarray = CUBE_FACES) -> Mesh:
    """Unit cubes at offsets, vertices at equal positions merged; `second`: the faces of all but the first."""
    positions = np.concatenate([CUBE + offset for offset in offsets])
    faces = np.concatenate([(second if i else CUBE_FACES) + 8 * i for i in range(len(offsets))])
    write_mesh(build_mesh(positions, faces), folder / "cubes.ply")
    return read_mesh(folder / "cubes.ply")


@pytest.mark.parametrize("offset", [(1, 1, 0), (1, -1, 0), (0, 1, 1), (-1, 0, 1), (1, 1, 1), (2, 0, 0)])
def test_cubes_that_touch_along_an_edge_are_closed(tmp_path: Path, offset: tuple[float, float, float]) -> None:
    mesh = cubes(tmp_path, (0, 0, 0), offset)
    assert (open_edges(mesh), inconsistent_edges(mesh), closedness_faults(mesh)) == (0, 0, [])
    assert signed_volume(mesh) == pytest.approx(2)
    assert check_mesh(tmp_path / "cubes.ply") == []
    assert closedness_faults(flipped(mesh)) == []


def test_four_edges_of_a_ring_of_cubes_touch(tmp_path: Path) -> None:
    mesh = cubes(tmp_path, (0, 0, 0), (1, 1, 0), (2, 0, 0), (1, -1, 0), second=OTHER_DIAGONALS)
    assert closedness_faults(mesh) == []
    assert signed_volume(mesh) == pytest.approx(4)


@pytest.mark.parametrize(
    ("second", "fault"), [(CUBE_FACES, "faces lie on other faces"), (OTHER_DIAGONALS, "overlap at")]
)
@pytest.mark.parametrize("offset", [(1, 0, 0), (0, 0, 0)])
def test_inner_walls_and_cubes_in_one_place_are_refused(tmp_path: Path, offset, second: np.ndarray, fault: str) -> None:
    """As many faces traverse every edge one way as the other, so this alone would pass them."""
    mesh = cubes(tmp_path, (0, 0, 0), offset, second=second)
    assert (open_edges(mesh), inconsistent_edges(mesh)) == (0, 0)
    assert fault in closedness_faults(mesh)[0]
    assert fault in check_mesh(tmp_path / "cubes.ply")[0]


def test_solids_that_overlap_at_an_edge_are_refused() -> None:
    """A wedge from 0° to 90° about the z axis, and one from 45° to 135°."""
    turn = np.array([[np.sqrt(0.5), np.sqrt(0.5), 0], [-np.sqrt(0.5), np.sqrt(0.5), 0], [0, 0, 1]])
    positions = np.concatenate([CUBE, (CUBE @ turn)[[1, 2, 3, 5, 6, 7]]])
    index = np.array([0, 8, 9, 10, 4, 11, 12, 13])
    mesh = build_mesh(positions, np.concatenate([CUBE_FACES, index[CUBE_FACES]]))
    assert open_edges(mesh) == 0
    assert (
        "solids overlap at 1 edges of more than two faces, the first between (0, 0, 0) and"
        in closedness_faults(mesh)[0]
    )
    apart = positions.copy()
    apart[8:] = (CUBE @ turn @ turn @ turn)[[1, 2, 3, 5, 6, 7]]
    assert closedness_faults(build_mesh(apart, mesh.faces)) == []


def test_faults_name_their_first_place() -> None:
    doubled = np.concatenate([TETRAHEDRON_FACES, TETRAHEDRON_FACES[3:]])
    assert closedness_faults(build_mesh(TETRAHEDRON, doubled)) == [
        "1 faces lie on other faces, the first between (1, 0, 0) and (0, 1, 0) and (0, 0, 1); remove doubled faces and "
        "inner walls"
    ]
    torn = TETRAHEDRON_FACES.copy()
    torn[0] = torn[0][::-1]
    assert (
        "3 edges lie between faces of opposite winding, the first"
        in closedness_faults(build_mesh(TETRAHEDRON, torn))[0]
    )
    fault = closedness_faults(build_mesh(TETRAHEDRON, TETRAHEDRON_FACES[:3]))[0]
    assert fault.startswith("3 edges are open, the first between (1, 0, 0) and (0, 1, 0); ")
    assert fault.endswith("close the holes (of the 3 vertices there, the nearest two lie 1.4 apart)")


def test_an_open_piece_beside_closed_ones_is_named() -> None:
    ball = sphere_mesh()
    ground = np.array([[-2.0, -1.5, -2.0], [2.0, -1.5, -2.0], [2.0, -1.5, 2.0], [-2.0, -1.5, 2.0]])
    sheet = np.array([[0, 2, 1], [0, 3, 2]]) + len(ball.positions)
    both = build_mesh(np.concatenate([ball.positions, ground]), np.concatenate([ball.faces, sheet]))
    (fault,) = closedness_faults(both)
    assert "4 edges are open" in fault
    assert "1 of its 2 pieces is open, the first from (-2, -1.5, -2) to (2, -1.5, 2): leave out what is not" in fault


def halves(gap: np.ndarray) -> Mesh:
    """A ball whose upper half has its own equator, moved by `gap`: [3] or [12,3]."""
    ball = sphere_mesh()
    equator = np.flatnonzero(np.abs(ball.positions[:, 2]) < 1e-9)
    faces, own = ball.faces.copy(), np.arange(len(ball.positions))
    own[equator] = len(ball.positions) + np.arange(len(equator))
    upper = ball.positions[ball.faces].mean(axis=1)[:, 2] > 0
    faces[upper] = own[faces[upper]]
    return build_mesh(np.concatenate([ball.positions, ball.positions[equator] + gap]), faces)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_a_seam_within_a_rounding_is_welded(tmp_path: Path, suffix: str) -> None:
    ball, torn = sphere_mesh(), halves(np.random.default_rng(0).uniform(-1, 1, (12, 3)) * 1e-7)
    assert open_edges(torn) == 24
    write_mesh(torn, tmp_path / f"torn{suffix}")
    with pytest.warns(InputWarning, match=r"12 vertices at open edges are within 1\.\de-07 of others.*were merged"):
        mesh = read_mesh(tmp_path / f"torn{suffix}")
    np.testing.assert_array_equal(mesh.faces, ball.faces)
    np.testing.assert_array_equal(mesh.positions, ball.positions)
    assert closedness_faults(mesh) == []
    sources = mesh.positions[mesh.source_vertex]
    np.testing.assert_allclose(sources, torn.positions, atol=2e-7)


def test_a_wider_seam_is_described_with_its_remedy(tmp_path: Path) -> None:
    write_mesh(halves(np.array([0, 0, 1e-4])), tmp_path / "torn.ply")
    (fault,) = check_mesh(tmp_path / "torn.ply")
    assert "24 edges are open" in fault
    assert (
        "the 24 vertices there lie up to 0.0001 from one another: merging vertices by distance 0.00011 closes" in fault
    )


def test_a_seam_that_welding_does_not_close_is_left_as_it_is(tmp_path: Path) -> None:
    torn = halves(np.array([0, 0, 1e-8]))
    write_mesh(build_mesh(torn.positions, torn.faces[1:]), tmp_path / "hole.ply")
    mesh = read_mesh(tmp_path / "hole.ply")
    assert open_edges(mesh) == 24 + 3
    assert len(mesh.positions) == len(torn.positions)


def test_small_triangles_are_not_welded_away(tmp_path: Path) -> None:
    """The hole is as small as a rounding; its three vertices would become one."""
    ball = sphere_mesh()
    positions = ball.positions.copy()
    positions[[1, 2]] = positions[0] + [(1e-8, 0, -1e-9), (0, 1e-8, -1e-9)]
    write_mesh(build_mesh(positions, ball.faces[1:]), tmp_path / "hole.ply")
    assert open_edges(read_mesh(tmp_path / "hole.ply")) == 3


def test_far_from_the_origin_only_a_seam_that_is_narrow_is_welded(tmp_path: Path) -> None:
    torn = halves(np.array([0, 0, 1e-3]))
    write_mesh(build_mesh(torn.positions + 1e5, torn.faces), tmp_path / "far.ply")
    assert open_edges(read_mesh(tmp_path / "far.ply")) == 24


FLAT = {
    "two corners in one": ("", "3 0 1 1"),
    "one corner": ("", "3 2 2 2"),
    "a line of its own vertices": ("0.5 0.5 0.5\n0.75 0.75 0.75", "3 0 4 5"),
    "a quad there and back": ("", "4 0 1 0 1"),
}


@pytest.mark.parametrize("case", FLAT)
def test_flat_faces_beside_a_closed_surface_are_dropped_with_a_warning(tmp_path: Path, case: str) -> None:
    vertices, row = FLAT[case]
    corners = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n" + vertices
    rows = "\n".join(f"3 {a} {b} {c}" for a, b, c in TETRAHEDRON_FACES)
    (tmp_path / "t.ply").write_text(ascii_ply(corners.strip(), rows + "\n" + row))
    with pytest.warns(InputWarning, match=r"\d of \d faces have no area, the first is face 4 .* were dropped"):
        mesh = read_mesh(tmp_path / "t.ply")
    np.testing.assert_array_equal(mesh.faces, TETRAHEDRON_FACES)
    assert mesh.dropped_faces >= 1
    with pytest.warns(InputWarning, match="no area"):
        assert check_mesh(tmp_path / "t.ply") == []


def test_a_flat_face_that_joins_others_is_refused(tmp_path: Path) -> None:
    """It closes the gap between an edge and the two edges of its neighbours that lie on it."""
    rows = "3 0 2 1\n3 0 4 3\n3 4 1 3\n3 0 3 2\n3 1 2 3\n3 0 1 4"
    (tmp_path / "t.ply").write_text(ascii_ply("0 0 0\n1 0 0\n0 1 0\n0 0 1\n0.5 0 0", rows))
    with pytest.raises(MeshError, match="1 of 6 faces have no area, the first is face 5"):
        read_mesh(tmp_path / "t.ply")
    assert open_edges(read_mesh(tmp_path / "t.ply", drop_flat_faces=True)) == 3
    assert len(check_mesh(tmp_path / "t.ply")) == 2
