"""Which parts of a bake are redundant: hidden and duplicate vertices, constant views, empty bands, equal channels.

May import: `prt_bake.baking.job`, and the rooms that it may import. Begin with `pruning.py`.
"""
