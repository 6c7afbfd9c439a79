"""Targets of the importance fit: a network's values on 32×64 directions of equal solid angle per query.

Positions are uniform over the mesh's surface, outgoing directions uniform over the hemisphere about the face normal.
The incident directions are a grid of 32 rings by 64 sectors, equal in (cosθ, φ), rotated at random. A block of queries
shares eight rotations, so that the network's fused evaluation can cache its tables.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.evaluation import values_at
from formats.errors import ModelError
from formats.image.gamut import LUMINANCE
from formats.mesh import Mesh
from prt_bake.mathematics.directions import on_sphere, rotations
from prt_bake.mathematics.random import uniforms

RINGS, SECTORS = 32, 64
DIRECTIONS = RINGS * SECTORS
QUERIES_PER_BLOCK = 256
TURNS = 8
_QUERY_STREAM, _TURN_STREAM = 0x1B0, 0x1B1

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Targets:
    """N queries on the surface, and the distribution of the transport's luminance over incident directions.

    Attributes:
        positions, outgoing, normals: [N,3].
        turn: [N], the set of directions that a query uses.
        directions: [R,D,3].
        share: float32 [N,D], each direction's share of the luminance, negative values taken as 0; rows sum to 1.
    """

    positions: Array
    outgoing: Array
    normals: Array
    turn: NDArray[np.int64]
    directions: NDArray[np.float32]
    share: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.turn)


def gather_targets(
    transport: Any,
    mesh: Mesh,
    blocks: Iterable[int],
    seed: int,
    *,
    threads: int = 1,
    follow: Callable[[int], bool] = lambda done: True,
) -> Targets:
    """The targets of numbered blocks of 256 queries; a block depends only on its number and the seed.

    `follow` receives the number of finished blocks and returns whether to continue. Raises ModelError if the transport
    has values that are not finite, or is black at every query.
    """
    finished: list[Targets] = []
    numbers = list(blocks)
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, len(numbers), threads):
            finished += pool.map(lambda block: _block(transport, mesh, block, seed), numbers[first : first + threads])
            if not follow(len(finished)):
                break
    targets = _concatenated(finished)
    if len(targets) == 0:
        raise ModelError(
            "importance: the network is black (never above 0) at every query on this mesh; there is nothing to sample. "
            "Is it the mesh on which the network was trained?"
        )
    return targets


def draw_queries(mesh: Mesh, block: int, seed: int) -> tuple[Array, Array, Array]:
    """Positions, outgoing directions and face normals [N,3] of block number `block`."""
    keys = np.arange(block * QUERIES_PER_BLOCK, (block + 1) * QUERIES_PER_BLOCK)
    u = uniforms((_QUERY_STREAM, seed, keys), 5)
    area = np.cumsum(np.asarray(mesh.face_areas, np.float64))
    faces = np.minimum(np.searchsorted(area, u[:, 0] * area[-1], side="right"), len(area) - 1)
    root = np.sqrt(u[:, 1:2])
    corners = np.asarray(mesh.positions, np.float64)[np.asarray(mesh.faces)[faces]]
    along = (1.0 - u[:, 2:3]) * corners[:, 1] + u[:, 2:3] * corners[:, 2]
    positions = (1.0 - root) * corners[:, 0] + root * along
    normals = np.asarray(mesh.face_normals, np.float64)[faces]
    towards = on_sphere(u[:, 3], u[:, 4])
    cosine = np.sum(towards * normals, axis=1, keepdims=True)
    return positions, np.where(cosine < 0.0, towards - 2.0 * cosine * normals, towards), normals


def bin_centres() -> Array:
    """The centres [2048,3] of 32 rings by 64 sectors of equal solid angle about z."""
    ring, sector = np.divmod(np.arange(DIRECTIONS), SECTORS)
    return on_sphere((ring + 0.5) / RINGS, (sector + 0.5) / SECTORS)


def _block(transport: Any, mesh: Mesh, block: int, seed: int) -> Targets:
    positions, outgoing, normals = draw_queries(mesh, block, seed)
    turns = rotations(uniforms((_TURN_STREAM, seed, block * TURNS + np.arange(TURNS)), 3))
    directions = np.einsum("rij,dj->rdi", turns, bin_centres())
    turn = np.arange(len(positions)) % TURNS
    values = values_at(transport, directions, turn, positions, outgoing)
    luminance = np.maximum(np.asarray(values, np.float64) @ LUMINANCE, 0.0)
    sums = luminance.sum(axis=1)
    if not np.isfinite(sums).all():
        raise ModelError(
            f"importance: the network has values that are not finite at {int((~np.isfinite(sums)).sum())} of "
            f"{len(sums)} queries, the first at {positions[~np.isfinite(sums)][0].tolist()}; train it again"
        )
    positive = sums > 0.0
    share = luminance[positive] / sums[positive, None]
    return Targets(
        positions[positive],
        outgoing[positive],
        normals[positive],
        turn[positive],
        directions.astype(np.float32),
        share.astype(np.float32),
    )


def _concatenated(blocks: list[Targets]) -> Targets:
    parts: dict[str, Any] = {
        name: np.concatenate([getattr(block, name) for block in blocks])
        for name in ("positions", "outgoing", "normals", "directions", "share")
    }
    turn = np.concatenate([block.turn + TURNS * number for number, block in enumerate(blocks)])
    return Targets(turn=turn, **parts)
