"""Texture space: bilinear taps, one row for each place, and coordinates that suit or are made again."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from formats.errors import MeshError
from formats.mesh import Mesh
from prt_bake.baselines import unwrapping
from prt_bake.baselines.texture_space import TextureSpace, cover, dilate
from prt_bake.baselines.unwrapping import PADDING, fault_of, in_unit_square, texture_coordinates, unwrap
from tests.baselines.shapes import ball_of_charts, queries_on

SIZE = 64


def space_of(mesh: Mesh, size: int = SIZE) -> TextureSpace:
    assert mesh.corner_uv is not None
    return cover(mesh.corner_uv, np.asarray(mesh.faces, np.int64), size).space(mesh.corner_uv, size)


def told(mesh: Mesh, size: int = SIZE) -> tuple[NDArray[np.float64], list[str]]:
    sentences: list[str] = []
    return texture_coordinates(mesh, size, sentences.append), sentences


def test_a_texture_of_coordinates_returns_the_coordinates_of_each_query() -> None:
    mesh = ball_of_charts()
    assert mesh.corner_uv is not None
    faces, barycentric, _positions = queries_on(mesh, 500)
    taps = space_of(mesh).taps(faces, barycentric)
    texels = np.stack([taps.rows % SIZE, taps.rows // SIZE], axis=-1)
    found = (np.sum(taps.weights[..., None] * texels, axis=1) + 0.5) / SIZE
    weights = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    expected = np.einsum("nc,ncj->nj", weights, mesh.corner_uv[faces])
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(taps.weights.sum(axis=1), 1.0)


def test_the_rows_that_a_query_reads_are_those_that_its_face_covers() -> None:
    mesh = ball_of_charts()
    assert mesh.corner_uv is not None
    coverage = cover(mesh.corner_uv, np.asarray(mesh.faces, np.int64), SIZE)
    faces, barycentric, _positions = queries_on(mesh, 2000)
    taps = coverage.space(mesh.corner_uv, SIZE).taps(faces, barycentric)
    covered = set(zip(coverage.faces.tolist(), coverage.rows.tolist(), strict=True))
    read = taps.weights > 0.0
    pairs = zip(np.repeat(faces, read.sum(axis=1)).tolist(), taps.rows[read].tolist(), strict=True)
    assert set(pairs) <= covered
    assert len(np.unique(coverage.charts)) == 6


def test_values_agree_on_both_sides_of_an_edge_inside_a_chart() -> None:
    mesh = ball_of_charts()
    assert mesh.corner_uv is not None
    space = space_of(mesh)
    table = np.random.default_rng(1).normal(size=space.rows)
    # The first and the second half of the faces of a side are the triangles of its quads, whose diagonal they share.
    first, second = np.arange(36), np.arange(36) + 36
    diagonal = {0: np.array([[0.0, 0.3]]), 1: np.array([[0.3, 0.0]])}  # at 0.3 from corner a to corner c
    values = []
    for faces, barycentric in ((first, diagonal[0]), (second, diagonal[1])):
        taps = space.taps(faces, np.repeat(barycentric, len(faces), axis=0))
        values.append(np.sum(taps.weights * table[taps.rows], axis=1))
    np.testing.assert_allclose(values[0], values[1], atol=1e-12)


def close_charts() -> Mesh:
    """The ball with two of its charts moved to half a texel from each other."""
    mesh = ball_of_charts()
    assert mesh.corner_uv is not None
    uv = mesh.corner_uv.copy()
    gap = uv[72:144, :, 0].min() - uv[:72, :, 0].max()
    uv[72:144, :, 0] -= gap - 0.5 / SIZE
    return replace(mesh, corner_uv=uv)


def test_places_within_one_texel_read_rows_of_their_own() -> None:
    mesh = close_charts()
    space = space_of(mesh)
    faces, barycentric, _positions = queries_on(mesh, 20_000)
    rows = space.taps(faces, barycentric).rows
    assert space.rows > SIZE**2
    left, right = (set(rows[faces // 72 == chart].ravel().tolist()) for chart in (0, 1))
    assert left
    assert right
    assert not left & right


def test_folded_neighbours_read_rows_of_their_own() -> None:
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]])
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.1, 0.1]])
    mesh = Mesh(positions, faces, np.array([[0.0, 0, 1]] * 4), corner_uv=uv[faces])
    rows = space_of(mesh).taps(np.array([0, 1]), np.full((2, 2), 1.0 / 3.0)).rows
    assert not set(rows[0]) & set(rows[1])


def test_good_coordinates_are_kept() -> None:
    mesh = ball_of_charts()
    assert mesh.corner_uv is not None
    found, sentences = told(mesh)
    np.testing.assert_array_equal(found, mesh.corner_uv)
    assert not sentences


def test_coordinates_beyond_the_unit_square_are_moved_into_it() -> None:
    mesh = ball_of_charts()
    assert mesh.corner_uv is not None
    moved = in_unit_square(3.0 * mesh.corner_uv - 1.0)
    assert moved.min() == 0.0
    assert moved.max() == 1.0
    assert fault_of(moved, np.asarray(mesh.faces, np.int64), SIZE) == ""


def mirrored() -> Mesh:
    """The ball with each chart on the one before it, as mirrored halves are."""
    mesh = ball_of_charts()
    assert mesh.corner_uv is not None
    uv = mesh.corner_uv.copy()
    uv[72:144] = uv[:72]
    return replace(mesh, corner_uv=uv)


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (mirrored(), "its texture coordinates overlap or are mirrored: "),
        (replace(ball_of_charts(), corner_uv=None), "it has no texture coordinates"),
        (replace(ball_of_charts(), corner_uv=np.zeros((432, 3, 2))), "432 of its 432 faces have no area"),
    ],
)
def test_coordinates_that_do_not_suit_are_refused_without_xatlas(
    mesh: Mesh, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = "xatlas is not installed; pip install xatlas"
    monkeypatch.setattr(unwrapping, "missing_sentence", lambda *_: missing)
    with pytest.raises(MeshError, match=rf"mesh: {reason}.*, which xatlas gives it; {missing}"):
        told(mesh)


def test_coordinates_that_do_not_suit_are_made_anew_and_the_reason_is_said() -> None:
    pytest.importorskip("xatlas")
    mesh = mirrored()
    found, sentences = told(mesh)
    assert sentences[0].startswith("mesh: its texture coordinates overlap or are mirrored: ")
    assert sentences[0].endswith("it is unwrapped by xatlas, and the model keeps the new coordinates")
    assert fault_of(found, np.asarray(mesh.faces, np.int64), SIZE) == ""


def test_unwrapped_charts_are_the_padding_apart() -> None:
    pytest.importorskip("xatlas")
    mesh, size = ball_of_charts(), 256
    uv = unwrap(mesh, size)
    coverage = cover(uv, np.asarray(mesh.faces, np.int64), size)
    chart = np.full((size, size), -1)
    # Texels read by a chart reach up to one texel beyond it on each side.
    chart.ravel()[coverage.texels] = coverage.charts[coverage.faces]
    assert 0.0 <= uv.min() < uv.max() <= 1.0
    for across, along in np.ndindex(PADDING - 2, PADDING - 2):
        one, other = chart[: size - along, : size - across], chart[along:, across:]
        assert not ((one != other) & (one >= 0) & (other >= 0)).any()


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e6])
def test_an_object_of_any_size_is_unwrapped(scale: float) -> None:
    pytest.importorskip("xatlas")
    mesh = ball_of_charts()
    faces = np.asarray(mesh.faces, np.int64)
    small = Mesh(scale * mesh.positions, mesh.faces, mesh.normals)
    assert fault_of(unwrap(small, 256), faces, 256) == ""


def test_untrained_rows_take_the_value_of_their_chart() -> None:
    mesh = close_charts()
    assert mesh.corner_uv is not None
    coverage = cover(mesh.corner_uv, np.asarray(mesh.faces, np.int64), SIZE)
    rows = coverage.space(mesh.corner_uv, SIZE).rows
    chart = np.full(rows, -1)
    chart[coverage.rows] = coverage.charts[coverage.faces]
    trained = np.random.default_rng(2).random(rows) < 0.3
    values = np.where(trained, chart, np.nan)[:, None].astype(np.float32)
    dilate(values, trained, coverage, SIZE)
    np.testing.assert_array_equal(values[chart >= 0, 0], chart[chart >= 0])
