"""Faces that lie on one another are refused; solids that touch along edges, thin slabs and narrow gaps are sound."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from formats.errors import MeshError
from formats.mesh import Mesh, build_mesh
from prt_bake.geometry.coincident_faces import _touching_boxes, common_points, near_faces
from prt_bake.geometry.shells import ambiguity, refuse_ambiguous
from prt_bake.tracer.estimate import estimate_coefficients
from tests.tracer.scenes import make_scene

TURN = trimesh.transformations.rotation_matrix(0.5, [1.0, 2.0, 3.0])


def box(low: tuple[float, ...], high: tuple[float, ...], inwards: bool = False) -> trimesh.Trimesh:
    made = trimesh.creation.box(bounds=(low, high))
    if inwards:
        made.invert()
    return made


def united(*solids: trimesh.Trimesh) -> Mesh:
    every = trimesh.util.concatenate(solids)
    return build_mesh(every.vertices, every.faces)


def card(corners: list[tuple[float, float, float]], back: list[tuple[int, int, int]]) -> trimesh.Trimesh:
    """A sheet of quads or triangles with a front of fans and the given back."""
    front = [(0, k, k + 1) for k in range(1, len(corners) - 1)]
    return trimesh.Trimesh(corners, [*front, *back], process=False)


UNIT = box((0, 0, 0), (1, 1, 1))
SLAB = box((0, 0, 0), (4, 4, 1))
QUAD = [(0.5, 0.1, 0.1), (0.5, 0.9, 0.1), (0.5, 0.9, 0.9), (0.5, 0.1, 0.9)]
OTHER_DIAGONAL = [(3, 2, 1), (3, 1, 0)]


def beside(gap: float) -> Mesh:
    """A unit box and a smaller one beside it: 2 long."""
    return united(UNIT, box((1 + gap, 0.25, 0.25), (2 + gap, 0.75, 0.75)))


COINCIDENT = {
    "inside one triangle": united(SLAB, box((0.5, 2.5, 1), (1, 3, 2))),
    "across a diagonal": united(SLAB, box((1.5, 1.5, 1), (2.5, 2.5, 2))),
    "in a corner that holds no centre": united(UNIT, box((1, 0.97, 0.97), (2, 2, 2))),
    "equal": united(UNIT, box((1, 0, 0), (2, 1, 1))),
    "a cylinder on a slab": united(
        SLAB, trimesh.creation.cylinder(0.3, 1.0, sections=24).apply_translation([0.8, 2.9, 1.5])
    ),
    "a flush pit": united(SLAB, box((0.5, 2.5, 0.4), (1, 3, 1), inwards=True)),
    "a two-sided quad inside": united(UNIT, card(QUAD, OTHER_DIAGONAL)),
    "a two-sided triangle inside": united(UNIT, card(QUAD[:3], [(2, 1, 0)])),
    "a two-sided quad outside": united(UNIT, card([(x + 1, y, z) for x, y, z in QUAD], OTHER_DIAGONAL)),
    "a two-sided quad on a wall": united(UNIT, card([(1.0, y, z) for _, y, z in QUAD], OTHER_DIAGONAL)),
    "a slab that is a sheet to rays": box((0, 0, 0), (1, 1, 5e-7)),
    **{f"a gap of {gap:g}": beside(gap) for gap in (3e-16, 1e-12, 1e-9, 3e-8, 1e-7)},
    **{f"an overlap of {gap:g}": beside(-gap) for gap in (3e-16, 1e-12, 1e-9)},
}
SOUND = {
    "touching along an edge": united(UNIT, box((1, 1, 0), (2, 2, 1))),
    "touching along a part of an edge": united(UNIT, box((1, 1, 0.3), (2, 2, 0.7))),
    "touching at a vertex": united(UNIT, box((1, 1, 1), (2, 2, 2))),
    "an edge on a face": united(
        SLAB.copy().apply_translation([-1, -2, -1]),
        UNIT.copy().apply_transform(trimesh.transformations.rotation_matrix(np.pi / 4, [1, 0, 0])),
    ),
    "in one plane side by side": united(UNIT, box((1.5, 0, 0), (2.5, 1, 1))),
    "fine flat faces": united(UNIT.subdivide().subdivide().subdivide()),
    "a fan": united(trimesh.creation.cylinder(1.0, 1.0, sections=500)),
    "a needle beside a large face": build_mesh(
        np.array([(0, 0, 0), (1, 0, 0), (0.5, 1e-9, 0), (0.5, 1, 0), (0.5, 0.3, 1)], float),
        np.array([(0, 2, 1), (0, 3, 2), (2, 3, 1), (0, 1, 4), (1, 3, 4), (3, 0, 4)]),
    ),
    "a slab": box((0, 0, 0), (1, 1, 1.5e-6)),
    "two slabs": united(box((0, 0, 0), (1, 1, 3e-6)), box((0, 0, 1e-3), (1, 1, 1e-3 + 3e-6))),
    "a cavity": united(UNIT, box((0.5, 0.25, 0.25), (0.5 + 1.5e-7, 0.75, 0.75), inwards=True)),
    "a cavity behind a thin wall": united(UNIT, box((2e-6,) * 3, (1 - 2e-6,) * 3, inwards=True)),
    **{f"a gap of {gap:g}": beside(gap) for gap in (5e-7, 1e-6, 1e-5)},
}


def moved(solid: Mesh | trimesh.Trimesh, scale: float, turned: bool) -> Mesh:
    positions = solid.positions if isinstance(solid, Mesh) else solid.vertices
    placed = positions @ TURN[:3, :3].T if turned else positions
    return build_mesh(scale * np.add(placed, [3.0, 0.0, -7.0]), np.asarray(solid.faces))


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", COINCIDENT)
def test_faces_that_lie_on_one_another_are_refused(name: str, turned: bool) -> None:
    with pytest.raises(MeshError, match=r"^file: \d+ of its faces lie on one another, .* the first at \(.*; unite its"):
        refuse_ambiguous(moved(COINCIDENT[name], 1.0, turned), "file")


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("scale", [1e-3, 1e4])
@pytest.mark.parametrize("name", SOUND)
def test_solids_that_merely_touch_and_thin_ones_pass(name: str, scale: float, turned: bool) -> None:
    assert ambiguity(moved(SOUND[name], scale, turned)) == ("", False)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("depth", [1e-7, 1e-6, 1e-5, 1e-4])
def test_shallow_overlaps_are_refused(depth: float, turned: bool) -> None:
    with pytest.raises(MeshError, match=r"some of its 2 shells overlap|lie on one another"):
        refuse_ambiguous(moved(beside(-depth), 1.0, turned), "file")


def test_a_shallow_overlap_that_holds_no_centre_of_a_face_is_refused() -> None:
    with pytest.raises(MeshError, match="some of its 2 shells overlap"):
        refuse_ambiguous(united(UNIT, box((1 - 5e-6, 0.97, 0.97), (2, 2, 2))), "file")


def test_a_contact_that_was_rounded_on_export_is_refused() -> None:
    mesh = moved(COINCIDENT["a cylinder on a slab"], 1.0, turned=True)
    with pytest.raises(MeshError, match=r"some of its 2 shells overlap|lie on one another"):
        refuse_ambiguous(build_mesh(mesh.positions.round(6), mesh.faces), "file")


def test_the_place_is_in_the_common_area() -> None:
    what, _wrong = ambiguity(COINCIDENT["in a corner that holds no centre"])
    assert "3 of its faces lie on one another, within a millionth of its size, the first at (1, 0.9" in what


def test_gaps_of_a_small_part_are_measured_by_the_whole_object() -> None:
    mesh = moved(beside(1e-6), 0.01, turned=False)
    assert ambiguity(mesh) == ("", False)
    with pytest.raises(MeshError, match="lie on one another"):
        refuse_ambiguous(mesh, "file", size=1.0)


def test_boxes_that_touch_are_those_of_every_pair_tested() -> None:
    random = np.random.default_rng(5)
    low = random.random((300, 3))
    high = low + 0.3 * random.random((300, 1)) ** 3 * random.random((300, 3))
    expected = ((low[:, None] <= high) & (low <= high[:, None])).all(axis=2)
    found = np.sort(np.concatenate(list(_touching_boxes(low, high))), axis=1)
    assert sorted(map(tuple, found)) == [(i, j) for i, j in zip(*np.nonzero(expected), strict=True) if i < j]


def test_common_areas_are_those_that_points_show() -> None:
    """A second method: points of each triangle of a plane that another one contains."""
    random = np.random.default_rng(6)
    corners = np.concatenate(
        [random.random((40, 3, 2)) * 0.4 + 0.6 * random.random((40, 1, 2)), np.zeros((40, 3, 1))], 2
    )
    mesh = build_mesh(corners.reshape(-1, 3), np.arange(120).reshape(-1, 3))
    pairs, coincide = near_faces(mesh, 1.0)
    assert coincide.all()
    shares = random.dirichlet([0.5] * 3, 4000)
    seen = {(i, j) for i in range(40) for j in range(40) if i != j and contains(corners[j], shares @ corners[i]).any()}
    found = {(i, j) for i, j in pairs.tolist()}
    assert {tuple(sorted(pair)) for pair in seen} == {tuple(sorted(pair)) for pair in found}
    points = common_points(mesh, pairs)
    assert all(
        contains(corners[i], p[None]).all() and contains(corners[j], p[None]).all()
        for (i, j), p in zip(pairs, points, strict=True)
    )


def contains(triangle: np.ndarray, points: np.ndarray) -> np.ndarray:
    shares = trimesh.triangles.points_to_barycentric(np.broadcast_to(triangle, (len(points), 3, 3)), points)
    return (shares > 0.0).all(axis=1)


def test_the_path_tracer_refuses_a_solid_on_another(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, COINCIDENT["inside one triangle"])
    with pytest.raises(MeshError, match=r"object\.ply: 3 of its faces lie on one another"):
        estimate_coefficients(scene, scene.mesh.positions[:1], scene.mesh.normals[:1], paths=2)
