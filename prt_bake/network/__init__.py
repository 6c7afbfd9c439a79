"""The neural BSSRDF: model, settings and checkpoint.

`features` computes the inputs of the network. `inference` evaluates a frozen network fast on CPU and GPU. `core.py` is
the torch module of the layers; `bssrdf.py` adds the frozen forms and the files to it. May import:
`prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `bssrdf.py`. This file imports
nothing, so that `settings` loads without torch.
"""
