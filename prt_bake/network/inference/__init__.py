"""Fast evaluation of a frozen network: fused layers on the CPU, Triton kernels on a GPU.

May import: the rest of `prt_bake.network`. Begin with `fused.py`.
"""
