"""Pictures of a baked asset under lights. Never loads torch.

What its vertices send (`prt_bake.shading.vertices`), on request what its surface reflects
(`prt_bake.shading.surface_reflection`), and the sky behind.
"""

import math
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError, refuse_path
from prt_bake.geometry.camera import Camera, Visibility, rays, refuse_eye_in_object
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.shading.layers import layers_of
from prt_bake.shading.radiance_error import over_faces, radiance_error
from prt_bake.shading.suns import SunTreatment, suns_apart
from prt_bake.shading.surface_reflection import SurfaceGloss, reflects
from prt_bake.shading.vertices import Shading, corner_shares, light_of, shade, shade_vertices
from prt_bake.shading.visible_points import PixelMeans, Seen, cast, grid_offsets, row_blocks

__all__ = ["Picture", "Shading", "radiance_error", "render_picture", "shade", "shade_vertices"]

Array = NDArray[np.float64]

_POINTS_AT_ONCE = 1 << 14
"""Of the surface, whose reflection is found together."""


@dataclass(frozen=True)
class Picture:
    """A picture [H,W,3] in linear radiance, the object's coverage [H,W], and what it took.

    clamped: as in `Shading`. shaded: vertices worked on. unlit: share of the object's samples whose face has no valid
    vertex; they are black. error: one sigma [H,W,3] of the object's part, by the asset's standard errors and by what
    two halves of the reflected rays differ; of what the model itself is off they know nothing. relative_error: its rms
    over that of the object's part. layers: what was asked for beside (`picture_layers`). reflects: whether the light
    that the surface reflects is in it. suns: how many were taken out of the other light.
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
    layers: tuple[str, ...] = (),
    suns: SunTreatment = "split",
) -> Picture:
    """A picture of the asset under lights, or under one lat-long sky [H,W,3]: samples² rays a pixel, only vertices that
    are seen are shaded.

    `up` overrides the asset's up axis, `rotate` turns the light (degrees, counter-clockwise seen from above). Without
    `background` there is nothing behind the object. With `reflection` the light that its surface reflects is added,
    unless its index is that of its surroundings; `roughness` is then its GGX alpha in place of the asset's, one or a
    texture [H,W] by the mesh's texture coordinates. `layers` names those of `picture_layers.LAYERS` that are wanted.
    `suns` says how suns are met (`sun_light`); reflected, they are always apart.

    Raises QueryError where nothing could be shown: no vertex is valid, the camera misses the object, or the eye is
    inside it; and for a reflection whose roughness nobody says.
    """
    begun = time.perf_counter()
    refuse_path("asset", asset, "prt.read_asset")
    if samples < 1:
        raise QueryError(f"samples: {samples} where at least 1 a pixel side is expected")
    refuse_eye_in_object(asset.mesh, camera.eye)
    lighting = as_lighting(light, up or asset.up, rotate)
    lit = suns_apart(lighting, asset.degree, suns) if asset.quantity == "transfer" else None
    harmonics, whole, apart = (lit.harmonics, lit.whole, lit.suns) if lit else (None, None, ())
    visibility = Visibility(asset.mesh)
    seen = cast(visibility, camera, grid_offsets(samples))
    corners = asset.mesh.faces[seen.faces]
    visible = np.zeros(len(asset.valid), np.bool_)
    visible[corners] = True
    towards_eye = camera.towards(asset.mesh.positions)
    shading = shade_vertices(asset, harmonics, towards_eye, visible, apart)
    sigma = radiance_error(asset, harmonics, towards_eye, visible, apart)
    shares = corner_shares(asset, corners, seen.barycentric)
    sent = np.einsum("nk,nkc->nc", shares, shading.radiance[corners])
    error = over_faces(asset, shares, corners, sigma)
    reflecting = reflection and reflects(asset)
    gloss = differing = np.zeros((0, 3))
    if reflecting:
        weights = light_of(asset, whole)
        surface = SurfaceGloss(asset, lighting, weights, visibility, samples**2, roughness)
        gloss, differing = _reflected(surface, seen, samples**2)
    pixels = PixelMeans(seen.pixels, camera, samples**2)
    coverage, picture, errors = pixels.means(None), pixels.means(sent), pixels.means(error)
    if reflecting:
        picture = picture + pixels.means(gloss)
        errors = np.hypot(errors, pixels.means(differing))
    signal = float((picture**2).sum())
    of_object = {"subsurface": sent, "reflection": gloss if reflecting else np.zeros_like(sent)}
    wanted = layers_of(layers, asset.mesh, seen, pixels, of_object, picture)
    if background:
        picture = picture.copy()
        _add_sky(picture, 1.0 - coverage, lighting, camera, samples)
    return Picture(
        picture.astype(np.float32),
        coverage.astype(np.float32),
        shading.clamped,
        shading.shaded,
        float((shares.sum(axis=1) <= 0.0).mean()),
        time.perf_counter() - begun,
        errors.astype(np.float32),
        math.sqrt(float((errors**2).sum()) / signal) if signal > 0.0 else 0.0,
        wanted,
        reflecting,
        lit.found if lit else 0,
    )


def _reflected(surface: SurfaceGloss, seen: Seen, samples: int) -> tuple[Array, Array]:
    """What the surface reflects at all points, and by how much its halves differ, [n,3] each."""
    parts = []
    for first in range(0, len(seen.pixels), _POINTS_AT_ONCE):
        some = Seen._make(part[first : first + _POINTS_AT_ONCE] for part in seen)
        keys = some.pixels * samples + some.samples
        parts.append(surface.radiance(some.faces, some.barycentric, some.outgoing, keys))
    total, differing = (np.concatenate(part) for part in zip(*parts, strict=True))
    return total, differing


def _add_sky(picture: Array, share: Array, lighting: Lighting, camera: Camera, samples: int) -> None:
    """Add the skies, and lights with a size, to the `share` [H,W] of each pixel that the object leaves open.

    As many samples a pixel side as it has texels of the finest sky along it, so that a sky finer than the picture does
    not flicker, and at most `samples`; all of them where a disc has an edge.
    """
    finest = max((len(sky.image) for sky in lighting.skies), default=1)
    across = 2.0 * math.tan(math.radians(camera.fov) / 2.0) if camera.extent is None else 0.0
    texels = across / camera.height * finest / math.pi
    edges = any(sun.angular_diameter > 0.0 for sun in lighting.suns)
    offsets = grid_offsets(samples if edges else max(1, min(samples, math.ceil(texels))))
    for rows in row_blocks(camera, len(offsets)):
        shown = share[rows] > 0.0
        towards = rays(camera, rows, offsets).directions[shown]
        radiance = lighting.radiance(towards.reshape(-1, 3)).reshape(towards.shape).mean(axis=1)
        picture[rows][shown] += share[rows][shown][:, None] * radiance
