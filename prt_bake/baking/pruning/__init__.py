"""What a scene does not need is not baked: hidden vertices, constant views, empty bands, equal channels.

May import: `prt_bake.baking.job` and what that may import. Begin with `pruning.py`.
"""
