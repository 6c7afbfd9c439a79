"""Radiance at the vertices of an asset, frame by frame, at the speed of memory.

May import: `prt_bake.shading`, `prt_bake.lights`, `prt_bake.jit` and `formats`. Begin with `frames.py`.
"""
