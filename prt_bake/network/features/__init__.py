"""Inputs of the network: Fourier features, averages along the view ray, occupancy toward the light, learned grids.

May import: `prt_bake.network.settings`, `prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit` and `formats`, but
not `prt_bake.network.core` or `inference`. Begin with `view_features.py`. The `*_kernel.py` files are compiled for the
CPU.
"""
