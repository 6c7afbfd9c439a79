"""The tree of boxes that rays search on a GPU, on the processor, compared with Embree."""

from typing import Any

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from formats.mesh import Mesh
from prt_bake.geometry import embree
from prt_bake.tracer.gpu.traversal import LEVELS, RAY_SIZE, nearest_hit
from prt_bake.tracer.gpu.tree import Tree, build_tree, joined
from tests.tracer.scenes import lumpy, slab, sphere, unit_directions


@numba.njit
def hits(tree: Any, root: Any, starts: Any, directions: Any, near: Any, far: Any, skip: Any) -> Any:
    found, distances, places = np.empty(len(starts), np.int64), np.empty(len(starts)), np.empty((len(starts), 2))
    ray = np.zeros(RAY_SIZE, np.float32)
    for n in range(len(starts)):
        found[n], distances[n] = nearest_hit(tree, root, ray, starts[n], directions[n], near, far, skip[n])
        places[n, 0], places[n, 1] = ray[15], ray[16]
    return found, distances, places


@numba.njit
def embree_hits(address: Any, scene: Any, starts: Any, directions: Any, near: Any, far: Any, skip: Any) -> Any:
    found, distances, places = np.empty(len(starts), np.int64), np.empty(len(starts)), np.empty((len(starts), 2))
    ray = embree.new_ray()
    for n in range(len(starts)):
        found[n], distances[n] = embree.nearest_hit(address, scene, ray, starts[n], directions[n], near, far, skip[n])
        places[n, 0], places[n, 1] = ray[15], ray[16]
    return found, distances, places


def scaled(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    positions = np.asarray(mesh.positions)
    low, high = positions.min(axis=0), positions.max(axis=0)
    return ((positions - 0.5 * (low + high)) / (high - low).max()).astype(np.float32), np.asarray(mesh.faces, np.int64)


def leaves(tree: Tree, root: int = 0) -> list[tuple[int, int]]:
    """(first place, faces) of all leaves below a node."""
    children = tree.nodes.view(np.int32).reshape(len(tree.nodes), 8)[:, 6:]
    found, waiting = [], [root]
    while waiting:
        node = waiting.pop()
        if node < 0:
            found.append(((-1 - node) >> 3, (-1 - node) & 7))
        else:
            waiting += [int(child) for child in children[node]]
    return found


MESHES = {"lumpy": lumpy(4), "sphere": sphere(2), "slab": slab(3.0)}


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("kind", ["anywhere", "from the surface", "along axes"])
def test_hits_are_those_of_embree(name: str, kind: str) -> None:
    positions, faces = scaled(MESHES[name])
    tree, scene = build_tree(positions, faces), embree.TriangleScene(positions, faces.astype(np.uint32))
    generator = np.random.default_rng(0)
    count = 20_000
    directions, skip = unit_directions(count, 1), np.full(count, -1)
    starts = generator.uniform(-0.6, 0.6, (count, 3))
    if kind == "from the surface":
        skip = generator.integers(len(faces), size=count)
        weights = generator.dirichlet([1.0, 1.0, 1.0], size=count)
        starts = np.einsum("nk,nkc->nc", weights, positions[faces[skip]].astype(np.float64))
    elif kind == "along axes":
        directions = np.sign(directions[:, :1]) * np.eye(3)[generator.integers(3, size=count)]
    near, far = (1e-6, np.inf) if kind == "from the surface" else (0.0, 0.9)
    found, distances, places = hits(tree, 0, starts, directions, near, far, skip)
    expected, at, there = embree_hits(embree.intersect_address(), scene.handle, starts, directions, near, far, skip)
    same = found == expected
    # At an edge, and within rounding of `far`, either face is right.
    assert np.mean(same) > 0.998
    convex = kind == "from the surface" and name != "lumpy"
    assert np.mean(found >= 0) > (-1.0 if convex else 0.1)
    hit = same & (found >= 0)
    assert_allclose(distances[hit], at[hit], rtol=2e-5, atol=2e-5)
    assert_allclose(places[hit], there[hit], atol=2e-3)
    both = (found >= 0) & (expected >= 0)
    assert_allclose(distances[both], at[both], rtol=1e-3, atol=1e-4)


def test_no_ray_from_inside_escapes_through_an_edge_or_a_vertex() -> None:
    """Rays from the centre of a ball to its vertices and to the middles of its edges."""
    mesh = sphere(3)
    positions, faces = scaled(mesh)
    tree = build_tree(positions, faces)
    middles = 0.5 * (positions[faces] + positions[np.roll(faces, 1, axis=1)]).reshape(-1, 3)
    targets = np.concatenate([positions, middles]).astype(np.float64)
    directions = targets / np.linalg.norm(targets, axis=1, keepdims=True)
    nothing = np.full(len(targets), -1)
    found, distances, _places = hits(tree, 0, np.zeros_like(targets), directions, 0.0, np.inf, nothing)
    assert found.min() >= 0
    assert_allclose(distances, np.linalg.norm(targets, axis=1), rtol=1e-6)


def test_the_face_that_a_ray_starts_on_is_not_hit_though_the_start_is_behind_it() -> None:
    positions, faces = scaled(sphere(3))
    tree, skip = build_tree(positions, faces), np.arange(len(faces))
    a, b, c = (positions[faces[:, k]].astype(np.float64) for k in range(3))
    outward = np.cross(b - a, c - a)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    starts = (a + b + c) / 3.0 - 1e-5 * outward
    assert (hits(tree, 0, starts, outward, 0.0, np.inf, np.full(len(faces), -1))[0] == skip).all()
    assert (hits(tree, 0, starts, outward, 0.0, np.inf, skip)[0] == -1).all()


def test_every_face_is_in_one_leaf_and_boxes_contain_their_faces() -> None:
    positions, faces = scaled(lumpy(4))
    tree = build_tree(positions, faces)
    places = [place for first, count in leaves(tree) for place in range(first, first + count)]
    assert sorted(places) == list(range(len(faces)))
    numbers = tree.triangles.view(np.int32).reshape(len(faces), 10)[:, 9]
    assert sorted(numbers) == list(range(len(faces)))
    assert_array_equal(tree.triangles.view(np.float32).reshape(-1, 10)[:, :9], positions[faces[numbers]].reshape(-1, 9))
    words = tree.nodes.view(np.uint32).reshape(len(tree.nodes), 8)
    step = 2.0 * tree.reach / LEVELS
    low, high = ((words[:, :6] & 0xFFFF) * step - tree.reach, (words[:, :6] >> 16) * step - tree.reach)
    for node, child in np.ndindex(len(words), 2):
        below = leaves(tree, int(words[node, 6 + child].view(np.int32)))
        corners = positions[faces[numbers[[k for a, n in below for k in range(a, a + n)]]]].reshape(-1, 3)
        assert (corners.min(axis=0) > low[node, child::2]).all()
        assert (corners.max(axis=0) < high[node, child::2]).all()


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_faces_that_all_coincide(count: int) -> None:
    """No plane separates them; the tree halves them."""
    positions = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0]], np.float32)
    tree = build_tree(positions, np.tile([[0, 1, 2]], (count, 1)))
    assert sum(number for _first, number in leaves(tree)) == count
    start, down = np.array([[0.1, 0.1, 0.3], [0.4, 0.4, 0.3]]), np.array([[0.0, 0.0, -1.0]] * 2)
    found, distances, _places = hits(tree, 0, start, down, 0.0, np.inf, np.full(2, -1))
    assert found[0] >= 0
    assert found[1] == -1
    assert distances[0] == pytest.approx(0.3)


def test_joined_trees_are_searched_from_their_roots() -> None:
    positions, faces = scaled(lumpy(2))
    half = len(faces) // 2
    alone = [build_tree(positions, faces[:half]), build_tree(positions, faces[half:])]
    tree, roots = joined(alone)
    starts, directions = np.zeros((500, 3)), unit_directions(500, 3)
    for single, root in zip(alone, roots, strict=True):
        expected = hits(single, 0, starts, directions, 0.0, np.inf, np.full(500, -1))
        found = hits(tree, root, starts, directions, 0.0, np.inf, np.full(500, -1))
        assert_array_equal(found[0], expected[0])
        assert_array_equal(found[1], expected[1])
