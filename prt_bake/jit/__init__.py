"""How numba kernels are compiled, cached and run on several threads, and the LLVM instructions that numba lacks.

May import: nothing of the product. Begin with `compilation.py`.
"""
