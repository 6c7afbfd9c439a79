"""Distant light: environments, suns, directional and sphere lights are read, projected on harmonics, and sampled.

`skies` handles the sky pictures. May import: `prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit`,
`bakers` and `formats`. Begin with `environment.py` (one sky) and `lighting.py` (several lights).
"""

from prt_bake.lights.environment import project, read_environment, rotate_light
from prt_bake.lights.lighting import Lighting, Sky, read_lighting

__all__ = ["Lighting", "Sky", "project", "read_environment", "read_lighting", "rotate_light"]
