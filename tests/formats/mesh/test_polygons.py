"""Polygons: triangles that fill them and use every corner, exact areas, closed solids, and outlines that cross."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.errors import InputWarning, MeshError
from formats.mesh import check_mesh, open_edges, read_mesh, signed_volume
from formats.mesh.edges import edges_of
from formats.mesh.triangulation import MOST_CORNERS, triangulate
from formats.triangle_soup import fan

L = np.array([(2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 0)], np.float64)
PENTAGRAM = np.array([(np.cos(a), np.sin(a)) for a in np.arange(5) * 0.8 * np.pi])
EASY = settings(max_examples=30, deadline=None, derandomize=True, database=None)


def divided(positions: np.ndarray, sizes: list[int]) -> np.ndarray:
    """Triangles [F,3] of polygons whose corners are the positions in order."""
    return triangulate(positions, np.arange(len(positions)), np.array(sizes), lambda index: f"polygon {index}")


def placed(flat: np.ndarray, seed: int = 0) -> np.ndarray:
    """A flat polygon [n,2], rotated and moved in space."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return flat @ axes[:2] + rng.normal(size=3)


def outline_area(flat: np.ndarray) -> float:
    x, y = (flat - flat[0]).T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def signed_areas(flat: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (flat[triangles[:, corner]] for corner in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def assert_fills(flat: np.ndarray, positions: np.ndarray | None = None) -> np.ndarray:
    """No triangle is turned over and the areas add up, so they cover the polygon once; their outline is its own."""
    triangles = divided(placed(flat) if positions is None else positions, [len(flat)])
    areas = signed_areas(flat, triangles)
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(outline_area(flat), rel=1e-12)
    assert len(triangles) == len(flat) - 2
    edges = edges_of(triangles)
    outline = {(i, (i + 1) % len(flat)) for i in range(len(flat))}
    found = {tuple(end[:: int(sign)]) for end, sign in zip(edges.ends.tolist(), edges.directions, strict=True) if sign}
    assert found == outline
    return triangles


def star(radii: list[float]) -> np.ndarray:
    angles = np.arange(len(radii)) * 2 * np.pi / len(radii)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1) * np.array(radii)[:, None]


def spiral(turns: float, count: int) -> np.ndarray:
    angle = np.linspace(0, turns * 2 * np.pi, count)
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([(1.5 + angle)[:, None] * way, (1 + angle[::-1])[:, None] * way[::-1]])


@EASY
@given(
    angles=st.lists(st.floats(0, 6.28), min_size=4, max_size=12, unique_by=lambda a: round(a, 1)),
    seed=st.integers(0, 99),
)
def test_convex_polygons_are_fans_about_their_first_corner(angles: list[float], seed: int) -> None:
    flat = np.array([(2 * np.cos(a), np.sin(a)) for a in sorted(angles)])
    np.testing.assert_array_equal(divided(placed(flat, seed), [len(flat)]), fan(np.array([len(flat)])))


@EASY
@given(radii=st.lists(st.floats(0.05, 1), min_size=4, max_size=30), first=st.integers(0, 29))
def test_star_shaped_polygons_are_filled(radii: list[float], first: int) -> None:
    assert_fills(np.roll(star(radii), first, axis=0))


@pytest.mark.parametrize("count", [25, 60])
def test_spirals_are_filled(count: int) -> None:
    assert_fills(spiral(3, count))
    assert_fills(np.roll(spiral(1.3, count), 7, axis=0))


@pytest.mark.parametrize("first", range(6))
def test_an_l_is_filled_from_every_first_corner(first: int) -> None:
    assert_fills(np.roll(L, first, axis=0))


def test_collinear_corners_are_corners_of_triangles_with_area() -> None:
    """As where a neighbour's edge is divided; without them a crack opens."""
    square = np.array(
        [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (3, 2), (3, 3), (1, 3), (0, 3), (0, 2), (0, 1)], np.float64
    )
    for first in range(len(square)):
        triangles = assert_fills(np.roll(square, first, axis=0))
        assert signed_areas(np.roll(square, first, axis=0), triangles).min() > 0.4
    triangle = np.array([(0, 0), (1, 0), (2, 0), (4, 0), (0, 4)], np.float64)
    assert_fills(triangle)


def test_the_worst_triangle_is_as_good_as_possible() -> None:
    """A fan about another corner of this strip has slivers; the zigzag has none."""
    lower, upper = np.arange(7.0), np.arange(6.0, -1.0, -1.0)
    strip = np.concatenate([np.stack([lower, 0 * lower], axis=1), np.stack([upper, 0 * upper + 1], axis=1)])
    areas = signed_areas(strip, assert_fills(strip))
    np.testing.assert_allclose(areas, 0.5)


def test_holes_that_are_joined_to_the_outline_stay_open() -> None:
    outer = [(0, 0), (6, 0), (6, 6), (0, 6), (0, 0)]
    hole = [(2, 2), (2, 4), (4, 4), (4, 2), (2, 2)]
    flat = np.array(outer + hole, np.float64)
    triangles = divided(placed(flat), [len(flat)])
    areas = signed_areas(flat, triangles)
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(32)


@EASY
@given(radii=st.lists(st.floats(0.3, 1), min_size=5, max_size=12), height=st.floats(0, 0.2), seed=st.integers(0, 99))
def test_polygons_that_are_not_planar_are_filled_in_their_projection(radii, height, seed) -> None:
    flat = star(radii)
    bumps = height * np.random.default_rng(seed).uniform(-1, 1, len(flat))
    triangles = divided(np.column_stack([flat, bumps]), [len(flat)])
    assert len(triangles) == len(flat) - 2
    assert not edges_of(np.concatenate([triangles, fan(np.array([len(flat)]))[:, ::-1]])).directions.any()


def test_many_polygons_are_divided_as_each_alone() -> None:
    rng = np.random.default_rng(3)
    polygons = [placed(star(list(rng.uniform(0.1, 1, n))), n) for n in rng.integers(3, 9, 60)]
    sizes = [len(polygon) for polygon in polygons]
    together = divided(np.concatenate(polygons), sizes)
    starts = np.cumsum(sizes) - sizes
    alone = [divided(polygon, [len(polygon)]) + start for polygon, start in zip(polygons, starts, strict=True)]
    np.testing.assert_array_equal(together, np.concatenate(alone))


def prism(flat: np.ndarray, suffix: str) -> str:
    """A solid of height 1 between two polygons, with quads as sides, as the text of a mesh file."""
    n = len(flat)
    vertices = [(x, y, z) for z in (0, 1) for x, y in flat.tolist()]
    faces = [list(range(n))[::-1], list(range(n, 2 * n))] + [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    if suffix == ".obj":
        rows = [f"v {x!r} {y!r} {z}" for x, y, z in vertices]
        return "\n".join(rows + ["f " + " ".join(str(i + 1) for i in face) for face in faces])
    header = f"ply\nformat ascii 1.0\nelement vertex {2 * n}\nproperty double x\nproperty double y\nproperty double z\n"
    header += f"element face {n + 2}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [f"{x!r} {y!r} {z}" for x, y, z in vertices]
    return header + "\n".join(rows + [" ".join(map(str, [len(face), *face])) for face in faces]) + "\n"


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_concave_prisms_are_closed_and_exact(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"prism{suffix}"
    for flat in (L, spiral(2, 12), star([1, 0.2] * 5)):
        path.write_text(prism(flat, suffix))
        mesh = read_mesh(path)
        length = np.linalg.norm(flat - np.roll(flat, 1, axis=0), axis=1).sum()
        assert signed_volume(mesh) == pytest.approx(outline_area(flat), rel=1e-12)
        assert mesh.face_areas.sum() == pytest.approx(2 * outline_area(flat) + length, rel=1e-12)
        assert check_mesh(path) == []
    path.write_text(prism(L, suffix))
    mesh = read_mesh(path)
    assert (mesh.face_areas.sum(), signed_volume(mesh)) == (pytest.approx(14), pytest.approx(3))


def test_quads_that_repeat_a_corner_are_triangles(tmp_path: Path) -> None:
    rows = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1", "f 1 3 2 2", "f 1 1 2 4", "f 1 4 4 3", "f 2 3 4 2"]
    (tmp_path / "t.obj").write_text("\n".join(rows))
    mesh = read_mesh(tmp_path / "t.obj")
    assert (len(mesh.faces), open_edges(mesh)) == (4, 0)
    assert signed_volume(mesh) == pytest.approx(1 / 6)


CROSSING = {
    "a bow tie": np.array([(0, 0), (2, 1), (2, 0), (0, 1.5)], np.float64),
    "a bow tie of equal halves": np.array([(0, 0), (1, 1), (1, 0), (0, 1)], np.float64),
    "a pentagram": PENTAGRAM,
    "a loop": np.array([(0, 0), (3, 0), (3, 3), (1, 3), (1, 1), (2, 1), (2, 4), (0, 4)], np.float64),
}


@pytest.mark.parametrize("case", CROSSING)
def test_outlines_that_cross_themselves_are_refused_with_their_place(tmp_path: Path, case: str) -> None:
    flat = CROSSING[case]
    sentence = f"a face of {len(flat)} corners crosses itself \\(1 in all\\)"
    with pytest.raises(MeshError, match=f"polygon 1: .*{sentence}"):
        divided(np.concatenate([placed(L), placed(flat)]), [6, len(flat)])
    rows = [f"v {x!r} {y!r} 0" for x, y in flat.tolist()] + ["# a comment"]
    (tmp_path / "t.obj").write_text(
        "\n".join([*rows, "f 1 2 3", "f " + " ".join(str(i + 1) for i in range(len(flat)))])
    )
    with pytest.raises(MeshError, match=f"line {len(flat) + 3}: .*{sentence}"):
        read_mesh(tmp_path / "t.obj")


def test_a_quad_folded_over_is_divided_where_it_bends_least_with_a_warning() -> None:
    folded = np.array([(0, 0, 0), (1, 0, 0.4), (0.2, 0.3, 0), (0.3, -0.1, 0.4)])
    with pytest.warns(InputWarning, match=r"polygon 0: a face is bent so far .*\(1 in all\)"):
        triangles = divided(folded, [4])
    assert len(triangles) == 2
    assert not edges_of(np.concatenate([triangles, [[2, 1, 0], [3, 2, 0]]])).directions.any()


def test_large_polygons_are_fans_or_refused() -> None:
    angles = np.arange(MOST_CORNERS + 1) * 2 * np.pi / (MOST_CORNERS + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    assert_fills(circle)
    circle[::2] *= 0.9
    with pytest.raises(MeshError, match=f"a face of {MOST_CORNERS + 1} corners is not convex; expected at most"):
        divided(placed(circle), [len(circle)])


def test_polygons_with_unusable_vertices_are_left_to_the_reader(tmp_path: Path) -> None:
    for vertex, face, sentence in (("nan 0 0", "1 2 3 4", "vertex 1"), ("1 0 0", "1 2 3 9", "9|do not exist")):
        (tmp_path / "t.obj").write_text(f"v 0 0 0\nv {vertex}\nv 1 1 0\nv 0 1 0\nf {face}\n")
        with pytest.raises(MeshError, match=sentence):
            read_mesh(tmp_path / "t.obj")
    for huge in ("1e200 0 0", "-1e308 1e308 0"):
        (tmp_path / "t.obj").write_text(f"v 0 0 0\nv {huge}\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
        with pytest.raises(MeshError, match="beyond"):
            read_mesh(tmp_path / "t.obj")


def test_polygons_without_any_vertex_are_refused(tmp_path):
    (tmp_path / "mesh.obj").write_text("f 1 2 3 4\nf 2 3 4\n")
    with pytest.raises(MeshError, match="faces use vertices that do not exist"):
        read_mesh(tmp_path / "mesh.obj")


NURBS = "cstype bspline\ndeg 1 1\nsurf 0 1 0 1 1 2 3 4\nparm u 0 0 1 1\nparm v 0 0 1 1\nend\n"


def test_free_form_surfaces_are_named(tmp_path: Path) -> None:
    vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (tmp_path / "a.obj").write_text(vertices + NURBS)
    with pytest.raises(MeshError, match=r"a\.obj: line 7: is a free-form surface, .*export it as a polygon mesh"):
        read_mesh(tmp_path / "a.obj")
    (tmp_path / "a.obj").write_text(vertices + NURBS + NURBS + "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    with pytest.warns(InputWarning, match=r"a\.obj: line 7: is a free-form surface, .*, and ignored"):
        assert len(read_mesh(tmp_path / "a.obj").faces) == 4
