"""Pictures of a baked asset under lights. Never loads torch.

A picture adds the radiance of the vertices (`vertices`), on request the light reflected at the surface
(`surface_reflection`), and the sky in the background.
"""

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError, refuse_path
from formats.image.single import single_precision
from formats.summary import summary
from prt_bake.face.assets import warn_of_other_eye
from prt_bake.geometry.camera import Camera, Visibility, rays, refuse_eye_in_object
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.reflection.finish import Normals
from prt_bake.shading.asset_light import AssetLight, prepare_light
from prt_bake.shading.errors.picture import PictureError, view_error
from prt_bake.shading.errors.radiance import interpolate_over_faces, radiance_error
from prt_bake.shading.errors.vertices import vertex_error
from prt_bake.shading.layers import make_layers
from prt_bake.shading.sun_shading import SunTreatment
from prt_bake.shading.surface_reflection import AssetReflection, reflects
from prt_bake.shading.vertices import Shading, corner_weights, light_coefficients, shade, shade_vertices
from prt_bake.shading.visible_points import PixelMeans, VisiblePoints, find_visible_points, grid_offsets, row_blocks

__all__ = ["Picture", "Shading", "radiance_error", "render_picture", "shade", "shade_vertices"]

Array = NDArray[np.float64]

_POINTS_AT_ONCE = 1 << 14
"""Points whose reflection is computed together."""


@dataclass(frozen=True)
class Picture:
    """A picture [H,W,3] in linear radiance, the object's coverage [H,W], and statistics.

    Attributes:
        clamped, shaded: as in `Shading`.
        unlit: share of the object's samples whose face has no valid vertex; they are black.
        seconds: computing time.
        error: standard error [H,W,3] of the object's radiance, from the asset's standard errors and from the difference
            between two half buffers of reflected rays. The error of the model itself is not included.
        relative_error: rms of `error` over rms of the object's radiance.
        errors: relative error of the picture, all that is known: network, bake, view bins, vertices, noise and suns.
        layers: the requested layers (`prt_bake.shading.layers`).
        reflects: whether light reflected at the surface is included.
        suns: number of suns that were treated separately.
    """

    image: NDArray[np.float32]
    coverage: NDArray[np.float32]
    clamped: float
    shaded: int
    unlit: float
    seconds: float
    error: NDArray[np.float32]
    relative_error: float
    layers: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    reflects: bool = False
    suns: int = 0
    errors: PictureError | None = None

    __repr__ = summary


def render_picture(
    asset: Asset,
    light: ArrayLike | Lighting,
    camera: Camera,
    *,
    up: str | None = None,
    rotate: float = 0.0,
    samples: int = 3,
    background: bool = True,
    reflection: bool = False,
    roughness: float | NDArray[np.float64] | None = None,
    normals: Normals | None = None,
    layers: tuple[str, ...] = (),
    suns: SunTreatment = "split",
) -> Picture:
    """A picture of the asset under a lighting, or under one lat-long sky [H,W,3], with samples² rays a pixel.

    Args:
        asset: the baked asset.
        light: a `Lighting` or a lat-long picture of radiance.
        camera: the view.
        up: overrides the asset's up axis.
        rotate: rotates the light (degrees, counter-clockwise seen from above).
        samples: rays along each side of a pixel.
        background: whether the sky is visible behind the object.
        reflection: adds the light reflected at the surface, unless the object's index is that of its surroundings.
        roughness: GGX alpha in place of the asset's, a number or a texture [H,W] in the mesh's texture coordinates.
        normals: those of the reflection: "vertex", interpolated but apart at edges sharper than 60 degrees, or "face".
            By default "vertex", unless the mesh file is flat shaded.
        layers: names of `prt_bake.shading.layers.LAYERS` to compute.
        suns: how suns are shaded (`prt_bake.shading.sun_shading`); their reflection is always exact.

    Raises QueryError if no vertex is valid, the camera misses the object, the eye is inside it, the roughness of a
    reflection is unknown, or its normals are of another kind.

    >>> import prt_bake as prt
    >>> asset = prt.read_asset("spot.h5")
    >>> camera = prt.fit_camera(asset.mesh, 64, 48)
    >>> picture = prt.render_picture(asset, prt.read_lighting("sky.hdr"), camera)
    >>> prt.write_image("spot.png", picture.image)
    """
    refuse_path("asset", asset, "prt.read_asset")
    lighting = as_lighting(light, up or asset.up, rotate)
    start = time.perf_counter()
    prepared = prepare_light(asset, lighting, suns)
    picture = picture_under(
        asset, lighting, prepared, camera, samples, background, reflection, roughness, normals, layers
    )
    return replace(picture, seconds=time.perf_counter() - start)


def picture_under(
    asset: Asset,
    lighting: Lighting,
    prepared: AssetLight,
    camera: Camera,
    samples: int = 3,
    background: bool = True,
    reflection: bool = False,
    roughness: float | NDArray[np.float64] | None = None,
    normals: Normals | None = None,
    layers: tuple[str, ...] = (),
) -> Picture:
    """`render_picture` under a lighting that was `prepared` for the asset, for several pictures under one light."""
    start = time.perf_counter()
    if samples < 1:
        raise QueryError(f"samples: expected at least 1 along each side of a pixel, found {samples}")
    refuse_eye_in_object(asset.mesh, camera.eye)
    warn_of_other_eye(asset, camera.eye)
    visibility = Visibility(asset.mesh)
    points = find_visible_points(visibility, camera, grid_offsets(samples))
    corners = asset.mesh.faces[points.faces]
    visible = np.zeros(len(asset.valid), np.bool_)
    visible[corners] = True
    outgoing = camera.towards(asset.mesh.positions)
    shading = shade_vertices(asset, prepared, outgoing, visible)
    if prepared.lobes is None:
        sigma = radiance_error(asset, prepared.harmonics, outgoing, visible, prepared.suns)
    else:
        sigma = radiance_error(asset, prepared.whole, outgoing, visible)
    weights = corner_weights(asset, corners, points.barycentric)
    subsurface = np.einsum("nk,nkc->nc", weights, shading.radiance[corners])
    sun_error = np.einsum("nk,nkc->nc", weights, shading.sun_error[corners])
    shares = np.bincount(corners.ravel(), weights.ravel(), len(visible)).astype(np.float64)
    pixels = PixelMeans(points.pixels, camera, samples**2)
    coverage, picture = pixels.means(None), pixels.means(subsurface)
    bake_error = pixels.means(interpolate_over_faces(asset, weights, corners, sigma))
    noise = np.zeros_like(bake_error)
    parts = {"subsurface": subsurface, "reflection": np.zeros_like(subsurface)}
    reflecting = reflection and reflects(asset)
    light_weights = light_coefficients(asset, prepared.whole)
    if reflecting:
        surface = AssetReflection(asset, lighting, light_weights, visibility, samples**2, roughness, normals)
        parts["reflection"], difference = _reflect(surface, points)
        picture = picture + pixels.means(parts["reflection"])
        noise = pixels.means(difference)
    errors = np.hypot(bake_error, noise)
    signal = float((picture**2).sum())
    below = float((pixels.means(subsurface) ** 2).sum())
    made = make_layers(layers, asset.mesh, points, pixels, parts, picture)
    if background:
        picture = picture.copy()
        _add_background(picture, 1.0 - coverage, lighting, camera, samples)
    return Picture(
        single_precision(picture, "picture"),
        coverage.astype(np.float32),
        shading.clamped,
        shading.shaded,
        float((weights.sum(axis=1) <= 0.0).mean()),
        time.perf_counter() - start,
        single_precision(errors, "picture: standard error"),
        _ratio(float((errors**2).sum()), signal),
        made,
        reflecting,
        0 if prepared.treatment == "plain" else prepared.found,
        _errors(
            asset,
            view_error(asset, light_weights, outgoing, shares, shading.radiance, sigma),
            vertex_error(asset, shares, shading.radiance, sigma),
            _ratio(below, signal),
            _ratio(float((bake_error**2).sum()), signal),
            _ratio(float((noise**2).sum()), signal),
            _suns(prepared, lighting, _ratio(float((pixels.means(sun_error) ** 2).sum()), signal)),
        ),
    )


def _errors(
    asset: Asset,
    views: float | None,
    vertices: float | None,
    subsurface: float,
    bake: float,
    noise: float,
    suns: float | None,
) -> PictureError:
    """The parts relative to the picture; `subsurface` is the rms of light from under the surface over that of all."""
    known = asset.error
    network = None if known.network is None else subsurface * known.network.value
    views, vertices = (None if part is None else subsurface * part for part in (views, vertices))
    return PictureError(network, bake or None, views, vertices, noise, known.path_traced, suns)


def _suns(light: AssetLight, lighting: Lighting, error: float) -> float | None:
    """The part of suns, `error` with lobes; 0 without suns, and None if it is unknown."""
    if not light.found and not lighting.suns:
        return 0.0
    return error if light.suns and light.lobes is not None else None


def _ratio(squares: float, signal: float) -> float:
    return math.sqrt(squares / signal) if signal > 0.0 else 0.0


def _reflect(surface: AssetReflection, points: VisiblePoints) -> tuple[Array, Array]:
    """Reflected radiance of all points, and the difference of its half buffers, [n,3] each."""
    starts = range(0, len(points.pixels), _POINTS_AT_ONCE)
    parts = [surface.radiance(points.subset(slice(first, first + _POINTS_AT_ONCE))) for first in starts]
    radiance, difference = (np.concatenate(part) for part in zip(*parts, strict=True))
    return radiance, difference


def _add_background(picture: Array, share: Array, lighting: Lighting, camera: Camera, samples: int) -> None:
    """Add the skies and the lights with a size to the `share` [H,W] of each pixel that the object leaves open.

    The number of samples along a pixel side is the number of texels of the finest sky there, and at most `samples`, so
    that fine skies do not flicker. Lights with an edge get all samples.
    """
    finest = max((len(sky.image) for sky in lighting.skies), default=1)
    across = 2.0 * math.tan(math.radians(camera.fov) / 2.0) if camera.extent is None else 0.0
    texels = across / camera.height * finest / math.pi
    edges = any(sun.angular_diameter > 0.0 for sun in lighting.suns)
    offsets = grid_offsets(samples if edges else max(1, min(samples, math.ceil(texels))))
    for rows in row_blocks(camera, len(offsets)):
        open_pixels = share[rows] > 0.0
        directions = rays(camera, rows, offsets).directions[open_pixels]
        radiance = lighting.radiance(directions.reshape(-1, 3)).reshape(directions.shape).mean(axis=1)
        picture[rows][open_pixels] += share[rows][open_pixels][:, None] * radiance
