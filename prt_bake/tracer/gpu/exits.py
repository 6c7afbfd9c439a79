"""Walks on a GPU: the exits of queries, and the sums of their coefficients."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from prt_bake.tracer.gpu.device_functions import SIMULATED, cuda
from prt_bake.tracer.gpu.kernels import draw_exits, sum_powers
from prt_bake.tracer.gpu.tree import Tree, build_tree, joined
from prt_bake.tracer.prepared import KernelQueries, PreparedScene
from prt_bake.tracer.surface.boundary import FIRST_FACE, TREE, Boundary
from prt_bake.tracer.volume.media import Media

THREADS = 128
_BLOCKS_PER_MULTIPROCESSOR = 4
_WALKS_AT_ONCE = 1 << 22


class Exits(NamedTuple):
    """Exits of P walks of N queries on the GPU: directions and throughput float32 [N,P,3] (0: never left), scattering
    events int32 [N,P], and lost throughput float32 [N,P].
    """

    directions: Any
    throughput: Any
    scattered: Any
    lost: Any


class SceneOnGpu:
    """The tables of a prepared scene on the GPU."""

    def __init__(self, prepared: PreparedScene) -> None:
        """Builds the trees of its faces, and copies all tables."""
        tree, roots = _trees(prepared)
        parts = prepared.boundary.parts.copy()
        parts[:, TREE] = roots
        tables = {name: _copied(value) for name, value in prepared.boundary._asdict().items()}
        # Rays through the tree are faster on a GPU than lists of nearby faces, whose lengths differ between threads.
        near = cuda.to_device(np.zeros(0, np.int32))
        tables.update(intersect=Tree._make(map(_copied, tree)), scene=0, parts=_copied(parts), near=near)
        self.boundary = Boundary(**tables)
        self.media = Media._make(map(_copied, prepared.medium))

    def draw(self, queries: KernelQueries, first_path: Any, seed: int, exits: Exits) -> None:
        """Fill `exits` by walks from queries, whose arrays and first_path [N] are on the GPU; does not wait for it."""
        blocks = _BLOCKS_PER_MULTIPROCESSOR * multiprocessors()
        walks, paths = exits.scattered.size, exits.scattered.shape[1]
        blocks = max(1, min(blocks, -(-walks // THREADS)))
        next_walk = cuda.to_device(np.zeros(1, np.int64))
        draw_exits[blocks, THREADS](
            self.boundary, self.media, tuple(queries), first_path, paths, seed, next_walk, tuple(exits)
        )


@lru_cache(maxsize=2)
def on_gpu(prepared: PreparedScene) -> SceneOnGpu:
    """The scene's tables on the GPU; those of the two last used scenes are kept."""
    return SceneOnGpu(prepared)


def sum_coefficients(
    prepared: PreparedScene,
    queries: KernelQueries,
    chunks: NDArray[np.int64],
    degree: int,
    seed: int,
    sums: NDArray[np.float64],
) -> None:
    """`prt_bake.tracer.kernels.sum_coefficients` on the GPU: fills sums [chunks, 5, K·3 + 4]."""
    scene = on_gpu(prepared)
    for paths in np.unique(chunks[:, 2]):
        same = np.flatnonzero(chunks[:, 2] == paths)
        most = max(1, _WALKS_AT_ONCE // int(paths))
        for begin in range(0, len(same), most):
            rows = same[begin : begin + most]
            placed = KernelQueries._make(_copied(field[chunks[rows, 0]]) for field in queries)
            exits = new_exits(len(rows), int(paths))
            scene.draw(placed, _copied(chunks[rows, 1]), seed, exits)
            some = cuda.device_array((len(rows), *sums.shape[1:]), np.float64)
            sum_powers[-(-some.shape[0] * some.shape[2] // THREADS), THREADS](tuple(exits), degree, some)
            sums[rows] = some.copy_to_host()


def new_exits(queries: int, paths: int) -> Exits:
    """Arrays on the GPU for exits."""
    shape = queries, paths
    return Exits(
        cuda.device_array((*shape, 3), np.float32),
        cuda.device_array((*shape, 3), np.float32),
        cuda.device_array(shape, np.int32),
        cuda.device_array(shape, np.float32),
    )


def multiprocessors() -> int:
    """Multiprocessors of the GPU."""
    return 1 if SIMULATED else int(cuda.get_current_device().MULTIPROCESSOR_COUNT)


def _copied(value: Any) -> Any:
    """An array, copied to the GPU; anything else as it is."""
    return cuda.to_device(np.ascontiguousarray(value)) if isinstance(value, np.ndarray) else value


def _trees(prepared: PreparedScene) -> tuple[Tree, list[int]]:
    """The tree of all faces, whose root is node 0, those of each part alone, and their roots."""
    positions = prepared.positions.astype(np.float32)
    whole = build_tree(positions, prepared.faces)
    first = prepared.boundary.parts[:, FIRST_FACE].astype(int)
    if len(first) == 1:
        return whole, [0]
    ends = [*first[1:], len(prepared.faces)]
    parts = [build_tree(positions, prepared.faces[a:b]) for a, b in zip(first, ends, strict=True)]
    tree, roots = joined([whole, *parts])
    return tree, roots[1:]
