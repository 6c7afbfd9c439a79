"""The neural BSSRDF: model, settings and checkpoint.

`features` computes the inputs of the network, `inference` evaluates a frozen network fast on CPU and GPU.
May import: `prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `bssrdf.py`.
"""
