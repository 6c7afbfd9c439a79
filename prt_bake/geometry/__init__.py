"""Cameras, and queries to the surface of a mesh: nearest faces, distances, nested parts.

May import: `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `surface.py`.
"""
