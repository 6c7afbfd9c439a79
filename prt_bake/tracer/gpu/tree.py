"""A binary tree of boxes over the faces of a mesh, split where the surface area heuristic expects least work.

Binned splits: Wald 2007, "On fast construction of SAH-based bounding volume hierarchies".
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.jit.compilation import compiled
from prt_bake.tracer.gpu.traversal import LEVELS

MARGIN = 1e-6
"""Boxes are larger than their faces by this, more than the float32 rounding of a ray within −½ … ½."""
_BINS = 16
_MOST_IN_LEAF = 4
_DEEPEST = 40
"""Levels of splits by area; below, splits halve the number of faces."""


class Tree(NamedTuple):
    """Boxes and faces of one or more trees, packed so that a ray reads few words."""

    nodes: NDArray[np.uint64]
    """[N,4]: along x, y and z the lower and the upper plane of the first child's box in 16 bits each, then those of the
    second child's; and both children in 32 bits each, nodes or leaves. A leaf is −1 − (8 · first place + faces)."""
    triangles: NDArray[np.uint64]
    """[places,5], in the order of the leaves: nine float32 coordinates of a face's corners, and its number."""
    reach: float
    """Planes are stored as multiples of 2 reach / LEVELS from −reach on."""


def build_tree(positions: NDArray[np.float32], faces: NDArray[np.int64]) -> Tree:
    """The tree of a mesh, whose root is node 0. Vertices float32 [V,3], also of other meshes; faces [F,3]."""
    corners = np.ascontiguousarray(positions[faces], np.float32)
    order, reach = np.arange(len(faces)), 1.001 * float(np.abs(positions).max()) + 2.0 * MARGIN
    boxes = np.zeros((max(1, len(faces)), 2, 2, 3), np.float32)
    children = np.zeros((len(boxes), 2), np.int32)
    count = _split_all(corners.min(axis=1), corners.max(axis=1), order, boxes.reshape(-1, 12), children)
    numbers = np.concatenate([corners[order].reshape(-1, 9), order.astype(np.int32).view(np.float32)[:, None]], axis=1)
    return Tree(_packed(boxes[:count], children[:count], reach), np.ascontiguousarray(numbers).view(np.uint64), reach)


def _packed(boxes: NDArray[np.float32], children: NDArray[np.int32], reach: float) -> NDArray[np.uint64]:
    """Nodes from boxes [N, child, lower or upper, 3]. Planes are rounded outwards."""
    at = (boxes.astype(np.float64) + reach) * (LEVELS / (2.0 * reach))
    margin = MARGIN * LEVELS / (2.0 * reach)
    low = np.clip(np.floor(at[:, :, 0] - margin), 0, LEVELS).astype(np.uint32)
    high = np.clip(np.ceil(at[:, :, 1] + margin), 0, LEVELS).astype(np.uint32)
    planes = (low | high << np.uint32(16)).transpose(0, 2, 1)
    words = np.concatenate([planes, children.view(np.uint32)[:, None]], axis=1)
    return np.ascontiguousarray(words).view(np.uint64)[..., 0]


def joined(trees: list[Tree]) -> tuple[Tree, list[int]]:
    """One table of several trees of equal reach, and the node that is the root of each. Faces keep their numbers."""
    nodes = np.cumsum([0] + [len(tree.nodes) for tree in trees])
    places = np.cumsum([0] + [len(tree.triangles) for tree in trees])
    tables = []
    for tree, node, place in zip(trees, nodes, places, strict=False):
        words = tree.nodes.copy().view(np.int32)
        children = words[:, 6:]
        children[:] = np.where(children >= 0, children + node, children - 8 * place)
        tables.append(words.view(np.uint64))
    triangles = np.concatenate([tree.triangles for tree in trees])
    return Tree(np.concatenate(tables), triangles, trees[0].reach), [int(node) for node in nodes[:-1]]


@compiled()
def _split_all(low: Any, high: Any, order: Any, boxes: Any, children: Any) -> Any:
    """Fill boxes and children of all nodes, sort `order` by leaves, and return the number of nodes."""
    # A task is a range of `order` with its level, and the child (node, side) that it becomes.
    tasks = np.zeros((2 * len(order) + 64, 5), np.int64)
    tasks[0] = np.array([0, len(order), 0, -1, 0])
    waiting, nodes = 1, 0
    while waiting:
        waiting -= 1
        first, last, level, parent, side = tasks[waiting]
        if last - first <= _MOST_IN_LEAF and parent >= 0:
            children[parent, side] = -1 - (8 * first + last - first)
            continue
        middle = _split(low, high, order, first, last, level)
        node = nodes
        nodes += 1
        if parent >= 0:
            children[parent, side] = node
        for half in range(2):
            begin, end = (first, middle) if half == 0 else (middle, last)
            for k in range(3):
                least, most = np.float32(np.inf), np.float32(-np.inf)
                for i in range(begin, end):
                    least, most = min(least, low[order[i], k]), max(most, high[order[i], k])
                boxes[node, 6 * half + k], boxes[node, 6 * half + 3 + k] = least, most
            tasks[waiting] = np.array([begin, end, level + 1, node, half])
            waiting += 1
    return nodes


@compiled()
def _split(low: Any, high: Any, order: Any, first: Any, last: Any, level: Any) -> Any:
    """Sort order[first:last] into two groups of faces, and return where the second begins."""
    axis, threshold = -1, 0.0
    if level < _DEEPEST and last - first > 2:
        axis, threshold = _cheapest_plane(low, high, order, first, last)
    if axis < 0:
        return (first + last) // 2
    middle = first
    for i in range(first, last):
        face = order[i]
        if low[face, axis] + high[face, axis] < threshold:
            order[i], order[middle] = order[middle], face
            middle += 1
    return middle if first < middle < last else (first + last) // 2


@compiled()
def _cheapest_plane(low: Any, high: Any, order: Any, first: Any, last: Any) -> Any:
    """Axis of the split with least expected work and twice its coordinate; axis −1 if all centres coincide."""
    best, chosen, threshold = np.inf, -1, 0.0
    counts, boxes, rights = np.zeros(_BINS, np.int64), np.zeros((_BINS, 6)), np.zeros(_BINS)
    for axis in range(3):
        begin, end = np.inf, -np.inf
        for i in range(first, last):
            centre = np.float64(low[order[i], axis] + high[order[i], axis])
            begin, end = min(begin, centre), max(end, centre)
        if end <= begin:
            continue
        counts[:] = 0
        boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
        for i in range(first, last):
            face = order[i]
            bin_ = min(_BINS - 1, int((low[face, axis] + high[face, axis] - begin) / (end - begin) * _BINS))
            counts[bin_] += 1
            for k in range(3):
                boxes[bin_, k] = min(boxes[bin_, k], low[face, k])
                boxes[bin_, 3 + k] = max(boxes[bin_, 3 + k], high[face, k])
        number, box = 0, np.array([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf])
        for b in range(_BINS - 1, 0, -1):
            number += counts[b]
            _extend(box, boxes[b])
            rights[b] = number * _area(box)
        number, box = 0, np.array([np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf])
        for b in range(_BINS - 1):
            number += counts[b]
            _extend(box, boxes[b])
            cost = number * _area(box) + rights[b + 1]
            if 0 < number < last - first and cost < best:
                best, chosen, threshold = cost, axis, begin + (b + 1) / _BINS * (end - begin)
    return chosen, threshold


@compiled()
def _extend(box: Any, other: Any) -> None:
    for k in range(3):
        box[k], box[3 + k] = min(box[k], other[k]), max(box[3 + k], other[3 + k])


@compiled()
def _area(box: Any) -> float:
    x, y, z = max(0.0, box[3] - box[0]), max(0.0, box[4] - box[1]), max(0.0, box[5] - box[2])
    return float(x * y + y * z + z * x)
