"""PLY headers and elements as other programs write them: types, line ends, comments, triangle strips."""

import struct
from pathlib import Path

import numpy as np
import pytest

from formats.errors import InputWarning, MeshError
from formats.mesh import open_edges, read_mesh, signed_volume
from tests.formats.mesh.test_mesh import (
    CUBE_CORNERS,
    TETRAHEDRON,
    TETRAHEDRON_FACES,
    TETRAHEDRON_ROWS,
    TETRAHEDRON_VERTICES,
    ascii_ply,
)


def tetrahedron_ply(kind: str, order: str = "", line_end: str = "\n", comment: str = "") -> bytes:
    """A tetrahedron with lists of `kind` ("uint64 int64"), ascii or binary of a byte order, "<" or ">"."""
    text = ascii_ply(TETRAHEDRON_VERTICES, TETRAHEDRON_ROWS).replace("uchar int", kind).replace("made by hand", comment)
    if not order:
        return text.replace("\n", line_end).encode()
    header = text[: text.rindex("end_header\n")].replace(
        "ascii", "binary_little_endian" if order == "<" else "binary_big_endian"
    )
    codes = {"uchar": "B", "int": "i", "uint64": "Q", "int64": "q", "uint8": "B", "ushort": "H", "float16": "e"}
    count, index = (codes[name] for name in kind.split())
    body = struct.pack(f"{order}12f", *TETRAHEDRON.ravel())
    body += b"".join(struct.pack(f"{order}{count}3{index}", 3, *face) for face in TETRAHEDRON_FACES)
    return (header + "end_header\n").replace("\n", line_end).encode() + body


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize("kind", ["uchar int", "uint64 int64", "int64 uint64", "uint8 ushort", "uchar float16"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
def test_types_byte_orders_and_line_ends(tmp_path: Path, order: str, kind: str, line_end: str) -> None:
    (tmp_path / "t.ply").write_bytes(tetrahedron_ply(kind, order, line_end))
    mesh = read_mesh(tmp_path / "t.ply")
    np.testing.assert_array_equal(mesh.positions, TETRAHEDRON)
    np.testing.assert_array_equal(mesh.faces, TETRAHEDRON_FACES)


def test_a_body_that_begins_with_a_line_end_is_kept(tmp_path: Path) -> None:
    """The first coordinate's first byte is 10, LF, after a header of carriage returns."""
    content = tetrahedron_ply("uchar int", "<", "\r")
    start = content.index(b"end_header\r") + len(b"end_header\r")
    (tmp_path / "t.ply").write_bytes(content[:start] + b"\n" + content[start + 1 :])
    assert read_mesh(tmp_path / "t.ply").positions[0, 0] == np.frombuffer(b"\n\0\0\0", "<f4")[0]


@pytest.mark.parametrize("order", ["", "<"])
def test_comments_may_hold_keywords(tmp_path: Path, order: str) -> None:
    comment = "end_header\nobj_info end_header element face 9\ncomment element vertex 3 property int x"
    (tmp_path / "t.ply").write_bytes(tetrahedron_ply("uchar int", order, comment=comment))
    np.testing.assert_array_equal(read_mesh(tmp_path / "t.ply").faces, TETRAHEDRON_FACES)


def test_indices_beyond_every_integer_are_refused(tmp_path: Path) -> None:
    for index in ("18446744073709551615", "-9223372036854775808", "1e300"):
        content = tetrahedron_ply("uchar int64").replace(b"3 1 2 3", b"3 1 2 " + index.encode())
        (tmp_path / "t.ply").write_bytes(content)
        with pytest.raises(MeshError, match="vertices that do not exist, the first is face 3"):
            read_mesh(tmp_path / "t.ply")


DAMAGED = {
    "lists of no number": (b"3 1 2 3", b"nan 1 2 3", "list of length nan"),
    "lists of infinite length": (b"3 1 2 3", b"inf 1 2 3", "list of length inf"),
    "half an index": (b"3 1 2 3", b"3 1 2 2.5", "not integers"),
    "an unknown type": (b"float y", b"long y", "line 6 of the PLY header: .*known type, found 'property long y'"),
    "a property twice": (b"float y", b"float x", "element vertex has the property 'x' twice"),
    "an element twice": (b"element face", b"element vertex", "line 8"),
    "a negative number of rows": (b"element face 4", b"element face -4", "line 8"),
    "rows beyond every integer": (b"vertex 4", b"vertex " + 5000 * b"9", "line 4 .* found 'element vertex 9{50,80}; "),
    "a property of no element": (b"comment", b"property int i\ncomment", "line 3"),
    "no format": (b"format ascii 1.0", b"comment", "no format line"),
    "another format": (b"ascii", b"binary", "line 2"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_headers_and_lists_are_refused(tmp_path: Path, case: str) -> None:
    old, new, sentence = DAMAGED[case]
    (tmp_path / "t.ply").write_bytes(tetrahedron_ply("uchar int").replace(old, new))
    with pytest.raises(MeshError, match=sentence):
        read_mesh(tmp_path / "t.ply")


def test_elements_without_properties_are_skipped(tmp_path: Path) -> None:
    content = tetrahedron_ply("uchar int").replace(b"element face", b"element nothing 1000000000000\nelement face")
    (tmp_path / "t.ply").write_bytes(content)
    np.testing.assert_array_equal(read_mesh(tmp_path / "t.ply").faces, TETRAHEDRON_FACES)


def strips_ply(corners: list[tuple[int, int, int]], strips: list[list[int]], kind: str = "int", faces: str = "") -> str:
    rows = "\n".join(" ".join(map(str, corner)) for corner in corners)
    text = ascii_ply(rows, faces).removesuffix("\n")
    start, body = text.split("end_header\n")
    start += f"element tristrips {len(strips)}\nproperty list int {kind} vertex_indices\nend_header\n"
    return start + body + "\n" + "\n".join(" ".join(map(str, [len(strip), *strip])) for strip in strips) + "\n"


def fans_as_strips(restart: int) -> list[int]:
    """The cube's quads as strips of two triangles."""
    quads = [(0, 3, 1, 2), (4, 5, 7, 6), (0, 1, 4, 5), (1, 2, 5, 6), (2, 3, 6, 7), (3, 0, 7, 4)]
    return [index for quad in quads for index in (*quad, restart)]


@pytest.mark.parametrize(
    ("strips", "kind"),
    [
        ([fans_as_strips(-1)], "int"),
        ([fans_as_strips(-1)[:-1]], "int"),
        ([fans_as_strips(2**32 - 1)], "uint"),
        ([fans_as_strips(-1)[5 * i : 5 * i + 4] for i in range(6)], "int"),
        ([[], fans_as_strips(-1)[:15], [], fans_as_strips(-1)[15:], []], "int"),
    ],
)
def test_triangle_strips_bound_a_cube(tmp_path: Path, strips: list[list[int]], kind: str) -> None:
    (tmp_path / "t.ply").write_text(strips_ply(CUBE_CORNERS, strips, kind))
    mesh = read_mesh(tmp_path / "t.ply")
    assert (len(mesh.faces), open_edges(mesh)) == (12, 0)
    assert signed_volume(mesh) == pytest.approx(1)


def test_one_strip_bounds_a_cube_and_repeated_vertices_join_strips(tmp_path: Path) -> None:
    corners = [(0, 0, 0), (0, 0, 1), (0, 1, 0), (0, 1, 1), (1, 0, 0), (1, 0, 1), (1, 1, 0), (1, 1, 1)]
    whole = [3, 2, 7, 6, 4, 2, 0, 3, 1, 7, 5, 4, 1, 0]
    (tmp_path / "t.ply").write_text(strips_ply(corners, [whole]))
    mesh = read_mesh(tmp_path / "t.ply")
    assert (len(mesh.faces), open_edges(mesh), abs(signed_volume(mesh))) == (12, 0, pytest.approx(1))
    quads = fans_as_strips(-1)
    joined = quads[:4]
    for i in range(1, 6):
        joined += [joined[-1], quads[5 * i], *quads[5 * i : 5 * i + 4]]
    (tmp_path / "t.ply").write_text(strips_ply(CUBE_CORNERS, [joined]))
    mesh = read_mesh(tmp_path / "t.ply")
    assert (len(mesh.faces), open_edges(mesh), signed_volume(mesh)) == (12, 0, pytest.approx(1))


def test_faces_and_strips_are_read_together(tmp_path: Path) -> None:
    faces = "4 0 3 2 1\n4 4 5 6 7"
    (tmp_path / "t.ply").write_text(strips_ply(CUBE_CORNERS, [fans_as_strips(-1)[10:]], faces=faces))
    mesh = read_mesh(tmp_path / "t.ply")
    assert (len(mesh.faces), open_edges(mesh), signed_volume(mesh)) == (12, 0, pytest.approx(1))


def test_strips_with_vertices_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    for wrong in (-2, 8):
        (tmp_path / "t.ply").write_text(strips_ply(CUBE_CORNERS, [[0, 1, 2, wrong]]))
        with pytest.raises(MeshError, match="do not exist"):
            read_mesh(tmp_path / "t.ply")
    (tmp_path / "t.ply").write_text(strips_ply(CUBE_CORNERS, [[0, 1]]))
    with pytest.raises(MeshError, match="no faces"):
        read_mesh(tmp_path / "t.ply")


def test_texture_coordinates_that_some_faces_lack_are_named(tmp_path: Path) -> None:
    pairs = ["6 0 0 1 0 0 1"] * 4
    pairs[2] = "0"
    rows = "\n".join(f"{row} {pair}" for row, pair in zip(TETRAHEDRON_ROWS.splitlines(), pairs, strict=True))
    text = ascii_ply(TETRAHEDRON_VERTICES, rows)
    (tmp_path / "t.ply").write_text(text.replace("end_header", "property list uchar float texcoord\nend_header"))
    with pytest.warns(InputWarning, match="1 of 4 faces do not have two texture .*first is face 2"):
        assert read_mesh(tmp_path / "t.ply").corner_uv is None


@pytest.mark.parametrize("order", ["", "<"])
def test_faces_that_the_header_does_not_count_are_named(tmp_path: Path, order: str) -> None:
    content = tetrahedron_ply("uchar int", order)
    (tmp_path / "t.ply").write_bytes(content + b"\n\n")
    read_mesh(tmp_path / "t.ply")
    (tmp_path / "t.ply").write_bytes(content.replace(b"element face 4", b"element face 3"))
    found = "13 bytes" if order else "4 numbers"
    with pytest.warns(InputWarning, match=f"{found} follow the last row that the header counts, and are ignored"):
        assert len(read_mesh(tmp_path / "t.ply").faces) == 3
