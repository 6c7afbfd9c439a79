"""Interfaces: Fresnel, rough microfacet boundaries with energy compensation, ray queries by Embree.

May import: `prt_bake.mathematics` and `prt_bake.jit`. Begin with `interface.py`.
"""
