"""Corner normals: smooth over bent surfaces, apart at sharp edges; files with flat shading are recognised."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from formats.asset import read_asset, write_asset
from formats.mesh import Mesh, build_mesh, good_normals, read_mesh
from prt_bake.inspection.files import find_remarks
from prt_bake.mathematics.sphere import tangent_frame
from tests.formats.asset.test_asset import make_asset
from tests.shapes import ball, ring
from tests.tracer.scenes import make_scene


def of(made: trimesh.Trimesh) -> Mesh:
    return build_mesh(made.vertices, made.faces)


def cosines(mesh: Mesh) -> np.ndarray:
    """Between the normals of corners and of their faces."""
    return np.asarray(np.einsum("fki,fi->fk", mesh.corner_normals, mesh.face_normals))


def test_a_bent_surface_has_its_vertex_normals() -> None:
    for mesh in (ball(2), ring()):
        np.testing.assert_array_equal(mesh.corner_normals, mesh.normals[mesh.faces])
        assert good_normals(mesh)


def test_sharp_edges_stay_hard() -> None:
    """A box has face normals; a cylinder has flat caps and radial sides, although their vertices are shared."""
    box = of(trimesh.creation.box())
    np.testing.assert_allclose(cosines(box), 1.0, atol=1e-12)
    cylinder = of(trimesh.creation.cylinder(1.0, 2.0, sections=24))
    cap = np.abs(cylinder.face_normals[:, 2]) > 0.5
    np.testing.assert_allclose(cosines(cylinder)[cap], 1.0, atol=1e-12)
    radial = cylinder.positions[cylinder.faces[~cap]] * [1.0, 1.0, 0.0]
    np.testing.assert_allclose(cylinder.corner_normals[~cap], radial, atol=1e-6)
    assert not good_normals(box)


def test_a_normal_far_from_its_faces_is_replaced() -> None:
    mesh = ball(2)
    normals = mesh.normals.copy()
    normals[0] = -normals[0]
    assert (cosines(replace(mesh, normals=normals)) > 0.5).all()


def test_opposite_windings_make_an_edge_sharp() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    mesh = Mesh(square, np.array([[0, 1, 2], [0, 3, 2]]), np.tile([0.0, 0.0, 1.0], (4, 1)))
    np.testing.assert_allclose(cosines(mesh), 1.0)


def write_obj(path: Path, mesh: Mesh, normals: np.ndarray, index: np.ndarray) -> None:
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.positions] + [f"vn {x} {y} {z}" for x, y, z in normals]
    for face, row in zip(mesh.faces + 1, index + 1, strict=True):
        lines.append("f " + " ".join(f"{vertex}//{normal}" for vertex, normal in zip(face, row, strict=True)))
    path.write_text("\n".join(lines))


def test_flat_shading_of_a_file_is_kept_in_its_asset(tmp_path: Path) -> None:
    for mesh in (ball(2), of(trimesh.creation.box())):
        each = np.repeat(np.arange(len(mesh.faces))[:, None], 3, axis=1)
        write_obj(tmp_path / "flat.obj", mesh, mesh.face_normals, each)
        flat = read_mesh(tmp_path / "flat.obj")
        assert flat.flat_shaded
        assert not good_normals(flat)
    asset = make_asset(len(flat.positions), 1, 4, 2)
    tangents = tangent_frame(flat.normals)
    write_asset(replace(asset, mesh=flat, tangents=tangents), tmp_path / "flat.h5")
    assert read_asset(tmp_path / "flat.h5").mesh.flat_shaded
    write_asset(asset, tmp_path / "other.h5")
    assert not read_asset(tmp_path / "other.h5").mesh.flat_shaded


def test_smooth_files_and_planes_are_not_flat_shaded(tmp_path: Path) -> None:
    """A cylinder has constant normals on its caps, a plane everywhere."""
    smooth = ball(2)
    write_obj(tmp_path / "smooth.obj", smooth, smooth.normals, smooth.faces)
    assert not read_mesh(tmp_path / "smooth.obj").flat_shaded
    cylinder = of(trimesh.creation.cylinder(1.0, 2.0, sections=24))
    corners = cylinder.corner_normals.reshape(-1, 3)
    write_obj(tmp_path / "cylinder.obj", cylinder, corners, np.arange(len(corners)).reshape(-1, 3))
    assert not read_mesh(tmp_path / "cylinder.obj").flat_shaded
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    plane = build_mesh(square, np.array([[0, 1, 2], [0, 2, 3]]))
    write_obj(tmp_path / "plane.obj", plane, plane.normals, plane.faces)
    assert not read_mesh(tmp_path / "plane.obj").flat_shaded


def test_check_remarks_on_flat_shading(tmp_path: Path) -> None:
    mesh = ball(2)
    each = np.repeat(np.arange(len(mesh.faces))[:, None], 3, axis=1)
    write_obj(tmp_path / "flat.obj", mesh, mesh.face_normals, each)
    (remark,) = find_remarks(tmp_path / "flat.obj")
    assert "flat.obj: it is flat shaded, one normal per face, so that reflections show its faces; export" in remark
    write_obj(tmp_path / "smooth.obj", mesh, mesh.normals, mesh.faces)
    assert find_remarks(tmp_path / "smooth.obj") == []


@pytest.mark.parametrize(
    ("made", "eta", "normals", "remarked"),
    [
        ("ball", 1.5, "face", True),
        ("ball", 1.0, "face", False),
        ("ball", 1.5, "vertex", False),
        ("box", 1.5, "face", False),
    ],
)
def test_check_remarks_on_refraction_by_faces(tmp_path: Path, made, eta, normals, remarked) -> None:
    scene = make_scene(tmp_path, of(trimesh.creation.box()) if made == "box" else ball(2), normals, eta=eta)
    found = [remark for remark in find_remarks(scene.path) if "'object': light is refracted by the faces" in remark]
    assert len(found) == remarked
