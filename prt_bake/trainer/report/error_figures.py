"""Figures of an assessment: relative errors with intervals, a white sky, and the error expected from the walks."""

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
    """Relative RMSE of the network, of the reference's noise, and of both together.

    "rests_on" is the effective number of clusters (Σ e)² / Σ e²: all of them if each contributes the same.
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


def transport_error(evaluation: Evaluation, seed: int) -> dict[str, Any] | None:
    """The error of Ŝ, None if Ŝ has no values."""
    if evaluation.transport is None:
        return None
    return split(evaluation.transport.errors(), seed)


def coefficient_error(evaluation: Evaluation, seed: int) -> dict[str, Any]:
    """The error of a_lm: over the surface by area, over vertices and views as in a bake, and at the worst vertices."""
    parts = per_view(evaluation)
    shape = evaluation.predicted_at_views.shape[:2]
    percentile, uncorrected = percentile_over(parts.error.reshape(shape), parts.value.reshape(shape), seed)
    return {
        "surface": split(evaluation.coefficients.errors(), seed),
        "vertices": split(by_vertex(evaluation), seed),
        "percentile_95": percentile.as_json(),
        "percentile_95_uncorrected": uncorrected,
    }


def per_view(evaluation: Evaluation) -> Sums:
    """Sums of squared errors of a_lm for every view [P·B]."""
    flat = evaluation.predicted_at_views.reshape(-1, *evaluation.predicted_at_views.shape[2:])
    return sums(flat, _flattened(evaluation.at_views.estimates))


def _flattened(estimates: Replicates) -> Replicates:
    """Estimates [P,B,…] as [P·B,…]."""
    shape = (-1, *estimates.mean.shape[2:])
    return Replicates(estimates.count, estimates.mean.reshape(shape), estimates.squares.reshape(shape))


def by_vertex(evaluation: Evaluation) -> Sums:
    """Sums of squared errors of a_lm for every vertex [P], over its views."""
    return evaluation.at_views.errors()


def white_sky(evaluation: Evaluation, seed: int) -> dict[str, Any]:
    """The error of √(4π) a_00, the radiance under a white sky of radiance 1: of the object's mean and by vertex."""
    predicted = _WHITE * evaluation.predicted_at_views[:, :, 0]
    reference = evaluation.at_views.estimates
    measured, variance = _WHITE * reference.mean[:, :, 0], 4.0 * np.pi * reference.variance[:, :, 0]
    difference = predicted - measured
    mean, total = difference.mean(axis=1), measured.mean(axis=1)
    # Views are drawn independently: their scatter includes the noise of the walks.
    scatter = difference.var(axis=1, ddof=1) / VIEWS
    length = np.sqrt((total**2).sum(axis=1, keepdims=True))
    length = np.where(length > 0.0, length, np.nan)  # no relative error at a black vertex
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


def prediction(evaluation: Evaluation, network: Any, training: dict[str, Any], seed: int) -> dict[str, Any]:
    """The error sqrt(weights · v / walks) expected of a network, v the relative variance of a single walk.

    v is that of Ŝ, or of a_lm if Ŝ has no values.
    """
    measured, quantity = evaluation.transport, "transport"
    if measured is None:
        measured, quantity = evaluation.coefficients, "coefficients"
    clusters = measured.errors()
    v = ratio(measured.walk_variance, clusters.value, seed)
    weights, walked = weights_of(network), float(training.get("walks", 0))
    expected = [float(np.sqrt(weights * max(0.0, x) / walked)) if walked else np.nan for x in vars(v).values()]
    return {
        "of": quantity,
        "v": v.as_json(),
        "weights": weights,
        "walks": walked,
        "predicted": Interval(*expected).as_json(),
        "reached": relative_rmse(clusters, seed).as_json(),
    }


def weights_of(network: Any) -> int:
    """The number of learned parameters."""
    return sum(int(parameter.numel()) for parameter in getattr(network, "parameters", tuple)())
