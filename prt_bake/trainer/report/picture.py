"""Pictures of a trained network compared with path-traced ones, under suns and a sky.

Coefficients of degree 2 measure how good an asset can be. A sun also shows the high frequencies of Ŝ: from the side,
the shadows that the object casts on itself; from behind, the light that it transmits. The sun has two thirds of the
light.
"""

import base64
import io
import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from formats.image.png import to_srgb
from formats.scene import Scene
from formats.scene.lights import DirectionalLight
from prt_bake.comparison.object_figures import (
    TracedPicture,
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
from prt_bake.rendering.half_buffers import HalfBuffers
from prt_bake.rendering.network import render_network
from prt_bake.rendering.scene import render_scene
from prt_bake.rendering.state import relative_noise
from prt_bake.tracer.prepared import smooth_part

FLIP = 0.05
"""Largest mean FLIP of the picture."""
SIZE = 96
"""Pixels along each side of the pictures that are compared."""
ENLARGED = 3
"""The network's picture is shown with so many times SIZE pixels along each side."""
_SPP = 16
"""Directions per shown pixel of the network's picture, in addition to the sun's."""
_NETWORK_SHARE, _REFERENCE_SHARE = 0.3, 0.4
"""Shares of a limited time for the two pictures; the comparison gets the rest."""
_SUN_SHARE = 2.0 / 3.0
_SUN_COLOUR, _SKY_COLOUR, _GROUND_COLOUR = (1.10, 1.00, 0.85), (0.75, 0.95, 1.30), (0.22, 0.20, 0.18)
_TOWARDS_SUN = {
    "aside": {"y": (-0.75, 0.60, 0.30), "z": (-0.75, -0.30, 0.60)},
    "behind": {"y": (-0.43, 0.45, -0.87), "z": (-0.43, 0.87, 0.45)},
}
"""Direction of each sun by the up axis, above the horizon. The camera stands in front: at +z, or at −y if z is up."""
SUNS = tuple(_TOWARDS_SUN)
_SUN_TEXT = {"aside": "from the side", "behind": "from behind"}
_DIAMETER, _WIDE = 0.53, 30.0
"""Angular diameters [degrees]. Walks hit a sun behind a smooth interface only by chance, so it is wide there."""


def picture_error(
    network: Any, scene: Scene, sun: str, seconds: float, seed: int, within: float = math.inf
) -> dict[str, Any]:
    """Compare the network's picture with one path traced for `seconds`, and return the report's entry.

    within: most seconds for both pictures; the network's has fewer directions per pixel if they are few.

    sun: one of SUNS. Only subsurface light is compared, at the exposure of the tables (`object_figures`). FLIP is
    measured over the complete picture and, as `on_object`, over the object's pixels. `flip` includes the reference's
    noise, `flip_without_noise` is corrected for it, `flip_of_noise` is that of the noise alone. `error` and `noise`
    are relative to the object's radiance. `webp` has the network's picture in ENLARGED times the size, the path traced
    one magnified, and the FLIP map.

    Raises QueryError if no light reaches the camera, PrtbakeError if the extra `evaluate` is not installed.
    """
    lighting = sun_and_sky(scene, sun)
    view = camera.fit(scene.mesh, SIZE, SIZE, up=scene.up)
    fine = replace(view, width=ENLARGED * SIZE, height=ENLARGED * SIZE)
    shown = render_network(
        network,
        scene.mesh,
        lighting,
        fine,
        _SPP,
        seed,
        sampling="light",
        background=False,
        minutes=_NETWORK_SHARE * within / 60.0 if math.isfinite(within) else None,
    )
    halves = _traced(scene, lighting, view, min(seconds, _REFERENCE_SHARE * within), seed)
    parts = halves.image, halves.standard_error, halves.noise, halves.coverage / sum(halves.passes)
    reference = TracedPicture(*(part.astype(np.float32) for part in parts))
    image, error = _reduced(shown.image), _reduced(shown.standard_error**2) ** 0.5 / ENLARGED
    mask = object_mask(reference.coverage)
    stops = exposure(reference.image, mask)
    flip_map, whole = _flips(image, reference, np.ones_like(mask), stops)
    return {
        "sun": sun,
        "light": f"a sun of {_diameter(scene):g}° {_SUN_TEXT[sun]} with {_SUN_SHARE:.0%} of the light, and a sky",
        "size": SIZE,
        **whole,
        "on_object": _flips(image, reference, mask, stops)[1],
        "error": error_without_noise(image, error, reference, mask),
        "noise": relative_noise(reference.image, reference.standard_error, reference.coverage),
        "walks": halves.spp,
        "seconds": halves.seconds,
        "webp": _side_by_side(shown.image, reference, flip_map, stops),
    }


def _flips(
    image: NDArray[np.float32], reference: TracedPicture, mask: NDArray[np.bool_], stops: float
) -> tuple[NDArray[np.float32], dict[str, float]]:
    """The FLIP map, and its means over the mask."""
    found = measure(image, reference.image, mask, stops)
    return found.flip_map, {
        "flip": found.flip,
        "flip_without_noise": flip_without_noise(image, reference, mask, stops, found.flip),
        "flip_of_noise": noise_figures(reference, image, mask, stops)["flip"],
    }


def picture_criterion(entry: dict[str, Any]) -> dict[str, Any]:
    """The criterion of a picture: mean FLIP without the reference's noise.

    If FLIP^p is linear in the variance of the noise, its value without noise follows from FLIP and from FLIP with
    doubled noise (`flip_without_noise`, where p is 2). p is 1 for little noise, and 1 / 0.35 for noise alone: these
    give the ends of the interval.
    """
    measured, without = entry["flip"], entry["flip_without_noise"]
    doubled = math.sqrt(2.0 * measured**2 - without**2)
    low, high = (max(0.0, 2.0 * measured**p - doubled**p) ** (1.0 / p) for p in (1.0 / 0.35, 1.0))
    span = Interval(without, min(low, without), max(high, without))
    name = f"mean FLIP of a picture, sun {sun_text(entry)}, {SIZE}x{SIZE}, without the reference's noise"
    return {"name": name, "unit": "FLIP", "bound": FLIP, **span.as_json(), "result": span.within(FLIP)}


def picture_summary(entry: dict[str, Any]) -> str:
    """The picture's figures as a sentence."""
    if error_is_known(entry):
        error = f"{entry['error']:.1%}, the reference's noise ({entry['noise']:.1%}) subtracted"
    else:
        error = f"unknown: noise ({entry['noise']:.1%} in the reference) hides it"
    return (
        f"A picture under {entry['light']}: the network's relative RMSE is {error}; mean FLIP is {entry['flip']:.3f} "
        f"({entry['on_object']['flip']:.3f} on the object alone), and {entry['flip_of_noise']:.3f} "
        f"({entry['on_object']['flip_of_noise']:.3f}) for noise alone."
    )


def error_is_known(entry: dict[str, Any]) -> bool:
    """Whether the picture's noise does not hide its error, which is NaN otherwise, and None in a file."""
    return entry["error"] is not None and not math.isnan(entry["error"])


def sun_text(entry: dict[str, Any]) -> str:
    """The position of a picture's sun in words."""
    return _SUN_TEXT[entry["sun"]]


def sun_and_sky(scene: Scene, sun: str) -> Lighting:
    """The light of the picture in an arbitrary unit: the exposure follows from the picture. `sun` is one of SUNS."""
    rows = [_SKY_COLOUR] * 8 + [_GROUND_COLOUR] * 8
    sky = as_lighting(np.repeat(np.array(rows, np.float32)[:, None], 32, axis=1), scene.up, 0.0)
    sky_fluence = 4.0 * math.pi * 0.5 * (np.array(_SKY_COLOUR) + _GROUND_COLOUR).mean()
    towards = np.array(_TOWARDS_SUN[sun][scene.up])
    light = DirectionalLight(
        towards / np.linalg.norm(towards),
        np.array(_SUN_COLOUR) * sky_fluence * _SUN_SHARE / (1.0 - _SUN_SHARE),
        _diameter(scene),
    )
    return Lighting(sky.skies, (light,))


def _diameter(scene: Scene) -> float:
    return _DIAMETER if smooth_part(scene) is None else _WIDE


def _traced(scene: Scene, lighting: Lighting, view: camera.Camera, seconds: float, seed: int) -> HalfBuffers:
    halves = HalfBuffers.empty(SIZE)
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


def _reduced(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of blocks of ENLARGED × ENLARGED pixels, [SIZE,SIZE,3]."""
    return np.asarray(image.reshape(SIZE, ENLARGED, SIZE, ENLARGED, 3).mean(axis=(1, 3)))


def _side_by_side(
    image: NDArray[np.float32], reference: TracedPicture, flip_map: NDArray[np.float32], stops: float
) -> str:
    """The network's picture, the path tracer's and the FLIP map (1 is white) as a WebP in base64, all as large."""
    ours, theirs = (to_srgb(part.astype(np.float64) * 2.0**stops) for part in (image, reference.image))
    parts = [
        np.rint(255.0 * np.clip(part, 0.0, 1.0)).astype(np.uint8)
        for part in (ours, theirs, flip_map.astype(np.float64))
    ]
    strip = Image.new("RGB", (3 * len(ours), len(ours)))
    for number, part in enumerate(parts):
        strip.paste(
            Image.fromarray(part).resize((len(ours), len(ours)), Image.Resampling.BICUBIC), (number * len(ours), 0)
        )
    file = io.BytesIO()
    strip.save(file, format="WEBP", quality=90, method=6)  # a sixth of the bytes of a PNG
    return base64.b64encode(file.getvalue()).decode("ascii")
