"""First pilot of an adaptive bake: the noise of fits over direction lattices, and the detail that these miss."""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.lattice_noise import DEFAULT_SLOPE, LatticeNoise, fit_lattice_noise
from bakers.adaptive.lattice_pools import Pools
from bakers.adaptive.nested_lattice import NestedLattice
from bakers.adaptive.records import RefinementSettings
from bakers.adaptive.view_levels import view_levels
from bakers.adaptive.view_survey import FULL_LEVELS
from bakers.evaluation import values_at
from bakers.transport import label
from bakers.workers import SINGLE_THREAD, Workers
from formats.errors import QueryError
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.survey import survey_views
from prt_bake.baking.job.lattices import (
    lattice_for,
    pair_rotations,
    pools_for,
    sample_without_replacement,
    validation_bins,
    vertex_rotations,
)
from prt_bake.baking.job.provenance import not_finite
from prt_bake.mathematics import sh
from prt_bake.mathematics.view_frames import mesh_view_frames

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST_NOISE_BINS, MOST_NOISE_BINS = 16, 48
REFERENCE_BINS, REFERENCE_DIRECTIONS = 8, 4096
"""Number of bins, and of the directions in which each is evaluated, to measure what fewer directions miss."""
DARK = 0.01
"""Share of the root mean square coefficient of the object, or of its median vertex if that is less. Errors of darker
vertices are relative to this value.
"""
VALIDATION_SHARE, FEWEST_VALIDATION_BINS, MOST_VALIDATION_BINS = 0.008, 64, 4096
HOPELESS = 4.0
"""The error is out of reach if the largest number of directions leaves more than this many times as much."""
FLOAT32_RANGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
NOT_FINITE = np.errstate(invalid="ignore", over="ignore")
"""The pilot skips bins with values that are not finite; the bake reports them."""
MISSED = 20.0
"""Squared error over its stated variance above which bins miss detail of the light."""


def first_refinement(job: AdaptiveJob, workers: Workers = SINGLE_THREAD) -> tuple[RefinementSettings, int]:
    """Refinement settings without tolerances, from the measured noise of fits; and the evaluations of this pilot."""
    lattice, pools, levels = lattice_for(job.degree), pools_for(job.degree, job.seed), view_levels(job.local)
    noise, pool_noise, squares, residual, noise_cost = _measure_noise(job, lattice, pools)
    missed, finest, missed_cost = _measure_missed_detail(job, lattice, noise)
    usual = float(np.sqrt(squares.mean()))
    survey, by_vertex, survey_cost = survey_views(job, lattice, levels, DARK * usual, workers)
    squares = by_vertex if len(by_vertex) else squares
    # If a few vertices outshine all others, nearly all vertices are dark compared with the mean.
    typical = float(np.sqrt(np.median(squares[squares > 0.0]))) if squares.any() else 0.0
    return RefinementSettings(
        levels=levels,
        lattice=lattice,
        rotations=vertex_rotations(job.seed),
        rotate=partial(sh.rotations, degree=job.degree),
        noise=noise,
        pools=pools,
        pool_noise=pool_noise,
        lattices="own",
        relative_residual=residual / max(usual**2, np.finfo(np.float64).tiny),
        light_tolerance=1.0,
        view_tolerance=1.0,
        validation_noise=1.0,
        floor=DARK * min(usual, typical),
        initial_sizes=1,
        full_levels=FULL_LEVELS,
        survey=survey,
        finest_error=finest,
        missed_error=missed,
        validation_bins=validation_bins(job.seed, job.bins, fewest_validation_bins(job) / job.many),
        frames=mesh_view_frames(job.mesh),
    ), noise_cost + missed_cost + survey_cost


def fewest_validation_bins(job: AdaptiveJob) -> float:
    """Least number of validation bins of a pass."""
    return float(np.clip(VALIDATION_SHARE * job.many, FEWEST_VALIDATION_BINS, MOST_VALIDATION_BINS))


@NOT_FINITE
def _measure_noise(
    job: AdaptiveJob, lattice: NestedLattice, pools: Pools
) -> tuple[LatticeNoise, LatticeNoise, Array, float, int]:
    """Noise of fits over the shared lattice and over pools, mean square coefficients [M] of the bins, mean squared
    residual of the fits, and evaluations. Random bins are fitted over two lattices each of several sizes.
    """
    few = int(np.clip(job.many // 2048, FEWEST_NOISE_BINS, MOST_NOISE_BINS))
    bins = sample_without_replacement(job.seed + 2, job.many, min(few, job.many))
    shared = [_pair(job, lattice, size, bins) for size in lattice.sizes[:2]]
    pooled = [_pooled_pair(job, pools, size, bins) for size in pools.sizes[2:7:2]]
    parts = [np.array([pair[part] for pair in shared + pooled]) for part in (1, 2)]
    finite = np.isfinite(parts).all(axis=(0, 1))
    if not finite.any():
        raise not_finite(job.transport, f"{len(bins)} view bins of a pilot")
    residuals, squared = (part[:, finite] for part in parts)
    sizes = tuple(pools.sizes[2:7:2])
    pool_noise = fit_lattice_noise([4.0 * np.pi / size for size in sizes], sizes, residuals[2:], squared[2:])
    noise = fit_lattice_noise(lattice.variance_shares[:2], lattice.sizes[:2], residuals[:2], squared[:2])
    noise = replace(noise, slope=min(noise.slope, pool_noise.slope, DEFAULT_SLOPE))
    squares = (pooled[-1][0][finite] ** 2).mean(axis=(1, 2))
    usual = float(np.sqrt(squares.mean()))
    if usual > 0.0 and not FLOAT32_RANGE[0] < usual < FLOAT32_RANGE[1]:
        low, high = FLOAT32_RANGE
        raise QueryError(
            f"{label(job.transport)}: expected coefficients from {low:.2g} to {high:.2g}, which float32 holds, found "
            f"about {usual:.2g}; scale the transport"
        )
    evaluations = 2 * len(bins) * (sum(sizes) + sum(lattice.sizes[:2]))
    return noise, pool_noise, squares, float(residuals[-1].mean()), evaluations


Pair = tuple[Array, Array, Array]
"""Coefficients [M,K,3], mean squared residual [M] and squared error [M] of the mean of two fits."""


def _pair(job: AdaptiveJob, lattice: NestedLattice, size: int, bins: Index) -> Pair:
    fits = []
    for which in (0, 1):
        rotations = pair_rotations(job.seed, size, which, bins)
        values = job.values_at_bins(lattice.directions[:size], rotations, bins)
        own, residual = lattice.fitted(values, lattice.sizes.index(size))
        fits.append((sh.rotations(rotations, job.degree) @ own.reshape(len(bins), -1, 3), residual))
    return _mean_of(fits)


def _pooled_pair(job: AdaptiveJob, pools: Pools, size: int, bins: Index) -> Pair:
    fits, pool = [], pools.of(size)
    vertices, outgoing = job.vertices_and_views(bins)
    for which in (1, 2):
        copies = pools.copies(size, vertices, bins, which)
        values = values_at(job.transport, pool.incident, copies, job.mesh.positions[vertices], outgoing)
        coefficients, _left, residual = pool.fitted(values, copies)
        fits.append((coefficients, residual))
    return _mean_of(fits)


def _mean_of(fits: list[tuple[Array, Array]]) -> Pair:
    (one, residual), (other, other_residual) = fits
    return (one + other) / 2.0, (residual + other_residual) / 2.0, ((one - other) ** 2).mean(axis=(1, 2)) / 2.0


@NOT_FINITE
def refuse_out_of_reach(job: AdaptiveJob, refinement: RefinementSettings, error: float) -> int:
    """Raises QueryError if the largest number of directions leaves a far larger error at a few bins. Returns the
    evaluations of this test, 0 if earlier measurements suffice.
    """
    if refinement.finest_error <= error:
        return 0
    size = refinement.pools.sizes[-1]
    bins = sample_without_replacement(job.seed + 5, job.many, min(REFERENCE_BINS, job.many))
    coefficients, _residual, squared = _pooled_pair(job, refinement.pools, size, bins)
    signal = _finite_mean(coefficients**2)
    left = float(np.sqrt(_finite_mean(squared) / signal)) if signal > 0.0 else 0.0
    if left > HOPELESS * error:
        raise out_of_reach(error, size, left)
    return 2 * len(bins) * size


def out_of_reach(error: float, size: int, left: float) -> QueryError:
    """The error to raise if `size` directions leave more than the requested error."""
    return QueryError(
        f"error: a relative RMSE of {error:g} is out of reach; up to {size:,} directions a bin leave {left:.3g}; "
        f"request a larger error, or a fixed number of samples"
    )


@NOT_FINITE
def _measure_missed_detail(job: AdaptiveJob, lattice: NestedLattice, noise: LatticeNoise) -> tuple[Array, float, int]:
    """Error that each size of the lattice has at most bins without noticing, over the root mean square coefficient; the
    relative error of the largest size; and evaluations. Compares with a few bins in many directions, because the
    residual of a fit does not show what its lattice missed.
    """
    bins = sample_without_replacement(job.seed + 3, job.many, min(REFERENCE_BINS, job.many))
    step = next((s for s, size in enumerate(lattice.sizes) if size >= REFERENCE_DIRECTIONS), len(lattice.sizes) - 1)
    values = job.values_at_bins(
        lattice.directions[: lattice.sizes[step]], pair_rotations(job.seed, REFERENCE_DIRECTIONS, 2, bins), bins
    )
    reference, _residual = lattice.fitted(values, step)
    missed, finest, signal = np.zeros(len(lattice.sizes)), 0.0, _finite_mean(reference**2)
    for number, size in enumerate(lattice.sizes[:step]):
        coefficients, residual = lattice.fitted(values[:, :size], number)
        squared = ((coefficients - reference) ** 2).mean(axis=1)
        stated = residual * noise.variance(lattice.variance_shares[number], size)
        if np.median(squared - MISSED * stated) > 0.0:
            missed[number] = np.sqrt(np.median(squared) / signal)
        finest = float(np.sqrt(_finite_mean(squared) / signal)) if signal > 0.0 else 0.0
    return missed, finest, len(bins) * lattice.sizes[step]


def _finite_mean(values: Array) -> float:
    """The mean of the finite values; nan if there are none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")
