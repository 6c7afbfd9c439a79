"""What a network is asked when it is assessed, and its answers as harmonic coefficients."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.transport import up_to
from prt_bake.mathematics import directions, sh
from prt_bake.mathematics.random import uniforms
from prt_bake.tracer.prepared import PreparedScene
from prt_bake.trainer.report.reference import FIRST_BATCHES, Reference, Tracer, grow
from prt_bake.trainer.samples.queries import Queries, QuerySource

Array = NDArray[np.float64]

DEGREE = 2
_LATTICE = 1024
_TURNS = 8
"""The lattice of directions comes in so many random turns, so that what it aliases is not the same everywhere."""
VERTICES, VIEWS = 192, 8
_COEFFICIENT_WALKS = 4
"""Walks a query for a_lm to one for Ŝ, to begin with: they cost a tenth or less."""
_TRANSPORT_SHARE, _SURFACE_SHARE = 0.4, 0.25
"""Of the seconds; of what is left then. The vertices take the rest."""
_VERTEX_STREAM, _VIEW_STREAM, _TURN_STREAM = 0xA1, 0xA2, 0xA3


@dataclass(frozen=True)
class VertexViews:
    """P vertices of the mesh, seen from B directions each: indices [P], positions and normals [P,3], outgoing [P,B,3].

    Views are uniform over the hemisphere about the vertex normal, bent above the horizon where a bake bends them.
    """

    indices: NDArray[np.int64]
    positions: Array
    normals: Array
    outgoing: Array

    def flat(self) -> tuple[Array, Array]:
        """Positions and outgoing [P·B,3]."""
        return np.repeat(self.positions, self.outgoing.shape[1], axis=0), self.outgoing.reshape(-1, 3)


def vertex_views(prepared: PreparedScene, vertices: int, views: int, seed: int) -> VertexViews:
    """Draw `vertices` of the mesh (all where there are fewer) and `views` for each."""
    mesh = prepared.surface.mesh
    used = np.unique(mesh.faces)
    order = np.argsort(uniforms((_VERTEX_STREAM, seed, used.astype(np.int64)), 1)[:, 0])
    chosen = np.sort(used[order[:vertices]]).astype(np.int64)
    positions, normals = (np.asarray(rows, np.float64)[chosen] for rows in (mesh.positions, mesh.normals))
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    outgoing = above(directions.uniform(len(chosen) * views, seed + _VIEW_STREAM), np.repeat(normals, views, axis=0))
    outgoing, _location, _bent = prepared.surface.above_horizon(np.repeat(positions, views, axis=0), outgoing)
    return VertexViews(chosen, positions, normals, outgoing.reshape(len(chosen), views, 3))


def above(rows: Array, normals: Array) -> Array:
    """Directions [N,3] mirrored to the side of the normals."""
    cosine = np.sum(rows * normals, axis=1, keepdims=True)
    return np.asarray(np.where(cosine < 0.0, rows - 2.0 * cosine * normals, rows))


def evaluated_coefficients(network: Any, positions: Array, outgoing: Array, seed: int) -> Array:
    """a_lm [N,B,9,3] of a network at positions [N,3] seen along outgoing [N,B,3], by least squares over a lattice."""
    turns = directions.random_rotations(_TURNS, seed + _TURN_STREAM)
    incident = directions.fibonacci(_LATTICE) @ turns.transpose(0, 2, 1)
    network = up_to(network, DEGREE)
    fits = np.linalg.pinv(sh.evaluate(incident, DEGREE))
    count, views = outgoing.shape[:2]
    taken = np.arange(count * views).reshape(count, views) % _TURNS
    if hasattr(network, "evaluate_block"):
        values = network.evaluate_block(incident, taken, positions, outgoing)
    else:
        rows = np.repeat(positions, views, axis=0), outgoing.reshape(-1, 3)
        values = network.evaluate(incident[taken.ravel()], *rows)
    values = np.asarray(values, np.float64).reshape(count, views, _LATTICE, 3)
    return np.asarray(np.einsum("nbkd,nbdc->nbkc", fits[taken], values))


@dataclass(frozen=True)
class Evaluation:
    """What was asked, the answers, and what path tracing says."""

    queries: Queries
    normals: Array
    transport_answer: Array
    transport: Reference | None
    coefficient_answer: Array
    coefficients: Reference
    views: VertexViews
    view_answer: Array
    view_reference: Reference


def ask(
    network: Any,
    prepared: PreparedScene,
    truth: Tracer,
    smooth: bool,
    count: int,
    directions: int,
    walks: int,
    seed: int,
    seconds: float,
    vertices: int,
) -> Evaluation:
    """Ask `network` and `truth` the same: `count` queries of `directions` each, and `vertices` from 8 sides.

    `walks` a query to begin with, and `seconds` of path tracing at most once that is done.
    """
    drawn = QuerySource(prepared, directions, seed).draw(0, count)
    answer = np.asarray(network.evaluate(drawn.incident, drawn.positions, drawn.outgoing), np.float64)
    coefficients = evaluated_coefficients(network, drawn.positions, drawn.outgoing[:, None], seed)[:, 0]
    views = vertex_views(prepared, vertices, VIEWS, seed)
    view_answer = evaluated_coefficients(network, views.positions, views.outgoing, seed)
    where, eye = drawn.location.positions, drawn.outgoing
    batch = -(-walks // FIRST_BATCHES)

    def transport(paths: int, key: int) -> Array:
        return truth.transport(where, eye, drawn.incident, paths, key)

    def at_queries(paths: int, key: int) -> Array:
        return truth.coefficients(where, eye, paths, key)

    def at_vertices(paths: int, key: int) -> Array:
        return truth.coefficients(*views.flat(), paths, key).reshape(view_answer.shape)

    many = _COEFFICIENT_WALKS * batch
    values = None if smooth else grow(transport, answer, batch, _TRANSPORT_SHARE * seconds, seed, 1)
    left = seconds - (values.seconds if values is not None else 0.0)
    surface = grow(at_queries, coefficients, many, _SURFACE_SHARE * left, seed, 2)
    return Evaluation(
        queries=drawn,
        normals=np.asarray(prepared.surface.mesh.face_normals, np.float64)[drawn.location.faces],
        transport_answer=answer,
        transport=values,
        coefficient_answer=coefficients,
        coefficients=surface,
        views=views,
        view_answer=view_answer,
        view_reference=grow(at_vertices, view_answer, many, left - surface.seconds, seed, 3),
    )
