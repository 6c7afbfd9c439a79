"""The figures of an assessment: relative errors with their intervals, a white sky, and what the walks let expect."""

from typing import Any

import numpy as np

from prt_bake.mathematics.noise_free import (
    Interval,
    Replicates,
    Sums,
    percentile_of_length,
    percentile_over,
    ratio,
    relative_noise,
    relative_rmse,
    sums,
)
from prt_bake.trainer.report.evaluation import VIEWS, Evaluation

_WHITE = float(np.sqrt(4.0 * np.pi))


def split(clusters: Sums, seed: int) -> dict[str, Any]:
    """Relative RMSE of the network, of the reference's noise, and of both as they are seen together; and on how many
    clusters the first one rests: (Σ e)² / Σ e², all of them where each carries as much.
    """
    network, noise = relative_rmse(clusters, seed), relative_noise(clusters)
    error = np.maximum(clusters.error, 0.0)
    return {
        "network": network.as_json(),
        "noise": noise,
        "together": float(np.hypot(network.value, noise)),
        "rests_on": float(error.sum() ** 2 / max(float((error**2).sum()), 1e-300)),
        "of": len(error),
    }


def transport_error(asked: Evaluation, seed: int) -> dict[str, Any] | None:
    """Of Ŝ, where it can be estimated."""
    return None if asked.transport is None else split(asked.transport.against(asked.transport_answer), seed)


def coefficient_error(asked: Evaluation, seed: int) -> dict[str, Any]:
    """Of a_lm: over the surface by area, over vertices and views as a bake asks, and the worst vertices."""
    parts = per_view(asked)
    shape = asked.view_answer.shape[:2]
    percentile, uncorrected = percentile_over(parts.error.reshape(shape), parts.value.reshape(shape), seed)
    return {
        "surface": split(asked.coefficients.against(asked.coefficient_answer), seed),
        "vertices": split(by_vertex(asked), seed),
        "percentile_95": percentile.as_json(),
        "percentile_95_uncorrected": uncorrected,
    }


def per_view(asked: Evaluation) -> Sums:
    """Of every view [P·B]."""
    flat = asked.view_answer.reshape(-1, *asked.view_answer.shape[2:])
    return sums(flat, _flattened(asked.view_reference.estimates))


def _flattened(estimates: Replicates) -> Replicates:
    """Estimates [P,B,…] as [P·B,…]."""
    shape = (-1, *estimates.mean.shape[2:])
    return Replicates(estimates.count, estimates.mean.reshape(shape), estimates.squares.reshape(shape))


def by_vertex(asked: Evaluation) -> Sums:
    """Of every vertex [P], its views together."""
    return asked.view_reference.against(asked.view_answer)


def white_sky(asked: Evaluation, seed: int) -> dict[str, Any]:
    """√(4π) a_00, what a white sky of radiance 1 makes of the object: mean over vertices and views, and by vertex."""
    found = _WHITE * asked.view_answer[:, :, 0]
    reference = asked.view_reference.estimates
    measured, variance = _WHITE * reference.mean[:, :, 0], 4.0 * np.pi * reference.variance[:, :, 0]
    difference = found - measured
    mean, total = difference.mean(axis=1), measured.mean(axis=1)
    # Views are drawn independently: what scatters between them holds the noise of the walks as well.
    scatter = difference.var(axis=1, ddof=1) / VIEWS
    length = np.sqrt((total**2).sum(axis=1, keepdims=True))
    of_vertices, uncorrected = percentile_of_length(mean / length, scatter / length**2, seed)
    by_view, by_view_uncorrected = percentile_over(
        ((difference**2) - variance).sum(axis=2), (measured**2 - variance).sum(axis=2), seed
    )
    return {
        "object": ratio(mean.sum(axis=1), total.sum(axis=1), seed).as_json(),
        "object_by_channel": [ratio(mean[:, c], total[:, c], seed).as_json() for c in range(3)],
        "mean": total.mean(axis=0).tolist(),
        "percentile_95": of_vertices.as_json(),
        "percentile_95_uncorrected": uncorrected,
        "percentile_95_of_views": by_view.as_json(),
        "percentile_95_of_views_uncorrected": by_view_uncorrected,
    }


def prediction(asked: Evaluation, network: Any, training: dict[str, Any], seed: int) -> dict[str, Any]:
    """sqrt(weights · v / walks), v the relative variance of what one walk tells (of Ŝ; of a_lm where no Ŝ is)."""
    measured, answer, quantity = asked.transport, asked.transport_answer, "transport"
    if measured is None:
        measured, answer, quantity = asked.coefficients, asked.coefficient_answer, "coefficients"
    clusters = measured.against(answer)
    v = ratio(measured.walk_variance, clusters.value, seed)
    weights, walked = weights_of(network), float(training.get("walks", 0))
    predicted = [float(np.sqrt(weights * max(0.0, x) / walked)) if walked else np.nan for x in vars(v).values()]
    return {
        "of": quantity,
        "v": v.as_json(),
        "weights": weights,
        "walks": walked,
        "predicted": Interval(*predicted).as_json(),
        "reached": relative_rmse(clusters, seed).as_json(),
    }


def weights_of(network: Any) -> int:
    """How many numbers were learnt."""
    return sum(int(parameter.numel()) for parameter in getattr(network, "parameters", tuple)())
