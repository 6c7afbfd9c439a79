"""Media: extinction, albedo and phase function; free flights and transmittance.

May import: `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `tracking.py`.
"""
