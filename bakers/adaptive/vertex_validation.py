"""Validates interpolated vertices against the transport."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.block_state import BlockState
from bakers.adaptive.evaluation_cache import NO_CACHE
from bakers.adaptive.records import FROM_VERTICES, RefinementSettings, ValidationSamples

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def validation_errors(
    transport: object,
    settings: RefinementSettings,
    vertices: Index,
    positions: Array,
    outgoing: Array,
    coefficients: Array,
    bins: Index,
) -> tuple[Array, int]:
    """Squared errors [n,m], mean over K and channels, of interpolated vertices with coefficients [n,B,K,3] at these
    bins [n,m], over the mean square of the vertex; and evaluations. The estimate is unbiased and may be negative.
    """
    state = _interpolated_state(transport, settings, vertices, positions, outgoing, coefficients)
    rows = np.repeat(np.arange(len(bins)), bins.shape[1])
    _probe_residuals(state, rows, bins.ravel())
    one, other = state.validation_errors(rows, bins.ravel(), coefficients)
    squared = (one * other).mean(axis=(1, 2)) / state.scale[rows]
    return squared.reshape(bins.shape), state.evaluations


def validation_samples(
    transport: object,
    settings: RefinementSettings,
    vertices: Index,
    positions: Array,
    outgoing: Array,
    coefficients: Array,
    variance: Array,
) -> ValidationSamples:
    """Validation samples at some bins of interpolated vertices with coefficients [n,B,K,3] and variance [n,B], as
    `refine` makes them for the vertices that it evaluates.
    """
    state = _interpolated_state(transport, settings, vertices, positions, outgoing, coefficients)
    rows, bins = np.nonzero(settings.validation_bins(vertices))
    _probe_residuals(state, rows, bins)
    begun = state.evaluations
    samples = state.validate(variance, coefficients)
    method = np.full(len(samples.rows), FROM_VERTICES, np.uint8)
    return replace(samples, method=method, evaluations=samples.evaluations + begun)


def _probe_residuals(state: BlockState, rows: Index, bins: Index) -> None:
    """Measures the residual variance at these bins."""
    fits = state.fit_own_lattice(rows, bins, np.full(len(rows), state.least_step), 1)
    state.residual_variance[bins, rows] = fits.residual_variance


def _interpolated_state(
    transport: object,
    settings: RefinementSettings,
    vertices: Index,
    positions: Array,
    outgoing: Array,
    coefficients: Array,
) -> BlockState:
    state = BlockState(transport, replace(settings, lattices="own", cache=NO_CACHE), vertices, positions, outgoing)
    state.scale = np.maximum((coefficients**2).mean(axis=(1, 2, 3)), settings.floor**2)
    return state
