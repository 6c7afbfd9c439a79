"""Environments, suns, directional and sphere lights: read, projected on harmonics, and sampled.

May import: `prt_bake.tracer`, `prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit`, `bakers` and `formats`.
Begin with `environment.py` (one sky) and `lighting.py` (several lights together).
"""
