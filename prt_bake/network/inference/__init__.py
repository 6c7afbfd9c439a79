"""Fast evaluation of a frozen network: fused layers on the CPU, Triton kernels on a GPU.

May import: `prt_bake.network.core`, everything that it may import, and `prt_bake.jit`. Begin with `fused.py`;
`prepared.py` chooses between the forms, and `pairs.py` is the form for pictures.
"""
