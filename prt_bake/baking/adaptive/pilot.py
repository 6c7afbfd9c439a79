"""Where a refined bake is, and a first look at it: how noisy fits over the lattice are, and what they miss."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.component_fit import LOOKS
from bakers.adaptive.fit_residual import USUAL_SLOPE, LightNoise, fitted_noise
from bakers.adaptive.lattice_pools import Pools
from bakers.adaptive.nested_lattice import NestedLattice
from bakers.adaptive.records import Refinement
from bakers.adaptive.view_levels import Level, view_levels
from bakers.adaptive.view_survey import ALWAYS, ViewSurvey
from bakers.evaluation import values_at
from bakers.workers import ALONE, Crew
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.lattices import checked_bins, drawn, lattice_for, pair_turns, pools_for, vertex_turns
from prt_bake.baking.job.views import Views
from prt_bake.mathematics import sh
from prt_bake.mathematics.view_frames import frames_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST_NOISE_BINS, MOST_NOISE_BINS = 16, 48
LOOKED_AT, LOOK = 8, 4096
"""Bins that are looked at in that many directions, to see what fewer miss."""
DARK = 0.01
"""Of the root mean square coefficient of the object, or of the vertex in the middle if that is less: darker vertices
are held to the errors of those that have it.
"""
BINS_AT_ONCE, FEWEST_AT_ONCE, MOST_AT_ONCE = 1 << 15, 1 << 12, 1024
"""Bins of a block, fewer where there are many workers; and most vertices."""
BLOCKS_A_WORKER = 4
"""At least, so that none has long to wait for the others in the end."""
MANY = 1 << 18
"""Bins of an object from which on a pilot is a small part of it all."""
CHECK_SHARE, FEWEST_CHECKS, MOST_CHECKS = 0.008, 64, 4096
SURVEY_SHARE, MOST_SURVEYED = 10, 32
"""Of how many vertices one is seen in all of its bins before, and at most how many are."""
HOPELESS = 4.0
"""Times the error asked for, that a few bins in the most directions may be off."""
HELD = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
"""Between which root mean square coefficients are kept in float32 without loss."""
NOT_FINITE = np.errstate(invalid="ignore", over="ignore")
"""Bins whose answers are not finite are passed over here, and named when they are baked."""
MISSED = 20.0
"""Times its stated variance that an error must be before bins are held not to see what there is."""


@dataclass(frozen=True)
class Site:
    """Where a refined bake is: the transport, ready to be asked, and what it is baked on."""

    transport: Any
    mesh: Mesh
    vertices: Index
    """Numbers of those that are baked."""
    views: Views
    local: Array
    """View bins [B,3] in the local frame."""
    degree: int
    seed: int
    grid: tuple[int, int] | None = None
    """Rings and sectors, where `local` are the bins of them all."""
    at_once: int | None = None
    """Vertices that are baked together, where that is settled."""

    @property
    def bins(self) -> int:
        """B"""
        return len(self.local)

    @property
    def many(self) -> int:
        """Bins in all."""
        return self.bins * len(self.vertices)

    @property
    def block_vertices(self) -> int:
        """Vertices that are baked together."""
        return self.at_once or vertices_at_once(len(self.vertices), self.bins, 1)

    @property
    def blocks(self) -> range:
        """Where in `vertices` each block begins."""
        return range(0, len(self.vertices), self.block_vertices)

    def block(self, first: int) -> Index:
        """The vertices of a block."""
        return self.vertices[first : first + self.block_vertices]


def vertices_at_once(vertices: int, bins: int, workers: int) -> int:
    """How many vertices to bake together, for blocks that are large but not too few for so many workers."""
    largest = int(np.clip(BINS_AT_ONCE // bins, 1, MOST_AT_ONCE))
    fair = -(-vertices // (BLOCKS_A_WORKER * workers)) if workers > 1 else largest
    return min(largest, max(fair, FEWEST_AT_ONCE // bins, 1))


def first_refinement(site: Site, crew: Crew = ALONE) -> tuple[Refinement, int]:
    """How to refine at all, tolerances apart; and how many evaluations it took to see how noisy fits are."""
    lattice, pools = lattice_for(site.degree), pools_for(site.degree, site.seed)
    noise, pool_noise, squares, rough, spent = _noise(site, lattice, pools)
    missed, finest, looked = _missed(site, lattice, noise)
    levels = view_levels(site.local)
    usual = float(np.sqrt(squares.mean()))
    survey, squares, surveyed = _survey(site, lattice, levels, squares, crew)
    # Where a few vertices outshine all others, nearly all would be dark beside the mean.
    typical = float(np.sqrt(np.median(squares[squares > 0.0]))) if squares.any() else 0.0
    return Refinement(
        levels=levels,
        lattice=lattice,
        rotations=vertex_turns(site.seed),
        rotate=partial(sh.rotations, degree=site.degree),
        noise=noise,
        pools=pools,
        pool_noise=pool_noise,
        lattices="own",
        roughness=rough / max(usual**2, np.finfo(np.float64).tiny),
        light=1.0,
        view=1.0,
        checked=1.0,
        floor=DARK * min(usual, typical),
        begin=1,
        always=ALWAYS,
        survey=survey,
        finest=finest,
        missed=missed,
        checks=checked_bins(site.seed, site.bins, fewest_checks(site) / site.many),
        frames=frames_of(site.mesh),
    ), spent + looked + surveyed


def fewest_checks(site: Site) -> float:
    """How many bins are held against others at least."""
    return float(np.clip(CHECK_SHARE * site.many, FEWEST_CHECKS, MOST_CHECKS))


@NOT_FINITE
def _noise(site: Site, lattice: NestedLattice, pools: Pools) -> tuple[LightNoise, LightNoise, Array, float, int]:
    """How noisy fits over the shared lattice and over pools are, mean square coefficients [M] of the bins, the mean
    square that fits leave over, and the evaluations that these took; from bins that are drawn, each with two lattices
    of each of some sizes.
    """
    few = int(np.clip(site.many // 2048, FEWEST_NOISE_BINS, MOST_NOISE_BINS))
    bins = drawn(site.seed + 2, site.many, min(few, site.many))
    shared = [_pair(site, lattice, size, bins) for size in lattice.sizes[:2]]
    pooled = [_pooled_pair(site, pools, size, bins) for size in pools.sizes[2:7:2]]
    parts = [np.array([pair[part] for pair in shared + pooled]) for part in (1, 2)]
    finite = np.isfinite(parts).all(axis=(0, 1))
    if not finite.any():
        raise QueryError(f"the transport answered values that are not finite at every one of {len(bins)} bins tried")
    rough, squared = (part[:, finite] for part in parts)
    sizes = tuple(pools.sizes[2:7:2])
    pool_noise = fitted_noise([4.0 * np.pi / size for size in sizes], sizes, rough[2:], squared[2:])
    noise = fitted_noise(lattice.variance_shares[:2], lattice.sizes[:2], rough[:2], squared[:2])
    noise = replace(noise, slope=min(noise.slope, pool_noise.slope, USUAL_SLOPE))
    squares = (pooled[-1][0][finite] ** 2).mean(axis=(1, 2))
    usual = float(np.sqrt(squares.mean()))
    if usual > 0.0 and not HELD[0] < usual < HELD[1]:
        raise QueryError(f"the transport's coefficients are about {usual:.2g}, which float32 does not hold; scale it")
    spent = 2 * len(bins) * (sum(sizes) + sum(lattice.sizes[:2]))
    return noise, pool_noise, squares, float(rough[-1].mean()), spent


Pair = tuple[Array, Array, Array]
"""Coefficients [M,K,3], squared roughness [M] and squared error [M] of one of two fits."""


def _pair(site: Site, lattice: NestedLattice, size: int, bins: Index) -> Pair:
    fits = []
    for which in (0, 1):
        turns = pair_turns(site.seed, size, which, bins)
        values = _values_at_bins(site, lattice.directions[:size], turns, bins)
        own, rough = lattice.fitted(values, lattice.sizes.index(size))
        fits.append((sh.rotations(turns, site.degree) @ own.reshape(len(bins), -1, 3), rough))
    return _both(fits)


def _pooled_pair(site: Site, pools: Pools, size: int, bins: Index) -> Pair:
    fits, pool = [], pools.of(size)
    vertices, outgoing = _places(site, bins)
    for which in (1, 2):
        copies = pools.copies(size, vertices, bins, which)
        values = values_at(site.transport, pool.incident, copies, site.mesh.positions[vertices], outgoing)
        found, _left, rough = pool.fitted(values, copies)
        fits.append((found, rough))
    return _both(fits)


def _both(fits: list[tuple[Array, Array]]) -> Pair:
    (one, rough), (other, also) = fits
    return (one + other) / 2.0, (rough + also) / 2.0, ((one - other) ** 2).mean(axis=(1, 2)) / 2.0


@NOT_FINITE
def refuse_out_of_reach(site: Site, refinement: Refinement, error: float) -> int:
    """Raises QueryError where the most directions there are leave far more at a few bins; evaluations, none where what
    was looked at before tells enough.
    """
    if refinement.finest <= error:
        return 0
    size = refinement.pools.sizes[-1]
    bins = drawn(site.seed + 5, site.many, min(LOOKED_AT, site.many))
    found, _rough, squared = _pooled_pair(site, refinement.pools, size, bins)
    signal = _finite_mean(found**2)
    left = float(np.sqrt(_finite_mean(squared) / signal)) if signal > 0.0 else 0.0
    if left > HOPELESS * error:
        raise out_of_reach(error, size, left)
    return 2 * len(bins) * size


def out_of_reach(error: float, size: int, left: float) -> QueryError:
    """That so many directions leave more than an error."""
    return QueryError(
        f"error: a relative RMSE of {error:g} is out of reach; up to {size:,} directions a bin leave {left:.3g}; ask "
        f"for a larger one"
    )


@NOT_FINITE
def _missed(site: Site, lattice: NestedLattice, noise: LightNoise) -> tuple[Array, float, int]:
    """What each size of the lattice misses at most bins, of the root mean square coefficient, without telling so; the
    relative error of the largest; and evaluations. A look at a few bins in many directions: of what a lattice has
    missed it says nothing itself.
    """
    bins = drawn(site.seed + 3, site.many, min(LOOKED_AT, site.many))
    step = next((s for s, size in enumerate(lattice.sizes) if size >= LOOK), len(lattice.sizes) - 1)
    values = _values_at_bins(
        site, lattice.directions[: lattice.sizes[step]], pair_turns(site.seed, LOOK, 2, bins), bins
    )
    all_seen, _rough = lattice.fitted(values, step)
    missed, finest, signal = np.zeros(len(lattice.sizes)), 0.0, _finite_mean(all_seen**2)
    for number, size in enumerate(lattice.sizes[:step]):
        found, rough = lattice.fitted(values[:, :size], number)
        off, stated = (
            ((found - all_seen) ** 2).mean(axis=1),
            rough * noise.variance(lattice.variance_shares[number], size),
        )
        if np.median(off - MISSED * stated) > 0.0:
            missed[number] = np.sqrt(np.median(off) / signal)
        finest = float(np.sqrt(_finite_mean(off) / signal)) if signal > 0.0 else 0.0
    return missed, finest, len(bins) * lattice.sizes[step]


def _finite_mean(values: Array) -> float:
    """The mean of those that are finite; nan where none is."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def _survey(
    site: Site, lattice: NestedLattice, levels: list[Level], squares: Array, crew: Crew
) -> tuple[ViewSurvey | None, Array, int]:
    """All bins of a few vertices in the fewest directions, where bins are going to be foretold; mean square
    coefficients of these vertices, or else those `squares` of bins that are known; and evaluations.
    """
    if len(levels) <= ALWAYS + 1:
        return None, squares, 0
    count = int(np.clip(len(site.vertices) // SURVEY_SHARE, 1, MOST_SURVEYED))
    chosen = np.sort(drawn(site.seed + 4, len(site.vertices), count))
    found = list(crew.in_order(lambda place: crew.do(_surveyed, (site, lattice), int(place)), chosen))
    whole = np.stack([coefficients for coefficients, _energies in found], axis=1)
    finite = np.isfinite(whole).all(axis=(0, 2))
    energies = np.stack([each for _coefficients, each in found])[finite].sum(axis=0)
    left = max(float(energies[LOOKS[0][1] :].sum() / energies.sum()), 0.0) if energies.sum() > 0.0 else 0.0
    floor = DARK * float(np.sqrt(squares.mean()))
    survey = ViewSurvey.of(levels, site.local, whole[:, finite], floor, left)
    of_vertices = (whole[:, finite] ** 2).mean(axis=(0, 2))
    return survey, of_vertices if finite.any() else squares, whole[..., 0].size * (lattice.sizes[0] // 2)


@NOT_FINITE
def _surveyed(site: Site, lattice: NestedLattice, place: int) -> tuple[Array, Array]:
    """Coefficients [B,K·3] at all bins of one vertex, from half of the smallest lattice; and the energies of its
    principal functions of the light, the largest first.
    """
    few = lattice.sizes[0] // 2
    bins = place * site.bins + np.arange(site.bins)
    turns = np.broadcast_to(pair_turns(site.seed, few, 3, bins[:1]), (site.bins, 3, 3))
    values = _values_at_bins(site, lattice.directions[:few], turns, bins).astype(np.float64)
    by_light = values.transpose(1, 0, 2).reshape(few, -1)
    gram = by_light @ by_light.T
    energies = np.full(few, np.nan)
    if np.isfinite(gram).all():
        energies[:] = np.linalg.eigvalsh(gram)[::-1]
    return np.asarray(np.linalg.pinv(lattice.harmonics[:few]) @ values).reshape(site.bins, -1), energies


def _values_at_bins(site: Site, directions: Array, turns: Array, bins: Index) -> NDArray[np.floating]:
    """Ŝ [M,D,3] at bins [M], numbered through all that are baked, in directions [D,3] turned by turns [M,3,3]."""
    vertices, outgoing = _places(site, bins)
    incident = directions @ turns.transpose(0, 2, 1)
    return values_at(site.transport, incident, np.arange(len(bins)), site.mesh.positions[vertices], outgoing)


def _places(site: Site, bins: Index) -> tuple[Index, Array]:
    """The vertices of bins [M], numbered through all that are baked, and their directions to the eye [M,3]."""
    places, local = np.divmod(bins, site.bins)
    vertices = site.vertices[places]
    seen, of_seen = np.unique(vertices, return_inverse=True)
    views = [site.views(int(vertex), int(vertex) + 1)[0][0] for vertex in seen]
    return vertices, np.stack([views[number][b] for number, b in zip(of_seen, local, strict=True)])
