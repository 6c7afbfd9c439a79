"""Interfaces: Fresnel reflection, rough GGX boundaries with energy compensation, and ray queries by Embree.

May import: `prt_bake.mathematics` and `prt_bake.jit`. Begin with `interface.py`.
"""
