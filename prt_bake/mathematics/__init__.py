"""Spherical harmonics, view bins, sets of directions, random and low-discrepancy numbers, error statistics, lobes.

May import: `prt_bake.jit` and `formats`. Begin with `sh.py` (harmonics and their convention) and `sphere.py` (view
bins and tangent frames).
"""

from prt_bake.mathematics import sh, sphere

__all__ = ["sh", "sphere"]
