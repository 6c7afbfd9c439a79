"""Standard error of radiance by the standard errors of the baked coefficients. Never loads torch."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.scene.lights import DirectionalLight
from prt_bake.mathematics import sphere
from prt_bake.mathematics.sphere import BinCoordinates
from prt_bake.mathematics.view_frames import ViewFrames
from prt_bake.shading.sun_shading import sun_gradient
from prt_bake.shading.vertices import bin_coordinates_at_vertices, eye_directions, light_coefficients

Array = NDArray[np.float64]


def radiance_error(
    asset: Asset,
    light: ArrayLike | None,
    eye: ArrayLike,
    visible: NDArray[np.bool_] | None = None,
    suns: Sequence[DirectionalLight] = (),
) -> Array:
    """Standard error [V,3] of the radiance of `shade`: its square is σ² · channels_c · b_cᵀ C b_c under a light b.

    C is the covariance between the errors of a vertex's harmonics, in the frame of the view
    (`formats.asset.error_covariance`). Without one in the asset the errors are independent. Between view bins, errors
    shared by the bins add linearly, and independent errors add in squares. Suns enter by the derivative of their
    radiance (`sun_shading.sun_gradient`), which is added to b for each vertex. The error of the model itself is not
    included. Arguments and exceptions are those of `shade_vertices`.
    """
    weights = light_coefficients(asset, light)
    vertices = np.flatnonzero(asset.valid if visible is None else asset.valid & visible)
    outgoing = eye_directions(asset, eye, vertices)
    at = bin_coordinates_at_vertices(asset, outgoing, vertices)
    error = np.zeros((len(asset.valid), 3))
    lights = np.broadcast_to(weights, (len(vertices), *weights.shape))
    if suns:
        lights = lights + sun_gradient(asset, suns, vertices, at)
    if asset.error_covariance is None:
        independent, variance = np.zeros(len(vertices)), (lights**2).sum(axis=1)
    else:
        covariance = asset.error_covariance.at_vertices(vertices)
        independent = covariance.apart[:, 0].astype(np.float64)
        frames = ViewFrames(asset.mesh.normals, np.asarray(asset.tangents, np.float64))
        nearest = _nearest_bin_directions(asset, vertices, at, outgoing)
        variance = covariance.variance_under(frames.in_view(vertices, nearest, lights))
    sigma = interpolate_sigma(asset.standard_error, vertices, at, asset.sectors, independent)
    error[vertices] = sigma[:, None] * np.sqrt(variance)
    return error


def _nearest_bin_directions(asset: Asset, vertices: NDArray[np.int64], at: BinCoordinates, outgoing: Array) -> Array:
    """World directions [n,3] of the nearest view bins; `outgoing` if one bin stands for all views."""
    if asset.coefficients.shape[1] == 1 and len(asset.directions) > 1:
        return outgoing
    ring = np.where(at.ring_weight > 0.5, at.ring_high, at.ring_low)
    sector = np.where(at.sector_weight > 0.5, at.sector_high, at.sector_low)
    local = asset.directions[ring * asset.sectors + sector]
    tangents = np.asarray(asset.tangents, np.float64)[vertices]
    return sphere.to_world(local, asset.mesh.normals[vertices], tangents)


def interpolate_sigma(
    sigma: NDArray[np.floating], vertices: NDArray[np.int64], at: BinCoordinates, sectors: int, independent: Array
) -> Array:
    """Standard errors [n] of `vertices` [n] between view bins, from those of the bins, [V,B] or [V,1].

    independent [n]: the share of the bins' variance that is independent between bins.
    """
    shared_sum, own_sum = np.zeros(len(vertices)), np.zeros(len(vertices))
    in_pole = at.pole_weight / sectors
    sector_terms = [(1.0 - at.sector_weight, at.sector_low), (at.sector_weight, at.sector_high)]
    if sectors == 1:
        sector_terms = [(np.ones(len(vertices)), at.sector_low)]
    for ring_weight, ring in ((1.0 - at.ring_weight, at.ring_low), (at.ring_weight, at.ring_high)):
        for sector_weight, sector in sector_terms:
            weight = (1.0 - at.pole_weight) * ring_weight * sector_weight
            bin_sigma = sigma[vertices, np.minimum(sectors * ring + sector, sigma.shape[1] - 1)].astype(np.float64)
            shared_sum += weight * bin_sigma
            own_sum += (weight**2 + 2.0 * weight * in_pole) * bin_sigma**2
    near = np.flatnonzero(at.pole_weight > 0.0)
    if len(near):
        ring = np.broadcast_to(sigma[vertices[near], :sectors].astype(np.float64), (len(near), sectors))
        shared_sum[near] += at.pole_weight[near] * ring.mean(axis=1)
        own_sum[near] += in_pole[near] ** 2 * (ring**2).sum(axis=1)
    return np.asarray(np.sqrt((1.0 - independent) * shared_sum**2 + independent * own_sum))


def interpolate_over_faces(asset: Asset, weights: Array, corners: NDArray[np.integer], sigma: Array) -> Array:
    """Standard errors [n,3] between those of vertices, `sigma` [V,3], by `weights` [n,3] of `corners` [n,3].

    Errors shared by vertices add linearly, independent ones in squares.
    """
    if asset.error_covariance is None:
        return np.asarray(np.einsum("nk,nkc->nc", weights, sigma[corners]))
    independent = asset.error_covariance.at_vertices(np.arange(len(asset.valid))).apart[:, 1:].astype(np.float64)
    squares = np.einsum("nk,nkc->nc", weights**2, (independent * sigma**2)[corners])
    if (independent < 1.0).any():
        squares += np.einsum("nk,nkc->nc", weights, (np.sqrt(1.0 - independent) * sigma)[corners]) ** 2
    return np.asarray(np.sqrt(squares))
