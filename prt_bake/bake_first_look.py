"""Where a refined bake is, and a first look at it: how noisy fits over the lattice are, and what they miss."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.light_noise import LightNoise, fitted_noise
from bakers.nested_lattice import NestedLattice
from bakers.refinement import Refinement, values_at
from bakers.view_levels import view_levels
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake import sh
from prt_bake.bake_job import Views
from prt_bake.bake_light import bin_turns, checked_bins, drawn, lattice_for, pair_turns, vertex_turns

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FEWEST_NOISE_BINS, MOST_NOISE_BINS = 16, 48
LOOKED_AT, LOOK = 8, 4096
"""Bins that are looked at in that many directions, to see what fewer miss."""
DARK = 0.01
"""Of the object's root mean square coefficient: darker vertices are held to the errors of those that have it."""
BINS_AT_ONCE = 1 << 15
CHECK_SHARE, FEWEST_CHECKS, MOST_CHECKS = 0.01, 64, 4096
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
        return int(np.clip(BINS_AT_ONCE // self.bins, 1, 64))

    @property
    def blocks(self) -> range:
        """Where in `vertices` each block begins."""
        return range(0, len(self.vertices), self.block_vertices)

    def block(self, first: int) -> Index:
        """The vertices of a block."""
        return self.vertices[first : first + self.block_vertices]


def first_refinement(site: Site) -> tuple[Refinement, int]:
    """How to refine at all, tolerances apart; and how many evaluations it took to see how noisy fits are."""
    lattice = lattice_for(site.degree)
    noise, floor, spent = _noise(site, lattice)
    missed, looked = _missed(site, lattice, noise)
    levels = view_levels(site.local)
    share = np.clip(CHECK_SHARE, FEWEST_CHECKS / site.many, MOST_CHECKS / site.many)
    return Refinement(
        levels=levels,
        lattice=lattice,
        rotations=vertex_turns(site.seed),
        other_rotations=bin_turns(site.seed),
        rotate=lambda turns: sh.rotations(turns, site.degree),
        noise=noise,
        light=1.0,
        view=1.0,
        checked=1.0,
        floor=DARK * floor,
        begin=1,
        missed=missed,
        checks=checked_bins(site.seed, site.bins, float(share)),
    ), spent + looked


def _noise(site: Site, lattice: NestedLattice) -> tuple[LightNoise, float, int]:
    """How noisy fits over the lattice are, the root mean square coefficient and the evaluations that these took; from
    bins that are drawn, each with two lattices of each of the first four sizes.
    """
    bins = drawn(
        site.seed + 2,
        site.many,
        min(int(np.clip(site.many // 2048, FEWEST_NOISE_BINS, MOST_NOISE_BINS)), site.many),
    )
    sizes, spent = lattice.sizes[:4], 0
    rough, squared, found = [], [], np.zeros(0)
    for size in sizes:
        fits = []
        for which in (0, 1):
            turns = pair_turns(site.seed, size, which, bins)
            values = _values_at_bins(site, lattice.directions[:size], turns, bins)
            coefficients, left = lattice.fitted(values, lattice.sizes.index(size))
            fits.append((sh.rotations(turns, site.degree) @ coefficients.reshape(len(bins), -1, 3), left))
            spent += len(bins) * size
        found = (fits[0][0] + fits[1][0]) / 2.0
        rough.append((fits[0][1] + fits[1][1]) / 2.0)
        squared.append(((fits[0][0] - fits[1][0]) ** 2).mean(axis=(1, 2)) / 2.0)
    finite = np.isfinite(squared).all(axis=0) & np.isfinite(rough).all(axis=0)
    if not finite.any():
        raise QueryError(f"the transport answered values that are not finite at every one of {len(bins)} bins tried")
    noise = fitted_noise(lattice, sizes, np.array(rough)[:, finite], np.array(squared)[:, finite])
    return noise, float(np.sqrt((found[finite] ** 2).mean())), spent


def _missed(site: Site, lattice: NestedLattice, noise: LightNoise) -> tuple[Array, int]:
    """What each size of the lattice misses at most bins, of the root mean square coefficient, without telling so; and
    evaluations. A look at a few bins in many directions: of what a lattice has missed it says nothing itself.
    """
    bins = drawn(site.seed + 3, site.many, min(LOOKED_AT, site.many))
    step = next((s for s, size in enumerate(lattice.sizes) if size >= LOOK), len(lattice.sizes) - 1)
    values = _values_at_bins(
        site, lattice.directions[: lattice.sizes[step]], pair_turns(site.seed, LOOK, 2, bins), bins
    )
    all_seen, _rough = lattice.fitted(values, step)
    missed, signal = np.zeros(len(lattice.sizes)), float(np.nanmean(all_seen**2))
    for number, size in enumerate(lattice.sizes[:step]):
        found, rough = lattice.fitted(values[:, :size], number)
        off, stated = ((found - all_seen) ** 2).mean(axis=1), rough * noise.variance(lattice, size)
        if np.median(off - MISSED * stated) > 0.0:
            missed[number] = np.sqrt(np.median(off) / signal)
    return missed, len(bins) * lattice.sizes[step]


def _values_at_bins(site: Site, directions: Array, turns: Array, bins: Index) -> NDArray[np.floating]:
    """Ŝ [M,D,3] at bins [M], numbered through all that are baked, in directions [D,3] turned by turns [M,3,3]."""
    places, local = np.divmod(bins, site.bins)
    vertices = site.vertices[places]
    outgoing = np.stack([site.views(int(v), int(v) + 1)[0][0, b] for v, b in zip(vertices, local, strict=True)])
    incident = directions @ turns.transpose(0, 2, 1)
    return values_at(site.transport, incident, np.arange(len(bins)), site.mesh.positions[vertices], outgoing)
