"""Radiance of the vertices of a baked asset towards an eye. Never loads torch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.arguments import described
from formats.asset import Asset
from formats.errors import QueryError, refuse_path
from formats.scene.lights import DirectionalLight
from prt_bake.face.assets import warn_of_other_eye
from prt_bake.geometry.camera import refuse_eye_in_object
from prt_bake.mathematics import sh, sphere
from prt_bake.shading.asset_light import AssetLight, as_asset_light, refuse_light_of_other_lobes
from prt_bake.shading.reconstruction import reconstruct
from prt_bake.shading.sun_shading import sun_radiance

Array = NDArray[np.float64]

_BASIS_ROUNDING = 1e-5


@dataclass(frozen=True)
class Shading:
    """Radiance [V,3] at vertices, 0 at vertices that are invalid or not visible.

    clamped: Σ of the negative radiance that was clamped to 0 / Σ of the radiance, over vertices and channels.
    shaded: the number of shaded vertices.
    sun_error: [V,3], the estimated error of suns and lobes; 0 without lobes.
    """

    radiance: Array
    clamped: float
    shaded: int
    sun_error: Array


def shade(
    asset: Asset, light: AssetLight | ArrayLike | None, eye: ArrayLike, *, suns: Sequence[DirectionalLight] = ()
) -> Array:
    """Radiance [V,3] towards the eye: L = Σ a_lm(x, ωo) b_lm, interpolated between view bins, clamped to at least 0.

    The asset's lobes are added if the light was prepared for them (`light_for`).

    Args:
        asset: the baked asset.
        light: from `light_for`, or coefficients [K,3] of the sky's radiance to the asset's degree, for its harmonics
            alone; None for an asset made for one light (quantity "radiance").
        eye: a point [3] in object space, or directions to the eye [V,3] of any length.
        suns: directional lights that are added without ringing. `suns_apart` divides a lighting into harmonics and
            suns.

    Vertices that were not baked are 0, and directions below the horizon are clamped to it. An asset made for one eye
    gives the radiance towards that eye; an InputWarning says so if another one is asked for.

    Raises QueryError for a light or an eye of another shape or not finite, for an eye on or in the object, for suns on
    an asset made for one light, and for an asset without baked vertices.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> asset = prt.read_asset("spot.h5")
    >>> light = prt.light_for(asset, prt.read_lighting("sky.hdr"))
    >>> radiance = prt.shade(asset, light, [0.0, 1.0, 4.0])
    >>> radiance.shape == asset.mesh.positions.shape
    True
    """
    refuse_path("asset", asset, "prt.read_asset")
    if isinstance(suns, str):
        raise QueryError(f"suns: expected directional lights, such as `prt.suns_apart(...).suns`, found {suns!r}")
    warn_of_other_eye(asset, eye)
    return shade_vertices(asset, light, eye, suns=suns).radiance


def shade_vertices(
    asset: Asset,
    light: AssetLight | ArrayLike | None,
    eye: ArrayLike,
    visible: NDArray[np.bool_] | None = None,
    suns: Sequence[DirectionalLight] = (),
) -> Shading:
    """`shade` for the `visible` vertices [V] only, with statistics."""
    if not asset.valid.any():
        raise QueryError(
            "asset: no vertex was baked, there is nothing to show; bake it again (resume finishes a partial bake)"
        )
    prepared = as_asset_light(light, suns)
    refuse_light_of_other_lobes(prepared, asset)
    if prepared.suns and asset.quantity == "radiance":
        raise QueryError("suns: the asset was made for one light and cannot be relit; pass no suns")
    vertices = np.flatnonzero(asset.valid if visible is None else asset.valid & visible)
    local = eye_in_frames(asset, eye, vertices)
    radiance, sun_error = np.zeros((2, len(asset.valid), 3))
    radiance[vertices], sun_error[vertices] = radiance_towards(asset, prepared, vertices, local)
    negative = abs(float(radiance[radiance < 0.0].sum()))
    radiance = np.maximum(radiance, 0.0)
    kept = float(radiance.sum())
    return Shading(radiance, negative / kept if kept > 0.0 else float(negative > 0.0), len(vertices), sun_error)


def radiance_towards(asset: Asset, light: AssetLight, vertices: NDArray[np.int64], local: Array) -> tuple[Array, Array]:
    """Radiance [n,3], not clamped, of `vertices` [n] (ascending) along `local` [n,3], directions in their frames.

    Also returns the estimated error [n,3] of suns and lobes (`lobed_suns`), 0 without lobes.
    """
    at = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    weights = light_coefficients(asset, light.harmonics)
    radiance = reconstruct(asset.coefficients, vertices, at, asset.sectors, weights)
    if light.lobes is None or asset.lobes is None:
        return radiance + sun_radiance(asset, light.suns, vertices, at), np.zeros_like(radiance)
    from prt_bake.lobes.interpolation import lobes_at
    from prt_bake.lobes.light import lobe_radiance
    from prt_bake.shading.lobed_suns import lobed_sun_radiance

    lobes = lobes_at(asset.lobes, vertices, local)
    if not light.suns:
        return radiance + lobe_radiance(light.lobes, *lobes), np.zeros_like(radiance)
    suns = lobed_sun_radiance(asset, light, vertices, at, lobes)
    return radiance + lobe_radiance(light.lobes.skies_alone(), *lobes) + suns.radiance, suns.error


def surface_radiance(
    asset: Asset, weights: Array, faces: NDArray[np.int64], barycentric: Array, outgoing: Array
) -> Array:
    """Radiance [n,3] that leaves the surface at (u, v) [n,2] of faces [n] along unit `outgoing` [n,3].

    weights: from `light_coefficients`. Radiance is linear between valid vertices, clamped to at least 0; a face without
    valid vertices is black.
    """
    corners = asset.mesh.faces[faces].astype(np.int64)
    shares = corner_weights(asset, corners, barycentric)
    used = np.flatnonzero(shares.ravel() > 0.0)
    # Sorted by vertex, so that each chunk of a file is read once.
    used = used[np.argsort(corners.ravel()[used], kind="stable")]
    vertices = corners.ravel()[used]
    at = bin_coordinates_at_vertices(asset, outgoing[used // 3], vertices)
    sent = np.maximum(reconstruct(asset.coefficients, vertices, at, asset.sectors, weights), 0.0)
    radiance = np.zeros((len(faces), 3))
    np.add.at(radiance, used // 3, shares.ravel()[used, None] * sent)
    return radiance


def corner_weights(asset: Asset, corners: NDArray[np.integer], barycentric: Array) -> Array:
    """Interpolation weights [n,3] of the valid corners [n,3] at (u, v) [n,2]; all 0 if no corner is valid."""
    shares = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    weights = np.maximum(shares, 0.0) * asset.valid[corners]
    total = weights.sum(axis=1, keepdims=True)
    return np.asarray(weights / np.where(total > 0.0, total, 1.0))


def eye_in_frames(asset: Asset, eye: ArrayLike, vertices: NDArray[np.int64]) -> Array:
    """Unit directions [n,3] from `vertices` [n] to the eye, in their frames; raises as `shade`."""
    return _to_frames(asset, eye_directions(asset, eye, vertices), vertices)


def bin_coordinates_at_vertices(asset: Asset, outgoing: Array, vertices: NDArray[np.int64]) -> sphere.BinCoordinates:
    """Coordinates of directions outgoing [n,3] between the view bins of `vertices` [n] (`sphere.bin_coordinates`)."""
    return sphere.bin_coordinates(_to_frames(asset, outgoing, vertices), asset.rings, asset.sectors)


def _to_frames(asset: Asset, outgoing: Array, vertices: NDArray[np.int64]) -> Array:
    """Directions [n,3] in the frames of `vertices` [n]."""
    return sphere.to_local(outgoing, asset.mesh.normals[vertices], np.asarray(asset.tangents, np.float64)[vertices])


def light_coefficients(asset: Asset, light: ArrayLike | None) -> Array:
    """The light's coefficients [K,3] as float64, or ones [1,3] for an asset made for one light; raises as `shade`."""
    if asset.quantity == "radiance":
        if light is not None:
            raise QueryError("light: the asset was made for one light and cannot be relit; pass None to show it")
        return np.ones((1, 3))
    try:
        weights = np.zeros(0) if light is None else np.asarray(light, np.float64)
    except (TypeError, ValueError):
        raise QueryError(
            f"light: expected coefficients [K, 3], such as those of suns_apart (.harmonics) or project_environment, "
            f"found {described(light)}"
        ) from None
    count = sh.count(asset.degree)
    if weights.shape != (count, 3):
        raise QueryError(
            f"light: expected shape [{count}, 3] for an asset of degree {asset.degree}, found {list(weights.shape)}; "
            "project the sky to that degree"
        )
    refuse_other_basis(asset)
    if not np.isfinite(weights).all():
        count = int((~np.isfinite(weights)).sum())
        raise QueryError(f"light: {count} of its coefficients are not finite; repair the sky (mend=True)")
    return weights


def refuse_other_basis(asset: Asset) -> None:
    """Raise QueryError if the harmonics of the asset differ from this program's in its check directions."""
    values = sh.evaluate(asset.check_directions, asset.degree)
    difference = float(np.abs(values - asset.check_values).max())
    if not difference <= _BASIS_ROUNDING:
        raise QueryError(
            f"asset: its harmonics differ from those of this program by {difference:.3g} in its check directions; it "
            "is of another basis or damaged, bake it again"
        )


def eye_directions(asset: Asset, eye: ArrayLike, vertices: NDArray[np.int64]) -> Array:
    """Unit directions [n,3] from `vertices` [n] to the eye; raises as `shade`."""
    point = np.asarray(eye, np.float64)
    positions = asset.mesh.positions
    if point.shape not in ((3,), positions.shape):
        raise QueryError(
            f"eye: expected a point [3] or directions [{len(positions)}, 3], found shape {list(point.shape)}"
        )
    outgoing = point - positions[vertices] if point.ndim == 1 else point[vertices]
    with np.errstate(over="ignore"):
        length = np.linalg.norm(outgoing, axis=1)
    wrong = ~(np.isfinite(length) & (length > 0.0))
    if wrong.any():
        raise QueryError(
            f"eye: no direction to it from {int(wrong.sum())} vertices, the first is {vertices[wrong.argmax()]}: "
            "expected finite numbers, and directions that are not zero"
        )
    if point.ndim == 1:
        refuse_eye_in_object(asset.mesh, point)
    return np.asarray(outgoing / length[:, None])
