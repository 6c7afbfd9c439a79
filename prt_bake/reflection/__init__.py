"""Light reflected at the surface: GGX microfacets, sampled by Monte Carlo. Never loads torch.

May import: `prt_bake.lights`, `prt_bake.geometry`, `prt_bake.mathematics` and `formats`. Begin with `reflector.py`.
"""

from prt_bake.reflection.finish import SurfacePoints, surface_points
from prt_bake.reflection.reflector import Reflector
from prt_bake.reflection.surface import ReflectingSurface

__all__ = ["ReflectingSurface", "Reflector", "SurfacePoints", "surface_points"]
