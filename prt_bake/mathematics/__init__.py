"""Spherical harmonics, view bins and direction sets, random and low-discrepancy numbers, statistics, lobes.

May import: `prt_bake.jit` and `formats`. Begin with `sh.py` (harmonics and their convention) and `sphere.py` (view
bins).
"""
