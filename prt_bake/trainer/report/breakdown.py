"""Breakdown of a network's error by angle and by position, and its worst queries."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.mathematics.noise_free import Replicates, Sums, relative_rmse
from prt_bake.trainer.references import FIRST_BATCHES

Array = NDArray[np.float64]

_ANGLES = 12
_REGIONS = 8
_WORST = 10


def binned(quantity: Array, edges: Array, parts: Sums, seed: int) -> dict[str, Any]:
    """Relative RMSE of values [N,D] in bins of a quantity [N,D], with intervals and shares of the squared error.

    Rows are independent, the D values of a row are not.
    """
    index = np.clip(np.searchsorted(edges, quantity, side="right") - 1, 0, len(edges) - 2)
    bins = []
    total = max(float(parts.error.sum()), 1e-300)
    for number in range(len(edges) - 1):
        inside = index == number
        touched = inside.any(axis=1)
        rows = Sums(*((part * inside).sum(axis=1)[touched] for part in (parts.error, parts.value, parts.noise)))
        bins.append(
            {
                **relative_rmse(rows, seed + number).as_json(),
                "share": float(rows.error.sum()) / total,
                "values": int(inside.sum()),
            }
        )
    return {"edges": edges.tolist(), "bins": bins}


def angles(incident: Array, outgoing: Array, normals: Array, parts: Sums, seed: int) -> dict[str, Any]:
    """Errors of Ŝ [N,D] by ωi·n, ωo·n and the angle between ωi [N,D,3] and ωo [N,3] in degrees."""
    incident_cosine = np.einsum("ndc,nc->nd", incident, normals)
    between = np.degrees(np.arccos(np.clip(np.einsum("ndc,nc->nd", incident, outgoing), -1.0, 1.0)))
    outgoing_cosine = np.broadcast_to(np.sum(outgoing * normals, axis=1)[:, None], incident_cosine.shape)
    return {
        "incident": binned(incident_cosine, np.linspace(-1.0, 1.0, _ANGLES + 1), parts, seed),
        "outgoing": binned(outgoing_cosine, np.linspace(0.0, 1.0, _ANGLES // 2 + 1), parts, seed + 100),
        "between": binned(between, np.linspace(0.0, 180.0, _ANGLES + 1), parts, seed + 200),
    }


def regions(positions: Array, vertices: Sums, seed: int) -> list[dict[str, Any]]:
    """Relative RMSE of up to eight parts of the object, the worst first, with their boxes.

    The P vertices are repeatedly halved across the longest side.
    """
    parts = [np.arange(len(positions))]
    while len(parts) < _REGIONS and min(len(part) for part in parts) >= 16:
        parts = [half for part in parts for half in _halves(positions, part)]
    rows = [
        {
            "box_low": positions[part].min(axis=0).tolist(),
            "box_high": positions[part].max(axis=0).tolist(),
            "vertices": len(part),
            **relative_rmse(vertices.select(part), seed + number).as_json(),
        }
        for number, part in enumerate(parts)
    ]
    return sorted(rows, key=lambda region: -region["value"])


def _halves(positions: Array, part: NDArray[Any]) -> list[NDArray[Any]]:
    axis = int(np.argmax(np.ptp(positions[part], axis=0)))
    order = part[np.argsort(positions[part, axis])]
    return [order[: len(order) // 2], order[len(order) // 2 :]]


def worst(predicted: Array, reference: Replicates, again: Callable[[NDArray[Any], NDArray[Any], int], Array]) -> Any:
    """The values [N,D,3] whose errors exceed their noise the most, measured again.

    Rows have the indices (n, d), the predicted and the measured mean over RGB, its standard error and z.
    `again(n, d, batch)` estimates chosen values [M,3] independently: the estimates that selected the values are biased
    by the selection, the new ones are not.
    """
    difference = predicted - reference.mean
    noise = np.sqrt(reference.variance.sum(axis=2))
    beyond = np.sqrt((difference**2).sum(axis=2)) - 2.0 * noise
    row = np.argmax(beyond, axis=1)
    order = np.argsort(-beyond[np.arange(len(row)), row])[:_WORST]
    n, d = order, row[order]
    fresh = Replicates.empty((len(n),))
    for batch in range(FIRST_BATCHES):
        fresh.add(again(n, d, batch).mean(axis=1))
    ours, measured, error = predicted[n, d].mean(axis=1), fresh.mean, np.sqrt(fresh.variance)
    z = np.divide(ours - measured, error, out=np.zeros_like(error), where=error > 0.0)
    return [
        {
            "query": int(n[i]),
            "direction": int(d[i]),
            "predicted": p,
            "measured": m,
            "standard_error": e,
            "z": float(z[i]),
        }
        for i, (p, m, e) in enumerate(zip(ours.tolist(), measured.tolist(), error.tolist(), strict=True))
    ]
