"""Where baked blocks go: arrays in memory, asset files and checkpoints.

May import: `prt_bake.baking.job`, `prt_bake.baking.pruning`, and the rooms that these may import. Begin with `sink.py`.
"""
