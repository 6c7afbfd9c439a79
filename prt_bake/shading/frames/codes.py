"""Compact coefficients in the layout of the kernels, and their radiance at all view bins under a light."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.asset.compact_record import CompactCoefficients, FactorisedViews
from prt_bake.jit.vectors import WIDEST

_DENSE_FROM = 0.04
"""Share of nonzero codes from which a view function is stored densely."""
_DENSE_BYTES = 1 << 30
_ROWS_TOGETHER = 4
_FOLDED_AT_ONCE = 64


class Codes(NamedTuple):
    """Codes in the layout of the kernels.

    table: float32 [B,R], view functions at the bins, most used first. poles: float32 [R], their means over ring 0.
    dense: int8 [V,D·size], codes of the first D view functions, `size` each: the J channel functions, padded with 0.
    Codes of vertex v that do not fit, or of other view functions, are the elements runs[v] to runs[v+1] of which,
    channel and values [M]; runs [V+1].
    """

    table: NDArray[np.float32]
    poles: NDArray[np.float32]
    dense: NDArray[np.int8]
    size: int
    runs: NDArray[np.int64]
    which: NDArray[np.uint16]
    channel: NDArray[np.uint16]
    values: NDArray[np.signedinteger]


def arrange(compact: CompactCoefficients, sectors: int) -> Codes:
    """Bring codes into the layout of the kernels."""
    vertices, functions, width = len(compact), len(compact.view_matrix), len(compact.channels)
    size = WIDEST * -(-width // WIDEST)
    views, channels = (part[compact.components] for part in (compact.view_component, compact.channel_component))
    used = np.bincount(views, minlength=functions)
    order = np.argsort(-used, kind="stable")
    dense_functions = int((used >= _DENSE_FROM * vertices * width).sum())
    dense_functions = min(dense_functions, _DENSE_BYTES // max(1, vertices * size))
    rows = _ROWS_TOGETHER * max(1, -(-dense_functions // _ROWS_TOGETHER))
    place = np.empty(functions, np.int64)
    place[order] = np.arange(functions)
    which = place[views]
    vertex = np.repeat(np.arange(vertices), np.diff(compact.starts))
    fits = (which < dense_functions) & (np.abs(compact.values) < 128)
    dense = np.zeros((vertices, rows, size), np.int8)
    dense[vertex[fits], which[fits], channels[fits]] = compact.values[fits]
    runs = np.concatenate([[0], np.cumsum(np.bincount(vertex[~fits], minlength=vertices))])
    # Unused functions pad the last group.
    table = np.zeros((compact.view_matrix.shape[1], max(rows, functions)), np.float32)
    table[:, :functions] = compact.view_matrix[order].T
    poles = table[:sectors].mean(axis=0, dtype=np.float64).astype(np.float32)
    others = (which[~fits].astype(np.uint16), channels[~fits].astype(np.uint16), compact.values[~fits])
    return Codes(table, poles, dense.reshape(vertices, -1), size, runs, *others)


def radiance_at_bins(
    compact: CompactCoefficients, basis_light: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Yield vertices [n] and their radiance [n,B,3] at all view bins, a few at a time.

    basis_light [J,3]: the channel functions under the light, times the quantisation step.
    """
    functions = len(compact.view_matrix)
    for first in range(0, len(compact), _FOLDED_AT_ONCE):
        vertices = np.arange(first, min(first + _FOLDED_AT_ONCE, len(compact)))
        begin, end = compact.starts[vertices[0]], compact.starts[vertices[-1] + 1]
        components, values = compact.components[begin:end], compact.values[begin:end]
        row = np.repeat(np.arange(len(vertices)), np.diff(compact.starts[first : first + len(vertices) + 1]))
        place = row * functions + compact.view_component[components]
        shares = values[:, None] * basis_light[compact.channel_component[components]]
        folded = np.array([np.bincount(place, share, len(vertices) * functions) for share in shares.T], np.float64)
        yield vertices, _at_bins(compact, folded.reshape(3, len(vertices), functions)).transpose(1, 2, 0)


def _at_bins(compact: CompactCoefficients, folded: NDArray[np.float64]) -> NDArray[np.float64]:
    """From view functions [3,n,R] to the bins [3,n,B]."""
    views = compact.views
    if not isinstance(views, FactorisedViews):
        return np.asarray(folded @ compact.view_matrix)
    rings, sectors = views.rings.astype(np.float64), views.sectors.astype(np.float64)
    grid = folded.reshape(*folded.shape[:2], len(rings), len(sectors))
    return np.asarray((rings.T @ (grid @ sectors)).reshape(*folded.shape[:2], -1))
