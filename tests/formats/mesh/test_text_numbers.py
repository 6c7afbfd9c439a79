"""Numbers of text files as some programs and countries write them, and the places of those that are wrong."""

from pathlib import Path

import numpy as np
import pytest

from formats.errors import MeshError
from formats.mesh import read_mesh
from formats.mesh.text_numbers import with_plain_nan

SQUARE = ["0 0 0", "1 0 0", "1 1 0", "0 1 0"]


def ply(rows: list[str], face: str) -> str:
    header = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {name}\n" for name in "xyzq")
    return (
        header
        + "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        + "\n".join([*rows, "3 1 0 2", face])
    )


def read(path: Path, text: str) -> np.ndarray:
    path.write_text(text)
    return read_mesh(path).positions


@pytest.mark.parametrize("written", ["-nan(ind)", "nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND", "-1.#IND00", "1.#INF"])
def test_nan_of_microsofts_library_is_read(tmp_path: Path, written: str) -> None:
    """In a vertex of no face, and in a property that is not used."""
    obj = "".join(f"v {row}\n" for row in SQUARE) + f"v {written} {written} {written}\nf 1 2 3 4\n"
    assert len(read(tmp_path / "square.obj", obj)) == 4
    assert len(read(tmp_path / "square.ply", ply([f"{row} {written}" for row in SQUARE], "3 0 2 3"))) == 4
    assert np.isnan(float(with_plain_nan(written.encode()))) or written == "1.#INF"


def test_words_that_hold_the_names_of_nan_are_unchanged() -> None:
    text = b"o part1.#INDIGO\n# nan(ind)x 1.#Q\n"
    assert with_plain_nan(text) == text


def test_a_ply_file_that_counts_from_1_is_named_by_its_row(tmp_path: Path) -> None:
    rows = [f"{row} 0" for row in SQUARE]
    with pytest.raises(
        MeshError, match=r"1 of 2 faces .*, the first is face 1 with corners \[2, 1, 3, 4\]; .* from 0 to 3"
    ):
        read(tmp_path / "square.ply", ply(rows, "4 2 1 3 4"))
    one = ply(rows, "4 2 1 3 4").replace("3 1 0 2", "3 2 1 3")
    with pytest.raises(MeshError, match="; the file seems to count from 1, PLY counts from 0"):
        read(tmp_path / "square.ply", one)


@pytest.mark.parametrize("suffix", ["ply", "stl"])
def test_decimal_commas_are_named(tmp_path: Path, suffix: str) -> None:
    texts = {"ply": ply(["0,5 0 0 0", *SQUARE[1:]], "3 0 2 3"), "stl": "solid\nfacet\nouter loop\nvertex 0,5 0 0\n"}
    with pytest.raises(MeshError, match="its numbers have commas; export it again with decimal points"):
        read(tmp_path / f"square.{suffix}", texts[suffix])
