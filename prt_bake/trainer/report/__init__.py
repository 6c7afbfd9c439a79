"""The training report: the error of a trained model on path-traced queries that were not in its training, with plots.

May import: the rest of `prt_bake.trainer`, and the rooms that it may import. Begin with `report.py`.
"""
