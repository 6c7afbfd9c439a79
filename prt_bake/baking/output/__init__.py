"""Where baked blocks go: arrays, asset files and checkpoints.

May import: `prt_bake.baking.job`, `prt_bake.baking.pruning`, `bakers` and `formats`. Begin with `sink.py`.
"""
