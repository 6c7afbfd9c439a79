"""The shipped scene, model, sky and reference, the programs that made them, and the demonstration on them.

May import: every room but `cli`, `paper` and `preview`. Start at `demonstration.py`.
"""
