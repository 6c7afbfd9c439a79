"""Radiance that the vertices of a baked asset send towards an eye. Never loads torch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError, refuse_path
from formats.scene.lights import DirectionalLight
from prt_bake.geometry.camera import refuse_eye_in_object
from prt_bake.mathematics import sh, sphere
from prt_bake.shading.reconstruction import reconstruct
from prt_bake.shading.suns import sun_radiance

Array = NDArray[np.float64]

_BASIS_ROUNDING = 1e-5


@dataclass(frozen=True)
class Shading:
    """Radiance [V,3] at vertices; what the clamp of negative values took away.

    clamped: Σ of what was cut off / Σ of what is left, over vertices and channels.
    shaded: how many vertices were worked on; the others, and invalid ones, hold 0.
    """

    radiance: Array
    clamped: float
    shaded: int


def shade(asset: Asset, light: ArrayLike | None, eye: ArrayLike, *, suns: Sequence[DirectionalLight] = ()) -> Array:
    """Radiance [V,3] towards the eye: L = Σ a_lm(x, ωo) b_lm, interpolated between view bins, negative values cut to 0.

    light: the sky's coefficients [K,3] of the asset's degree, of radiance; None for an asset made for one light
    (quantity "radiance"). eye: a point [3] in object space, or directions to the eye [V,3] of any length. suns: shine
    besides that light, without ringing: harmonics and suns are what `suns_apart` divides a lighting into. Vertices that
    were not baked hold 0; directions below the horizon are taken as grazing. Raises QueryError for a light or an eye of
    another shape or not finite, for an eye on the object or inside it, for suns on an asset made for one light, and for
    an asset without any baked vertex.
    """
    refuse_path("asset", asset, "prt.read_asset")
    if isinstance(suns, str):
        raise QueryError(
            f"suns: {suns!r} where directional lights are expected: `.suns` of what prt.suns_apart returns"
        )
    return shade_vertices(asset, light, eye, suns=suns).radiance


def shade_vertices(
    asset: Asset,
    light: ArrayLike | None,
    eye: ArrayLike,
    visible: NDArray[np.bool_] | None = None,
    suns: Sequence[DirectionalLight] = (),
) -> Shading:
    """Like `shade`, for the `visible` vertices [V] alone where given, with the clamped share; `suns` shine besides the
    light, without ringing (`sun_light`).
    """
    if not asset.valid.any():
        raise QueryError(
            "asset: no vertex was baked, there is nothing to show; bake it again (--resume finishes a partial bake)"
        )
    weights = light_of(asset, light)
    if suns and asset.quantity == "radiance":
        raise QueryError("suns: the asset was made for one light and cannot be relit; hand in none")
    vertices = np.flatnonzero(asset.valid if visible is None else asset.valid & visible)
    at = between_bins(asset, eye, vertices)
    radiance = np.zeros((len(asset.valid), 3))
    radiance[vertices] = reconstruct(asset.coefficients, vertices, at, asset.sectors, weights)
    if suns:
        radiance[vertices] += sun_radiance(asset, suns, vertices, at)
    negative = -float(radiance[radiance < 0.0].sum())
    radiance = np.maximum(radiance, 0.0)
    kept = float(radiance.sum())
    return Shading(radiance, negative / kept if kept > 0.0 else float(negative > 0.0), len(vertices))


def surface_radiance(
    asset: Asset, weights: Array, faces: NDArray[np.int64], barycentric: Array, outgoing: Array
) -> Array:
    """Radiance [n,3] that leaves points of the surface, at (u, v) [n,2] of faces [n], along unit `outgoing` [n,3].

    weights: as `light_of` gives them. Between valid vertices it is linear, negative values cut to 0; a face
    without any sends nothing.
    """
    corners = asset.mesh.faces[faces].astype(np.int64)
    shares = corner_shares(asset, corners, barycentric)
    used = np.flatnonzero(shares.ravel() > 0.0)
    # By vertex: of a file each chunk is then read once.
    used = used[np.argsort(corners.ravel()[used], kind="stable")]
    vertices = corners.ravel()[used]
    tangents = np.asarray(asset.tangents, np.float64)[vertices]
    local = sphere.to_local(outgoing[used // 3], asset.mesh.normals[vertices], tangents)
    at = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    sent = np.maximum(reconstruct(asset.coefficients, vertices, at, asset.sectors, weights), 0.0)
    radiance = np.zeros((len(faces), 3))
    np.add.at(radiance, used // 3, shares.ravel()[used, None] * sent)
    return radiance


def corner_shares(asset: Asset, corners: NDArray[np.integer], barycentric: Array) -> Array:
    """What each valid corner [n,3] adds to the points (u, v) [n,2] of its face [n,3]; 0 where none is valid."""
    shares = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    weights = np.maximum(shares, 0.0) * asset.valid[corners]
    total = weights.sum(axis=1, keepdims=True)
    return np.asarray(weights / np.where(total > 0.0, total, 1.0))


def between_bins(asset: Asset, eye: ArrayLike, vertices: NDArray[np.int64]) -> sphere.BinCoordinates:
    """Where the direction to the eye lies between the view bins of `vertices` [n]; raises as `shade` for the eye."""
    return towards(asset, eye, vertices)[0]


def towards(asset: Asset, eye: ArrayLike, vertices: NDArray[np.int64]) -> tuple[sphere.BinCoordinates, Array]:
    """The same, and the direction itself [n,3]."""
    outgoing = _towards_eye(asset, eye, vertices)
    local = sphere.to_local(outgoing, asset.mesh.normals[vertices], np.asarray(asset.tangents, np.float64)[vertices])
    return sphere.bin_coordinates(local, asset.rings, asset.sectors), outgoing


def light_of(asset: Asset, light: ArrayLike | None) -> Array:
    """The light's coefficients [K,3] as float64, or ones [1,3] for an asset made for one light; raises as `shade`."""
    if asset.quantity == "radiance":
        if light is not None:
            raise QueryError("light: the asset was made for one light and cannot be relit; hand in None to see it so")
        return np.ones((1, 3))
    try:
        weights = np.zeros(0) if light is None else np.asarray(light, np.float64)
    except (TypeError, ValueError):
        raise QueryError(
            f"light: a {type(light).__name__} where coefficients [K, 3] are expected, such as those of suns_apart "
            "(.harmonics) or project_environment"
        ) from None
    count = sh.count(asset.degree)
    if weights.shape != (count, 3):
        raise QueryError(
            f"light: shape {list(weights.shape)} where [{count}, 3] is expected: the asset is of degree "
            f"{asset.degree}; project the sky to that degree"
        )
    refuse_other_basis(asset)
    if not np.isfinite(weights).all():
        raise QueryError(f"light: {int((~np.isfinite(weights)).sum())} of its coefficients are not finite")
    return weights


def refuse_other_basis(asset: Asset) -> None:
    """Raise QueryError where the asset's harmonics have other values in its check directions than they have here."""
    ours = sh.evaluate(asset.check_directions, asset.degree)
    off = float(np.abs(ours - asset.check_values).max())
    if not off <= _BASIS_ROUNDING:
        raise QueryError(
            f"asset: its harmonics are off those of this program by {off:.3g} in its check directions; it is of "
            "another basis or damaged, bake it again"
        )


def _towards_eye(asset: Asset, eye: ArrayLike, vertices: NDArray[np.int64]) -> Array:
    """Unit directions [n,3] from the vertices [n] to the eye."""
    place = np.asarray(eye, np.float64)
    positions = asset.mesh.positions
    if place.shape not in ((3,), positions.shape):
        raise QueryError(
            f"eye: shape {list(place.shape)} where a point [3] or directions [{len(positions)}, 3] are expected"
        )
    towards = place - positions[vertices] if place.ndim == 1 else place[vertices]
    with np.errstate(over="ignore"):
        length = np.linalg.norm(towards, axis=1)
    wrong = ~(np.isfinite(length) & (length > 0.0))
    if wrong.any():
        raise QueryError(
            f"eye: no direction to it from {int(wrong.sum())} vertices, the first is {vertices[wrong.argmax()]}: "
            f"expected finite numbers, and directions of some length"
        )
    if place.ndim == 1:
        refuse_eye_in_object(asset.mesh, place)
    return np.asarray(towards / length[:, None])
