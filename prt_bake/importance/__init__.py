"""The importance module of the paper: a lobe about the normal that says where much light comes through.

May import: `prt_bake.network`, `prt_bake.mathematics`, `bakers` and `formats`. Begin with `module.py`; `fit.py` trains
it.
"""
