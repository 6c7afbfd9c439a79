"""By how much radiance may be off for what a bake has left in the coefficients. Never loads torch."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.scene.lights import DirectionalLight
from prt_bake.mathematics import sphere
from prt_bake.mathematics.sphere import BinCoordinates
from prt_bake.mathematics.view_frames import ViewFrames
from prt_bake.shading.suns import sun_slopes
from prt_bake.shading.vertices import light_of, towards

Array = NDArray[np.float64]


def radiance_error(
    asset: Asset,
    light: ArrayLike | None,
    eye: ArrayLike,
    visible: NDArray[np.bool_] | None = None,
    suns: Sequence[DirectionalLight] = (),
) -> Array:
    """One sigma [V,3] of what `shade` gives, by the asset's standard errors: σ² · channels_c · b_cᵀ C b_c for light b.

    C is how the errors of a vertex's harmonics hang together in the frame of the view
    (`formats.asset.error_covariance`); where an asset does not say, they do not. Between bins errors that bins have in
    common stay, and others go by the squares of the weights. Suns that shine besides are met by what small errors do to
    them (`sun_light.sun_slopes`), which is added to b vertex by vertex. Of what the model itself is off it knows
    nothing. Arguments and errors as those of `shade_vertices`.
    """
    weights = light_of(asset, light)
    vertices = np.flatnonzero(asset.valid if visible is None else asset.valid & visible)
    sigma, (at, outgoing) = asset.standard_error, towards(asset, eye, vertices)
    error = np.zeros((len(asset.valid), 3))
    lights = np.broadcast_to(weights, (len(vertices), *weights.shape))
    if suns:
        lights = lights + sun_slopes(asset, suns, vertices, at)
    if asset.error_covariance is None:
        apart, times = np.zeros(len(vertices)), (lights**2).sum(axis=1)
    else:
        shape = asset.error_covariance.at_vertices(vertices)
        apart, frames = (
            shape.apart[:, 0].astype(np.float64),
            ViewFrames(asset.mesh.normals, np.asarray(asset.tangents, np.float64)),
        )
        times = shape.variance_under(frames.in_view(vertices, _of_bins(asset, vertices, at, outgoing), lights))
    error[vertices] = between(sigma, vertices, at, asset.sectors, apart)[:, None] * np.sqrt(times)
    return error


def _of_bins(asset: Asset, vertices: NDArray[np.int64], at: BinCoordinates, outgoing: Array) -> Array:
    """The directions [n,3] of the nearest view bins, whose errors they are; `outgoing` where all are kept as one."""
    if asset.coefficients.shape[1] == 1 and len(asset.directions) > 1:
        return outgoing
    ring = np.where(at.ring_weight > 0.5, at.ring_high, at.ring_low)
    sector = np.where(at.sector_weight > 0.5, at.sector_high, at.sector_low)
    local = asset.directions[ring * asset.sectors + sector]
    tangents = np.asarray(asset.tangents, np.float64)[vertices]
    return sphere.to_world(local, asset.mesh.normals[vertices], tangents)


def between(
    sigma: NDArray[np.floating], vertices: NDArray[np.int64], at: BinCoordinates, sectors: int, apart: Array
) -> Array:
    """Sigma [n] of `vertices` [n] between view bins that have sigma [V,B], or [V,1] each; the share `apart` [n] of a
    bin's variance is its own.
    """
    alike, own = np.zeros(len(vertices)), np.zeros(len(vertices))
    in_pole = at.pole_weight / sectors
    beside = [(1.0 - at.sector_weight, at.sector_low), (at.sector_weight, at.sector_high)]
    if sectors == 1:
        beside = [(np.ones(len(vertices)), at.sector_low)]
    for ring_weight, ring in ((1.0 - at.ring_weight, at.ring_low), (at.ring_weight, at.ring_high)):
        for sector_weight, sector in beside:
            weight = (1.0 - at.pole_weight) * ring_weight * sector_weight
            here = sigma[vertices, np.minimum(sectors * ring + sector, sigma.shape[1] - 1)].astype(np.float64)
            alike += weight * here
            own += (weight**2 + 2.0 * weight * in_pole) * here**2
    near = np.flatnonzero(at.pole_weight > 0.0)
    if len(near):
        ring = np.broadcast_to(sigma[vertices[near], :sectors].astype(np.float64), (len(near), sectors))
        alike[near] += at.pole_weight[near] * ring.mean(axis=1)
        own[near] += in_pole[near] ** 2 * (ring**2).sum(axis=1)
    return np.asarray(np.sqrt((1.0 - apart) * alike**2 + apart * own))


def over_faces(asset: Asset, shares: Array, corners: NDArray[np.integer], sigma: Array) -> Array:
    """Sigma [n,3] of points that are `shares` [n,3] of their face's `corners` [n,3], of `sigma` [V,3] at vertices:
    those that err by themselves add up in squares.
    """
    if asset.error_covariance is None:
        return np.asarray(np.einsum("nk,nkc->nc", shares, sigma[corners]))
    alone = asset.error_covariance.at_vertices(np.arange(len(asset.valid))).apart[:, 1:].astype(np.float64)
    squares = np.einsum("nk,nkc->nc", shares**2, (alone * sigma**2)[corners])
    if (alone < 1.0).any():
        squares += np.einsum("nk,nkc->nc", shares, (np.sqrt(1.0 - alone) * sigma)[corners]) ** 2
    return np.asarray(np.sqrt(squares))
