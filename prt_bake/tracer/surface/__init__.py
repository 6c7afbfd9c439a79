"""Interfaces: Fresnel reflection, rough GGX boundaries with energy compensation, and what walks meet.

May import: `prt_bake.geometry`, `prt_bake.mathematics` and `prt_bake.jit`. Begin with `interface.py`.
"""
