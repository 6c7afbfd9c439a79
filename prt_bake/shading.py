"""Relighting a baked asset: radiance at its vertices, and whole pictures. Never loads torch."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError
from formats.lights import DirectionalLight
from formats.mesh import Mesh
from prt_bake import sh, sphere
from prt_bake.camera import Camera, Hits, Visibility, directions, refuse_eye_in_object
from prt_bake.lighting import Lighting, as_lighting
from prt_bake.reconstruction import reconstruct
from prt_bake.sun_light import SunTreatment, sun_radiance, suns_apart

Array = NDArray[np.float64]

_RAYS_AT_ONCE = 1 << 15
"""Few enough for the arrays of one block of rows to stay in cache."""


@dataclass(frozen=True)
class Shading:
    """Radiance [V,3] at vertices; what the clamp of negative values took away.

    clamped: Σ of what was cut off / Σ of what is left, over vertices and channels.
    shaded: how many vertices were worked on; the others, and invalid ones, hold 0.
    """

    radiance: Array
    clamped: float
    shaded: int


@dataclass(frozen=True)
class Picture:
    """A picture [H,W,3] in linear radiance, the object's coverage [H,W], and what it took.

    clamped: as in `Shading`. shaded: vertices worked on. unlit: share of the object's samples whose face has no valid
    vertex; they are black. error: one sigma [H,W,3] of the object's part, by the asset's standard errors; of what the
    model itself is off they know nothing. relative_error: its rms over that of the object's part. suns: how many were
    taken out of the other light.
    """

    image: NDArray[np.float32]
    coverage: NDArray[np.float32]
    clamped: float
    shaded: int
    unlit: float
    seconds: float
    error: NDArray[np.float32]
    relative_error: float
    suns: int = 0


def shade(asset: Asset, light: ArrayLike | None, eye: ArrayLike) -> Array:
    """Radiance [V,3] towards the eye: L = Σ a_lm(x, ωo) b_lm, interpolated between view bins, negative values cut to 0.

    light: the sky's coefficients [K,3] of the asset's degree, of radiance; None for an asset made for one light
    (quantity "radiance"). eye: a point [3] in object space, or directions to the eye [V,3] of any length. Vertices that
    were not baked hold 0; directions below the horizon are taken as grazing. Raises QueryError for a light or an eye of
    another shape or not finite, for an eye on the object or inside it, and for an asset without any baked vertex.
    """
    return shade_vertices(asset, light, eye).radiance


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
    weights = _light(asset, light)
    vertices = np.flatnonzero(asset.valid if visible is None else asset.valid & visible)
    at = _between_bins(asset, eye, vertices)
    radiance = np.zeros((len(asset.valid), 3))
    radiance[vertices] = reconstruct(asset.coefficients, vertices, at, asset.sectors, weights)
    if suns:
        radiance[vertices] += sun_radiance(asset, suns, vertices, at)
    negative = -float(radiance[radiance < 0.0].sum())
    radiance = np.maximum(radiance, 0.0)
    kept = float(radiance.sum())
    return Shading(radiance, negative / kept if kept > 0.0 else float(negative > 0.0), len(vertices))


def radiance_error(
    asset: Asset, light: ArrayLike | None, eye: ArrayLike, visible: NDArray[np.bool_] | None = None
) -> Array:
    """One sigma [V,3] of what `shade` gives, by the asset's standard errors: that of a coefficient, between bins as
    radiance is, times the length of the light's coefficients.

    Errors of the bins that a direction lies between are taken to be alike: where they are not, it is less. Of what the
    model itself is off it knows nothing. Arguments and errors as those of `shade_vertices`.
    """
    length = np.sqrt((_light(asset, light) ** 2).sum(axis=0))
    vertices = np.flatnonzero(asset.valid if visible is None else asset.valid & visible)
    at, sigma = _between_bins(asset, eye, vertices), asset.standard_error[:, :, None, None]
    error = np.zeros((len(asset.valid), 3))
    error[vertices] = length * reconstruct(sigma, vertices, at, asset.sectors, np.ones((1, 3)))
    return error


def render_picture(
    asset: Asset,
    light: ArrayLike | Lighting,
    camera: Camera,
    *,
    up: str | None = None,
    rotate: float = 0.0,
    samples: int = 3,
    background: bool = True,
    suns: SunTreatment = "split",
) -> Picture:
    """A picture of the asset under lights, or under one lat-long sky [H,W,3]: samples² rays a pixel, only vertices that
    are seen are shaded.

    `up` overrides the asset's up axis, `rotate` turns the light (degrees, counter-clockwise seen from above). Without
    `background` there is nothing behind the object. `suns` says how suns are met (`sun_light`). The light reflected at
    the surface itself is not in the picture.

    Raises QueryError where nothing could be shown: no vertex is valid, the camera misses the object, or the eye is
    inside it.
    """
    begun = time.perf_counter()
    if samples < 1:
        raise QueryError(f"samples: {samples} where at least 1 a pixel side is expected")
    axis = up or asset.up
    lighting = as_lighting(light, axis, rotate)
    lit = suns_apart(lighting, asset.degree, suns) if asset.quantity == "transfer" else None
    harmonics, whole, apart = (lit.harmonics, lit.whole, lit.suns) if lit else (None, None, ())
    pixels, hits = _cast(asset.mesh, camera, _grid_offsets(samples))
    corners = asset.mesh.faces[hits.faces]
    visible = np.zeros(len(asset.valid), np.bool_)
    visible[corners] = True
    shading = shade_vertices(asset, harmonics, camera.eye, visible, apart)
    # As directions: where the eye stands has been looked at already.
    sigma = radiance_error(asset, whole, camera.eye - asset.mesh.positions, visible)
    shown = np.concatenate([shading.radiance, sigma], axis=1)
    seen, unlit = _interpolate(asset, shown, corners, hits.barycentric)
    shape = (camera.height, camera.width)
    coverage, *channels = (
        np.bincount(pixels, share, math.prod(shape)).reshape(shape) / samples**2 for share in (None, *seen.T)
    )
    picture, error = np.stack(channels[:3], axis=-1), np.stack(channels[3:], axis=-1)
    signal = float((picture**2).sum())
    relative_error = math.sqrt(float((error**2).sum()) / signal) if signal > 0.0 else 0.0
    if background:
        _add_sky(picture, 1.0 - coverage, lighting, camera, samples)
    return Picture(
        picture.astype(np.float32),
        coverage.astype(np.float32),
        shading.clamped,
        shading.shaded,
        unlit,
        time.perf_counter() - begun,
        error.astype(np.float32),
        relative_error,
        lit.found if lit else 0,
    )


def _between_bins(asset: Asset, eye: ArrayLike, vertices: NDArray[np.int64]) -> sphere.BinCoordinates:
    """Where the direction to the eye lies between the view bins of each vertex."""
    outgoing = _towards_eye(asset, eye, vertices)
    local = sphere.to_local(outgoing, asset.mesh.normals[vertices], np.asarray(asset.tangents, np.float64)[vertices])
    return sphere.bin_coordinates(local, asset.rings, asset.sectors)


def _light(asset: Asset, light: ArrayLike | None) -> Array:
    if asset.quantity == "radiance":
        if light is not None:
            raise QueryError("light: the asset was made for one light and cannot be relit; hand in None to see it so")
        return np.ones((1, 3))
    weights = np.zeros(0) if light is None else np.asarray(light, np.float64)
    count = sh.count(asset.degree)
    if weights.shape != (count, 3):
        raise QueryError(
            f"light: shape {list(weights.shape)} where [{count}, 3] is expected: the asset is of degree "
            f"{asset.degree}; project the sky to that degree"
        )
    if not np.isfinite(weights).all():
        raise QueryError(f"light: {int((~np.isfinite(weights)).sum())} of its coefficients are not finite")
    return weights


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


def _cast(mesh: Mesh, camera: Camera, offsets: Array) -> tuple[NDArray[np.int64], Hits]:
    """The samples of a picture that meet the mesh: their pixels [n], row · width + column, and hits [n]."""
    visibility = Visibility(mesh)
    parts = []
    for rows in _row_blocks(camera, len(offsets)):
        hits = visibility.first_hits(camera.eye, directions(camera, rows, offsets).reshape(-1, 3))
        met = np.flatnonzero(hits.faces >= 0)
        parts.append((rows.start * camera.width + met // len(offsets), hits.faces[met], hits.barycentric[met]))
    pixels, faces, barycentric = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(pixels):
        raise QueryError(
            f"camera: the eye at {camera.eye.tolist()}, looking at {camera.target.tolist()}, sees nothing of the "
            "object; turn it to the object, or narrow the view of one far away"
        )
    return pixels, Hits(faces, barycentric)


def _row_blocks(camera: Camera, samples: int) -> Iterator[slice]:
    step = max(1, _RAYS_AT_ONCE // (camera.width * samples))
    for first in range(0, camera.height, step):
        yield slice(first, min(first + step, camera.height))


def _grid_offsets(samples: int) -> Array:
    """The centres of a samples × samples grid in the pixel [S,2]."""
    steps = (np.arange(samples) + 0.5) / samples
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _interpolate(asset: Asset, radiance: Array, corners: NDArray[np.int32], barycentric: Array) -> tuple[Array, float]:
    """Barycentric mean of the valid corners' radiance [n,3], and the share of samples that have none."""
    shares = np.concatenate([1.0 - barycentric.sum(axis=1, keepdims=True), barycentric], axis=1)
    weights = np.maximum(shares, 0.0) * asset.valid[corners]
    total = weights.sum(axis=1)
    weights /= np.where(total > 0.0, total, 1.0)[:, None]
    return np.einsum("nk,nkc->nc", weights, radiance[corners]), float((total <= 0.0).mean())


def _add_sky(picture: Array, share: Array, lighting: Lighting, camera: Camera, samples: int) -> None:
    """Add the skies, and lights with a size, to the `share` [H,W] of each pixel that the object leaves open.

    As many samples a pixel side as it has texels of the finest sky along it, so that a sky finer than the picture does
    not flicker, and at most `samples`; all of them where a disc has an edge.
    """
    finest = max((len(sky.image) for sky in lighting.skies), default=1)
    texels = 2.0 * math.tan(math.radians(camera.fov) / 2.0) / camera.height * finest / math.pi
    edges = any(sun.angular_diameter > 0.0 for sun in lighting.suns)
    offsets = _grid_offsets(samples if edges else max(1, min(samples, math.ceil(texels))))
    for rows in _row_blocks(camera, len(offsets)):
        shown = share[rows] > 0.0
        rays = directions(camera, rows, offsets)[shown]
        radiance = lighting.radiance(rays.reshape(-1, 3)).reshape(rays.shape).mean(axis=1)
        picture[rows][shown] += share[rows][shown][:, None] * radiance
