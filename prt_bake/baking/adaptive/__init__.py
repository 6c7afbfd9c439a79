"""Adaptive bakes, to a requested error or within a time: pilot, passes, interpolation between vertices.

`pilot.py` and `tolerances.py` choose the settings of a pass, `passes.py` runs one, `run.py` runs them in sequence.
May import: `bakers.adaptive`, `prt_bake.baking.job`, `.pruning`, `.output`, and the rooms that these may import.
Begin with `run.py`.
"""
