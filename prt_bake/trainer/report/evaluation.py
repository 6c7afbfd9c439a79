"""The queries that assess a network, its predictions there, and the path-traced references."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.transport import up_to
from prt_bake.mathematics import directions, sh
from prt_bake.mathematics.random import uniforms
from prt_bake.tracer.prepared import PreparedScene
from prt_bake.trainer.references import (
    FIRST_BATCHES,
    Estimate,
    Follow,
    Predict,
    TracedReference,
    silent,
    trace_reference,
)
from prt_bake.trainer.report.reference import Tracer
from prt_bake.trainer.samples.queries import Queries, QuerySource

Array = NDArray[np.float64]

DEGREE = 2
_LATTICE = 1024
_ROTATIONS = 8
"""Random rotations of the lattice of directions, so that its aliasing differs between queries."""
VERTICES, VIEWS = 192, 8
_COEFFICIENT_WALKS = 4
"""Initial walks per query for a_lm, for each one for Ŝ: they cost a tenth or less."""
_TRANSPORT_SHARE, _SURFACE_SHARE = 0.25, 0.4
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

    def select(self, rows: slice) -> "VertexViews":
        """Some of the vertices."""
        return VertexViews(self.indices[rows], self.positions[rows], self.normals[rows], self.outgoing[rows])


def vertex_views(prepared: PreparedScene, vertices: int, views: int, seed: int) -> VertexViews:
    """Draw `vertices` vertices of the mesh (all if it has fewer) and `views` views of each."""
    mesh = prepared.surface.mesh
    used = np.unique(mesh.faces)
    order = np.argsort(uniforms((_VERTEX_STREAM, seed, used.astype(np.int64)), 1)[:, 0])
    chosen = used[order[:vertices]].astype(np.int64)
    positions, normals = (np.asarray(rows, np.float64)[chosen] for rows in (mesh.positions, mesh.normals))
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    outgoing = above(directions.uniform(len(chosen) * views, seed + _VIEW_STREAM), np.repeat(normals, views, axis=0))
    outgoing, _location, _clamped = prepared.surface.locate_clamped(np.repeat(positions, views, axis=0), outgoing)
    return VertexViews(chosen, positions, normals, outgoing.reshape(len(chosen), views, 3))


def above(rows: Array, normals: Array) -> Array:
    """Directions [N,3], mirrored to the side of the normals where necessary."""
    cosine = np.sum(rows * normals, axis=1, keepdims=True)
    return np.asarray(np.where(cosine < 0.0, rows - 2.0 * cosine * normals, rows))


class Coefficients:
    """The coefficients of a network, which is prepared once, by least squares over a lattice."""

    def __init__(self, network: Any, seed: int) -> None:
        rotations = directions.random_rotations(_ROTATIONS, seed + _ROTATION_STREAM)
        self._incident = directions.fibonacci(_LATTICE) @ rotations.transpose(0, 2, 1)
        self._fits = np.linalg.pinv(sh.evaluate(self._incident, DEGREE))
        network = up_to(network, DEGREE)
        self._network = network.prepared() if hasattr(network, "prepared") else network

    def __call__(self, positions: Array, outgoing: Array) -> Array:
        """a_lm [N,B,9,3] at positions [N,3] for outgoing [N,B,3]."""
        count, views = outgoing.shape[:2]
        rotation = np.arange(count * views).reshape(count, views) % _ROTATIONS
        if hasattr(self._network, "evaluate_block"):
            values = self._network.evaluate_block(self._incident, rotation, positions, outgoing)
        else:
            rows = np.repeat(positions, views, axis=0), outgoing.reshape(-1, 3)
            values = self._network.evaluate(self._incident[rotation.ravel()], *rows)
        values = np.asarray(values, np.float64).reshape(count, views, _LATTICE, 3)
        return np.asarray(np.einsum("nbkd,nbdc->nbkc", self._fits[rotation], values))


@dataclass(frozen=True)
class Evaluation:
    """Predictions of a network and references for the same queries, and for the same vertices and views.

    Each reference covers as many of the first queries or vertices as its time allowed. `queries` and `normals` are
    those of `transport`, or those of `coefficients` behind a smooth interface: Ŝ has no values there, and `transport`
    is None.
    """

    queries: Queries
    normals: Array
    transport: TracedReference | None
    coefficients: TracedReference
    views: VertexViews
    at_views: TracedReference

    @property
    def predicted_at_views(self) -> Array:
        """The network's a_lm [P,B,9,3] of every vertex and view."""
        assert self.at_views.predicted is not None
        return self.at_views.predicted


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
    follow: Follow = silent,
) -> Evaluation:
    """Evaluate `network` and `tracer` at `count` queries of `directions` directions, and at `vertices` from 8 sides.

    The tracer begins with `walks` walks per query and continues for at most `seconds`, in which fewer queries and
    vertices may be evaluated.
    """
    drawn = QuerySource(prepared, directions, seed).draw(0, count)
    views = vertex_views(prepared, vertices, VIEWS, seed)
    coefficients = Coefficients(network, seed)
    positions, outgoing = drawn.location.positions, drawn.outgoing
    begun = time.perf_counter()

    def transport(rows: slice, paths: int, key: int) -> Array:
        return tracer.transport(positions[rows], outgoing[rows], drawn.incident[rows], paths, key)

    def at_queries(rows: slice, paths: int, key: int) -> Array:
        return tracer.coefficients(positions[rows], outgoing[rows], paths, key)

    def at_vertices(rows: slice, paths: int, key: int) -> Array:
        found = tracer.coefficients(*views.select(rows).flat(), paths, key)
        return found.reshape(-1, VIEWS, *found.shape[1:])

    def values(rows: slice) -> Array:
        some = drawn.select(rows)
        return np.asarray(network.evaluate(some.incident, some.positions, some.outgoing))

    def coefficients_at_queries(rows: slice) -> Array:
        return coefficients(drawn.positions[rows], outgoing[rows, None])[:, 0]

    def coefficients_at_vertices(rows: slice) -> Array:
        return coefficients(views.positions[rows], views.outgoing[rows])

    def traced(
        estimate: Estimate, predict: Predict, many: int, paths: int, share: float, before: float, stream: int
    ) -> TracedReference:
        limit = share * (seconds - (time.perf_counter() - begun)) if np.isfinite(seconds) else seconds

        def follow_part(done: float) -> None:
            follow(before + (1.0 - before) * share * done)

        return trace_reference(
            estimate,
            many,
            paths,
            predict=predict,
            seconds=max(0.0, limit),
            seed=seed,
            stream=stream,
            follow=follow_part,
        )

    batch = -(-walks // FIRST_BATCHES)
    each = _COEFFICIENT_WALKS * batch
    share = 0.0 if smooth else _TRANSPORT_SHARE
    of_values = None if smooth else traced(transport, values, count, batch, share, 0.0, 1)
    surface = traced(at_queries, coefficients_at_queries, count, each, _SURFACE_SHARE, share, 2)
    share += (1.0 - share) * _SURFACE_SHARE
    at_views = traced(at_vertices, coefficients_at_vertices, len(views.positions), each, 1.0, share, 3)
    known = slice(0, len(surface if of_values is None else of_values))
    return Evaluation(
        queries=drawn.select(known),
        normals=np.asarray(prepared.surface.mesh.face_normals, np.float64)[drawn.location.faces[known]],
        transport=of_values,
        coefficients=surface,
        views=views.select(slice(0, len(at_views))),
        at_views=at_views,
    )
