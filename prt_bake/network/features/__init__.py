"""Inputs of the network: what a ray of view meets inside the object, what is on the way to the light, learned grids.

May import: `prt_bake.network.settings`, `prt_bake.jit` and `formats`. Begin with `view_features.py`.
"""
