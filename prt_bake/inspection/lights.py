"""Description and faults of a lights file."""

from pathlib import Path
from typing import Any

from formats.scene.lights import DirectionalLight, SkyLight, SphereLight, read_lights
from prt_bake.inspection import sky


def describe(path: Path) -> dict[str, Any]:
    """Return the number of lights of each kind, and the files of the skies."""
    lights = read_lights(path)
    return {
        "directional lights": sum(isinstance(light, DirectionalLight) for light in lights),
        "sphere lights": sum(isinstance(light, SphereLight) for light in lights),
        "skies": [str(light.path) for light in lights if isinstance(light, SkyLight)],
    }


def find_faults(path: Path) -> list[str]:
    """Raise the error of reading the file, or that of a sky; else return no faults."""
    for light in read_lights(path):
        if isinstance(light, SkyLight):
            sky.find_faults(light.path)
    return []
