"""The path tracer on a GPU: the walk of `prt_bake.tracer.walk`, compiled for CUDA, with its own search for hits.

May import: `prt_bake.tracer` and what that may import. Begin with `exits.py`. numba-cuda is needed (the extra `cuda`).
"""
