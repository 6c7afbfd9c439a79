"""STL: ascii and binary, headers that mislead, and damaged files."""

import struct
from pathlib import Path

import numpy as np
import pytest

from formats.errors import InputWarning, MeshError
from formats.mesh import Mesh, check_mesh, open_edges, read_mesh, signed_volume
from tests.formats.mesh.test_mesh import sphere_mesh, tetrahedron


def ascii_stl(mesh: Mesh, name: str = "ball") -> str:
    rows = [f"solid {name}"]
    for normal, corners in zip(mesh.face_normals.tolist(), mesh.positions[mesh.faces].tolist(), strict=True):
        rows += [" facet normal {:e} {:e} {:e}".format(*normal), "  outer loop"]
        rows += ["   vertex {!r} {!r} {!r}".format(*corner) for corner in corners]
        rows += ["  endloop", " endfacet"]
    return "\n".join([*rows, f"endsolid {name}", ""])


def binary_stl(mesh: Mesh, header: bytes = b"exported", facets: int | None = None) -> bytes:
    count = len(mesh.faces) if facets is None else facets
    rows = [struct.pack("<12fH", 0, 0, 0, *corners.ravel(), 0) for corners in mesh.positions[mesh.faces]]
    return header.ljust(80, b" ")[:80] + struct.pack("<I", count) + b"".join(rows)


def assert_ball(path: Path) -> None:
    ball, mesh = sphere_mesh(), read_mesh(path)
    assert check_mesh(path) == []
    assert (len(mesh.positions), len(mesh.faces)) == (len(ball.positions), len(ball.faces))
    assert signed_volume(mesh) == pytest.approx(signed_volume(ball), rel=1e-6)
    np.testing.assert_allclose(mesh.positions[mesh.faces], ball.positions[ball.faces], atol=1e-7)


@pytest.mark.parametrize("name", ["ball", "", "a vertex and a facet", "endsolid solid"])
def test_ascii_is_read_whatever_its_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "ball.stl").write_text(ascii_stl(sphere_mesh(), name))
    assert_ball(tmp_path / "ball.stl")
    (tmp_path / "ball.stl").write_text(ascii_stl(sphere_mesh(), name).upper())
    assert_ball(tmp_path / "ball.stl")


@pytest.mark.parametrize("name", ["ball", "a vertex and a facet"])
@pytest.mark.parametrize("end", ["outer", "vertex", "endloop", "endfacet", "facet"])
def test_ascii_is_read_with_several_statements_in_a_line(tmp_path: Path, name: str, end: str) -> None:
    lines = ascii_stl(sphere_mesh(), name).splitlines()
    joined = "".join((" " if line.split()[0] in ("vertex", "endloop", end) else "\n") + line for line in lines[1:-1])
    (tmp_path / "ball.stl").write_text("\n".join([lines[0] + joined, lines[-1], ""]))
    assert_ball(tmp_path / "ball.stl")


@pytest.mark.parametrize("header", [b"exported", b"solid ball", b"\xff\xfe\xfa", b"\0", b"solid\nfacet normal 0 0 0"])
def test_binary_is_read_whatever_its_header(tmp_path: Path, header: bytes) -> None:
    (tmp_path / "ball.stl").write_bytes(binary_stl(sphere_mesh(), header))
    assert_ball(tmp_path / "ball.stl")


def test_several_solids_are_one_mesh(tmp_path: Path) -> None:
    far = tetrahedron()
    far = Mesh(far.positions + 5, far.faces, far.normals)
    (tmp_path / "two.stl").write_text(ascii_stl(tetrahedron(), "one") + ascii_stl(far, "two"))
    mesh = read_mesh(tmp_path / "two.stl")
    assert (len(mesh.positions), len(mesh.faces), open_edges(mesh)) == (8, 8, 0)


@pytest.mark.parametrize("facets", [0, 1, 167, 169, 2**32 - 1])
@pytest.mark.parametrize("header", [b"exported", b"solid ball"])
def test_a_number_of_facets_that_disagrees_with_the_size_is_refused(tmp_path: Path, facets: int, header: bytes) -> None:
    ball = sphere_mesh()
    assert len(ball.faces) == 168
    (tmp_path / "ball.stl").write_bytes(binary_stl(ball, header, facets))
    with pytest.raises(MeshError, match=f"its header says {facets} facets, its size is that of 168;"):
        read_mesh(tmp_path / "ball.stl")


def test_bytes_after_the_facets_are_named(tmp_path: Path) -> None:
    (tmp_path / "ball.stl").write_bytes(binary_stl(sphere_mesh()) + b"\r\n")
    with pytest.warns(InputWarning, match="2 bytes after the last of 168 facets are ignored"):
        read_mesh(tmp_path / "ball.stl")


def test_truncated_files_are_refused(tmp_path: Path) -> None:
    binary, text = binary_stl(sphere_mesh()), ascii_stl(sphere_mesh()).encode()
    for content in (binary, text):
        for tenth in range(10):
            (tmp_path / "cut.stl").write_bytes(content[: len(content) * tenth // 10])
            with pytest.raises(MeshError, match=r"cut\.stl"):
                read_mesh(tmp_path / "cut.stl")
    whole_facets = text[: text.index(b" facet", 2000)]
    (tmp_path / "cut.stl").write_bytes(whole_facets)
    with pytest.raises(MeshError, match=r"truncated: it ends after \d+ facets without endsolid"):
        read_mesh(tmp_path / "cut.stl")


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("   vertex 0.0 0.0 0.0\n   vertex 0.0 1.0 0.0\n", "   vertex 0.0 0.0 0.0\n", 6),
        ("  endloop", "   vertex 0 0 0\n  endloop", 8),
        ("vertex 0.0 1.0 0.0", "vertex 0,0 1,0 0,0", 5),
        ("vertex 0.0 1.0 0.0", "vertex 0.0 1.0", 5),
        ("  outer loop", "  loop", 3),
        ("solid ball", "cylinder ball", 1),
    ],
)
def test_errors_in_ascii_name_the_line(tmp_path: Path, old: str, new: str, line: int) -> None:
    (tmp_path / "bad.stl").write_text(ascii_stl(tetrahedron()).replace(old, new, 1))
    with pytest.raises(MeshError, match=f"line {line}: expected an STL facet"):
        read_mesh(tmp_path / "bad.stl")


def test_vertices_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.stl").write_text(ascii_stl(tetrahedron()).replace("vertex 0.0 1.0 0.0", "vertex nan 1.0 0.0", 1))
    with pytest.raises(MeshError, match="1 of 12 vertices are NaN"):
        read_mesh(tmp_path / "bad.stl")
