"""Turntables: pictures of an asset while the eye or the light goes round."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

from formats.asset import Asset
from formats.errors import QueryError
from prt_bake.geometry.camera import Camera
from prt_bake.lights import environment
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.shading.asset_light import prepare_light
from prt_bake.shading.picture import Picture, picture_under, render_picture


def turntable(
    asset: Asset,
    lighting: Lighting,
    camera: Camera,
    frames: int,
    turning: Literal["eye", "light"],
    *,
    up: str | None = None,
    **options: Any,
) -> Iterator[Picture]:
    """`frames` pictures, evenly spaced over one turn about the up axis, counter-clockwise seen from above.

    The eye turns about the axis through the camera's target. The first picture has no rotation. Options are those of
    `render_picture`. Raises QueryError for less than one frame, and as `render_picture`.
    """
    if frames < 1:
        raise QueryError(f"frames: expected at least 1, found {frames}")
    axis = up or asset.up
    angles = [360.0 * number / frames for number in range(frames)]
    if turning == "light":
        for degrees in angles:
            yield render_picture(asset, lighting.turned(degrees, axis), camera, up=axis, **options)
        return
    still = as_lighting(lighting, axis, options.pop("rotate", 0.0))
    prepared = prepare_light(asset, still, options.pop("suns", "split"))
    for degrees in angles:
        eye = camera.target + environment.rotation(degrees, axis) @ (camera.eye - camera.target)
        yield picture_under(asset, still, prepared, replace(camera, eye=eye), **options)
