"""Texture coordinates that no texture can be looked up by are faults; those outside the image are remarks."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from formats.mesh import Mesh, check_mesh, read_mesh, texture_fault, texture_remark, write_mesh
from prt_bake.inspection.files import find_faults, find_remarks
from tests.formats.mesh.test_mesh import sphere_mesh


def ball_with(pairs: np.ndarray) -> Mesh:
    return dataclasses.replace(sphere_mesh(), uv=pairs)


def inside() -> np.ndarray:
    return np.linspace(0, 1, 2 * 86).reshape(86, 2)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, -1e7])
def test_unusable_ones_are_counted_and_the_first_is_given(tmp_path: Path, suffix: str, value: float) -> None:
    pairs = inside()
    pairs[40, 1] = value
    ball = ball_with(pairs)
    write_mesh(ball, tmp_path / f"ball{suffix}")
    (fault,) = check_mesh(tmp_path / f"ball{suffix}")
    count = (ball.faces == 40).sum()
    place = ", ".join(f"{x:.6g}" for x in ball.positions[40])
    assert f"{count} of 504 corners of faces have texture coordinates that are not finite or beyond ±1e+06" in fault
    assert f"the first at vertex 40 ({place}): ({pairs[40, 0]:.6g}, {value:.6g})" in fault
    assert find_faults(tmp_path / f"ball{suffix}") == [fault]


def test_the_vertex_is_that_of_the_file(tmp_path: Path) -> None:
    rows = ["v 9 9 9", "v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1", "vt 0 0", "vt nan 0"]
    (tmp_path / "t.obj").write_text(
        "\n".join([*rows, "f 2/1 4/1 3/1", "f 2/1 3/1 5/1", "f 2/1 5/1 4/1", "f 3/2 4/1 5/1"])
    )
    assert "the first at vertex 2 (1, 0, 0): (nan, 0)" in check_mesh(tmp_path / "t.obj")[0]


def test_usable_ones_are_no_fault() -> None:
    assert texture_fault(sphere_mesh()) is None
    assert texture_remark(sphere_mesh()) is None
    for pairs in (inside(), inside() * 1e6, inside() * 1.0005):
        assert texture_fault(ball_with(pairs)) is None
    assert texture_remark(ball_with(inside() * 1.0005)) is None


def test_those_outside_the_image_are_a_remark(tmp_path: Path) -> None:
    write_mesh(ball_with(inside() * [3, 1] - [0.5, 0]), tmp_path / "ball.ply")
    assert find_faults(tmp_path / "ball.ply") == []
    (remark,) = find_remarks(tmp_path / "ball.ply")
    assert "from (-0.5, 0.00584795) to (2.48246, 1); outside 0 to 1 images repeat" in remark
    write_mesh(ball_with(inside()), tmp_path / "ball.ply")
    assert find_remarks(tmp_path / "ball.ply") == []
    assert read_mesh(tmp_path / "ball.ply").corner_uv is not None


@pytest.mark.parametrize(("second", "warned"), [(1, 1), (0, 0)])
def test_several_images_are_named(tmp_path: Path, recwarn: pytest.WarningsRecorder, second: int, warned: int) -> None:
    """MeshLab writes the image of each face as texnumber."""
    header = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {name}\n" for name in "xyz")
    header += "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    rows = ["0 0 0", "1 0 0", "1 1 0", "0 1 0", "3 0 1 2 6 0 0 1 0 1 1 0", f"3 0 2 3 6 0 0 1 1 0 1 {second}"]
    (tmp_path / "square.ply").write_text("\n".join([header + "property int texnumber\nend_header", *rows]))
    assert read_mesh(tmp_path / "square.ply").corner_uv is not None
    assert ["those of 2 images (texnumber)" in str(warning.message) for warning in recwarn] == [True] * warned
