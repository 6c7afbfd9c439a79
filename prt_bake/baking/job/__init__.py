"""A bake with its arguments checked and resolved: bins, basis, sampling, lattices, pilot and time forecast.

May import: `bakers`, `prt_bake.mathematics`, `prt_bake.geometry` and `formats`. Begin with `job.py`.
"""
