"""Assessment of a trained network on path-traced queries that were not in its training; figures have intervals.

Ŝ and a_lm are compared at queries over the surface, drawn with a separate seed. Errors by position are measured at
vertices of the mesh, each from several sides. All errors are corrected for the reference's noise.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.mathematics.noise_free import Replicates, Sums
from prt_bake.tracer.prepared import PreparedScene, is_unrefracted, prepare, smooth_part
from prt_bake.trainer.references import Follow, TracedReference, silent
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
from prt_bake.trainer.report.evaluation import VERTICES, VIEWS, Evaluation, evaluate
from prt_bake.trainer.report.reference import PathTracer, Tracer
from prt_bake.trainer.report.summary import criteria, sentences

Array = NDArray[np.float64]

ASSESSMENT_SEED = 0xA55E55
_WALKS = 64
"""Initial walks per query. They are doubled until the noise is a third of the measured error."""
_OUTLINE_POINTS = 1500
_CELLS = 40
_DECADES = 4.0


def assess(
    network: Any,
    scene: Scene,
    *,
    queries: int = 1024,
    seed: int = ASSESSMENT_SEED,
    history: Sequence[Sequence[float]] = (),
    seconds: float = 40.0,
    vertices: int = VERTICES,
    tracer: Tracer | None = None,
    follow: Follow = silent,
) -> dict[str, Any]:
    """Compare a network with the path tracer, and return the report's content as plain values.

    Args:
        network, scene: the network, bound to its mesh, and its scene.
        seed: seed of the queries, the vertices and the walks.
        queries, vertices: fresh queries over the surface, and vertices of the mesh that are evaluated from 8 sides.
        seconds: most seconds for the references and the predictions; fewer queries and vertices if they are too few.
        history: rows (seconds, walks, validation error) of the training.
        tracer: replaces the path tracer.
        follow: receives the finished share.

    Only coefficients are assessed behind a smooth interface, where Ŝ has no values.
    """
    training = getattr(network, "metadata", {}).get("training", {})
    stream = training.get("stream", {})
    tracer = tracer or PathTracer(scene, int(stream.get("connections", 4)))
    prepared, smooth = prepare(scene), smooth_part(scene) is not None
    directions = int(stream.get("directions", 8))
    evaluation = evaluate(
        network,
        prepared,
        tracer,
        smooth=smooth,
        count=queries,
        directions=directions,
        walks=_WALKS,
        seed=seed,
        seconds=seconds,
        vertices=vertices,
        follow=follow,
    )
    report: dict[str, Any] = {
        "format": "prtbake training report",
        "version": 1,
        "model": _model(network, scene, training),
        "reference": _reference(evaluation, seed),
        "transport": transport_error(evaluation, seed),
        "coefficients": coefficient_error(evaluation, seed),
        "white_sky": white_sky(evaluation, seed),
        "prediction": prediction(evaluation, network, training, seed),
        "history": {
            "of": training.get("validation_of", _validated_quantity(scene, training)),
            "columns": ["seconds", "walks", "validation error"],
            "rows": [[np.nan if x is None else float(x) for x in row] for row in history],
        },
        "angles": _angles(evaluation, seed),
        "regions": breakdown.regions(evaluation.views.positions, by_vertex(evaluation), seed),
        "vertices": _vertices(evaluation),
        "outline": _outline(prepared),
        "up": scene.up,
        "predicted_measured": _predicted_measured(evaluation),
        "worst": _worst(evaluation, tracer, seed),
        "seams": _seams(network, evaluation, seed),
    }
    report["criteria"] = criteria(report, scene)
    report["summary"] = sentences(report)
    return report


def _validated_quantity(scene: Scene, training: dict[str, Any]) -> str:
    """The quantity of the history's validation errors, for models that do not state it."""
    return "transport" if is_unrefracted(scene) or "samples" in training else "coefficients"


def _model(network: Any, scene: Scene, training: dict[str, Any]) -> dict[str, Any]:
    seconds, walked = float(training.get("seconds", 0.0)), int(training.get("walks", 0))
    return {
        "kind": getattr(network, "kind", ""),
        "scene": scene.path.name,
        "scene_hash": scene.content_hash,
        "weights": weights_of(network),
        "started_from": getattr(network, "metadata", {}).get("started_from", ""),
        "training_seconds": seconds,
        "steps": int(training.get("steps", 0)),
        "walks": walked,
        "walks_per_second": walked / seconds if seconds > 0.0 else 0.0,
        "final_errors": training.get("relative_rmse"),
    }


def _reference(evaluation: Evaluation, seed: int) -> dict[str, Any]:
    vertices = len(evaluation.views.positions)
    report: dict[str, Any] = {
        "seed": seed,
        "queries": len(evaluation.normals),
        "directions": evaluation.queries.incident.shape[1],
        "vertices": vertices,
        "views": VIEWS,
    }
    parts = (
        ("transport", evaluation.transport, 1),
        ("coefficients", evaluation.coefficients, 1),
        ("coefficients at vertices", evaluation.at_views, VIEWS),
    )
    for name, part, views in parts:
        if part is not None:
            count = len(part) * views
            report[name] = {
                "queries": count,
                "walks": part.walks,
                "walks_per_second": part.walks * count / max(part.seconds, 1e-9),
                "seconds": part.seconds,
                "ended_by": part.ended,
            }
    return report


def _single_values(evaluation: Evaluation) -> Sums | None:
    """Squared errors of every value of Ŝ [N,D], None if Ŝ has no values."""
    if evaluation.transport is None:
        return None
    mean, variance = evaluation.transport.estimates.mean, evaluation.transport.estimates.variance
    return Sums(
        error=((_predicted(evaluation.transport) - mean) ** 2 - variance).sum(axis=2),
        value=(mean**2 - variance).sum(axis=2),
        noise=variance.sum(axis=2),
    )


def _predicted(traced: TracedReference) -> Array:
    assert traced.predicted is not None
    return traced.predicted


def _views_as_values(evaluation: Evaluation) -> Sums:
    """Squared errors of a_lm by vertex and view [P,B]."""
    parts, shape = per_view(evaluation), evaluation.predicted_at_views.shape[:2]
    return Sums(parts.error.reshape(shape), parts.value.reshape(shape), parts.noise.reshape(shape))


def _angles(evaluation: Evaluation, seed: int) -> dict[str, Any]:
    """Errors of Ŝ by three angles; errors of a_lm by the view's angle if Ŝ has no values."""
    single, queries = _single_values(evaluation), evaluation.queries
    if single is not None:
        by_angle = breakdown.angles(queries.incident, queries.outgoing, evaluation.normals, single, seed)
        return {"of": "transport", **by_angle}
    cosine = np.einsum("pbc,pc->pb", evaluation.views.outgoing, evaluation.views.normals)
    by_cosine = breakdown.binned(cosine, np.linspace(0.0, 1.0, 7), _views_as_values(evaluation), seed)
    return {"of": "coefficients", "outgoing": by_cosine}


def _vertices(evaluation: Evaluation) -> dict[str, Any]:
    parts = by_vertex(evaluation)
    error = np.sqrt(np.maximum(parts.error, 0.0) / np.maximum(parts.value, 1e-300))
    rows = np.column_stack([evaluation.views.positions, evaluation.views.normals, error])
    return {"columns": ["x", "y", "z", "nx", "ny", "nz", "relative RMSE of the coefficients"], "rows": _short(rows)}


def _outline(prepared: PreparedScene) -> list[list[float]]:
    """Positions and normals of vertices all over the mesh, for the plot of positions."""
    mesh = prepared.surface.mesh
    step = max(1, -(-len(mesh.positions) // _OUTLINE_POINTS))
    rows: list[list[float]] = _short(np.column_stack([mesh.positions, mesh.normals])[::step])
    return rows


def _predicted_measured(evaluation: Evaluation) -> dict[str, Any]:
    """√(4π) a_00 of every view, mean over RGB, with the reference's error; and a histogram of values of Ŝ."""
    white, reference = np.sqrt(4.0 * np.pi), evaluation.at_views.estimates
    # Channels share their walks; their errors are treated as fully correlated.
    error = white * np.sqrt(reference.variance[:, :, 0]).mean(axis=2)
    plots: dict[str, Any] = {
        "white_sky": {
            "standard_error": float(np.sqrt(np.mean(error**2))),
            "columns": ["measured", "predicted"],
            "rows": _short(
                white
                * np.column_stack(
                    [
                        reference.mean[:, :, 0].mean(axis=2).ravel(),
                        evaluation.predicted_at_views[:, :, 0].mean(axis=2).ravel(),
                    ]
                )
            ),
        }
    }
    if evaluation.transport is not None:
        plots["transport"] = _histogram(evaluation.transport.estimates, _predicted(evaluation.transport))
    return plots


def _histogram(reference: Replicates, predictions: Array) -> dict[str, Any]:
    """Counts [measured, predicted] of Ŝ, mean over RGB, in cells of log10; darker values count in the first cells."""
    measured, predicted = reference.mean.mean(axis=2).ravel(), predictions.mean(axis=2).ravel()
    top = float(np.log10(max(measured.max(), predicted.max(), 1e-30)))
    edges = np.linspace(top - _DECADES, top + 1e-6, _CELLS + 1)
    lowest = 10.0 ** edges[0]
    logs = [np.log10(np.maximum(values, lowest)) for values in (measured, predicted)]
    counts = np.histogram2d(logs[0], logs[1], bins=[edges, edges])[0]
    return {"log10_edges": _short(edges), "counts": counts.astype(int).tolist()}


def _worst(evaluation: Evaluation, tracer: Tracer, seed: int) -> dict[str, Any]:
    """The worst values of Ŝ, measured again; of √(4π) a_00 if Ŝ has no values."""
    queries = evaluation.queries
    positions = queries.location.positions
    if evaluation.transport is not None:

        def again(n: NDArray[Any], d: NDArray[Any], batch: int) -> Array:
            incident = queries.incident[n, d][:, None]
            return tracer.transport(positions[n], queries.outgoing[n], incident, _WALKS, seed + 7001 + batch)[:, 0]

        rows = breakdown.worst(_predicted(evaluation.transport), evaluation.transport.estimates, again)
    else:
        white = np.sqrt(4.0 * np.pi)
        estimates = evaluation.coefficients.estimates
        first = Replicates(estimates.count, white * estimates.mean[:, :1], white**2 * estimates.squares[:, :1])

        def again(n: NDArray[Any], d: NDArray[Any], batch: int) -> Array:
            coefficients = tracer.coefficients(positions[n], queries.outgoing[n], 4 * _WALKS, seed + 7001 + batch)
            return np.asarray(white * coefficients[:, 0])

        rows = breakdown.worst(white * _predicted(evaluation.coefficients)[:, :1], first, again)
    for row in rows:
        n, d = row.pop("query"), row.pop("direction")
        row["position"] = _short(positions[n])
        row["outgoing"] = _short(queries.outgoing[n])
        if evaluation.transport is not None:
            row["incident"] = _short(queries.incident[n, d])
    return {"of": "transport" if evaluation.transport is not None else "white sky", "rows": rows}


def _seams(network: Any, evaluation: Evaluation, seed: int) -> dict[str, Any]:
    jumps = seams.jumps(network, evaluation.queries.positions, evaluation.normals, seed)
    single, queries = _single_values(evaluation), evaluation.queries
    near: dict[str, Any] = {}
    for name, is_near in (("seam", seams.near_seam), ("pole", seams.near_pole)):
        if single is not None:
            near[f"{name} of incident"] = seams.compared_with_elsewhere(single, is_near(queries.incident))
        views = is_near(evaluation.views.outgoing)
        near[f"{name} of outgoing"] = seams.compared_with_elsewhere(_views_as_values(evaluation), views)
    return {"jumps": {name: jump.as_json() for name, jump in jumps.items()}, "errors_near": near}


def _short(values: Array) -> Any:
    """The values as nested lists, rounded to four digits."""
    return [_short(row) if row.ndim else float(f"{row:.4g}") for row in values]
