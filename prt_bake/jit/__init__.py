"""How numba kernels are compiled, cached and run on several threads, and the LLVM instructions that numba lacks.

May import: nothing else of the product. Begin with `compilation.py`.
"""
