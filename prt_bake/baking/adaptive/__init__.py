"""Bakes to an error that is asked for, or within a time: pilot, passes, interpolated vertices.

`run.py` goes through the passes, `pilot.py` and `tolerances.py` find out how, `passes.py` does one.
May import: `bakers.adaptive`, the other sub-rooms of `prt_bake.baking` except `report`. Begin with `run.py`.
"""
