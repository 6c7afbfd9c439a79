"""`transforms_*.json`: cameras and lights in the keys that readers of relightable Gaussians know.

A frame has `file_path` (without suffix) and `transform_matrix` (camera to world, OpenGL axes), as in NeRF's synthetic
scenes (Mildenhall et al. 2020). The light has the keys of each family of readers:

* `pl_pos`, `pl_intensity`: GS³ (Bi et al. 2024), SSD-GS and NRHints (Zeng et al. 2023); `camera_near`, `camera_far` are
  NRHints'.
* `width`, `height`, `light_positions`, `file_paths`: SSS-GS (Dihlmann et al. 2024), whose frames list several lights.
* `transform_matrix_sun`: PRTGaussian (Zhang et al. 2024), whose lights are distant, as they are here.
* `light_direction`, `light_irradiance`: the exact light.

A reader with point lights gets one at `DISTANCE` in the direction of the light. Seen from any point of the object its
direction deviates by at most 1°, its irradiance by at most 3.6 %.
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from formats.json_report import write_report
from prt_bake.olat.pictures import SETS, Coordinates, Picture
from prt_bake.olat.settings import OlatSettings

DISTANCE = 50.0
"""Of `pl_pos` from the object's centre, in lengths of the object. GS³'s shadow cameras see up to 100."""
_RADIUS = math.sqrt(3.0) / 2.0
"""Of the ball around an object of unit size."""


def write_transforms(
    folder: Path, pictures: Iterable[Picture], coordinates: Coordinates, settings: OlatSettings
) -> None:
    """Write one file for each set, with its pictures. Raises StorageError if one cannot be written."""
    chosen = list(pictures)
    for name in SETS:
        frames = [frame(picture, coordinates) for picture in chosen if picture.set == name]
        if frames:
            cameras = [picture.camera for picture in chosen if picture.set == name]
            distance = float(np.linalg.norm(coordinates.points(cameras[0].eye)))
            head = {
                "camera_angle_x": _horizontal(settings),
                "camera_near": max(distance - _RADIUS, 0.01),
                "camera_far": distance + _RADIUS,
                "w": settings.width,
                "h": settings.height,
            }
            write_report({**head, "frames": frames}, folder / f"transforms_{name}.json")


def frame(picture: Picture, coordinates: Coordinates) -> dict[str, Any]:
    """The entry of a picture."""
    entry: dict[str, Any] = {
        "file_path": picture.name,
        "transform_matrix": coordinates.camera_to_world(picture.camera).tolist(),
        "width": picture.camera.width,
        "height": picture.camera.height,
    }
    if picture.direction is None:
        return {**entry, "environment": picture.sky}
    towards = coordinates.directions(picture.direction)
    irradiance = picture.lighting.suns[0].irradiance
    position = (DISTANCE * towards).tolist()
    return {
        **entry,
        "light_direction": towards.tolist(),
        "light_irradiance": irradiance.tolist(),
        "pl_pos": position,
        "pl_intensity": (irradiance * DISTANCE**2).tolist(),
        "light_positions": [position],
        "file_paths": [picture.name],
        "transform_matrix_sun": _at(position),
    }


def _at(position: list[float]) -> list[list[float]]:
    """The matrix [4,4] of a translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return matrix.tolist()


def _horizontal(settings: OlatSettings) -> float:
    """The horizontal field of view in radians."""
    half = math.tan(math.radians(settings.fov) / 2.0) * settings.width / settings.height
    return 2.0 * math.atan(half)
