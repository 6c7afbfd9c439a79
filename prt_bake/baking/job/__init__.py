"""A bake with its arguments checked and resolved: view bins, pruning, sampling, lattices, pilot and time forecast.

May import: `bakers`, `formats`, `prt_bake.mathematics`, `prt_bake.geometry` and `prt_bake.jit`. Begin with `job.py`.
"""
