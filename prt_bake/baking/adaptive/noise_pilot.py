"""The job of an adaptive bake, and a first pilot: the noise of fits over direction lattices, and what these miss."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.lattice_noise import DEFAULT_SLOPE, LatticeNoise, fit_lattice_noise
from bakers.adaptive.lattice_pools import Pools
from bakers.adaptive.nested_lattice import NestedLattice
from bakers.adaptive.principal_components import PROBE_STAGES
from bakers.adaptive.records import RefinementSettings
from bakers.adaptive.view_levels import Level, view_levels
from bakers.adaptive.view_survey import FULL_LEVELS, ViewSurvey
from bakers.evaluation import values_at
from bakers.workers import SINGLE_THREAD, Workers
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.lattices import (
    lattice_for,
    pair_rotations,
    pools_for,
    sample_without_replacement,
    validation_bins,
    vertex_rotations,
)
from prt_bake.baking.job.views import Views
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
BINS_AT_ONCE, FEWEST_AT_ONCE, MOST_AT_ONCE = 1 << 15, 1 << 12, 1024
"""Most and fewest bins of a block, the latter with many workers; and most vertices of a block."""
BLOCKS_PER_WORKER = 4
"""Least number of blocks per worker, so that workers finish at about the same time."""
MANY = 1 << 18
"""Bins of an object for which a pilot is a small part of the cost."""
VALIDATION_SHARE, FEWEST_VALIDATION_BINS, MOST_VALIDATION_BINS = 0.008, 64, 4096
SURVEY_SHARE, MOST_SURVEYED = 10, 32
"""The survey evaluates all bins of one in `SURVEY_SHARE` vertices, and of at most `MOST_SURVEYED`."""
HOPELESS = 4.0
"""The error is out of reach if the largest number of directions leaves more than this many times as much."""
FLOAT32_RANGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
NOT_FINITE = np.errstate(invalid="ignore", over="ignore")
"""The pilot skips bins with values that are not finite; the bake reports them."""
MISSED = 20.0
"""Squared error over its stated variance above which bins miss detail of the light."""


@dataclass(frozen=True)
class AdaptiveJob:
    """Transport, vertices, view bins and degree of an adaptive bake."""

    transport: Any
    mesh: Mesh
    vertices: Index
    """Indices of the vertices that are baked."""
    views: Views
    local: Array
    """View bins [B,3] in the local frame."""
    degree: int
    seed: int
    grid: tuple[int, int] | None = None
    """Rings and sectors, if `local` holds all of their bins."""
    at_once: int | None = None
    """Vertices of a block; None: as `vertices_at_once` chooses."""

    @property
    def bins(self) -> int:
        """View bins of a vertex."""
        return len(self.local)

    @property
    def many(self) -> int:
        """View bins of all vertices."""
        return self.bins * len(self.vertices)

    @property
    def block_vertices(self) -> int:
        """Vertices of a block."""
        return self.at_once or vertices_at_once(len(self.vertices), self.bins, 1)

    @property
    def blocks(self) -> range:
        """Index into `vertices` of the first vertex of each block."""
        return range(0, len(self.vertices), self.block_vertices)

    def block(self, first: int) -> Index:
        """The vertices of a block."""
        return self.vertices[first : first + self.block_vertices]


def vertices_at_once(vertices: int, bins: int, workers: int) -> int:
    """Vertices of a block: large blocks, but enough of them for all workers."""
    largest = int(np.clip(BINS_AT_ONCE // bins, 1, MOST_AT_ONCE))
    fair = -(-vertices // (BLOCKS_PER_WORKER * workers)) if workers > 1 else largest
    return min(largest, max(fair, FEWEST_AT_ONCE // bins, 1))


def first_refinement(job: AdaptiveJob, workers: Workers = SINGLE_THREAD) -> tuple[RefinementSettings, int]:
    """Refinement settings without tolerances, from the measured noise of fits; and the evaluations of this pilot."""
    lattice, pools = lattice_for(job.degree), pools_for(job.degree, job.seed)
    noise, pool_noise, squares, residual, noise_cost = _measure_noise(job, lattice, pools)
    missed, finest, missed_cost = _measure_missed_detail(job, lattice, noise)
    levels = view_levels(job.local)
    usual = float(np.sqrt(squares.mean()))
    survey, squares, survey_cost = _survey(job, lattice, levels, squares, workers)
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
        raise QueryError(
            f"{type(job.transport).__name__}: expected finite values, found NaN or infinite ones at all "
            f"{len(bins)} view bins of a pilot"
        )
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
            f"{type(job.transport).__name__}: expected coefficients from {low:.2g} to {high:.2g}, which float32 holds, "
            f"found about {usual:.2g}; scale the transport"
        )
    evaluations = 2 * len(bins) * (sum(sizes) + sum(lattice.sizes[:2]))
    return noise, pool_noise, squares, float(residuals[-1].mean()), evaluations


Pair = tuple[Array, Array, Array]
"""Coefficients [M,K,3], mean squared residual [M] and squared error [M] of the mean of two fits."""


def _pair(job: AdaptiveJob, lattice: NestedLattice, size: int, bins: Index) -> Pair:
    fits = []
    for which in (0, 1):
        turns = pair_rotations(job.seed, size, which, bins)
        values = _values_at_bins(job, lattice.directions[:size], turns, bins)
        own, residual = lattice.fitted(values, lattice.sizes.index(size))
        fits.append((sh.rotations(turns, job.degree) @ own.reshape(len(bins), -1, 3), residual))
    return _mean_of(fits)


def _pooled_pair(job: AdaptiveJob, pools: Pools, size: int, bins: Index) -> Pair:
    fits, pool = [], pools.of(size)
    vertices, outgoing = _vertices_and_views(job, bins)
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
        f"request a larger error"
    )


@NOT_FINITE
def _measure_missed_detail(job: AdaptiveJob, lattice: NestedLattice, noise: LatticeNoise) -> tuple[Array, float, int]:
    """Error that each size of the lattice has at most bins without noticing, over the root mean square coefficient; the
    relative error of the largest size; and evaluations. Compares with a few bins in many directions, because the
    residual of a fit does not show what its lattice missed.
    """
    bins = sample_without_replacement(job.seed + 3, job.many, min(REFERENCE_BINS, job.many))
    step = next((s for s, size in enumerate(lattice.sizes) if size >= REFERENCE_DIRECTIONS), len(lattice.sizes) - 1)
    values = _values_at_bins(
        job, lattice.directions[: lattice.sizes[step]], pair_rotations(job.seed, REFERENCE_DIRECTIONS, 2, bins), bins
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


def _survey(
    job: AdaptiveJob, lattice: NestedLattice, levels: list[Level], squares: Array, workers: Workers
) -> tuple[ViewSurvey | None, Array, int]:
    """Evaluates all bins of a few vertices in few directions, if bins will be interpolated. Returns the survey, mean
    square coefficients of these vertices (without a survey, `squares`), and evaluations.
    """
    if len(levels) <= FULL_LEVELS + 1:
        return None, squares, 0
    count = int(np.clip(len(job.vertices) // SURVEY_SHARE, 1, MOST_SURVEYED))
    chosen = np.sort(sample_without_replacement(job.seed + 4, len(job.vertices), count))
    results = list(workers.in_order(lambda place: workers.do(_survey_vertex, (job, lattice), int(place)), chosen))
    coefficients = np.stack([each for each, _energies in results], axis=1)
    finite = np.isfinite(coefficients).all(axis=(0, 2))
    energies = np.stack([each for _coefficients, each in results])[finite].sum(axis=0)
    left = max(float(energies[PROBE_STAGES[0][1] :].sum() / energies.sum()), 0.0) if energies.sum() > 0.0 else 0.0
    floor = DARK * float(np.sqrt(squares.mean()))
    survey = ViewSurvey.of(levels, job.local, coefficients[:, finite], floor, left)
    by_vertex = (coefficients[:, finite] ** 2).mean(axis=(0, 2))
    return survey, by_vertex if finite.any() else squares, coefficients[..., 0].size * (lattice.sizes[0] // 2)


@NOT_FINITE
def _survey_vertex(job: AdaptiveJob, lattice: NestedLattice, place: int) -> tuple[Array, Array]:
    """Coefficients [B,K·3] at all bins of one vertex, from half of the smallest lattice; and the energies of the
    principal components of its values over directions, the largest first.
    """
    few = lattice.sizes[0] // 2
    bins = place * job.bins + np.arange(job.bins)
    turns = np.broadcast_to(pair_rotations(job.seed, few, 3, bins[:1]), (job.bins, 3, 3))
    values = _values_at_bins(job, lattice.directions[:few], turns, bins).astype(np.float64)
    by_light = values.transpose(1, 0, 2).reshape(few, -1)
    gram = by_light @ by_light.T
    energies = np.full(few, np.nan)
    if np.isfinite(gram).all():
        energies[:] = np.linalg.eigvalsh(gram)[::-1]
    return np.asarray(np.linalg.pinv(lattice.harmonics[:few]) @ values).reshape(job.bins, -1), energies


def _values_at_bins(job: AdaptiveJob, directions: Array, turns: Array, bins: Index) -> NDArray[np.floating]:
    """Ŝ [M,D,3] at bins [M], counted over all baked vertices, in directions [D,3] rotated by turns [M,3,3]."""
    vertices, outgoing = _vertices_and_views(job, bins)
    incident = directions @ turns.transpose(0, 2, 1)
    return values_at(job.transport, incident, np.arange(len(bins)), job.mesh.positions[vertices], outgoing)


def _vertices_and_views(job: AdaptiveJob, bins: Index) -> tuple[Index, Array]:
    """The vertices of bins [M], counted over all baked vertices, and their directions to the eye [M,3]."""
    rows, local = np.divmod(bins, job.bins)
    vertices = job.vertices[rows]
    distinct, inverse = np.unique(vertices, return_inverse=True)
    views = [job.views(int(vertex), int(vertex) + 1)[0][0] for vertex in distinct]
    return vertices, np.stack([views[row][b] for row, b in zip(inverse, local, strict=True)])
