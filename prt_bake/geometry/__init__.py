"""Cameras and ray casting (`embree.py`), and surface queries on meshes: faces at a position, distances, nesting.

May import: `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `surface.py` and `camera.py`.
"""

from prt_bake.geometry.camera import Camera, fit

__all__ = ["Camera", "fit"]
