"""The settings of a test set, which its pictures depend on."""

from dataclasses import asdict, dataclass
from typing import Any

IRRADIANCE = 3.141592653589793
"""Of every directional light, in each channel: a white Lambertian surface that faces the light has radiance 1."""


@dataclass(frozen=True)
class OlatSettings:
    """Numbers of cameras and lights, and the quality of each picture.

    Attributes:
        views, lights: of the training set, which has a picture for each pair.
        test_views, test_lights: of the test set, likewise; others than those of the training set.
        width, height: pixels.
        spp: paths per pixel.
        seed: of cameras, lights and paths.
        subsurface: only the light from under the surface that was scattered, as in networks and assets.
        light_diameter: degrees; 0 is a point at infinity.
        fov: vertical field of view, degrees.
    """

    views: int = 16
    lights: int = 8
    test_views: int = 8
    test_lights: int = 2
    width: int = 256
    height: int = 256
    spp: int = 64
    seed: int = 0
    subsurface: bool = False
    light_diameter: float = 0.0
    fov: float = 30.0

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return asdict(self)
