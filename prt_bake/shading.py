"""Relighting a baked asset: radiance at its vertices, and whole pictures. Never loads torch."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError
from prt_bake import environment, sh, sphere
from prt_bake.camera import Camera, Hits, Visibility, directions
from prt_bake.reconstruction import reconstruct

Array = NDArray[np.float64]

_BYTES_AT_ONCE = 256 << 20
_NEAREST_EYE = 1e-9


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

    clamped: as in `Shading`. shaded: vertices worked on. unlit: share of the object's samples whose face has no valid vertex.
    """

    image: NDArray[np.float32]
    coverage: NDArray[np.float32]
    clamped: float
    shaded: int
    unlit: float
    seconds: float


def shade(asset: Asset, light: ArrayLike, eye: ArrayLike) -> Array:
    """Radiance [V,3] towards the eye: L = Σ a_lm(x, ωo) b_lm, interpolated between view bins, negative values cut to 0.

    light: the sky's coefficients [K,3] of the asset's degree, of radiance. eye: a point [3] in object space, or directions to the
    eye [V,3]. Vertices that were not baked hold 0. Raises QueryError for a light or an eye of another shape, and for an eye on a
    vertex.
    """
    return shade_vertices(asset, light, eye).radiance


def shade_vertices(
    asset: Asset, light: ArrayLike, eye: ArrayLike, visible: NDArray[np.bool_] | None = None
) -> Shading:
    """Like `shade`, for the `visible` vertices [V] alone where given, with the clamped share."""
    weights = _light(asset, light)
    wanted = asset.valid if visible is None else asset.valid & visible
    vertices = np.flatnonzero(wanted)
    outgoing = _towards_eye(asset, eye)[vertices]
    local = sphere.to_local(outgoing, asset.mesh.normals[vertices], np.asarray(asset.tangents, np.float64)[vertices])
    at = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    radiance = np.zeros((len(asset.valid), 3))
    for rows, coefficients, first in _blocks(asset, vertices):
        part = sphere.BinCoordinates._make(field[rows] for field in at)
        radiance[vertices[rows]] = reconstruct(coefficients, vertices[rows] - first, part, asset.sectors, weights)
    negative = -float(radiance[radiance < 0.0].sum())
    radiance = np.maximum(radiance, 0.0)
    kept = float(radiance.sum())
    return Shading(radiance, negative / kept if kept > 0.0 else float(negative > 0.0), len(vertices))


def render_picture(
    asset: Asset,
    sky: NDArray[np.float32],
    camera: Camera,
    *,
    up: str | None = None,
    rotate: float = 0.0,
    samples: int = 3,
    background: bool = True,
) -> Picture:
    """A picture of the asset under a lat-long sky [H,W,3]: samples² rays a pixel, only vertices that are seen are shaded.

    `up` overrides the asset's up axis, `rotate` turns the light (degrees, counter-clockwise seen from above). The light reflected at the
    surface itself is not in it.

    Raises QueryError where nothing could be shown: no vertex is valid, the camera misses the object, or the eye is inside it.
    """
    begun = time.perf_counter()
    if samples < 1:
        raise QueryError(f"samples: {samples} where at least 1 a pixel side is expected")
    if not asset.valid.any():
        raise QueryError("asset: no vertex was baked, there is nothing to show; bake it again (--resume finishes a partial bake)")
    axis = up or asset.up
    light = environment.rotate_light(environment.project(sky, asset.degree, axis), rotate, axis)
    offsets = _grid_offsets(samples)
    rays = directions(camera, slice(None), offsets).reshape(-1, 3)
    hits = Visibility(asset.mesh).first_hits(camera.eye, rays)
    _refuse_empty(asset, camera, rays, hits)
    corners = np.asarray(asset.mesh.faces, np.int64)[hits.faces[hits.faces >= 0]]
    visible = np.zeros(len(asset.valid), np.bool_)
    visible[corners] = True
    shading = shade_vertices(asset, light, camera.eye, visible)
    seen, unlit = _interpolate(asset, shading.radiance, corners, hits)
    colour = np.zeros((len(rays), 3))
    colour[hits.faces >= 0] = seen
    if background:
        missed = hits.faces < 0
        colour[missed] = environment.lookup(sky, rays[missed] @ environment.rotation(rotate, axis), axis)
    shape = (camera.height, camera.width, len(offsets))
    return Picture(
        colour.reshape(*shape, 3).mean(axis=2).astype(np.float32),
        (hits.faces >= 0).reshape(shape).mean(axis=2).astype(np.float32),
        shading.clamped,
        shading.shaded,
        unlit,
        time.perf_counter() - begun,
    )


def _light(asset: Asset, light: ArrayLike) -> Array:
    weights = np.asarray(light, np.float64)
    count = sh.count(asset.degree)
    if weights.shape != (count, 3):
        raise QueryError(
            f"light: shape {weights.shape} where [{count},3] is expected: the asset is of degree {asset.degree}; "
            f"project the sky to that degree"
        )
    if not np.isfinite(weights).all():
        raise QueryError("light: coefficients that are not finite")
    return weights


def _towards_eye(asset: Asset, eye: ArrayLike) -> Array:
    """Unit directions [V,3] from the vertices to the eye."""
    towards = np.asarray(eye, np.float64)
    positions = asset.mesh.positions
    if towards.shape == (3,):
        towards = towards - positions
    elif towards.shape != positions.shape:
        raise QueryError(f"eye: shape {towards.shape} where a point [3] or directions [{len(positions)},3] are expected")
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    if not (length > _NEAREST_EYE * asset.mesh.diagonal * (np.ndim(eye) == 1)).all() or not np.isfinite(towards).all():
        raise QueryError(f"eye: on vertex {int(np.argmin(length))} or not finite; it must stand off the object")
    return np.asarray(towards / length)


def _blocks(asset: Asset, vertices: NDArray[np.int64]) -> Iterator[tuple[slice, NDArray[np.generic], int]]:
    """Runs of `vertices` with the coefficients that hold them and the first vertex of those: all at once from memory, block by block
    from an open file."""
    coefficients = asset.coefficients
    if isinstance(coefficients, np.ndarray):
        yield slice(0, len(vertices)), coefficients, 0
        return
    size = max(1, _BYTES_AT_ONCE // int(np.prod(coefficients.shape[1:]) * coefficients.dtype.itemsize))
    for first in range(0, len(asset.valid), size):
        rows = slice(*np.searchsorted(vertices, [first, first + size]).tolist())
        if rows.stop > rows.start:
            yield rows, coefficients[first : first + size], first


def _grid_offsets(samples: int) -> Array:
    """The centres of a samples × samples grid in the pixel [S,2]."""
    steps = (np.arange(samples) + 0.5) / samples
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _refuse_empty(asset: Asset, camera: Camera, rays: Array, hits: Hits) -> None:
    met = hits.faces >= 0
    if not met.any():
        raise QueryError(f"camera: the eye at {camera.eye.tolist()} sees nothing of the object; look at it, or step back")
    facing = np.sum(np.asarray(asset.mesh.face_normals)[hits.faces[met]] * rays[met], axis=1)
    if (facing > 0.0).all():
        raise QueryError(f"camera: the eye at {camera.eye.tolist()} is inside the object, where an asset holds nothing")


def _interpolate(asset: Asset, radiance: Array, corners: NDArray[np.int64], hits: Hits) -> tuple[Array, float]:
    """Barycentric mean of the valid corners' radiance [n,3], and the share of samples that have none."""
    uv = hits.barycentric[hits.faces >= 0]
    weights = np.concatenate([1.0 - uv.sum(axis=1, keepdims=True), uv], axis=1) * asset.valid[corners]
    total = weights.sum(axis=1, keepdims=True)
    none = total[:, 0] <= 0.0
    weights /= np.where(total > 0.0, total, 1.0)
    return np.einsum("nk,nkc->nc", weights, radiance[corners]), float(none.mean())
