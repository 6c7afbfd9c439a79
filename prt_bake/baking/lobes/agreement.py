"""Whether a transport is the one of an asset's coefficients: lobes of another would be wrong in silence."""

from typing import Any

import numpy as np

from bakers.evaluation import values_at
from formats.asset import Asset
from formats.errors import warn
from prt_bake.baking.lobes.search import LobeSearch
from prt_bake.mathematics import sh, sphere
from prt_bake.mathematics.directions import fibonacci

_VERTICES, _VIEWS, _DIRECTIONS, _SEED = 24, 6, 256, 7
_ALIKE = 0.35
"""Most networks are within 15 % of a path-traced bake of their object, the worst of the paper's scenes 30 %."""


def harmonics_apart(asset: Asset, transport: Any, search: LobeSearch) -> float:
    """The difference between a transport's harmonics and an asset's coefficients at a few vertices and view bins,
    relative to the coefficients; warns if it is large.

    transport: prepared for the asset's degree (`bakers.transport.up_to`). search: of the same transport.
    """
    draw, valid = np.random.default_rng(_SEED), np.flatnonzero(asset.valid)
    vertices = np.sort(draw.choice(valid, min(_VERTICES, len(valid)), replace=False))
    bins = np.sort(draw.choice(asset.rings * asset.sectors, min(_VIEWS, asset.rings * asset.sectors), replace=False))
    outgoing = search.outgoing(vertices, sphere.view_bins(asset.rings, asset.sectors)[bins])
    positions = np.repeat(asset.mesh.positions[vertices], len(bins), axis=0)
    towards = fibonacci(max(_DIRECTIONS, 4 * sh.count(asset.degree)))
    taken = np.zeros(len(positions), np.int64)
    values = values_at(transport, towards[None], taken, positions, outgoing.reshape(-1, 3)).astype(np.float64)
    found = np.linalg.pinv(sh.evaluate(towards, asset.degree)) @ values  # [n·B,K,3]
    bins = bins if asset.coefficients.shape[1] > 1 else 0 * bins
    stored = np.concatenate([np.asarray(asset.coefficients[int(v)], np.float64)[bins] for v in vertices])
    size = float(np.linalg.norm(np.broadcast_to(stored, found.shape)))
    apart = float(np.linalg.norm(found - stored)) / size if size > 0.0 else 0.0
    if apart > _ALIKE:
        warn(
            f"transport: its harmonics are {apart:.0%} off the asset's coefficients; if it is not a model of the same "
            "object and material, the lobes are wrong"
        )
    return apart
