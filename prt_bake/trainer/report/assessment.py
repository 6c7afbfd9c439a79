"""How good a trained network is, by path-traced queries that it never saw: every figure with its interval.

Queries over the surface, of a seed of their own, for Ŝ and a_lm; and vertices of the mesh, each seen from
several sides, for what is said of positions. Figures are of the network alone, the reference's noise taken out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.mathematics.noise_free import Replicates, Sums
from prt_bake.tracer.prepared import PreparedScene, is_unbent, smooth_part
from prt_bake.trainer.report import breakdown, seams
from prt_bake.trainer.report.error_figures import (
    by_vertex,
    coefficient_error,
    per_view,
    prediction,
    transport_error,
    weights_of,
    white_sky,
)
from prt_bake.trainer.report.evaluation import VERTICES, VIEWS, Evaluation, ask
from prt_bake.trainer.report.reference import PathTracer, Tracer
from prt_bake.trainer.report.summary import criteria, sentences

Array = NDArray[np.float64]

ASSESSMENT_SEED = 0xA55E55
_OUTLINE = 1500
_CELLS = 40
_DECADES = 4.0


@dataclass(frozen=True)
class Assessment:
    """What was found, under the names that the report has."""

    found: dict[str, Any]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return self.found


def assess(
    network: Any,
    scene: Scene,
    prepared: PreparedScene,
    *,
    queries: int = 1024,
    walks: int = 64,
    seed: int = ASSESSMENT_SEED,
    history: Sequence[Sequence[float]] = (),
    seconds: float = 40.0,
    vertices: int = VERTICES,
    tracer: Tracer | None = None,
) -> Assessment:
    """Hold a network against the path tracer on `queries` fresh queries and on `vertices` of the mesh from 8 sides.

    `walks` a query to begin with (four times as many for coefficients), doubled until the noise is a third of the
    error that is measured or `seconds` of path tracing are used up. `history` rows are (seconds, walks, validation
    error) of the training. `tracer` takes the path tracer's place. Where no estimate of Ŝ exists, behind a smooth
    interface, coefficients alone are assessed.
    """
    training = getattr(network, "metadata", {}).get("training", {})
    stream = training.get("stream", {})
    truth = tracer or PathTracer(scene, int(stream.get("connections", 4)))
    smooth = smooth_part(scene) is not None
    directions = int(stream.get("directions", 8))
    asked = ask(network, prepared, truth, smooth, queries, directions, walks, seed, seconds, vertices)
    found: dict[str, Any] = {
        "format": "prtbake training report",
        "version": 1,
        "model": _model(network, scene, training),
        "reference": _reference(asked, seed),
        "transport": transport_error(asked, seed),
        "coefficients": coefficient_error(asked, seed),
        "white_sky": white_sky(asked, seed),
        "prediction": prediction(asked, network, training, seed),
        "history": {
            "of": training.get("validation_of", _watched(scene, training)),
            "columns": ["seconds", "walks", "validation error"],
            "rows": [[float(x) for x in row] for row in history],
        },
        "angles": _angles(asked, seed),
        "regions": breakdown.regions(asked.views.positions, by_vertex(asked), seed),
        "vertices": _vertices(asked),
        "outline": _outline(prepared),
        "up": scene.up,
        "predicted_measured": _predicted_measured(asked),
        "worst": _worst(asked, truth, walks, seed),
        "seams": _seams(network, asked, seed),
    }
    found["criteria"] = criteria(found, scene)
    found["summary"] = sentences(found)
    return Assessment(found)


def _watched(scene: Scene, training: dict[str, Any]) -> str:
    """What the error is of that a model's history keeps, where the model itself does not say."""
    return "transport" if is_unbent(scene) or "samples" in training else "coefficients"


def _model(network: Any, scene: Scene, training: dict[str, Any]) -> dict[str, Any]:
    seconds, walked = float(training.get("seconds", 0.0)), int(training.get("walks", 0))
    return {
        "scene": scene.path.name,
        "scene_hash": scene.content_hash,
        "weights": weights_of(network),
        "training_seconds": seconds,
        "steps": int(training.get("steps", 0)),
        "walks": walked,
        "walks_per_second": walked / seconds if seconds > 0.0 else 0.0,
    }


def _reference(asked: Evaluation, seed: int) -> dict[str, Any]:
    queries, vertices = len(asked.normals), len(asked.views.positions)
    told: dict[str, Any] = {
        "seed": seed,
        "queries": queries,
        "directions": asked.queries.incident.shape[1],
        "vertices": vertices,
        "views": VIEWS,
    }
    parts = (
        ("transport", asked.transport, queries),
        ("coefficients", asked.coefficients, queries),
        ("coefficients at vertices", asked.view_reference, vertices * VIEWS),
    )
    for name, part, count in parts:
        if part is not None:
            told[name] = {
                "walks": part.walks,
                "walks_per_second": part.walks * count / max(part.seconds, 1e-9),
                "seconds": part.seconds,
                "ended_by": part.ended,
            }
    return told


def _single_values(asked: Evaluation) -> Sums | None:
    """Of every value of Ŝ [N,D]."""
    if asked.transport is None:
        return None
    mean, variance = asked.transport.estimates.mean, asked.transport.estimates.variance
    return Sums(
        error=((asked.transport_answer - mean) ** 2 - variance).sum(axis=2),
        value=(mean**2 - variance).sum(axis=2),
        noise=variance.sum(axis=2),
    )


def _views_as_values(asked: Evaluation) -> Sums:
    """Of a_lm, every view a value: [P,B]."""
    parts, shape = per_view(asked), asked.view_answer.shape[:2]
    return Sums(parts.error.reshape(shape), parts.value.reshape(shape), parts.noise.reshape(shape))


def _angles(asked: Evaluation, seed: int) -> dict[str, Any]:
    """Of Ŝ against three angles; of a_lm against that of the view alone where Ŝ cannot be estimated."""
    single, queries = _single_values(asked), asked.queries
    if single is not None:
        told = breakdown.angles(queries.incident, queries.outgoing, asked.normals, single, seed)
        return {"of": "transport", **told}
    cosine = np.einsum("pbc,pc->pb", asked.views.outgoing, asked.views.normals)
    told = breakdown.against(cosine, np.linspace(0.0, 1.0, 7), _views_as_values(asked), seed)
    return {"of": "coefficients", "outgoing": told}


def _vertices(asked: Evaluation) -> dict[str, Any]:
    parts = by_vertex(asked)
    error = np.sqrt(np.maximum(parts.error, 0.0) / np.maximum(parts.value, 1e-300))
    rows = np.column_stack([asked.views.positions, asked.views.normals, error])
    return {"columns": ["x", "y", "z", "nx", "ny", "nz", "relative RMSE of the coefficients"], "rows": _short(rows)}


def _outline(prepared: PreparedScene) -> list[list[float]]:
    """Positions and normals of vertices all over the mesh, to draw it by."""
    mesh = prepared.surface.mesh
    step = max(1, -(-len(mesh.positions) // _OUTLINE))
    rows: list[list[float]] = _short(np.column_stack([mesh.positions, mesh.normals])[::step])
    return rows


def _predicted_measured(asked: Evaluation) -> dict[str, Any]:
    """√(4π) a_00 of every view, mean over RGB, with the error of what was measured; and counts of values of Ŝ."""
    white, reference = np.sqrt(4.0 * np.pi), asked.view_reference.estimates
    # Channels share their walks: their errors are taken to go together.
    error = white * np.sqrt(reference.variance[:, :, 0]).mean(axis=2)
    told: dict[str, Any] = {
        "white_sky": {
            "standard_error": float(np.sqrt(np.mean(error**2))),
            "columns": ["measured", "predicted"],
            "rows": _short(
                white
                * np.column_stack(
                    [
                        reference.mean[:, :, 0].mean(axis=2).ravel(),
                        asked.view_answer[:, :, 0].mean(axis=2).ravel(),
                    ]
                )
            ),
        }
    }
    if asked.transport is not None:
        told["transport"] = _counted(asked.transport.estimates, asked.transport_answer)
    return told


def _counted(reference: Replicates, answer: Array) -> dict[str, Any]:
    """Counts [measured, predicted] of Ŝ, mean over RGB, in cells of log10; what is darker is taken to the first
    cells.
    """
    measured, predicted = reference.mean.mean(axis=2).ravel(), answer.mean(axis=2).ravel()
    top = float(np.log10(max(measured.max(), predicted.max(), 1e-30)))
    edges = np.linspace(top - _DECADES, top + 1e-6, _CELLS + 1)
    lowest = 10.0 ** edges[0]
    logs = [np.log10(np.maximum(values, lowest)) for values in (measured, predicted)]
    counts = np.histogram2d(logs[0], logs[1], bins=[edges, edges])[0]
    return {"log10_edges": _short(edges), "counts": counts.astype(int).tolist()}


def _worst(asked: Evaluation, truth: Tracer, walks: int, seed: int) -> dict[str, Any]:
    """The worst values of Ŝ, measured again; of √(4π) a_00 where Ŝ cannot be estimated."""
    queries, paths = asked.queries, max(64, walks)
    where = queries.location.positions
    if asked.transport is not None:

        def again(n: NDArray[Any], d: NDArray[Any], batch: int) -> Array:
            incident = queries.incident[n, d][:, None]
            return truth.transport(where[n], queries.outgoing[n], incident, paths, seed + 7001 + batch)[:, 0]

        rows = breakdown.worst(asked.transport_answer, asked.transport.estimates, again)
    else:
        white = np.sqrt(4.0 * np.pi)
        estimates = asked.coefficients.estimates
        first = Replicates(estimates.count, white * estimates.mean[:, :1], white**2 * estimates.squares[:, :1])

        def again(n: NDArray[Any], d: NDArray[Any], batch: int) -> Array:
            found = truth.coefficients(where[n], queries.outgoing[n], 4 * paths, seed + 7001 + batch)
            return np.asarray(white * found[:, 0])

        rows = breakdown.worst(white * asked.coefficient_answer[:, :1], first, again)
    for row in rows:
        n, d = row.pop("query"), row.pop("direction")
        row["position"] = _short(where[n])
        row["outgoing"] = _short(queries.outgoing[n])
        if asked.transport is not None:
            row["incident"] = _short(queries.incident[n, d])
    return {"of": "transport" if asked.transport is not None else "white sky", "rows": rows}


def _seams(network: Any, asked: Evaluation, seed: int) -> dict[str, Any]:
    found = seams.jumps(network, asked.queries.positions, asked.normals, seed)
    single, queries = _single_values(asked), asked.queries
    near: dict[str, Any] = {}
    for name, lies_near in (("seam", seams.near_seam), ("pole", seams.near_pole)):
        if single is not None:
            near[f"{name} of incident"] = seams.compared_with_elsewhere(single, lies_near(queries.incident))
        views = lies_near(asked.views.outgoing)
        near[f"{name} of outgoing"] = seams.compared_with_elsewhere(_views_as_values(asked), views)
    return {"jumps": {name: jump.as_json() for name, jump in found.items()}, "errors_near": near}


def _short(values: Array) -> Any:
    """Plain values with four digits."""
    return [_short(row) if row.ndim else float(f"{row:.4g}") for row in values]
