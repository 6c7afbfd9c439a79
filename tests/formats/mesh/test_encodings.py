"""Text as editors and other programs write it: byte order marks, line ends, comments; missing texture coordinates."""

import codecs
from pathlib import Path

import numpy as np
import pytest

from formats.errors import InputWarning, MeshError
from formats.mesh import check_mesh, read_mesh
from tests.formats.mesh.test_mesh import (
    TETRAHEDRON,
    TETRAHEDRON_FACES,
    TETRAHEDRON_ROWS,
    TETRAHEDRON_VERTICES,
    ascii_ply,
)

FACES = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n" + FACES
STL = (
    "solid t\n"
    + "".join(
        f"facet normal 0 0 0\nouter loop\n{''.join(f'vertex {x} {y} {z}' + chr(10) for x, y, z in TETRAHEDRON[face])}"
        "endloop\nendfacet\n"
        for face in TETRAHEDRON_FACES
    )
    + "endsolid t\n"
)
TEXTS = {".obj": OBJ, ".ply": ascii_ply(TETRAHEDRON_VERTICES, TETRAHEDRON_ROWS), ".stl": STL}


def assert_tetrahedron(path: Path) -> None:
    mesh = read_mesh(path)
    np.testing.assert_array_equal(
        np.sort(mesh.positions.view("f8,f8,f8"), axis=0), np.sort(TETRAHEDRON.view("f8,f8,f8"), axis=0)
    )
    assert check_mesh(path) == []


@pytest.mark.parametrize("suffix", TEXTS)
@pytest.mark.parametrize("line_end", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("mark", [b"", codecs.BOM_UTF8])
def test_byte_order_marks_and_line_ends_change_nothing(
    tmp_path: Path, suffix: str, line_end: bytes, mark: bytes
) -> None:
    path = tmp_path / f"t{suffix}"
    path.write_bytes(mark + TEXTS[suffix].encode().replace(b"\n", line_end))
    assert_tetrahedron(path)


@pytest.mark.parametrize("suffix", TEXTS)
@pytest.mark.parametrize(("encoding", "name"), [("utf-16", "UTF-16"), ("utf-32", "UTF-32")])
def test_other_encodings_are_named(tmp_path: Path, suffix: str, encoding: str, name: str) -> None:
    (tmp_path / f"t{suffix}").write_bytes(TEXTS[suffix].encode(encoding))
    with pytest.raises(MeshError, match=f"expected text in UTF-8, found {name}"):
        read_mesh(tmp_path / f"t{suffix}")


def test_a_mark_before_the_first_vertex_does_not_lose_it(tmp_path: Path) -> None:
    (tmp_path / "t.obj").write_bytes(codecs.BOM_UTF8 + (OBJ + "v 9 9 9\n").encode())
    assert_tetrahedron(tmp_path / "t.obj")


def test_a_backslash_continues_statements_only(tmp_path: Path) -> None:
    """Paths in comments and in names of materials may end in one."""
    text = OBJ.replace("v 0 0 0", "# made in C:\\models\\\nv 0 0 0").replace("f 1 3 2", "mtllib C:\\\nf 1 \\\n3 2")
    for line_end in ("\n", "\r\n", "\r"):
        (tmp_path / "t.obj").write_bytes(text.replace("\n", line_end).encode())
        assert_tetrahedron(tmp_path / "t.obj")
    (tmp_path / "t.obj").write_text(OBJ.removesuffix("f 2 3 4\n") + "f 2 3 4 \\")
    assert_tetrahedron(tmp_path / "t.obj")


def test_bytes_that_end_lines_elsewhere_do_not_end_them_in_obj(tmp_path: Path) -> None:
    """Python's str.splitlines also ends lines at U+0085 and U+2028, which names and comments may hold."""
    (tmp_path / "t.obj").write_text("# a\u2028v 1 2\x85v 3\ng b\u2029v 4\x1cv 5\n" + OBJ, encoding="utf-8", newline="")
    assert_tetrahedron(tmp_path / "t.obj")


def test_the_old_name_of_faces_is_read(tmp_path: Path) -> None:
    (tmp_path / "t.obj").write_text(OBJ.replace("f ", "fo "))
    assert_tetrahedron(tmp_path / "t.obj")


def test_errors_in_obj_name_lines_after_continued_ones(tmp_path: Path) -> None:
    for damaged in ("v 1 x 2", "f 1 2 99999999999999999999"):
        (tmp_path / "t.obj").write_text("v 0 \\\n0 0\n\n" + damaged + "\n")
        with pytest.raises(MeshError, match=f"line 4: expected an OBJ statement, found '{damaged}'"):
            read_mesh(tmp_path / "t.obj")


def test_texture_coordinates_that_some_corners_lack_are_named(tmp_path: Path) -> None:
    pairs = "vt 0 0\nvt 1 0\nvt 0 1\n"
    whole = FACES.replace(" 1", " 1/1").replace(" 2", " 2/2").replace(" 3", " 3/3").replace(" 4", " 4/3")
    for lacking, count, line in (
        (whole.replace("3/3 2/2\n", "3 2\n"), 2, 8),
        (whole.replace("f 1/1 4/3 3/3", "f 1/1 4/9 3/3"), 1, 10),
    ):
        (tmp_path / "t.obj").write_text(pairs + OBJ.removesuffix(FACES) + lacking)
        with pytest.warns(InputWarning, match=f"{count} of 12 corners of faces have no texture .* line {line}"):
            mesh = read_mesh(tmp_path / "t.obj")
        assert mesh.corner_uv is None
    (tmp_path / "t.obj").write_text(pairs + OBJ.removesuffix(FACES) + whole)
    assert read_mesh(tmp_path / "t.obj").corner_uv is not None
    (tmp_path / "t.obj").write_text(pairs + OBJ)
    assert read_mesh(tmp_path / "t.obj").corner_uv is None


@pytest.mark.parametrize("last", ["f 2 3 4\n", "f 2//2 3//3 4//9\n"])
def test_normals_that_some_corners_lack_are_named(tmp_path: Path, last: str) -> None:
    corners = "f 1//1 3//3 2//2\nf 1//1 2//2 4//4\nf 1//1 4//4 3//3\n" + last
    rows = "vn -1 -1 -1\nvn 1 0 0\nvn 0 1 0\nvn 0 0 1\n"
    (tmp_path / "t.obj").write_text(OBJ.removesuffix(FACES) + rows + corners)
    count = 3 if last == "f 2 3 4\n" else 1
    with pytest.warns(InputWarning, match=f"{count} of 12 corners of faces have no normals, .* those of the faces are"):
        read_mesh(tmp_path / "t.obj")
