"""The training report: the error of a trained model on path-traced queries that were not in its training, with plots.

May import: `prt_bake.rendering`, `prt_bake.comparison`, `prt_bake.trainer` and the rooms below. Begin with `report.py`.
"""
