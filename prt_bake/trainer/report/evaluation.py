"""The queries that assess a network, its predictions there, and the path-traced references."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.transport import up_to
from prt_bake.mathematics import directions, sh
from prt_bake.mathematics.random import uniforms
from prt_bake.tracer.prepared import PreparedScene
from prt_bake.trainer.report.reference import FIRST_BATCHES, Reference, Tracer, refine_reference
from prt_bake.trainer.samples.queries import Queries, QuerySource

Array = NDArray[np.float64]

DEGREE = 2
_LATTICE = 1024
_ROTATIONS = 8
"""Random rotations of the lattice of directions, so that its aliasing differs between queries."""
VERTICES, VIEWS = 192, 8
_COEFFICIENT_WALKS = 4
"""Initial walks per query for a_lm, for each one for Ŝ: they cost a tenth or less."""
_TRANSPORT_SHARE, _SURFACE_SHARE = 0.4, 0.25
"""Shares of the time: of all seconds, and of the seconds left after Ŝ. Vertices get the rest."""
_VERTEX_STREAM, _VIEW_STREAM, _ROTATION_STREAM = 0xA1, 0xA2, 0xA3


@dataclass(frozen=True)
class VertexViews:
    """P vertices of the mesh with B views each: indices [P], positions and normals [P,3], outgoing [P,B,3].

    Views are uniform over the hemisphere about the vertex normal and clamped to the horizon as in a bake.
    """

    indices: NDArray[np.int64]
    positions: Array
    normals: Array
    outgoing: Array

    def flat(self) -> tuple[Array, Array]:
        """Positions and outgoing [P·B,3]."""
        return np.repeat(self.positions, self.outgoing.shape[1], axis=0), self.outgoing.reshape(-1, 3)


def vertex_views(prepared: PreparedScene, vertices: int, views: int, seed: int) -> VertexViews:
    """Draw `vertices` vertices of the mesh (all if it has fewer) and `views` views of each."""
    mesh = prepared.surface.mesh
    used = np.unique(mesh.faces)
    order = np.argsort(uniforms((_VERTEX_STREAM, seed, used.astype(np.int64)), 1)[:, 0])
    chosen = np.sort(used[order[:vertices]]).astype(np.int64)
    positions, normals = (np.asarray(rows, np.float64)[chosen] for rows in (mesh.positions, mesh.normals))
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    outgoing = above(directions.uniform(len(chosen) * views, seed + _VIEW_STREAM), np.repeat(normals, views, axis=0))
    outgoing, _location, _clamped = prepared.surface.locate_clamped(np.repeat(positions, views, axis=0), outgoing)
    return VertexViews(chosen, positions, normals, outgoing.reshape(len(chosen), views, 3))


def above(rows: Array, normals: Array) -> Array:
    """Directions [N,3], mirrored to the side of the normals where necessary."""
    cosine = np.sum(rows * normals, axis=1, keepdims=True)
    return np.asarray(np.where(cosine < 0.0, rows - 2.0 * cosine * normals, rows))


def evaluated_coefficients(network: Any, positions: Array, outgoing: Array, seed: int) -> Array:
    """a_lm [N,B,9,3] of a network at positions [N,3] for outgoing [N,B,3], by least squares over a lattice."""
    rotations = directions.random_rotations(_ROTATIONS, seed + _ROTATION_STREAM)
    incident = directions.fibonacci(_LATTICE) @ rotations.transpose(0, 2, 1)
    network = up_to(network, DEGREE)
    fits = np.linalg.pinv(sh.evaluate(incident, DEGREE))
    count, views = outgoing.shape[:2]
    rotation = np.arange(count * views).reshape(count, views) % _ROTATIONS
    if hasattr(network, "evaluate_block"):
        values = network.evaluate_block(incident, rotation, positions, outgoing)
    else:
        rows = np.repeat(positions, views, axis=0), outgoing.reshape(-1, 3)
        values = network.evaluate(incident[rotation.ravel()], *rows)
    values = np.asarray(values, np.float64).reshape(count, views, _LATTICE, 3)
    return np.asarray(np.einsum("nbkd,nbdc->nbkc", fits[rotation], values))


@dataclass(frozen=True)
class Evaluation:
    """Predictions of a network and references for the same queries, and for the same vertices and views.

    `transport` is None behind a smooth interface, where Ŝ has no values.
    """

    queries: Queries
    normals: Array
    predicted_transport: Array
    transport: Reference | None
    predicted_coefficients: Array
    coefficients: Reference
    views: VertexViews
    predicted_at_views: Array
    at_views: Reference


def evaluate(
    network: Any,
    prepared: PreparedScene,
    tracer: Tracer,
    *,
    smooth: bool,
    count: int,
    directions: int,
    walks: int,
    seed: int,
    seconds: float,
    vertices: int,
) -> Evaluation:
    """Evaluate `network` and `tracer` at `count` queries of `directions` directions, and at `vertices` from 8 sides.

    The tracer begins with `walks` walks per query and continues for at most `seconds`.
    """
    drawn = QuerySource(prepared, directions, seed).draw(0, count)
    values = np.asarray(network.evaluate(drawn.incident, drawn.positions, drawn.outgoing), np.float64)
    coefficients = evaluated_coefficients(network, drawn.positions, drawn.outgoing[:, None], seed)[:, 0]
    views = vertex_views(prepared, vertices, VIEWS, seed)
    view_coefficients = evaluated_coefficients(network, views.positions, views.outgoing, seed)
    positions, outgoing = drawn.location.positions, drawn.outgoing
    batch = -(-walks // FIRST_BATCHES)

    def transport(paths: int, key: int) -> Array:
        return tracer.transport(positions, outgoing, drawn.incident, paths, key)

    def at_queries(paths: int, key: int) -> Array:
        return tracer.coefficients(positions, outgoing, paths, key)

    def at_vertices(paths: int, key: int) -> Array:
        return tracer.coefficients(*views.flat(), paths, key).reshape(view_coefficients.shape)

    many = _COEFFICIENT_WALKS * batch
    traced = None if smooth else refine_reference(transport, values, batch, _TRANSPORT_SHARE * seconds, seed, 1)
    left = seconds - (traced.seconds if traced is not None else 0.0)
    surface = refine_reference(at_queries, coefficients, many, _SURFACE_SHARE * left, seed, 2)
    return Evaluation(
        queries=drawn,
        normals=np.asarray(prepared.surface.mesh.face_normals, np.float64)[drawn.location.faces],
        predicted_transport=values,
        transport=traced,
        predicted_coefficients=coefficients,
        coefficients=surface,
        views=views,
        predicted_at_views=view_coefficients,
        at_views=refine_reference(at_vertices, view_coefficients, many, left - surface.seconds, seed, 3),
    )
