"""Pictures of a trained network beside the path tracer's own, under suns and a sky that no training knows.

Coefficients of degree 2 say how good an asset can be. Under a sun all of Ŝ is seen: with the sun aside, shadows that
the object casts on itself; with the sun behind the object, light that comes through. Two thirds of the light are the
sun's.
"""

import base64
import io
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from formats.image.png import to_srgb
from formats.scene import Scene
from formats.scene.lights import DirectionalLight
from prt_bake.comparison.object_figures import (
    error_without_noise,
    exposure,
    flip_without_noise,
    measure,
    noise_figures,
    object_mask,
)
from prt_bake.geometry import camera
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.mathematics.noise_free import Interval
from prt_bake.rendering.half_buffers import Halves, Traced
from prt_bake.rendering.network import render_network
from prt_bake.rendering.scene import render_scene
from prt_bake.rendering.state import relative_noise
from prt_bake.tracer.prepared import smooth_part

FLIP = 0.05
"""Of the judged picture, at most."""
SIZE = 96
_SPP = 128
"""Directions a pixel of the network's picture; the sun has its own besides."""
_SUN_SHARE = 2.0 / 3.0
_SUN_COLOUR, _SKY_COLOUR, _GROUND_COLOUR = (1.10, 1.00, 0.85), (0.75, 0.95, 1.30), (0.22, 0.20, 0.18)
_TOWARDS_SUN = {
    "aside": {"y": (0.75, 0.60, -0.30), "z": (0.75, 0.30, 0.60)},
    "behind": {"y": (0.43, 0.45, 0.87), "z": (0.43, -0.87, 0.45)},
}
"""Where each sun stands, by the axis that is up: both above. `camera.fit` looks from −z, or from y with z up."""
SUNS = tuple(_TOWARDS_SUN)
_DIAMETER, _WIDE = 0.53, 30.0
"""Degrees. Behind a smooth interface walks meet a sun by chance alone: it is wide there."""


def picture_error(network: Any, scene: Scene, sun: str, seconds: float, seed: int) -> dict[str, Any]:
    """How far the network's picture is from one that is path traced for `seconds`, as the report keeps it.

    sun: of SUNS. Of light from under the surface alone, lifted as in the tables (`object_figures`). FLIP of the whole
    picture, and as `on_object` of the pixels that the object covers: `flip` with the reference's noise in it,
    `flip_without_noise` estimated without, `flip_of_noise` what the noise alone makes. `error` and `noise` are
    relative, of the object; the pictures with the map of FLIP are a PNG.

    Raises QueryError where no light reaches what is seen, PrtbakeError where the extra `evaluate` is missing.
    """
    lighting = sunny(scene, sun)
    view = camera.fit(scene.mesh, SIZE, SIZE, up=scene.up)
    halves = _traced(scene, lighting, view, seconds, seed)
    reference = halves.traced()
    seen = render_network(network, scene.mesh, lighting, view, _SPP, seed, sampling="light", background=False)
    mask = object_mask(reference.coverage)
    stops = exposure(reference.image, mask)
    flip_map, whole = _flips(seen.image, reference, np.ones_like(mask), stops)
    return {
        "sun": sun,
        "light": f"a sun {sun} of {_diameter(scene):g}° with {_SUN_SHARE:.0%} of the light, and a sky",
        "size": SIZE,
        **whole,
        "on_object": _flips(seen.image, reference, mask, stops)[1],
        "error": error_without_noise(seen.image, seen.standard_error, reference, mask),
        "noise": relative_noise(reference.image, reference.standard_error, reference.coverage),
        "walks": halves.spp,
        "seconds": halves.seconds,
        "png": _side_by_side(seen.image, reference, flip_map, stops),
    }


def _flips(
    image: NDArray[np.float32], reference: Traced, mask: NDArray[np.bool_], stops: float
) -> tuple[NDArray[np.float32], dict[str, float]]:
    """The map of FLIP, and its means over the mask."""
    found = measure(image, reference.image, mask, stops)
    return found.flip_map, {
        "flip": found.flip,
        "flip_without_noise": flip_without_noise(image, reference, mask, stops, found.flip),
        "flip_of_noise": noise_figures(reference, image, mask, stops)["flip"],
    }


def verdict(found: dict[str, Any]) -> dict[str, Any]:
    """The bar for the picture with its figure: FLIP from what it would be without noise to what it is with it."""
    span = Interval(found["flip"], found["flip_without_noise"], found["flip"])
    reached = span.within(FLIP)
    # What is left without noise is an upper estimate where noise is most of what is seen.
    if reached == "not met" and found["flip_of_noise"] > 0.5 * found["flip"]:
        reached = "undecided"
    name = f"mean FLIP of a picture, the sun {found['sun']}, {SIZE}x{SIZE}, without and with the reference's noise"
    return {"name": name, "unit": "FLIP", "bound": FLIP, **span.as_json(), "verdict": reached}


def sentence(found: dict[str, Any]) -> str:
    """The picture's figures in words."""
    return (
        f"A picture under {found['light']}: the network is {found['error']:.1%} off, the reference's own noise "
        f"({found['noise']:.1%}) taken out; mean FLIP {found['flip']:.3f} ({found['on_object']['flip']:.3f} on the "
        f"object alone), where noise alone would make {found['flip_of_noise']:.3f} "
        f"({found['on_object']['flip_of_noise']:.3f})."
    )


def sunny(scene: Scene, sun: str) -> Lighting:
    """The light of the picture, whatever its unit: its exposure follows from what is seen. `sun` is of SUNS."""
    rows = [_SKY_COLOUR] * 8 + [_GROUND_COLOUR] * 8
    sky = as_lighting(np.repeat(np.array(rows, np.float32)[:, None], 32, axis=1), scene.up, 0.0)
    whole = 4.0 * math.pi * 0.5 * (np.array(_SKY_COLOUR) + _GROUND_COLOUR).mean()
    towards = np.array(_TOWARDS_SUN[sun][scene.up])
    light = DirectionalLight(
        towards / np.linalg.norm(towards),
        np.array(_SUN_COLOUR) * whole * _SUN_SHARE / (1.0 - _SUN_SHARE),
        _diameter(scene),
    )
    return Lighting(sky.skies, (light,))


def _diameter(scene: Scene) -> float:
    return _DIAMETER if smooth_part(scene) is None else _WIDE


def _traced(scene: Scene, lighting: Lighting, view: camera.Camera, seconds: float, seed: int) -> Halves:
    halves = Halves.empty(SIZE)
    for half in range(2):
        halves.add(
            render_scene(
                scene,
                lighting,
                view,
                None,
                2 * seed + half,
                background=False,
                shown="scattered",
                minutes=0.5 * seconds / 60.0,
            )
        )
    return halves


def _side_by_side(image: NDArray[np.float32], reference: Traced, flip_map: NDArray[np.float32], stops: float) -> str:
    """Network, path tracer and FLIP (white is 1) beside one another: PNG in base64."""
    shown = [to_srgb(part.astype(np.float64) * 2.0**stops) for part in (image, reference.image)]
    pixels = np.concatenate([*shown, np.repeat(flip_map[..., None], 3, axis=2)], axis=1)
    file = io.BytesIO()
    Image.fromarray(np.rint(255.0 * np.clip(pixels, 0.0, 1.0)).astype(np.uint8)).save(file, format="PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode("ascii")
