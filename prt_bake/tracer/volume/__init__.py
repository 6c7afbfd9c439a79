"""Participating media: extinction, albedo, phase function, free-flight sampling and transmittance.

May import: `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `tracking.py`.
"""
